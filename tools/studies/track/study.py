"""The filter judged on trajectories with known poses: against independent frames, and against the thesis's own (thesis 8.1)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geomtact.contact_space.contact_class import contact_class
from geomtact.contact_space.index import Index
from geomtact.errors import MeshError
from geomtact.geometry.distance import PoseDistance, mode_radius
from geomtact.inference import filter as filtering
from geomtact.inference.distribution import cell_log_density
from geomtact.inference.effort import effort_of
from geomtact.inference.posterior import Posterior
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
LOST = 0.01  # share below which the true mode counts as lost: of all mass, or of what the frame alone gives it
LIVE = 50_000  # cells at which a step of the filter is timed
SPEED = 4e-3  # m from frame to frame, half of what the thesis's motion allows
_FLOOR = np.log(1e-4)  # log density that a truth without any counts as
_POINTS = 128  # of the surface, for distances


@dataclass(frozen=True)
class Followed:
    """The figures of each of ``METHODS`` on one trajectory, a number a frame.

    Attributes
    ----------
    plain : whether the contact has no feature: flat, or a cylinder's
    gain : log density at the true pose, relative to the uniform distribution; -inf where it was given no probability
    level : credible level of the true pose
    mass : of the true mode: all cells whose pose lies within the modes' radius of the truth, or as much farther as a cell is wide
    claimed : minus the entropy
    """

    number: int
    elastic: bool
    plain: list[bool]
    gain: dict[str, list[float]]
    level: dict[str, list[float]]
    mass: dict[str, list[float]]
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
    distance = PoseDistance(localizer.mesh, _POINTS)
    radius = mode_radius(localizer.mesh) + cell_width(localizer.index, distance)
    for number in range(first, n):
        trajectory = make_trajectory(localizer, number, seed, frames, noise)
        filters = {
            "filter": make_filter(localizer, seed=seed, effort=resolved),
            "thesis": make_filter(localizer, counts=(1, 1), fresh=0, most=50, seed=seed),
        }
        told: dict[str, list[tuple[float, ...]]] = {method: [] for method in METHODS}
        rng = np.random.default_rng([seed, number, 1])
        poses = trajectory.T_sensor_object
        cells = localizer.index.lookup(poses, localizer.space.penetration(poses))[:, None]
        for T, cell, mask in zip(poses, cells, trajectory.masks, strict=True):
            of_cells = localizer.localize(mask, kind="mask", effort="fast", seed=seed)
            near, tie = cells_near(localizer.index, distance, T, radius), rng.random()
            found = {"frames": resolve_touch(of_cells, None, None, localizer.scorer, resolved)}
            found |= {method: each.step(of_cells) for method, each in filters.items()}
            for method, posterior in found.items():
                if posterior.explored is None:
                    told[method].append(_judged(posterior, cell, near, tie))
                else:
                    told[method].append(_judged_within(posterior, T, distance, radius))
        plain = [contact_class(localizer.space, T) in FEATURELESS for T in poses]
        columns = [{m: [row[k] for row in rows] for m, rows in told.items()} for k in range(4)]
        yield Followed(number, trajectory.elastic, plain, *columns)


def cell_width(index: Index, distance: PoseDistance) -> float:
    """Mean point distance [m] from a cell's own pose within which nine of ten of its poses lie."""
    rng = np.random.default_rng(0)
    cells = rng.choice(index.possible, 300)
    drawn, _ = index.draw(cells, rng)
    own = index.poses(cells)
    return float(np.quantile([distance.mean(a, b[None])[0] for a, b in zip(own, drawn, strict=True)], 0.9))


def cells_near(index: Index, distance: PoseDistance, T: Array, radius: float) -> NDArray[np.int64]:
    """Pose ids (n,) of all cells whose own pose lies within ``radius`` [m] of ``T`` (4, 4) in mean point distance."""
    near = index.perhaps_within(T, distance, radius)
    return near[distance.within(T, index.poses(near), radius)]


def _judged_within(
    posterior: Posterior, T: Array, distance: PoseDistance, radius: float
) -> tuple[float, float, float, float]:
    """As :func:`_judged`, of a posterior that is resolved within the cells and a true pose ``T`` (4, 4)."""
    explored = posterior.explored
    assert explored is not None
    mass = float(explored.weight @ distance.within(T, explored.poses, radius))
    return posterior.log_density(T), posterior.credible_level(T), mass, posterior.information_gain_nats


def _judged(
    posterior: Posterior, cell: NDArray[np.int64], near: NDArray[np.int64], tie: float
) -> tuple[float, float, float, float]:
    """Gain, level, mass of the cells ``near`` (n,), and minus the entropy; ``cell`` (1,) holds the truth, of whose ties
    the share ``tie`` counts."""
    index = posterior.index
    gain = float(cell_log_density(posterior, cell)[0])
    log_measure = index.log_weight[posterior.cells]
    density, probability = posterior.cell_log_prob - log_measure, np.exp(posterior.cell_log_prob)
    held = probability > 0
    claimed = float(probability[held] @ density[held])
    above, tied = density > gain + 1e-4, np.abs(density - gain) <= 1e-4
    level = float(probability[above].sum() + tie * probability[tied].sum()) if np.isfinite(gain) else 1.0
    mass = np.exp(cell_log_density(posterior, near)) @ index.weight.ravel()[near].astype(float)
    return gain, min(level, 1.0), float(mass), claimed


def time_steps(localizer: Localizer, seed: int, frames: int, noise: Noise, effort: str) -> list[float]:
    """Milliseconds of each frame, with ``LIVE`` cells kept, from the third one of a trajectory on."""
    state = make_filter(localizer, most=LIVE, seed=seed, effort=effort_of(effort))
    masks = make_trajectory(localizer, 0, seed, frames, noise).masks
    posteriors = [state.step(localizer.localize(mask, kind="mask", effort="fast", seed=seed)) for mask in masks]
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
    Over the frames before the first feature: ``lost``, the number of trajectories in which the true mode once fell below a
    hundredth of what the frame alone gives it; ``below``, the share of frames at which it holds less than ``LOST`` outright.
    """
    means = {m: np.array([np.mean(_clipped(o.gain[m])) for o in outcomes]) for m in METHODS}
    stretches = [(o, stretch(o)) for o in outcomes if stretch(o) >= 2]
    rng = np.random.default_rng(0)
    out: dict[str, Any] = {"n": len(outcomes), "stretches": len(stretches), "least_gain": float(_FLOOR)}
    for m in METHODS:
        pairs = [(o.mass[m][k], o.mass["frames"][k]) for o, n in stretches for k in range(n)]
        lost = [
            any(a < LOST * b for a, b in zip(o.mass[m][:n], o.mass["frames"][:n], strict=True)) for o, n in stretches
        ]
        more = means[m] - means["frames"]
        out[m] = {
            "gain_mean": float(means[m].mean()),
            "claimed_mean": float(np.mean([np.mean(o.claimed[m]) for o in outcomes])),
            "more": mean_with_interval(more, rng),
            "better": float((more > 0).mean()),
            "worst": float(more.min()),
            "lost": sum(lost),
            "below": float(np.mean([a < LOST for a, _ in pairs])) if pairs else None,
            "mass_mean": float(np.mean([a for a, _ in pairs])) if pairs else None,
            **coverage_figures([level for o in outcomes for level in o.level[m]]),
        }
    return out


def stretch(outcome: Followed) -> int:
    """Frames before the first one with a feature."""
    return outcome.plain.index(False) if False in outcome.plain else len(outcome.plain)


def _clipped(gain: Sequence[float]) -> Array:
    return np.maximum(np.asarray(gain, float), _FLOOR)
