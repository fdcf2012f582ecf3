"""Object identification: which of several objects is it, by how likely each makes the images."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from geomtact.errors import NoPoseAgreesError, UsageError
from geomtact.inference.joint_refinement import UNLIKE
from geomtact.inference.posterior import Posterior
from geomtact.inference.views import read_views
from geomtact.localizer import Localizer
from geomtact.se3 import Array
from geomtact.sensing.reading import Observation

# nats a contact that the likeliest pose of the right part falls short by, of several: 5 % of 22 scenes of seed 77 did by more
_MISFIT = 4.6
# what evidence of the moments is worth between parts, since a density fitted to a part's own touches is too sure of others':
# chosen on 600 touches of ten parts, seed 7777
_OF_MOMENTS = 0.25


@dataclass(frozen=True)
class Candidate:
    """One of the parts that it may be.

    Attributes
    ----------
    name : of the part
    probability : that it is this one, of those given: evidence of moments counts by a quarter, of pixels in full
    log_evidence : of what is shown, if it is; -inf where no pose agrees with all sensors
    unlike : whether hardly any touch of this part is so unlikely, or no pose explains all contacts
    """

    name: str
    probability: float
    log_evidence: float
    unlike: bool


@dataclass(frozen=True, eq=False)
class Identification:
    """The part, and its pose.

    Attributes
    ----------
    candidates : the most probable first
    localizer, posterior : of the most probable part
    """

    candidates: list[Candidate]
    localizer: Localizer
    posterior: Posterior

    @property
    def foreign(self) -> bool:
        """Whether what is shown is unlike all of the parts."""
        return all(candidate.unlike for candidate in self.candidates)


def identify(
    localizers: Iterable[Localizer], image: Any, weights: Sequence[float] | None = None, **options: Any
) -> Identification:
    """The probabilities of parts, and the pose of the most probable, given what one sensor shows, or several.

    Parameters
    ----------
    localizers : one a part, all prepared for the same sensors; of a generator, the best so far is held and one other
    image : as of ``Localizer.localize``
    weights : (n,) how probable each part is beforehand, up to a factor; all alike by default
    options : of ``Localizer.localize``; a ``prior`` would be of each part's own frame

    Raises
    ------
    UsageError
        There is no list of parts, or not one weight for each; or none with a weight could show this.
    NoPoseAgreesError
        Of no part.
    """
    found: list[tuple[str, float, bool]] = []  # name, evidence, unlike
    log_odds: list[float] = []
    best: tuple[float, Localizer, Posterior] | None = None
    read: dict[tuple[str, ...], list[Observation]] = {}  # by the sensors that read them
    log_weights = None if weights is None else _log_weights(weights)
    if not isinstance(localizers, Iterable):
        raise UsageError(
            f"identify: expected a localizer for each part, got {type(localizers).__name__}; give a list of them"
        )
    for i, localizer in enumerate(localizers):
        if log_weights is not None and i >= len(log_weights):
            raise UsageError(f"identify: expected a weight for each part, got {len(log_weights)} for more")
        try:
            sensors = tuple(sensor.to_toml() for sensor in localizer.sensors)
            if sensors not in read:
                read[sensors] = _read(localizer, image, **options)
            posterior = localizer.localize(read[sensors], **options)
        except NoPoseAgreesError as error:
            found.append((localizer.mesh.name, -np.inf, True))
            log_odds.append(-np.inf)
            last_error = error
            continue
        found.append((localizer.mesh.name, posterior.log_evidence, _is_unlike(posterior)))
        log_odds.append(
            _evidence_power(posterior) * posterior.log_evidence
            + (0.0 if log_weights is None else float(log_weights[i]))
        )
        if best is None or log_odds[-1] > best[0]:
            best = log_odds[-1], localizer, posterior
    if not found:
        raise UsageError("identify: expected parts to choose from, got none")
    if log_weights is not None and len(log_weights) != len(found):
        raise UsageError(f"identify: expected a weight for each of {len(found)} parts, got {len(log_weights)}")
    if best is None:
        raise last_error
    if best[0] == -np.inf:
        raise UsageError("identify: none of the parts whose weight is above 0 can show this; give others a weight")
    probability = np.exp(log_odds - np.logaddexp.reduce(log_odds))
    order = np.argsort(-probability, kind="stable")
    candidates = [Candidate(found[i][0], float(probability[i]), *found[i][1:]) for i in order]
    return Identification(candidates, best[1], best[2])


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
        raise UsageError(f"identify: expected weights >= 0, one a part, got {weights}")
    with np.errstate(divide="ignore"):
        return np.asarray(np.log(given / given.sum()))


def _evidence_power(posterior: Posterior) -> float:
    """Of the evidence: in full where pixels were compared, less where only moments were."""
    return 1.0 if posterior.diagnostics.unexplained_nats is not None else _OF_MOMENTS


def _is_unlike(posterior: Posterior) -> bool:
    found = posterior.diagnostics
    return posterior.contact and (
        found.is_outlier or (found.unexplained_nats or 0.0) > UNLIKE or (found.misfit_nats or 0.0) > _MISFIT
    )
