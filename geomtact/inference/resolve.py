"""Poses resolved within the cells of the grid, by the contacts that are cut at them: on one sensor, or on several."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geomtact.contact_space.cell_transfer import ExtrinsicsStd
from geomtact.inference.effort import Effort
from geomtact.inference.particles import OtherSensor
from geomtact.inference.pose_prior import prior_at_poses
from geomtact.inference.posterior import Posterior
from geomtact.inference.registered import Search
from geomtact.inference.timing import timed
from geomtact.inference.two_runs import explore_twice
from geomtact.scoring.contact_likelihood import POWERS, ContactQuery, indentation_of
from geomtact.scoring.fitted import FittedScorer
from geomtact.se3 import Array, inverse

_UNCONFIRMED = "half of the probability is left on the grid's cells; cut more contacts: --effort exact"
LogMass = NDArray[np.floating] | None  # (M,) of every cell of an index; None for the uniform's


def resolve_touch(
    posterior: Posterior,
    prior: Any,
    log_prior: LogMass,
    scorer: FittedScorer,
    effort: Effort,
    alone: Posterior | None = None,
) -> Posterior:
    """The ``posterior`` of one image, resolved within the cells by the contacts of ``effort``.

    It is as it was without contact. ``prior`` and ``log_prior`` are as of ``single_touch.touch_posterior``,
    ``alone`` is the posterior of the same image without them, where that is known.
    """
    if log_prior is None:
        return resolve_touches(posterior, [posterior], None, None, effort)
    log_coarse = None
    if alone is not None:
        log_coarse = _log_mass(alone)
    elif effort.contacts and posterior.contact and posterior.observation is not None:
        # cells that the prior rules out have no mass in the posterior
        log_coarse = scorer.log_mass(posterior.index, posterior.observation.contact.soft_mask)
    return resolve_touches(posterior, [posterior], prior, log_prior, effort, log_coarse=log_coarse)


def resolve_touches(
    posterior: Posterior,
    touches: Sequence[Posterior],
    prior: Any,
    log_prior: LogMass,
    effort: Effort,
    extrinsics_std: ExtrinsicsStd | None = None,
    search: Search | None = None,
    log_coarse: LogMass = None,
) -> Posterior:
    """The ``posterior`` of several sensors, resolved within the cells of the first with contact.

    ``touches``, ``prior`` and ``log_prior`` are as of ``fusion.fused_posterior``. ``log_coarse`` (P, n) is the log mass of the
    cells without the prior, by default that of ``posterior``, divided by the prior.
    """
    if not effort.contacts or not any(touch.contact and touch.observation for touch in touches):
        return posterior
    index, at_poses = posterior.index, None
    with timed(posterior.timing_ms, "explore"):
        if log_prior is not None:
            in_cells = np.where(index.log_weight > -np.inf, log_prior - np.maximum(index.log_weight, -1e3), -np.inf)
            at_poses = prior_at_poses(index, in_cells, prior, posterior.T_frame_sensor)
        if log_coarse is None:
            log_coarse = _log_mass(posterior)
            if at_poses is not None:  # in logarithms: a narrow prior has densities that no number holds
                possible = np.isfinite(in_cells)
                log_coarse = np.where(possible, log_coarse - np.where(possible, in_cells, 0), -np.inf)
            log_coarse = log_coarse - log_coarse.max()
        coarse = np.exp(log_coarse).reshape(index.weight.shape).sum(0, dtype=float)
        first = next(touch for touch in touches if touch.contact)
        others = [
            OtherSensor(
                touch.index, _query(touch), inverse(touch.T_frame_sensor) @ first.T_frame_sensor, extrinsics_std
            )
            for touch in touches
            if touch is not first
        ]
        rng = np.random.default_rng(posterior.seed)
        found = explore_twice(
            index, _query(first), coarse, effort.attempts(len(touches)), rng, at_poses, others, search
        )
    diagnostics = replace(
        posterior.diagnostics,
        evidence_of="contacts",
        misfit_nats=found.misfit_nats,
        unexplained_nats=found.unexplained_nats,
    )
    posterior = replace(posterior, log_evidence=found.log_evidence)
    explored = found.explored
    if explored is None:
        warning = f"the pose is not resolved within the grid's cells: {found.why_not}"
        return replace(posterior, diagnostics=diagnostics, warnings=[*posterior.warnings, warning])
    settled = explored.density.trust == 1
    power = explored.density.powers[-1] / POWERS[-1] if settled else 0.0
    warnings = [] if settled else [f"{found.why_not}: {_UNCONFIRMED}"]
    return replace(
        posterior,
        explored=explored,
        diagnostics=replace(diagnostics, settled_power=power),
        warnings=posterior.warnings + warnings,
    )


def _log_mass(posterior: Posterior) -> Array:
    """Log mass (N,) of every cell of its index."""
    out = np.full(len(posterior.index), -np.inf)
    out[posterior.cells] = posterior.cell_log_prob
    return out


def _query(touch: Posterior) -> ContactQuery:
    assert touch.observation is not None
    source = "mask" if touch.observation.method is None else "image"
    contact = touch.observation.contact
    return ContactQuery.of(contact.soft_mask, touch.sensor, source, indentation_of(contact, touch.sensor))
