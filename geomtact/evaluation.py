"""How well an object is localized: posteriors compared with true poses, on simulated touches."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from geomtact.contact_space.space import ContactSpace
from geomtact.contact_space.touches import Touch, each_touch
from geomtact.errors import NoPoseAgreesError
from geomtact.geometry.distance import PoseDistance, mode_radius, mssd
from geomtact.geometry.mesh import Mesh
from geomtact.inference.posterior import Posterior
from geomtact.localizer import Localizer
from geomtact.se3 import Array, inverse, random_rotations, transform
from geomtact.sensing.noise import MODERATE, Noise
from geomtact.sensing.sensor import Sensor

LEVELS = (0.5, 0.8, 0.9, 0.95)  # nominal masses at which coverage is reported
MODES = 5  # the best of so many modes is reported beside the first
_REACH = 0.3  # m: an object's position in the world is uniform within so much of the origin, along each axis


@dataclass(frozen=True)
class Coverage:
    """Share of truths inside the region of ``nominal`` mass, with the interval (low, high) that its count allows."""

    nominal: float
    share: float
    low: float
    high: float


def coverage(levels: ArrayLike, nominal: Sequence[float], confidence: float = 0.95) -> list[Coverage]:
    """How often the truth lies in the highest-density region of each nominal mass.

    Parameters
    ----------
    levels : (n,) credible levels of the true poses, in [0, 1]
    nominal : masses in (0, 1)
    confidence : of the binomial intervals (Clopper and Pearson 1934)
    """
    levels = np.asarray(levels, float)
    return [
        Coverage(float(mass), *share_with_interval(int((levels <= mass).sum()), len(levels), confidence))
        for mass in nominal
    ]


def share_with_interval(hits: int, n: int, confidence: float = 0.95) -> list[float]:
    """The share of ``hits`` in ``n``, and its binomial interval (Clopper and Pearson 1934)."""
    from scipy.stats import binomtest

    interval = binomtest(hits, n).proportion_ci(confidence, "exact")
    return [hits / n, float(interval.low), float(interval.high)]


@dataclass(frozen=True, eq=False)
class Assessment:
    """A posterior compared with the true pose.

    Attributes
    ----------
    gain : log density at the true pose relative to the uniform distribution [nats]; -inf where it has no probability
    expected_gain : information gain that the posterior itself expects [nats]
    level : credible level of the true pose, in [0, 1]
    poses : (k, 4, 4) of the first k modes, most probable first
    mssd, mean : (k,) largest and mean point distance [m] of each mode from the true pose, modulo symmetry
    probability : of the first mode; 0 where there is none
    """

    gain: float
    expected_gain: float
    level: float
    poses: Array
    mssd: Array
    mean: Array
    probability: float


def assess(
    posterior: Posterior, T_true: Array, modes: int, distance: PoseDistance, nearest: Array | None = None
) -> Assessment:
    """Compare a posterior and its first ``modes`` with the true pose (4, 4) in the posterior's frame.

    ``distance`` is that of the object. Where the true pose lies outside the contact pose space, gain and level are those of
    ``nearest`` (4, 4), a pose inside.
    """
    inside = T_true if nearest is None else nearest
    found = posterior.modes(modes)
    poses = np.array([mode.T for mode in found]).reshape(-1, 4, 4)
    return Assessment(
        gain=float(posterior.log_density(inside)),
        expected_gain=-float(posterior.entropy_nats),
        level=float(posterior.credible_level(inside)),
        poses=poses,
        mssd=mssd(T_true, poses, distance.mesh),
        mean=distance.mean(T_true, poses),
        probability=found[0].probability if found else 0.0,
    )


@dataclass(frozen=True, eq=False)
class SimultaneousTouches:
    """One object in the world that several sensors touch: their poses (n, 4, 4), the object's (4, 4), and what each reports."""

    T_world_sensor: Array
    T_world_object: Array
    touches: list[Touch]


def simultaneous_touches(
    space: ContactSpace, n: int, sensors: int, seed: int, noise: Noise = MODERATE, elastic: bool | None = None
) -> Iterator[SimultaneousTouches]:
    """``n`` objects touched by so many ``sensors``, each at a pose uniform over the contact pose space.

    ``elastic`` and ``noise`` are those of ``contact_space.touches.each_touch``. Sensors may be where they would collide.
    """
    rng = np.random.default_rng([seed, 13])
    touches = each_touch(space, n * sensors, seed, elastic, noise)
    for _ in range(n):
        some = list(islice(touches, sensors))
        T_world_object = transform(random_rotations(1, rng)[0], rng.uniform(-_REACH, _REACH, 3))
        T = np.stack([T_world_object @ inverse(touch.T_sensor_object) for touch in some])
        yield SimultaneousTouches(T, T_world_object, some)


def localized(
    localizer: Localizer, scene: SimultaneousTouches, sensors: int, **options: Any
) -> tuple[Posterior | None, float]:
    """The posterior by the first ``sensors`` of a scene, with ``options`` of ``Localizer.localize``, and the time it took [ms];
    None and 0 where no pose agrees."""
    began = time.perf_counter()
    images = [touch.mask for touch in scene.touches[:sensors]]
    try:
        posterior = localizer.localize(images, "mask", None, scene.T_world_sensor[:sensors], **options)
    except NoPoseAgreesError:
        return None, 0.0
    return posterior, 1e3 * (time.perf_counter() - began)


@dataclass(frozen=True)
class Outcome:
    """One localization by so many ``sensors``, compared with the true pose.

    Attributes
    ----------
    information_gain_nats : log density at the true pose; -inf where it has no probability
    expected_information_gain_nats : minus the posterior's entropy
    credible_level : of the true pose
    error_mm, best_of_5_error_mm : MSSD modulo symmetry of the first mode, and the least of five; inf without any mode
    within_mode_radius : whether the true pose lies within the first mode, by mean point distance
    ms : time that localizing took
    """

    sensors: int
    information_gain_nats: float
    expected_information_gain_nats: float
    credible_level: float
    error_mm: float
    best_of_5_error_mm: float
    within_mode_radius: bool
    ms: float


def evaluate(
    localizer: Localizer,
    sensors: Sequence[int],
    touches: int,
    effort: str = "balanced",
    seed: int = 1,
    first: int = 0,
) -> Iterator[list[Outcome]]:
    """Localize simulated touches, ``touches`` times from the ``first`` on: one outcome for each number of ``sensors``.

    Rigid and elastic touches alternate, with moderate noise. They come from casts at poses that the contact index does not
    hold, by another seed than those on which the score was calibrated.
    """
    distance, radius = PoseDistance(localizer.mesh), mode_radius(localizer.mesh)
    most = max(sensors) | 1  # an odd number, so that the first sensor's touches alternate as well
    for scene in islice(simultaneous_touches(localizer.space, touches, most, seed), first, None):
        out = []
        for n in sensors:
            posterior, ms = localized(localizer, scene, n, effort=effort, seed=seed)
            if posterior is None:
                out.append(Outcome(n, -math.inf, 0.0, 1.0, math.inf, math.inf, False, ms))
                continue
            found = assess(posterior, scene.T_world_object, MODES, distance)
            out.append(
                Outcome(
                    sensors=n,
                    information_gain_nats=found.gain,
                    expected_information_gain_nats=found.expected_gain,
                    credible_level=found.level,
                    error_mm=float(1e3 * found.mssd[:1].min(initial=np.inf)),
                    best_of_5_error_mm=float(1e3 * found.mssd.min(initial=np.inf)),
                    within_mode_radius=bool(found.mean[:1].min(initial=np.inf) <= radius),
                    ms=ms,
                )
            )
        yield out


@dataclass(frozen=True)
class Accuracy:
    """Figures over all localizations by so many ``sensors``.

    Attributes
    ----------
    n : localizations
    information_gain_nats, standard_error_nats : mean over the true poses that have probability, and its standard error;
        None where there are too few
    expected_information_gain_nats : mean
    excluded : share of true poses without probability
    coverage : of HPD credible levels, with 95 % intervals
    error_mm_median, error_mm_90_percent : MSSD of the first mode modulo symmetry: median and 90 % quantile
    best_of_5_error_mm_median : of the best of five modes
    within_mode_radius : share of true poses within the first mode, and its 95 % interval
    ms_median : time of a localization
    """

    sensors: int
    n: int
    information_gain_nats: float | None
    standard_error_nats: float | None
    expected_information_gain_nats: float
    excluded: float
    coverage: list[Coverage]
    error_mm_median: float
    error_mm_90_percent: float
    best_of_5_error_mm_median: float
    within_mode_radius: list[float]
    ms_median: float


def accuracy(rows: Sequence[Sequence[Outcome]]) -> list[Accuracy]:
    """Figures for each number of sensors, fewest first, of what :func:`evaluate` yields."""
    outcomes = [outcome for row in rows for outcome in row]
    return [_accuracy(n, [o for o in outcomes if o.sensors == n]) for n in sorted({o.sensors for o in outcomes})]


def _accuracy(sensors: int, some: Sequence[Outcome]) -> Accuracy:
    n, gain = len(some), np.array([o.information_gain_nats for o in some])
    kept = gain[np.isfinite(gain)]
    error = np.array([o.error_mm for o in some])
    return Accuracy(
        sensors=sensors,
        n=n,
        information_gain_nats=float(kept.mean()) if len(kept) else None,
        standard_error_nats=float(kept.std(ddof=1) / np.sqrt(len(kept))) if len(kept) > 1 else None,
        expected_information_gain_nats=float(np.mean([o.expected_information_gain_nats for o in some])),
        excluded=1 - len(kept) / n,
        coverage=coverage([o.credible_level for o in some], LEVELS),
        error_mm_median=float(np.median(error)),
        error_mm_90_percent=float(np.quantile(error, 0.9, method="inverted_cdf")),
        best_of_5_error_mm_median=float(np.median([o.best_of_5_error_mm for o in some])),
        within_mode_radius=share_with_interval(sum(o.within_mode_radius for o in some), n),
        ms_median=float(np.median([o.ms for o in some])),
    )


def identity(mesh: Mesh, sensor: Sensor) -> dict[str, Any]:
    """Names and hashes of an object and a sensor."""
    return {
        "object": mesh.name,
        "object_sha256": mesh.sha256,
        "sensor": sensor.name,
        "sensor_sha256": sensor.sha256,
    }


def describe(localizer: Localizer) -> dict[str, Any]:
    """What the figures of a localizer depend on."""
    index, calibration = localizer.index, localizer.scorer.calibration
    return identity(localizer.mesh, localizer.sensor) | {
        "index": index.key,
        "poses": len(index),
        "grid": index.resolution.to_json(),
        "scorer": localizer.scorer.name,
        "calibration": asdict(calibration),
    }


def changed(held: Mapping[str, Any], given: Mapping[str, Any]) -> list[str]:
    """Keys of settings that differ by more than another processor's arithmetic makes of the last digits."""
    return [key for key in {**held, **given} if not _alike(held.get(key), given.get(key))]


def _alike(held: Any, given: Any) -> bool:
    if isinstance(held, dict) and isinstance(given, dict):
        return held.keys() == given.keys() and all(_alike(held[key], given[key]) for key in held)
    if isinstance(held, list) and isinstance(given, list):
        return len(held) == len(given) and all(map(_alike, held, given))
    if isinstance(held, float) and isinstance(given, float):
        return math.isclose(held, given, rel_tol=1e-5)
    return bool(held == given)
