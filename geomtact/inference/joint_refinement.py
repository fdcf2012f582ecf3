"""The leading modes of several sensors, or of heights, taken below the grid, by all contacts at once.

A cell is wider than the contacts of several sensors leave the pose, so its own pose is far from where they agree: in each of the
likeliest, the pose is sought that suits all contacts (``search``). Directions that one contact leaves open another may tell.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from geomtact.inference.distribution import cell_log_density, likeliest_cells
from geomtact.inference.posterior import Posterior
from geomtact.inference.reweight import reweight_cells
from geomtact.inference.search import Search, SensorView
from geomtact.se3 import Array

_CELLS = 250  # that are looked into, however many modes are asked for: more of them take time and tell no more
# Power of the joint likelihood at one pose; and the share of their mass that the cells looked into keep, whatever is likely
# within them. Chosen, as are the next, on scenes that the study does not judge (docs/several-sensors.md)
_LIKELIHOOD_POWER, _KEPT_SHARE = 0.3, 0.03
# The share that all others keep: halved by every contact, at most, and for how likely those looked into are in the mean, as a
# share of the best of them
_OTHERS, _AT_MOST, _AS_LIKELY = 0.4, 0.2, 5.0
_IMAGE_POWER = 0.5  # power of what a cell had, against what its likeliest pose explains: both speak of the same images
# nats, for each contact, that a pose explains less than the poses which suit each sensor best: of a right one, of a wrong one
ALIKE, UNLIKE = 4.0, 8.0
_EVIDENCE_POWER = 0.5  # power of the likelihood in the evidence
_OUTLINE = 150.0  # nats that each metre of a contact's outline costs even at the right pose


def refine_jointly(
    posterior: Posterior,
    views: Sequence[SensorView],
    k: int,
    seed: int,
    log_prior: NDArray[np.floating] | None = None,
) -> Posterior:
    """``posterior``, on the first sensor's cells, with its ``k`` leading modes refined against all ``views`` and weighed anew.

    As in ``ModeRefiner.refine``, each cell keeps the pose at which what is seen is likeliest, and what the cells hold together
    is shared out anew by these likelihoods: but only as far as the likeliest pose explains what all sensors show, in the mean
    nearly as well as other poses do what each of them shows. If none does, the right one was not looked into. ``log_prior`` is as
    of ``reweight_cells``.

    The evidence becomes the mean likelihood under the prior, as far as the cells looked into hold it. The posterior's
    diagnostics report ``unexplained_nats`` and, of masks alone, ``misfit_nats``.
    """
    searched = likeliest_cells(posterior, _CELLS)
    if not len(searched):
        return posterior
    search = Search(posterior, views, np.random.default_rng(seed))
    candidates = search.around_the_best(search.registered(search.drawn(searched)))
    home, poses, likely = search.best_of_each_cell(candidates)

    unexplained = (search.best.sum() - likely.max(initial=-np.inf)) / search.n_contacts
    explains = float(np.clip((UNLIKE - unexplained) / (UNLIKE - ALIKE), 0, 1))
    mass = cell_log_density(posterior, home) + posterior.index.log_weight[home]
    others = 1.0
    if search.n_contacts > 1:
        others = _others_factor(mass, _LIKELIHOOD_POWER * likely, search.n_contacts)
    kept_share, others_factor = (1 - (1 - share) * explains for share in (_KEPT_SHARE, others))
    if len(home):
        prior = posterior.index.log_weight if log_prior is None else log_prior
        heights = search.heights(poses)
        explained = prior[home] + _EVIDENCE_POWER * (likely - heights) + heights
        posterior = replace(posterior, log_evidence=float(np.logaddexp.reduce(explained)))
    posterior = reweight_cells(
        posterior, home, _LIKELIHOOD_POWER * likely, kept_share, others_factor, _IMAGE_POWER, log_prior
    )

    misfit = None
    if not any(view.has_height for view in views):
        outline = np.mean([view.outline for view in search.views[: search.n_contacts]])
        misfit = _finite_or_inf(-likely.max(initial=-np.inf) / search.n_contacts - _OUTLINE * outline)
    diagnostics = replace(posterior.diagnostics, unexplained_nats=_finite_or_inf(unexplained), misfit_nats=misfit)
    return replace(posterior, refined=search.refined(posterior, home, poses, k), diagnostics=diagnostics)


def _finite_or_inf(nats: float) -> float:
    """``nats``; inf where no pose was found that all images allow."""
    return float(nats) if np.isfinite(nats) else np.inf


def _others_factor(log_mass: Array, log_likelihood: Array, n_contacts: int) -> float:
    """Factor on the mass of cells that were not searched, given ``log_mass`` (n,) and ``log_likelihood`` (n,) of those that were.

    A pose there may explain all contacts as well as the best. That is the less likely, the more contacts there are and the more
    the best of the searched cells stands out.
    """
    if len(log_mass) < 2:
        return _AT_MOST
    others = np.arange(len(log_mass)) != log_likelihood.argmax()
    log_mass, beside = log_mass[others], log_likelihood[others] - log_likelihood.max()
    in_the_mean = np.logaddexp.reduce(log_mass + beside) - np.logaddexp.reduce(log_mass)
    return float(min(_AT_MOST, _OTHERS / 2**n_contacts + _AS_LIKELY * np.exp(in_the_mean)))
