"""The leading modes of several sensors, or of heights, taken below the grid, by all contacts at once.

A cell is wider than the contacts of several sensors leave the pose, so its own pose is far from where they agree: in each of the
likeliest, the pose is sought that suits all contacts (``search``). Directions that one contact leaves open another may tell.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from geomtact.inference.posterior import Posterior
from geomtact.inference.search import Search, View
from geomtact.se3 import Array

_CELLS = 250  # that are looked into, however many modes are asked for: more of them take time and tell no more
# Power of the joint likelihood at one pose; and the share of their mass that the cells looked into keep, whatever is likely
# within them. Chosen, as are the next, on scenes that the study does not judge (docs/several-sensors.md)
_TRUST, _DOUBT = 0.3, 0.03
# The share that all others keep: halved by every contact, at most, and for how likely those looked into are in the mean, as a
# share of the best of them
_ELSEWHERE, _AT_MOST, _AS_LIKELY = 0.4, 0.2, 5.0
_BEFORE = 0.5  # power of what a cell had, against what its likeliest pose explains: both speak of the same images
# nats, for each contact, that a pose explains less than the poses which suit each sensor best: of a right one, of a wrong one
ALIKE, UNLIKE = 4.0, 8.0
_WORTH = 0.5  # power of the likelihood in the evidence
_OUTLINE = 150.0  # nats that each metre of a contact's outline costs even at the right pose


def refine_together(
    posterior: Posterior,
    views: Sequence[View],
    k: int,
    seed: int,
    log_prior: NDArray[np.floating] | None = None,
) -> Posterior:
    """``posterior``, on the first sensor's cells, with its ``k`` leading modes refined against all ``views`` and weighed anew.

    As in ``Refinery.refine``, each cell keeps the pose at which what is seen is likeliest, and what the cells hold together
    is shared out anew by these likelihoods: but only as far as the likeliest pose explains what all sensors show, in the mean
    nearly as well as other poses do what each of them shows. If none does, the right one was not looked into. ``log_prior`` is as
    of ``Posterior.shared_anew``.

    The evidence becomes the mean likelihood under the prior, as far as the cells looked into hold it. ``settings`` tell by how
    many nats a contact the likeliest pose falls short: ``unexplained_nats``, of the poses that suit each sensor best, and, of
    masks alone, ``misfit_nats``, of what is left to chance by the length of the outlines.
    """
    looked_into = posterior.likeliest_cells(_CELLS)
    if not len(looked_into):
        return posterior
    search = Search(posterior, views, np.random.default_rng(seed))
    tried = search.around_the_best(search.registered(search.drawn(looked_into)))
    home, poses, likely = search.best_of_each_cell(tried)

    unexplained = (search.most.sum() - likely.max(initial=-np.inf)) / search.felt
    explains = float(np.clip((UNLIKE - unexplained) / (UNLIKE - ALIKE), 0, 1))
    mass = posterior.cell_log_density(home) + posterior.index.log_weight[home]
    share_elsewhere = _share_elsewhere(mass, _TRUST * likely, search.felt) if search.felt > 1 else 1.0
    doubt, elsewhere = (1 - (1 - share) * explains for share in (_DOUBT, share_elsewhere))
    if len(home):
        known = posterior.index.log_weight if log_prior is None else log_prior
        heights = search.heights(poses)
        explained = known[home] + _WORTH * (likely - heights) + heights
        posterior = replace(posterior, log_evidence=float(np.logaddexp.reduce(explained)))
    posterior = posterior.shared_anew(home, _TRUST * likely, doubt, elsewhere, _BEFORE, log_prior)

    told_at = search.told(posterior, home, poses, k)
    said: dict[str, float | None] = {"unexplained_nats": float(unexplained)}
    if not any(view.measured for view in views):
        outline = np.mean([view.outline for view in search.views[: search.felt]])
        said["misfit_nats"] = float(-likely.max(initial=-np.inf) / search.felt - _OUTLINE * outline)
    said = {name: nats if nats is not None and np.isfinite(nats) else None for name, nats in said.items()}
    return replace(posterior, refined=told_at, settings=posterior.settings | said)


def _share_elsewhere(log_mass: Array, log_likelihood: Array, felt: int) -> float:
    """The share of their mass that cells not looked into keep: a pose may lie there that explains ``felt`` contacts as well as
    the best, but seldom, the more of them there are and the more the best of those looked into, with ``log_mass`` (n,) and
    ``log_likelihood`` (n,), stands out of the others."""
    if len(log_mass) < 2:
        return _AT_MOST
    others = np.arange(len(log_mass)) != log_likelihood.argmax()
    log_mass, beside = log_mass[others], log_likelihood[others] - log_likelihood.max()
    in_the_mean = np.logaddexp.reduce(log_mass + beside) - np.logaddexp.reduce(log_mass)
    return float(min(_AT_MOST, _ELSEWHERE / 2**felt + _AS_LIKELY * np.exp(in_the_mean)))
