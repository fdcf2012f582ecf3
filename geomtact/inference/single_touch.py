"""The posterior of one sensor's image (thesis 6.1), and its leading modes refined (thesis 6.3)."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from geomtact.contact_space.index import Index
from geomtact.inference.effort import Effort
from geomtact.inference.facts import Diagnostics, Provenance, ViewRecord
from geomtact.inference.mode_refiner import ModeRefiner
from geomtact.inference.posterior import Posterior
from geomtact.inference.prior import lost_contact, prior_log_density, prior_log_mass
from geomtact.inference.repeated_images import digest
from geomtact.inference.resolve import LogMass
from geomtact.inference.timing import timed
from geomtact.inference.views import Placed
from geomtact.registration.contact_problem import make_problem
from geomtact.scoring.fitted import FittedScorer
from geomtact.sensing.contact import Contact, SoftMask
from geomtact.sensing.moments import cleaned

_HOLLOW = 0.01  # share of the surface in hollows wider than the window, above which the user is warned; hand-set
# Gain in an image's log evidence without the prior, above which the user is warned [nats]. Derived: by Markov's inequality at
# most one image in exp(5) = 148 exceeds it, where the moments' likelihood is exact and the prior holds.
_CONTRADICTION_NATS = 5.0


def touch_posterior(
    index: Index, scorer: FittedScorer, placed: Placed, prior: Any, provenance: Provenance, seed: int
) -> tuple[Posterior, LogMass]:
    """The posterior of one image on the cells of ``index``, not refined, and the log prior mass of every cell (M,).

    The log prior mass is None without a prior, or without contact.

    Parameters
    ----------
    prior : as of ``Localizer.localize``, opened
    """
    observation, T_frame_sensor, frame = placed.observation, placed.T_frame_sensor, placed.frame
    contact, warnings = observation.contact, [*index.mesh.warnings, *observation.warnings]
    shown, above = _scored(contact)
    posterior = Posterior(
        index,
        np.zeros(0, np.int64),
        np.zeros(0),
        frame,
        T_frame_sensor,
        contact=bool((shown > 0.5).any()),
        seed=seed,
        observations=[observation],
        provenance=replace(provenance, views=(_record(placed, bool((shown > 0.5).any())),)),
        timing_ms={"read": placed.read_ms},
        warnings=warnings,
    )
    if not posterior.contact:
        return replace(posterior, off_contact_log_density=prior_log_density(index, prior, frame)), None
    timing, log_prior = posterior.timing_ms, None
    with timed(timing, "score"):
        if prior is not None:
            log_prior = prior_log_mass(index, prior, T_frame_sensor, frame)
        rows = scorer.rows(index, shown, log_prior, above)
    with timed(timing, "posterior"):
        log_prob = rows.log_prob
        model = scorer.evidence_model
        usual, likeliest = model.evidence(index, shown)
        evidence = usual if log_prior is None else model.evidence(index, shown, log_prior, above)[0]
    if log_prior is not None:
        without_prior = model.evidence(index, shown, index.log_weight, above)[0] if above else usual
        warnings.extend(_contradiction(without_prior - evidence))
    is_outlier = model.is_outlier(usual, likeliest)
    if is_outlier:
        warnings.append(
            "out-of-distribution contact: no simulated touch of this object resembles it; "
            "check the object, the sensor and the mask"
        )
    warnings.extend(hollow_warnings(index.space.hollow))
    calibration = rows.calibration
    posterior = replace(
        posterior,
        cells=rows.cells,
        cell_log_prob=log_prob,
        log_evidence=evidence,
        provenance=replace(
            posterior.provenance, scored_by=rows.by, temperature=calibration.temperature, floor=calibration.floor
        ),
        diagnostics=Diagnostics(is_outlier=is_outlier),
    )
    return posterior, log_prior


def drop_lost_contact_prior(posterior: Posterior, prior: Any) -> tuple[Posterior, Any]:
    """``posterior`` and ``prior``; without the prior where it requires contact but the image shows none."""
    if posterior.contact or not lost_contact(prior, posterior.sensor, posterior.T_frame_sensor):
        return posterior, prior
    warning = (
        "contact was lost: the prior requires contact at this sensor pose, but the image shows none; it is discarded"
    )
    return replace(posterior, off_contact_log_density=None, warnings=[*posterior.warnings, warning]), None


def refine_modes(posterior: Posterior, refiner: ModeRefiner, effort: Effort) -> Posterior:
    """The ``posterior`` of one image with its leading modes refined, where it is resolved within the cells."""
    if posterior.explored is None or posterior.observation is None or not effort.modes:
        return posterior
    with timed(posterior.timing_ms, "refine"):
        contact = posterior.observation.contact
        problem = make_problem(cleaned(contact.soft_mask, posterior.sensor), posterior.sensor, contact.height)
        return refiner.refine(posterior, problem, effort.modes, effort.thorough)


def _scored(contact: Contact) -> tuple[SoftMask, float]:
    """The mask that is scored, and the depth [m] of the gel's contour line that bounds it; 0 without depths.

    At that depth the gel surely lies on the object, which reaches that much deeper.
    """
    if contact.height is not None and contact.height[contact.mask].any():
        return contact.deeper(contact.sure_depth), contact.sure_depth
    return contact.soft_mask, 0.0


def _record(placed: Placed, has_contact: bool) -> ViewRecord:
    observation = placed.observation
    # a mask is the same in whichever two values
    image = observation.contact.mask if observation.kind == "mask" else observation.image
    return ViewRecord(
        placed.T_frame_sensor,
        observation.kind,
        observation.method,
        observation.contact.height is not None,
        has_contact,
        digest(image) if has_contact else None,
    )


def _contradiction(nats: float) -> list[str]:
    """The warning, if any, where an image is ``nats`` likelier without the prior."""
    if not nats > _CONTRADICTION_NATS:
        return []
    return [
        f"the prior and the image contradict each other, by {nats:.0f} nats: check that both are of this touch and object, "
        "and the prior's frame and units"
    ]


def hollow_warnings(share: float) -> list[str]:
    """The warning, if any, of an object with this share of its surface in hollows that are wider than the window."""
    if not share > _HOLLOW:
        return []
    return [
        f"{100 * share:.0f} % of the object's surface lies in hollows wider than the sensor's window, and touches inside them "
        "are mistaken for others: touch from outside, or localize on a mesh of that wall alone"
    ]
