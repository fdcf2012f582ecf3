"""The filter judged on trajectories with known poses: against independent frames, and against the thesis's own (thesis 8.1)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from geomtact.contact_space.contact_class import contact_class
from geomtact.errors import MeshError
from geomtact.inference import filter as filtering
from geomtact.inference.effort import GRID_ALONE, effort_of
from geomtact.inference.resolve import resolve_touch
from geomtact.inference.sequence import make_filter
from geomtact.localizer import Localizer
from geomtact.se3 import Array
from geomtact.sensing.noise import Noise
from tools.studies.common.study import coverage_figures, mean_with_interval
from tools.studies.track.trajectories import FEATURELESS, Trajectory, random_trajectory

# Ours, each frame alone, and the thesis's 50 poses that count each frame in full
METHODS = ("filter", "frames", "thesis")
FRAMES = 16
STRETCH = 10  # frames without features that begin every other pair of trajectories, where the object has such
LOST = 0.01  # density at the true pose, over that of the frame alone, below which it counts as lost
LIVE = 50_000  # cells at which a step of the filter is timed
SPEED = 4e-3  # m from frame to frame, half of what the thesis's motion allows
_FLOOR = np.log(1e-4)  # log density that a truth without any counts as


@dataclass(frozen=True)
class Followed:
    """The figures of each of ``METHODS`` on one trajectory, a number a frame.

    Attributes
    ----------
    plain : whether the contact has no feature: flat, or a cylinder's
    gain : log density at the true pose, relative to the uniform distribution; -inf where it was given no probability
    level : credible level of the true pose
    claimed : minus the entropy
    """

    number: int
    elastic: bool
    plain: list[bool]
    gain: dict[str, list[float]]
    level: dict[str, list[float]]
    claimed: dict[str, list[float]]


def make_trajectory(localizer: Localizer, number: int, seed: int, frames: int, noise: Noise) -> Trajectory:
    """Trajectory ``number`` of a part: every other one elastic, the first two of four with a stretch without features."""
    options: dict[str, Any] = {"elastic": number % 2 == 1, "noise": noise, "speed": SPEED}
    own = int(np.random.default_rng([seed, number]).integers(1 << 31))
    if number % 4 < 2:
        try:
            return random_trajectory(localizer.space, frames, own, featureless=min(STRETCH, frames), **options)
        except MeshError:
            pass
    return random_trajectory(localizer.space, frames, own, **options)


def follow(
    localizer: Localizer, n: int, seed: int, frames: int, noise: Noise, effort: str, first: int = 0
) -> Iterator[Followed]:
    """Trajectories ``first`` to ``n`` of an object, each frame localized alone and put through every filter."""
    resolved = effort_of(effort)
    for number in range(first, n):
        trajectory = make_trajectory(localizer, number, seed, frames, noise)
        filters = {
            "filter": make_filter(localizer, seed=seed, effort=resolved),
            "thesis": make_filter(localizer, counts=(1, 1), fresh=0, most=50, seed=seed),
        }
        judged: dict[str, list[tuple[float, ...]]] = {method: [] for method in METHODS}
        poses = trajectory.T_sensor_object
        for T, mask in zip(poses, trajectory.masks, strict=True):
            of_cells = localizer.localize(mask, kind="mask", effort=GRID_ALONE, seed=seed)
            found = {"frames": resolve_touch(of_cells, None, None, localizer.scorer, resolved)}
            found |= {method: each.step(of_cells) for method, each in filters.items()}
            for method, posterior in found.items():
                level = float(posterior.credible_level(T))
                judged[method].append((float(posterior.log_density(T)), level, posterior.information_gain_nats))
        plain = [contact_class(localizer.space, T) in FEATURELESS for T in poses]
        columns = [{m: [row[k] for row in rows] for m, rows in judged.items()} for k in range(3)]
        yield Followed(number, trajectory.elastic, plain, *columns)


def time_steps(localizer: Localizer, seed: int, frames: int, noise: Noise, effort: str) -> list[float]:
    """Milliseconds of each frame, with ``LIVE`` cells kept, from the third one of a trajectory on."""
    state = make_filter(localizer, most=LIVE, seed=seed, effort=effort_of(effort))
    masks = make_trajectory(localizer, 0, seed, frames, noise).masks
    posteriors = [state.step(localizer.localize(mask, kind="mask", effort=GRID_ALONE, seed=seed)) for mask in masks]
    return [sum(p.timing_ms.values()) for p in posteriors[2:]]


def settings() -> dict[str, Any]:
    """What the judged filter depends on."""
    return {
        "speed_mm": 1e3 * SPEED,
        "now": filtering.FRAME_POWER,
        "memory": filtering.MEMORY_POWER,
        "newest": filtering.NEWEST_SHARE,
        "fresh": filtering.UNIFORM_SHARE,
    }


def summarise(outcomes: Sequence[Followed]) -> dict[str, Any]:
    """Figures over all trajectories.

    For each method: the mean gain a frame, a truth without probability counting as ``least_gain``; ``more``, how much that is
    above independent frames, with its bootstrap interval; ``better``, the share of trajectories in which it is above; coverage.
    ``lost`` is the number of trajectories in which, before the first feature, the density at the truth once fell below ``LOST``
    of that of the frame alone.
    """
    means = {m: np.array([np.mean(_clipped(o.gain[m])) for o in outcomes]) for m in METHODS}
    stretches = [(o, stretch(o)) for o in outcomes if stretch(o) >= 2]
    rng = np.random.default_rng(0)
    out: dict[str, Any] = {"n": len(outcomes), "stretches": len(stretches), "least_gain": float(_FLOOR)}
    for m in METHODS:
        lost = [
            any(
                a < b + np.log(LOST)
                for a, b in zip(_clipped(o.gain[m][:n]), _clipped(o.gain["frames"][:n]), strict=True)
            )
            for o, n in stretches
        ]
        more = means[m] - means["frames"]
        out[m] = {
            "gain_mean": float(means[m].mean()),
            "claimed_mean": float(np.mean([np.mean(o.claimed[m]) for o in outcomes])),
            "more": mean_with_interval(more, rng),
            "better": float((more > 0).mean()),
            "worst": float(more.min()),
            "lost": sum(lost),
            **coverage_figures([level for o in outcomes for level in o.level[m]]),
        }
    return out


def stretch(outcome: Followed) -> int:
    """Frames before the first one with a feature."""
    return outcome.plain.index(False) if False in outcome.plain else len(outcome.plain)


def _clipped(gain: Sequence[float]) -> Array:
    return np.maximum(np.asarray(gain, float), _FLOOR)
