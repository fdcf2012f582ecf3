"""What one touch leaves open, whoever reads it: how far apart the poses lie that feel the same.

No method can know which of these poses it is, so the error expected of a guess among them bounds that of all methods. The
search for them (``evaluation.alike``) is not exhaustive; what it misses makes the bound lower.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from math import comb
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from geomtact.evaluation.alike import SPACING_MM, STARTS, alike
from geomtact.evaluation.known_approach import Outcome, touches_of_side
from geomtact.evaluation.known_approach import summarise as table
from geomtact.geometry.distance import PoseDistance
from geomtact.inference.localizer import Localizer
from geomtact.se3 import Array
from geomtact.sensing.noise import Noise

DISTINCTIVE_MM = 10.0  # a touch is distinctive if no pose that feels the same lies farther off
GUESSES = 10  # as many as in the thesis's best10


@dataclass(frozen=True)
class Ambiguity:
    """What a touch leaves open. Lengths are ADD modulo symmetry [mm].

    Attributes
    ----------
    side, touch : number of the side, and of the touch from there
    poses : how many feel the same, ``alike.SPACING_MM`` apart, the true one among them
    needed : overlap (IoU) of contacts that feel the same: the median of two noisy readings of the true pose
    span_mm : from the true pose to the farthest of them
    random_mm, random10_mm : expected error of one of them guessed at random, and of the best of ten
    least_mm : expected error of the best guess, were each of them as likely to be the true one
    """

    side: int
    touch: int
    poses: int
    needed: float
    span_mm: float
    random_mm: float
    random10_mm: float
    least_mm: float


def settings(touches: int) -> dict[str, Any]:
    """What the figures of ``touches`` from each side depend on."""
    return {"touches": touches, "spacing_mm": SPACING_MM, "distinctive_mm": DISTINCTIVE_MM, "starts": STARTS}


def judge_side(
    localizer: Localizer, side: int, n: int, first: int, seed: int, noise: Noise, elastic: bool | None
) -> Iterator[Ambiguity]:
    """What the ``first`` of the ``n`` touches leave open that ``known_approach.judge_side`` judges."""
    distance = PoseDistance(localizer.mesh)
    for number, touch in enumerate(islice(touches_of_side(localizer, side, n, seed, noise, elastic), first)):
        T, needed = alike(localizer, touch, noise, np.random.default_rng([seed, side, number]))
        yield Ambiguity(side, number, len(T), needed, *errors(1e3 * np.stack([distance.mean(one, T) for one in T])))


def errors(between: Array) -> tuple[float, float, float, float]:
    """Span, and expected errors of a guess, of the best of ten and of the best guess, from the distances (n, n) between
    poses that feel the same, the true one first."""
    return (
        float(between[0].max()),
        float(between[0].mean()),
        best_of(between[0], GUESSES),
        float(between.mean(0).min()),
    )


def summarise(found: Sequence[Ambiguity], outcomes: Sequence[Outcome], touches: int) -> dict[str, Any]:
    """Medians of what touches leave open, the share of distinctive ones, and ``known_approach.summarise`` of these and of the
    rest; of each side there are ``touches`` outcomes."""
    distinctive = [a.span_mm < DISTINCTIVE_MM for a in found]
    judged = [outcomes[a.side * touches + a.touch] for a in found]
    tables = {"all": judged}
    for name, kind in (("distinctive", True), ("ambiguous", False)):
        tables[name] = [o for o, d in zip(judged, distinctive, strict=True) if d is kind]
    names = ("poses", "needed", "span_mm", "random_mm", "random10_mm", "least_mm")
    return {
        "n": len(found),
        "distinctive": float(np.mean(distinctive)),
        "median": {name: float(np.median([getattr(a, name) for a in found])) for name in names},
        "mean": {name: float(np.mean([getattr(a, name) for a in found])) for name in names},
        "table": {name: table(some) for name, some in tables.items() if some},
    }


def best_of(error: ArrayLike, k: int) -> float:
    """Expected least of ``k`` different ones drawn at random of ``error`` (n,); of all, if they are fewer."""
    error = np.sort(np.asarray(error, float))
    n, k = len(error), min(k, len(error))
    return float(sum(e * comb(n - 1 - i, k - 1) for i, e in enumerate(error)) / comb(n, k))
