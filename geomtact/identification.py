"""Object identification: the probability of each of several objects, given the images."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from geomtact.errors import NoPoseAgreesError, UsageError
from geomtact.inference.effort import effort_of
from geomtact.inference.facts import UNEXPLAINED_NATS
from geomtact.inference.posterior import Posterior
from geomtact.inference.views import read_views
from geomtact.localizer import Localizer
from geomtact.se3 import Array
from geomtact.sensing.reading import Observation

# Misfit [nats per contact] of the likeliest pose of several contacts above which an object is an outlier: the true object
# exceeds it in 5 % of 22 simulated scenes, seed 77.
_MISFIT_NATS = 4.6
# Power of the moments' evidence between objects: a density fitted to an object's own touches is overconfident about others.
# Chosen on 600 simulated touches of ten objects, seed 7777.
_MOMENTS_POWER = 0.25


@dataclass(frozen=True)
class Candidate:
    """One of the objects that it may be.

    Attributes
    ----------
    name : of the object
    probability : of this object, among those given; evidence of moments has the power 0.25, of pixels 1
    log_evidence : of the images under this object; -inf where no pose agrees with all sensors
    is_outlier : whether hardly any touch of this object is so unlikely, or no pose explains all contacts
    """

    name: str
    probability: float
    log_evidence: float
    is_outlier: bool


@dataclass(frozen=True, eq=False)
class Identification:
    """The object, and its pose.

    Attributes
    ----------
    candidates : the most probable first
    localizer, posterior : of the most probable object
    """

    candidates: list[Candidate]
    localizer: Localizer
    posterior: Posterior

    @property
    def is_unknown(self) -> bool:
        """Whether the images are outliers for all of the objects."""
        return all(candidate.is_outlier for candidate in self.candidates)


def identify(
    localizers: Iterable[Localizer], image: Any, weights: Sequence[float] | None = None, **options: Any
) -> Identification:
    """The probabilities of objects, and the pose of the most probable, given the images of one sensor or several.

    Parameters
    ----------
    localizers : one per object, all prepared for the same sensors; of a generator, the best so far is held and one other
    image : as of ``Localizer.localize``
    weights : (n,) prior probability of each object, up to a factor; equal by default
    options : of ``Localizer.localize``; a ``prior`` is in each object's own frame

    Raises
    ------
    UsageError
        There is no list of objects, or not one weight for each; or no object with a weight above 0 explains the images.
    NoPoseAgreesError
        No object has a pose that all sensors agree with.
    """
    found: list[tuple[str, float, bool]] = []  # name, evidence, is_outlier
    log_odds: list[float] = []
    best: tuple[float, Localizer, Posterior] | None = None
    read: dict[tuple[str, ...], list[Observation]] = {}  # by the sensors that read them
    log_weights = None if weights is None else _log_weights(weights)
    if not isinstance(localizers, Iterable):
        raise UsageError(
            f"identify: expected a localizer for each object, got {type(localizers).__name__}; give a list of them"
        )
    asked = effort_of(options.get("effort", "balanced"))
    # poses are resolved within the cells for the most probable object alone
    evidence = replace(asked, contacts=0, several=0)
    for i, localizer in enumerate(localizers):
        if log_weights is not None and i >= len(log_weights):
            raise UsageError(f"identify: expected a weight for each object, got {len(log_weights)} for more")
        try:
            sensors = _sensors(localizer)
            if sensors not in read:
                read[sensors] = _read(localizer, image, **options)
            posterior = localizer.localize(read[sensors], **{**options, "effort": evidence})
        except NoPoseAgreesError as error:
            found.append((localizer.mesh.name, -np.inf, True))
            log_odds.append(-np.inf)
            last_error = error
            continue
        found.append((localizer.mesh.name, posterior.log_evidence, _is_outlier(posterior)))
        log_odds.append(
            _evidence_power(posterior) * posterior.log_evidence
            + (0.0 if log_weights is None else float(log_weights[i]))
        )
        if best is None or log_odds[-1] > best[0]:
            best = log_odds[-1], localizer, posterior
    if not found:
        raise UsageError("identify: expected objects to choose from, got none")
    if log_weights is not None and len(log_weights) != len(found):
        raise UsageError(f"identify: expected a weight for each of {len(found)} objects, got {len(log_weights)}")
    if best is None:
        raise last_error
    if best[0] == -np.inf:
        raise UsageError("identify: no object with a weight above 0 explains the images; give others a weight")
    probability = np.exp(log_odds - np.logaddexp.reduce(log_odds))
    order = np.argsort(-probability, kind="stable")
    _, localizer, posterior = best
    if evidence != asked:
        posterior = localizer.localize(read[_sensors(localizer)], **options)
    candidates = [Candidate(found[i][0], float(probability[i]), *found[i][1:]) for i in order]
    return Identification(candidates, localizer, posterior)


def _sensors(localizer: Localizer) -> tuple[str, ...]:
    return tuple(sensor.to_toml() for sensor in localizer.sensors)


def _read(
    localizer: Localizer,
    image: Any,
    kind: str = "auto",
    background: Any = None,
    T_world_sensor: Any = None,
    **_: Any,
) -> list[Observation]:
    views = read_views(image, T_world_sensor, localizer.sensors, kind, background)
    return [view.observation for view in views]


def _log_weights(weights: Sequence[float]) -> Array:
    given = np.asarray(weights, float)
    if given.ndim != 1 or not np.isfinite(given).all() or (given < 0).any() or not given.sum() > 0:
        raise UsageError(f"identify: expected weights >= 0, one per object, got {weights}")
    with np.errstate(divide="ignore"):
        return np.asarray(np.log(given / given.sum()))


def _evidence_power(posterior: Posterior) -> float:
    """Power of the evidence: 1 where pixels were compared, less where only moments were."""
    return 1.0 if posterior.diagnostics.unexplained_nats is not None else _MOMENTS_POWER


def _is_outlier(posterior: Posterior) -> bool:
    found = posterior.diagnostics
    return posterior.contact and (
        found.is_outlier
        or (found.unexplained_nats or 0.0) > UNEXPLAINED_NATS
        or (found.misfit_nats or 0.0) > _MISFIT_NATS
    )
