"""Several sensors on one object: the product of their likelihoods (thesis 6.2 and its appendix).

    P(T | LS_1 .. LS_N)  is proportional to  P(T) P(LS_1 | T) .. P(LS_N | T)

Each sensor's posterior, relative to the uniform distribution on its own contact pose space, is its likelihood up to a
constant. All are transferred to the cells of one sensor, the first that has contact. A sensor without contact counts against
the poses at which the object would touch it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geomtact.contact_space.cell_transfer import CellTransfer, ExtrinsicsStd
from geomtact.errors import NoPoseAgreesError
from geomtact.inference.densities import NoContactDensity
from geomtact.inference.distribution import Refined, cell_densities
from geomtact.inference.effort import Effort
from geomtact.inference.extrinsics import extrinsics_covariance
from geomtact.inference.facts import UNEXPLAINED_NATS, Diagnostics
from geomtact.inference.mode_refiner import ModeRefiner
from geomtact.inference.posterior import Posterior
from geomtact.inference.prior import prior_log_density, prior_log_mass
from geomtact.inference.resolve import resolve_touches
from geomtact.inference.single_touch import hollow_warnings
from geomtact.inference.timing import timed
from geomtact.log_mass import normalised
from geomtact.registration.contact_problem import make_problem
from geomtact.registration.protocol import Problem
from geomtact.se3 import Array, inverse
from geomtact.sensing.contact import Contact
from geomtact.sensing.moments import cleaned
from geomtact.sensing.sensor import Sensor
from geomtact.threads import thread_count

# Least correlation between the log densities of two sensors, because a cell's width hides the same part of the pose from both.
# Hand-set; its effect was measured on simulated scenes apart from those of the study (docs/evaluation-several-sensors.md).
_LEAST_CORRELATION = 0.1
_NEGLIGIBLE_NATS = 25.0  # log density below that of the most probable place from which a place has no weight; hand-set
_UNLIKELY_DENSITY = 0.1  # density relative to the uniform below which a place is transferred by one pose; hand-set
_DISAGREES_NATS = -2.0  # support of the other sensors for an image below which a disagreement is reported; hand-set
_POINTS, _ROUGH_POINTS = 60, 20  # of an outline, at most, to register modes, and many poses; hand-set


@dataclass(frozen=True, eq=False)
class Fused:
    """The product of several posteriors.

    Attributes
    ----------
    cells : (n,) of the index of the first sensor that has contact
    log_prob : (n,) log probability of each, normalised
    first : which sensor that is
    weight : (N,) power of each sensor's likelihood: less than 1 where sensors correlate
    log_evidence : log of the mean over the prior, on the first sensor's space, of the product of densities so weighed
    support : (N,) for each sensor, the log likelihood of its image under the others, relative to the uniform; 0 for one
    """

    cells: NDArray[np.int64]
    log_prob: NDArray[np.floating]
    first: int
    weight: Array
    log_evidence: float
    support: Array


def fuse(
    posteriors: Sequence[Posterior],
    log_prior: NDArray[np.floating] | None = None,
    extrinsics_std: ExtrinsicsStd | None = None,
) -> Fused:
    """The product of the posteriors of N sensors that touch, or do not touch, one object at the same time.

    Parameters
    ----------
    posteriors : of the single sensors under the uniform prior, all in the world frame, one of them with contact
    log_prior : (M,) log mass of every cell of the first index with contact, the uniform's where it is None
    extrinsics_std : uncertainty of the sensors' poses relative to each other

    Raises
    ------
    NoPoseAgreesError
        No pose of the object agrees with all sensors; names the one that disagrees, where one does.
    """
    first = next(i for i, posterior in enumerate(posteriors) if posterior.contact)
    base, others = posteriors[first], [i for i in range(len(posteriors)) if i != first]
    index = base.index
    log_prior = index.log_weight if log_prior is None else log_prior
    density = cell_densities(base).reshape(len(index.height), -1)
    prior = np.exp(log_prior.astype(np.float32)).reshape(density.shape)
    # the other sensors do not distinguish the penetrations of a place
    place_prior = prior.sum(0, dtype=float)
    place_mass = np.einsum("pn,pn->n", prior, density).astype(float)
    unlikely = place_mass < _UNLIKELY_DENSITY * place_prior

    def likelihood_of(other: Posterior) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
        T_other_first = inverse(other.T_frame_sensor) @ base.T_frame_sensor
        return _likelihood(
            CellTransfer(index, other.index, T_other_first, extrinsics_std or ExtrinsicsStd()), other, unlikely
        )

    with ThreadPoolExecutor(thread_count()) as pool:  # whole sensors, for parts of one would wait for each other
        likelihoods = list(pool.map(likelihood_of, [posteriors[i] for i in others]))
    seen, uniform = [each[0].astype(float) for each in likelihoods], [each[1] for each in likelihoods]
    total = float(_product(place_mass, seen).sum())
    without = [_product(place_prior, seen), *(_product(place_mass, seen, i) for i in range(len(seen)))]
    order = [first, *others]
    if not total > 0:
        raise NoPoseAgreesError(_excluded(base.mesh.name, order, [float(each.sum()) for each in without]))
    with np.errstate(divide="ignore"):
        support = np.zeros(len(order))
        support[order] = [
            np.log(total / without[0].sum()),
            *map(partial(_support, total, place_prior), without[1:], uniform),
        ]
        logs = np.log([np.divide(place_mass, place_prior, out=np.zeros_like(place_mass), where=place_prior > 0), *seen])
        share = _shares(np.log(place_prior), logs, np.array([posteriors[i].contact for i in order]))
        log_prob = np.float32(share[0]) * np.log(density) + (share[1:, None] * logs[1:]).sum(0).astype(np.float32)
    log_prob = log_prob.reshape(-1) + log_prior
    cells = np.flatnonzero(np.isfinite(log_prior))
    joint = normalised(log_prob[cells])
    top = int(joint.argmax())
    weight = np.zeros(len(order))
    weight[order] = share
    return Fused(cells, joint, first, weight, float(log_prob[cells[top]] - joint[top]), support)


def fused_posterior(
    touches: Sequence[Posterior],
    mode_refiners: Sequence[ModeRefiner],
    prior: Any,
    effort: Effort,
    extrinsics_std: ExtrinsicsStd | None = None,
) -> Posterior:
    """The posterior of all sensors together, on the cells of the first that has contact, its leading modes refined.

    Masks are resolved within the cells, where the sensors' poses are known.

    Parameters
    ----------
    touches : posteriors of the single sensors under the uniform prior, not refined, in the world frame
    mode_refiners : of the object on each sensor
    prior : as in ``Localizer.localize``
    effort : how many modes are refined, and by how many contacts the pose is resolved

    Raises
    ------
    NoPoseAgreesError
        As :func:`fuse`.
    """
    if not any(touch.contact for touch in touches):
        return _without_contact(touches, prior)
    first = next(touch for touch in touches if touch.contact)
    timing = {stage: sum(t.timing_ms.get(stage, 0.0) for t in touches) for stage in ("read", "score", "posterior")}
    log_prior = None
    with timed(timing, "fuse"):
        if prior is not None:
            log_prior = prior_log_mass(first.index, prior, first.T_frame_sensor, first.frame)
        fused = fuse(touches, log_prior, extrinsics_std)
    against = disagreement(fused, prior is not None)
    posterior = replace(
        first,
        cells=fused.cells,
        cell_log_prob=fused.log_prob,
        log_evidence=float(fused.weight @ [t.log_evidence for t in touches]) + fused.log_evidence,
        timing_ms=timing,
        **_of_all(touches, None if against is None else [against]),
    )
    others = [touch.T_frame_sensor for touch in touches if touch.contact and touch is not first]
    uncertain = bool(others) and extrinsics_std not in (None, ExtrinsicsStd())
    touching = [(touch, touch.observation) for touch in touches if touch.contact and touch.observation]
    shown = [(observation.contact, touch.sensor) for touch, observation in touching]
    T_first_sensor = inverse(first.T_frame_sensor) @ np.stack([touch.T_frame_sensor for touch, _ in touching])
    refiner = mode_refiners[posterior.provenance.base]
    search = None
    if effort.contacts:
        search = refiner.searching(posterior.index, joint_problem(shown, T_first_sensor, _ROUGH_POINTS))
    posterior = resolve_touches(posterior, touches, prior, log_prior, effort, extrinsics_std, search)
    if posterior.explored is not None and effort.modes:
        with timed(timing, "refine"):
            posterior = refiner.refine(posterior, joint_problem(shown, T_first_sensor), effort.modes, effort.thorough)
    if uncertain:
        assert extrinsics_std is not None
        posterior = replace(posterior, refined=_widened(posterior, np.stack(others), extrinsics_std))
    elif others and against is None:
        warnings = poor_agreement(posterior.diagnostics.unexplained_nats, UNEXPLAINED_NATS, prior is not None)
        posterior = replace(posterior, warnings=posterior.warnings + warnings)
    return posterior


def joint_problem(shown: Sequence[tuple[Contact, Sensor]], T_first_sensor: Array, max_points: int = _POINTS) -> Problem:
    """All contacts, each ``shown`` by a sensor at ``T_first_sensor`` (n, 4, 4), together, with so many points of each outline at
    most."""
    problems = [
        make_problem(cleaned(contact.soft_mask, sensor), sensor, contact.height, max_points=max_points)
        for contact, sensor in shown
    ]
    return Problem.joined(problems, T_first_sensor)


def _widened(posterior: Posterior, T_frame_sensor: Array, extrinsics_std: ExtrinsicsStd) -> dict[int, Refined]:
    """The refined modes, with the uncertainty of where the other sensors (n, 4, 4) are added to their covariances."""
    seen = inverse(posterior.T_frame_sensor) @ T_frame_sensor
    return {
        cell: replace(each, covariance=each.covariance + extrinsics_covariance(each.T, seen, extrinsics_std))
        for cell, each in posterior.refined.items()
    }


def poor_agreement(unexplained_nats: float | None, most: float, with_prior: bool = False) -> list[str]:
    """The warning, if any, that no pose explains all images nearly as well as others explain each of them: but for ``most``
    nats a contact."""
    if unexplained_nats is None or unexplained_nats <= most:
        return []
    left = f"leaves {unexplained_nats:.1f} nats a contact unexplained"
    if not np.isfinite(unexplained_nats):
        left = "does not suit all of them"
    return [
        f"the sensors agree badly: the likeliest pose {left}, rarely more than {most:g} nats where sensor poses and "
        f"contacts are right; check {'the prior, ' * with_prior}T_world_sensor, the contacts that were found, whether one of "
        "them touches something else, or whether the object reaches deeper than the sensor's housing_depth outside its window; "
        "or give the uncertainty of the sensor poses (std_mm, std_deg)"
    ]


def _without_contact(touches: Sequence[Posterior], prior: Any) -> Posterior:
    """The posterior when no sensor has contact: the prior, restricted to poses that touch none of them."""
    first, others = touches[0], touches[1:]
    density = NoContactDensity(others, prior_log_density(first.index, prior, first.frame))
    return replace(first, off_contact_log_density=density, **_of_all(touches))


def _of_all(touches: Sequence[Posterior], disagreements: Sequence[str] | None = None) -> dict[str, Any]:
    """Fields of the joint posterior that collect those of all ``touches``, in their order; warnings with the sensor's number."""
    first = next((touch for touch in touches if touch.contact), touches[0])
    of_object = [*first.index.mesh.warnings, *(hollow_warnings(first.index.space.hollow) if first.contact else [])]
    warnings = list(of_object)
    for i, touch in enumerate(touches, 1):
        own = [warning for warning in touch.warnings if warning not in of_object]
        warnings += [f"sensor {i}: {warning}" for warning in (*own, *_not_found(touch))]
    return {
        "observations": [o for touch in touches for o in touch.observations],
        "provenance": replace(first.provenance, views=tuple(v for t in touches for v in t.provenance.views)),
        "diagnostics": Diagnostics(
            is_outlier=any(t.diagnostics.is_outlier for t in touches), disagrees=disagreements is not None
        ),
        "warnings": warnings + list(disagreements or []),
    }


def _not_found(touch: Posterior) -> list[str]:
    """The warning, if any, that no contact was found in a camera image."""
    if touch.contact or touch.observation is None or touch.observation.method is None:
        return []
    return [
        "no contact was found in its image, which counts against poses that touch there; if it does touch the object, leave it "
        "out, or give its contact mask"
    ]


def disagreement(fused: Fused, with_prior: bool = False) -> str | None:
    """The warning, if any, that the others, or the prior, contradict a sensor."""
    against = np.flatnonzero(fused.support < _DISAGREES_NATS)
    if not len(against):
        return None
    if len(fused.support) == 2:
        return (
            "the two sensors disagree: hardly any pose agrees with both; check "
            f"{'the prior, ' * with_prior}T_world_sensor (sensor to world, not the inverse), or whether one of them touches "
            "something else"
        )
    worst = int(against[fused.support[against].argmin()])
    return (
        f"sensor {worst + 1} of {len(fused.support)} disagrees with the others: they make what it shows less likely than chance "
        f"does; check {'the prior, ' * with_prior}its T_world_sensor (sensor to world, not the inverse), or whether it touches "
        "something else"
    )


def _likelihood(
    transfer: CellTransfer, other: Posterior, unlikely: NDArray[np.bool_]
) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
    """Likelihood (n,) of what ``other`` shows at each place of ``transfer.here``, and of its contact, or its lack."""
    if not other.contact:
        free = transfer.no_contact_likelihood()
        return free, free
    return transfer.mean(cell_densities(other), unlikely)


def _shares(log_prior: Array, logs: Array, has_contact: NDArray[np.bool_]) -> Array:
    """The power (N,) of each of N sensors, given the log density (N, n) that each gives n places.

    Sensors whose log densities correlate over the possible places repeat one another, errors included. So each gets the power
    1 / (1 + the sum of its correlations with the others). One without contact gets the power 1.
    """
    share, logs = np.ones(len(logs)), logs[has_contact]
    if len(logs) < 2:
        return share
    joint = log_prior + logs.mean(0)
    top = joint.max(initial=-np.inf)
    if top == -np.inf:
        return share
    possible = joint > top - _NEGLIGIBLE_NATS
    logs = logs[:, possible]
    weight = np.exp(normalised(joint[possible]))
    # einsum, not @: over so many places a product of matrices waits for its threads longer than it computes
    off = (logs - np.einsum("in,n->i", logs, weight)[:, None]) * np.sqrt(weight)
    covariance = np.einsum("in,jn->ij", off, off)
    std = np.sqrt(np.maximum(covariance.diagonal(), 1e-12))
    correlation = np.clip(covariance / np.outer(std, std), _LEAST_CORRELATION, 1)
    np.fill_diagonal(correlation, 1)
    share[has_contact] = 1 / correlation.sum(1)
    return share


def _support(total: float, touched: Array, without: Array, uniform: Array) -> float:
    """Log likelihood [nats] of a sensor's image under the others, relative to the uniform over the poses that touch it.

    That the sensor is touched at all counts only where the others make it less likely than chance does.

    Parameters
    ----------
    total : mass of the product of all densities
    touched : (n,) prior mass of the places
    without : (n,) the product of all but this sensor's
    uniform : (n,) share of each place that touches it, or does not, as it shows
    """
    expected = float(np.einsum("n,n->", without, uniform))
    by_touch = np.log(expected / without.sum() / float(np.einsum("n,n->", touched, uniform)))
    return float(np.log(total / expected) + min(0.0, by_touch))


def _product(mass: Array, densities: Sequence[Array], left_out: int | None = None) -> Array:
    """``mass`` (n,) times all ``densities`` (n,) but one."""
    return math.prod((each for i, each in enumerate(densities) if i != left_out), start=mass)


def _excluded(name: str, order: Sequence[int], rest: Sequence[float]) -> str:
    """The error message where no pose agrees with all sensors; ``rest`` is the mass that all but one of them leave."""
    possible = [i for i, mass in zip(order, rest, strict=True) if mass > 0]
    if len(order) > 2 and len(possible) == 1:
        return (
            f"T_world_sensor: no pose of {name} agrees with sensor {possible[0] + 1} and with all others, which agree with "
            "each other; check that sensor's pose (metres) and image"
        )
    which = "both" if len(order) == 2 else f"all {len(order)}"
    return (
        f"T_world_sensor: no pose of {name} agrees with {which} sensors; check their poses (metres, sensor to world; "
        "perhaps the matrices are inverted) and that they touch the same object"
    )
