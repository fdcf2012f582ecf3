"""The ambiguity of one touch: how far apart the poses lie that show the same contact.

No method can know which of these poses it is. A guess need not be one of them, and may lie between; but by the triangle
inequality even the best one is off by half of what the best among them is, or more. The search for them (``evaluation.alike``)
is not exhaustive. And what the posterior makes of them: whether it holds them, and little else.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any

import numpy as np

from geomtact.geometry.distance import PoseDistance, mode_radius
from geomtact.inference.posterior import Posterior
from geomtact.localizer import Localizer
from geomtact.se3 import Array
from geomtact.sensing.noise import Noise
from tools.studies.thesis.alike import SPACING_MM, STARTS, alike
from tools.studies.thesis.known_approach import Outcome, touches_of_side
from tools.studies.thesis.known_approach import summarise as table

DISTINCTIVE_MM = 10.0  # a touch is distinctive if no pose that shows the same contact lies farther off
DRAWS = 200  # poses of a posterior
REGION = 0.9  # of a posterior's mass, within which poses count as held


@dataclass(frozen=True)
class Ambiguity:
    """What a touch leaves open. Lengths are ADD modulo symmetry [mm].

    Attributes
    ----------
    side, touch : number of the side, and of the touch from there
    poses : how many show the same contact, ``alike.SPACING_MM`` apart, the true one among them
    needed : overlap (IoU) at which contacts count as the same: the median of two noisy tactile images of the true pose
    span_mm : from the true pose to the farthest of them
    random_mm : expected error of one of them guessed at random
    least_mm : expected error of the best guess among them, were each of them as likely to be the true one
    precision : share of the posterior that lies within a mode's radius of one of them
    recall : share of them that the region of 90 % of the posterior holds
    """

    side: int
    touch: int
    poses: int
    needed: float
    span_mm: float
    random_mm: float
    least_mm: float
    precision: float
    recall: float


def settings(touches: int) -> dict[str, Any]:
    """What the figures of ``touches`` from each side depend on."""
    return {"touches": touches, "spacing_mm": SPACING_MM, "distinctive_mm": DISTINCTIVE_MM, "starts": STARTS}


def judge_side(
    localizer: Localizer, side: int, n: int, first: int, seed: int, noise: Noise, effort: str, elastic: bool | None
) -> Iterator[Ambiguity]:
    """What the ``first`` of the ``n`` touches leave open that ``known_approach.judge_side`` judges."""
    distance = PoseDistance(localizer.mesh)
    for number, touch in enumerate(islice(touches_of_side(localizer, side, n, seed, noise, elastic), first)):
        T, needed = alike(localizer, touch, noise, np.random.default_rng([seed, side, number]))
        left = errors(1e3 * np.stack([distance.mean(one, T) for one in T]))
        posterior = localizer.localize(touch.mask, "mask", effort=effort, seed=seed)
        rng = np.random.default_rng([seed, side, number, 1])
        yield Ambiguity(side, number, len(T), needed, *left, *held(posterior, T, distance, rng))


def errors(between: Array) -> tuple[float, float, float]:
    """Span, and expected errors of a guess and of the best guess, from the distances (n, n) between such poses, the
    true one first."""
    return float(between[0].max()), float(between[0].mean()), float(between.mean(0).min())


def held(posterior: Posterior, T: Array, distance: PoseDistance, rng: np.random.Generator) -> tuple[float, float]:
    """Precision and recall of a posterior, of the poses ``T`` (n, 4, 4) that show the same contact."""
    if not posterior.contact:
        return 0.0, 0.0
    drawn, radius = posterior.sample(DRAWS, rng), mode_radius(distance.mesh)
    near = np.any([distance.within(one, drawn, radius) for one in T], axis=0)
    inside = posterior.credible_level(T) <= REGION
    return float(near.mean()), float(inside.mean())


def summarise(found: Sequence[Ambiguity], outcomes: Sequence[Outcome], touches: int) -> dict[str, Any]:
    """Medians of what touches leave open, the share of distinctive ones, and ``known_approach.summarise`` of these and of the
    rest; of each side there are ``touches`` outcomes."""
    distinctive = [a.span_mm < DISTINCTIVE_MM for a in found]
    judged = [outcomes[a.side * touches + a.touch] for a in found]
    tables = {"all": judged}
    for name, kind in (("distinctive", True), ("ambiguous", False)):
        tables[name] = [o for o, d in zip(judged, distinctive, strict=True) if d is kind]
    names = ("poses", "needed", "span_mm", "random_mm", "least_mm", "precision", "recall")
    return {
        "n": len(found),
        "distinctive": float(np.mean(distinctive)),
        "median": {name: float(np.median([getattr(a, name) for a in found])) for name in names},
        "mean": {name: float(np.mean([getattr(a, name) for a in found])) for name in names},
        "table": {name: table(some) for name, some in tables.items() if some},
    }
