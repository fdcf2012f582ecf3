"""The leading modes of several sensors, or of depth maps, refined below the grid by all contacts at once.

A cell is wider than the region in which several contacts agree, so its own pose may be far from that region. In each of the
likeliest cells, ``search`` looks for the pose that suits all contacts. One contact may constrain what another leaves open.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from geomtact.inference.distribution import cell_log_density, likeliest_cells
from geomtact.inference.facts import UNEXPLAINED_NATS
from geomtact.inference.posterior import Posterior
from geomtact.inference.reweight import reweight_cells
from geomtact.inference.search import Search, SensorView
from geomtact.se3 import Array

_CELLS = 250  # number of cells that are searched: more cells cost time and add no information
# The next five were chosen on simulated scenes apart from those of the study (docs/several-sensors.md).
_LIKELIHOOD_POWER = 0.3  # power of the joint likelihood at one pose
_KEPT_SHARE = 0.03  # share of their mass that the searched cells keep, whatever the search finds
# Share of their mass that unsearched cells keep: least of ``_OTHERS_MOST`` and ``_OTHERS_BASE`` / 2^contacts +
# ``_OTHERS_SLOPE`` times the mean likelihood of the searched cells relative to the best.
_OTHERS_BASE, _OTHERS_MOST, _OTHERS_SLOPE = 0.4, 0.2, 5.0
_IMAGE_POWER = 0.5  # power of a cell's mass beside the likelihood of its best pose, of the same images; hand-set
EXPLAINED_NATS = 4.0  # unexplained nats per contact up to which the search is trusted in full; hand-set
_EVIDENCE_POWER = 0.5  # power of the likelihood in the evidence, chosen on 22 simulated scenes (docs/which-part.md)


def refine_jointly(
    posterior: Posterior,
    views: Sequence[SensorView],
    k: int,
    seed: int,
    log_prior: NDArray[np.floating] | None = None,
) -> Posterior:
    """``posterior``, on the first sensor's cells, with its ``k`` leading modes refined against all ``views`` and reweighted.

    As in ``ModeRefiner.refine``, each cell keeps its likeliest pose, and these likelihoods share out the mass of the cells.
    That holds only as far as the likeliest pose explains all images nearly as well as other poses explain each of them. If no
    pose does, the search missed the right cell. ``log_prior`` is as of ``reweight_cells``.

    The posterior's diagnostics report ``unexplained_nats``. Where the evidence is not that of contacts, it becomes the mean
    likelihood of the pixels under the prior, over the searched cells.
    """
    searched = likeliest_cells(posterior, _CELLS)
    if not len(searched):
        return posterior
    search = Search(posterior, views, np.random.default_rng(seed))
    candidates = search.around_the_best(search.registered(search.drawn(searched)))
    home, poses, likely = search.best_of_each_cell(candidates)

    unexplained = (search.best.sum() - likely.max(initial=-np.inf)) / search.n_contacts
    explains = float(np.clip((UNEXPLAINED_NATS - unexplained) / (UNEXPLAINED_NATS - EXPLAINED_NATS), 0, 1))
    mass = cell_log_density(posterior, home) + posterior.index.log_weight[home]
    others = 1.0
    if search.n_contacts > 1:
        others = _others_factor(mass, _LIKELIHOOD_POWER * likely, search.n_contacts)
    kept_share, others_factor = (1 - (1 - share) * explains for share in (_KEPT_SHARE, others))
    diagnostics = replace(posterior.diagnostics, unexplained_nats=_finite_or_inf(unexplained))
    if len(home) and diagnostics.evidence_of != "contacts":
        diagnostics = replace(diagnostics, evidence_of="pixels")
        prior = posterior.index.log_weight if log_prior is None else log_prior
        by_depth = search.depth_log_likelihood(poses)
        explained = prior[home] + _EVIDENCE_POWER * (likely - by_depth) + by_depth
        posterior = replace(posterior, log_evidence=float(np.logaddexp.reduce(explained)))
    posterior = reweight_cells(
        posterior, home, _LIKELIHOOD_POWER * likely, kept_share, others_factor, _IMAGE_POWER, log_prior
    )

    return replace(posterior, refined=search.refined(posterior, home, poses, k), diagnostics=diagnostics)


def _finite_or_inf(nats: float) -> float:
    """``nats``; inf where no pose was found that all images allow."""
    return float(nats) if np.isfinite(nats) else np.inf


def _others_factor(log_mass: Array, log_likelihood: Array, n_contacts: int) -> float:
    """Factor on the mass of cells that were not searched, given ``log_mass`` (n,) and ``log_likelihood`` (n,) of those that were.

    A pose there may explain all contacts as well as the best. That is less likely with more contacts, and where the best of the
    searched cells stands out.
    """
    if len(log_mass) < 2:
        return _OTHERS_MOST
    others = np.arange(len(log_mass)) != log_likelihood.argmax()
    log_mass, beside = log_mass[others], log_likelihood[others] - log_likelihood.max()
    mean = np.logaddexp.reduce(log_mass + beside) - np.logaddexp.reduce(log_mass)
    return float(min(_OTHERS_MOST, _OTHERS_BASE / 2**n_contacts + _OTHERS_SLOPE * np.exp(mean)))
