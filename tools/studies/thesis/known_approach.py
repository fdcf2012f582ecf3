"""The thesis's Table 1: one touch of a known contact face, anywhere on the object, turned in any way about the normal (7.1).

A robot that lowers an object onto the sensor knows its approach. The errors of the grid's pose at the heart of the most
probable mode are given before and after refinement, by this project and by the thesis's own method; and those of the
estimate, and of the best of ten poses and of ten modes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from geomtact.contact_space.space import ContactSpace
from geomtact.contact_space.touches import Touch, each_touch
from geomtact.geometry.approach import Approach, approach_of
from geomtact.geometry.distance import PoseDistance
from geomtact.geometry.mesh import Mesh
from geomtact.inference.effort import effort_of
from geomtact.inference.modes import grown
from geomtact.localizer import Localizer
from geomtact.registration.contact_problem import make_problem
from geomtact.registration.observability import Spread
from geomtact.se3 import Array
from geomtact.sensing.moments import cleaned
from geomtact.sensing.noise import Noise
from geomtact.sensing.sensor import Sensor
from tools.studies.common.study import MODES, expected_random_add
from tools.studies.registration.study import Seen, thesis_refinement

ROWS = (
    "best",
    "refined best",
    "thesis's refinement of best",
    "answer",
    "best10",
    "answer10",
    "ten modes",
    "answer's ten modes",
)
NEAR_MM = 10.0  # a start that is farther off lies at another place, to which no registration leads back


@dataclass(frozen=True)
class Outcome:
    """Errors after one touch: ADD modulo symmetry [mm], and over what two random poses of the contact pose space differ by.

    Attributes
    ----------
    side : number of the side that is touched
    error_mm : of each of ``ROWS``: the heart of the grid's most probable mode, that pose refined, refined as in the thesis, and
        the first mode of ``localize``; the best of the ten most probable poses, as in the thesis, of the grid and of
        ``localize``; and the best of the ten modes of each, no two of which are neighbours
    random_mm : expected ADD of a random guess, touching from that side
    """

    side: int
    elastic: bool
    error_mm: list[float]
    random_mm: float


def draw_sides(mesh: Mesh, sensor: Sensor, n: int, seed: int) -> list[Approach]:
    """Approaches of ``n`` touches drawn by the uniform measure of the contact pose space."""
    T, _ = ContactSpace(mesh, sensor).sample(n, np.random.default_rng([seed, 41]))
    return [[(direction, 0.0)] for direction in approach_of(T[:, :3, :3])]


def granularity(localizer: Localizer, n: int = 100) -> float:
    """Mean ADD [mm] from a pose of the grid to the nearest one that is not merely deeper, over ``n`` drawn at random."""
    index, distance = localizer.index, PoseDistance(localizer.mesh)
    least = []
    for one in np.random.default_rng(0).choice(index.possible, n):
        T, reach = index.poses([one])[0], 2 * index.resolution.step
        near = index.perhaps_within(T, distance, reach)
        near = near[near % index.places != one % index.places]
        least.append(distance.mean(T, index.poses(near)).min(initial=reach))
    return 1e3 * float(np.mean(least))


def touches_of_side(
    localizer: Localizer, side: int, n: int, seed: int, noise: Noise, elastic: bool | None
) -> Iterator[Touch]:
    """The ``n`` touches of a side, one by one: the same ones whoever asks."""
    return each_touch(localizer.space, n, seed * 1000 + side, elastic, noise)


def judge_side(
    localizer: Localizer, side: int, n: int, seed: int, noise: Noise, effort: str, elastic: bool | None
) -> Iterator[Outcome]:
    """``n`` touches of an object whose approach ``localizer`` knows; ``elastic`` as in ``touches.random_touches``."""
    distance, random_mm = PoseDistance(localizer.mesh), expected_random_add(localizer)
    for touch in touches_of_side(localizer, side, n, seed, noise, elastic):
        errors = [
            1e3 * float(distance.mean(touch.T_sensor_object, T).min()) for T in _answers(localizer, touch, effort)
        ]
        yield Outcome(side, touch.elastic, errors, random_mm)


def _answers(localizer: Localizer, touch: Touch, effort: str) -> list[Array]:
    """The poses (k, 4, 4) that each of ``ROWS`` names."""
    index, sensor = localizer.index, localizer.sensor
    grid = localizer.localize(touch.mask, "mask", effort=replace(effort_of(effort), modes=0))
    refined = localizer.localize(touch.mask, "mask", effort=effort)
    modes = [np.stack([mode.T for mode in posterior.modes(MODES)]) for posterior in (grid, refined)]
    poses = [posterior.likeliest(MODES) for posterior in (grid, refined)]
    best = index.poses(np.array([cell for cell, _ in grown(grid, 1)]))
    mask = cleaned(touch.mask, sensor)
    ours = localizer.mode_refiner.refiners(index, thorough=False)[0].refine(make_problem(mask, sensor), best).T
    spread = Spread.of_grid(index.angle_step, index.resolution.step, index.approach)
    theirs = thesis_refinement(localizer.space, spread)(Seen(mask, make_problem(mask, sensor)), best[0]).T[None]
    return [best, ours, theirs, modes[1][:1], *poses, *modes]


def summarise(outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """For each of ``ROWS`` the median error [mm] with its quartiles, the mean, and the median normalised error.

    Of a refinement also which share of touches it brings nearer than the pose that it started from, and which farther; and of
    touches whose start was ``NEAR_MM`` off at most, their number and the median errors before and after: ``near``.
    """
    error = np.array([o.error_mm for o in outcomes])
    normalised = error / np.array([[o.random_mm] for o in outcomes])
    start = {"refined best": "best", "thesis's refinement of best": "best"}
    out = {}
    for i, row in enumerate(ROWS):
        figures: dict[str, Any] = {
            "n": len(error),
            "error_mm_quartiles": [float(q) for q in np.quantile(error[:, i], [0.25, 0.5, 0.75])],
            "error_mm_mean": float(error[:, i].mean()),
            "normalised_median": float(np.median(normalised[:, i])),
        }
        if row in start:
            before = error[:, ROWS.index(start[row])]
            figures["nearer"] = float((error[:, i] < before - 1e-9).mean())
            figures["farther"] = float((error[:, i] > before + 1e-9).mean())
            near = before <= NEAR_MM
            medians = [float(np.median(some[near])) if near.any() else None for some in (before, error[:, i])]
            figures["near"] = [int(near.sum()), *medians]
        out[row] = figures
    return out
