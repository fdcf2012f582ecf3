"""Object identification: the probability of each of several objects, given the images.

An object is as probable as the images are likely if it is the one, in the mean over its poses. A fraction of the contacts shows
that of most objects not: the others are looked at closely.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from geomtact.errors import NoPoseAgreesError, UsageError
from geomtact.inference.effort import LEAST_CONTACTS, Effort, effort_of
from geomtact.inference.posterior import Posterior
from geomtact.inference.views import read_views
from geomtact.localizer import Localizer
from geomtact.se3 import Array
from geomtact.sensing.reading import Observation

# Misfit [nats for 15 mm of outline] of the likeliest pose above which an object is an outlier: 2 of 30 scenes of three touches of
# the right one exceed it, seed 503.
_MISFIT_NATS = 10.0
# Powers of the evidence between objects. Moments: a density fitted to an object's own touches is overconfident about others;
# chosen on 600 simulated touches of ten objects, seed 7777. Contacts: for the log score on 90 scenes of these, seed 503.
_POWER = {"moments": 0.25, "contacts": 0.5}
# Probability that the evidence says nothing, because the right pose was not found: fitted with the power of contacts.
_MISSED = 0.02
_HARDLY = 0.01  # probability, by the least contacts, below which an object is not looked at closely; hand-set


@dataclass(frozen=True)
class Candidate:
    """One of the objects that it may be.

    Attributes
    ----------
    name : of the object
    probability : of this object, among those given
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
    best: tuple[tuple[float, float], Localizer, Posterior] | None = None
    read: dict[tuple[str, ...], list[Observation]] = {}  # by the sensors that read them
    log_weights = None if weights is None else _log_weights(weights)
    if not isinstance(localizers, Iterable):
        raise UsageError(
            f"identify: expected a localizer for each object, got {type(localizers).__name__}; give a list of them"
        )
    for i, localizer in enumerate(localizers):
        if log_weights is not None and i >= len(log_weights):
            raise UsageError(f"identify: expected a weight for each object, got {len(log_weights)} for more")
        sensors = tuple(sensor.to_toml() for sensor in localizer.sensors)
        if sensors not in read:
            read[sensors] = _read(localizer, image, **options)
        weight = 0.0 if log_weights is None else float(log_weights[i])
        try:
            for effort in _efforts(options.get("effort", "balanced")):
                posterior = localizer.localize(read[sensors], **{**options, "effort": effort})
                odds = weight + _POWER[posterior.diagnostics.evidence_of] * posterior.log_evidence
                if best is not None and odds < best[0][0] + np.log(_HARDLY):
                    break
        except NoPoseAgreesError as error:
            found.append((localizer.mesh.name, -np.inf, True))
            log_odds.append(-np.inf)
            last_error = error
            continue
        found.append((localizer.mesh.name, posterior.log_evidence, _is_outlier(posterior)))
        log_odds.append(odds)
        if best is None or (odds, weight) > best[0]:
            best = (odds, weight), localizer, posterior
    if not found:
        raise UsageError("identify: expected objects to choose from, got none")
    if log_weights is not None and len(log_weights) != len(found):
        raise UsageError(f"identify: expected a weight for each of {len(found)} objects, got {len(log_weights)}")
    if best is None:
        raise last_error
    if best[0][1] == -np.inf:
        raise UsageError("identify: no object with a weight above 0 explains the images; give others a weight")
    missed = _MISSED if best[2].diagnostics.evidence_of == "contacts" else 0.0
    probability = _probability(np.array(log_odds), log_weights, missed)
    order = np.argsort(-probability, kind="stable")
    candidates = [Candidate(found[i][0], float(probability[i]), *found[i][1:]) for i in order]
    return Identification(candidates, *best[1:])


def _efforts(effort: str | Effort) -> list[Effort]:
    """The efforts by which an object is looked at, the last one only where the object may be the right one.

    All begin with as many contacts on each of several sensors as on one. With a quarter of them the right pose was missed in 5 of
    60 scenes of three touches (``python -m tools.studies identify``, seed 42), and with it 20 to 45 nats of evidence.
    """
    asked = effort_of(effort)
    if not asked.contacts:
        return [asked]
    asked = replace(asked, first=asked.first or asked.attempts(1)[0])
    roughly = replace(asked, modes=0, contacts=min(asked.contacts, LEAST_CONTACTS), first=LEAST_CONTACTS)
    return [asked] if roughly.contacts == asked.contacts else [roughly, asked]


def _probability(log_odds: Array, log_weights: Array | None, missed: float) -> Array:
    """Probability (n,) of each object, where the evidence says nothing with a probability of ``missed``: all that have a weight
    are as probable then."""
    weights = np.ones(len(log_odds)) if log_weights is None else np.exp(log_weights)
    total, possible = np.logaddexp.reduce(log_odds), weights > 0
    if total == -np.inf:
        return np.asarray(weights / weights.sum())
    return np.asarray((1 - missed) * np.exp(log_odds - total) + missed * possible / possible.sum())


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


def _is_outlier(posterior: Posterior) -> bool:
    found = posterior.diagnostics
    return posterior.contact and (found.is_outlier or (found.misfit_nats or 0.0) > _MISFIT_NATS)
