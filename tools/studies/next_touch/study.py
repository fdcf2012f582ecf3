"""The next touch judged: how many more it takes until one mode is sure, chosen for their expected gain or at random (thesis 8.2).

An object lies on a table, on the side on which it rests lowest. Where, and how it is turned, is unknown. A sensor
comes down on it again and again, wherever the planner's grid of touches allows.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geomtact.contact_space.touch import simulate_mask, spoilt
from geomtact.contact_space.touches import Touch, penetrations, random_touches
from geomtact.errors import NoPoseAgreesError
from geomtact.geometry.distance import mssd
from geomtact.inference.posterior import Posterior
from geomtact.localizer import Localizer
from geomtact.planning.actions import Touch as Planned
from geomtact.planning.grid import grid_of_touches
from geomtact.planning.next_touch import next_touch
from geomtact.se3 import Array, inverse, random_rotations, transform
from geomtact.sensing.noise import Noise
from tools.studies.common.study import RESAMPLES, WRONG_MM

SURE, MOST = 0.95, 10
POLICIES = ("best", "random")


@dataclass(frozen=True)
class Run:
    """One object touched until sure.

    Attributes
    ----------
    touches : after the first, until the first mode held ``SURE``; ``MOST`` if it never did
    probability : of the first mode, at last
    mssd_mm : of the first mode, at last
    gains : log density at the true pose after each touch with contact, the first included
    """

    scene: int
    policy: str
    touches: int
    probability: float
    mssd_mm: float
    gains: list[float]


def touch_until_sure(localizer: Localizer, n: int, seed: int, noise: Noise, first: int = 0) -> Iterator[list[Run]]:
    """For ``n`` scenes from ``first`` on, a run by each policy, from the same first touch; gels are rigid and elastic in turn."""
    touches = random_touches(localizer.space, n, seed, None, noise)
    for number, touch in enumerate(touches[first:], first):
        yield [_run(localizer, number, touch, policy, seed, noise) for policy in POLICIES]


def _run(localizer: Localizer, scene: int, first: Touch, policy: str, seed: int, noise: Noise) -> Run:
    rng = np.random.default_rng([seed, scene, POLICIES.index(policy)])
    T_world_object = transform(random_rotations(1, np.random.default_rng([seed, scene]))[0], np.zeros(3))
    stops, images = [T_world_object @ inverse(first.T_sensor_object)], [first.mask]
    tried = list(stops)
    posterior = localizer.localize(images, "mask", None, stops, seed=scene)
    gains = [float(posterior.log_density(T_world_object))]
    while posterior.modes(1)[0].probability < SURE and len(tried) <= MOST:
        touch = _chosen(posterior, tried, policy, rng)
        if touch is None:
            break
        stop = touch.reached(localizer.space, T_world_object, rng.uniform(*penetrations(localizer.space)))[0]
        tried.append(stop)
        image = _made(localizer, inverse(stop) @ T_world_object, first.elastic, noise, rng)
        if image is None:
            continue
        stops.append(stop)
        images.append(image)
        try:
            posterior = localizer.localize(images, "mask", None, stops, seed=scene)
        except NoPoseAgreesError:
            return Run(scene, policy, MOST, 0.0, np.inf, [*gains, -np.inf])
        gains.append(float(posterior.log_density(T_world_object)))
    mode = posterior.modes(1)[0]
    more = len(tried) - 1 if mode.probability >= SURE else MOST
    error = 1e3 * float(mssd(T_world_object, mode.T[None], localizer.mesh)[0])
    return Run(scene, policy, more, mode.probability, error, gains)


def _made(
    localizer: Localizer, T: Array, elastic: bool, noise: Noise, rng: np.random.Generator
) -> NDArray[np.bool_] | None:
    """The image with the object at ``T`` (4, 4) over the sensor, empty if it meets nothing; None where the sensor's body strikes
    first."""
    space = localizer.space
    mask = simulate_mask(space, T, elastic)
    if not mask.any():
        return mask
    return None if np.isnan(space.penetration(T[None])[0]) else spoilt(mask, space, noise, rng)


def _chosen(posterior: Posterior, made: Sequence[Array], policy: str, rng: np.random.Generator) -> Planned | None:
    touches = grid_of_touches(posterior, made=made)
    if not touches or policy == "random":
        return touches[rng.integers(len(touches))] if touches else None
    of = next_touch(posterior, touches)[0].of
    assert isinstance(of, Planned)
    return of


def summarise(runs: Sequence[Run]) -> dict[str, Any]:
    """Figures of each policy; ``ratio`` is that of the mean numbers of touches, best to random, with its paired 95 % bootstrap
    interval, and ``wrong`` the share of sure first modes more than 10 mm (MSSD) off."""
    out: dict[str, Any] = {}
    counts = []
    for policy in POLICIES:
        own = sorted((run for run in runs if run.policy == policy), key=lambda run: run.scene)
        counts.append(np.array([run.touches for run in own], float))
        sure = np.array([run.probability >= SURE for run in own])
        error = np.array([run.mssd_mm for run in own])
        sure_after = [
            float(np.mean([s and run.touches <= k for s, run in zip(sure, own, strict=True)])) for k in range(MOST + 1)
        ]
        out[policy] = {
            "n": len(own),
            "touches_mean": float(counts[-1].mean()),
            "sure": float(sure.mean()),
            "sure_after": sure_after,
            "wrong": float((error[sure] > WRONG_MM).mean()) if sure.any() else None,
            "mssd_mm_median": float(np.median(error)),
        }
    best, random = counts
    rows = np.random.default_rng(0).integers(len(best), size=(RESAMPLES, len(best)))
    # all sure at once: no touch was needed by either
    ratios = best[rows].mean(1) / np.maximum(random[rows].mean(1), 1e-9)
    out["ratio"] = [
        float(best.mean() / max(random.mean(), 1e-9)),
        *(float(q) for q in np.quantile(ratios, [0.025, 0.975])),
    ]
    return out
