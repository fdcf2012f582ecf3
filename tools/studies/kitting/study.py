"""Kitting judged: how many objects are placed right, placed wrong, and refused, for each clearance and number of touches."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from geomtact.errors import NoPoseAgreesError
from geomtact.evaluation import share_with_interval
from geomtact.localizer import Localizer
from geomtact.se3 import inverse
from geomtact.sensing.noise import Noise
from tools.studies.kitting.cell import SURE, draw_part, kit
from tools.studies.kitting.fixture import Fixture

TOUCHES = 4
CLEARANCES = (0.25e-3, 0.5e-3, 1e-3, 2e-3, 4e-3)  # m
GOAL = 1e-3  # m: the clearance at which the robot has to be sure
THOROUGH = 5  # with every so many-th object it goes on until it is sure at all clearances


@dataclass(frozen=True)
class Outcome:
    """One object. For each touch, and in it for each clearance: the estimated ``probability`` that the object fits, and the
    clearance ``needed_mm`` that it would truly have needed, had it been placed then."""

    run: int
    elastic: bool
    probability: list[list[float]]
    needed_mm: list[list[float]]

    def placed(self, touches: int, k: int) -> int | None:
        """After which touch, counted from 0, a robot that may make all of them was first sure at clearance ``k``;
        None: refused."""
        sure = (i for i, p in enumerate(self.probability[:touches]) if p[k] >= SURE)
        return next(sure, None)


def run_cell(localizer: Localizer, runs: int, seed: int, noise: Noise, first: int = 0) -> Iterator[Outcome]:
    """Objects one by one, those from ``first`` on; every other one on an elastic gel, the rest by the rigid threshold.

    The robot touches until it is sure at a clearance of ``GOAL``, with every ``THOROUGH``-th object until it is at
    all clearances.
    """
    fixture = Fixture(localizer.mesh)
    for run in range(first, runs):
        rng = np.random.default_rng([seed, run])
        T_world_part = draw_part(localizer.space, rng)
        probability: list[list[float]] = []
        needed: list[list[float]] = []
        try:
            for step in kit(localizer, fixture, T_world_part, CLEARANCES, rng, TOUCHES, run % 2 == 1, noise):
                by = np.stack([decision.T_world_part for decision in step.decisions])
                needed.append(np.round(1e3 * fixture.clearance_needed(inverse(by) @ T_world_part), 3).tolist())
                probability.append([round(decision.probability, 4) for decision in step.decisions])
                asked = [d for d, c in zip(step.decisions, CLEARANCES, strict=True) if run % THOROUGH == 0 or c >= GOAL]
                if all(decision.sure for decision in asked):
                    break
        except NoPoseAgreesError:
            pass  # refused
        yield Outcome(run, run % 2 == 1, probability, needed)


def summarise(outcomes: Sequence[Outcome]) -> list[dict[str, Any]]:
    """For each clearance and number of touches allowed: the shares placed ``right``, placed ``wrong`` and ``refused``, and
    the 95 % interval of the first (Clopper and Pearson 1934). Below ``GOAL`` of every ``THOROUGH``-th object alone."""
    out = []
    for k, clearance in enumerate(CLEARANCES):
        some = [o for o in outcomes if clearance >= GOAL or o.run % THOROUGH == 0]
        for allowed in range(1, TOUCHES + 1):
            placed = [(o, o.placed(allowed, k)) for o in some]
            fits = [o.needed_mm[i][k] <= 1e3 * clearance for o, i in placed if i is not None]
            right, n = sum(fits), len(some)
            out.append(
                {
                    "clearance_mm": 1e3 * clearance,
                    "touches": allowed,
                    "n": n,
                    "right": right,
                    "wrong": len(fits) - right,
                    "refused": n - len(fits),
                    "interval": share_with_interval(right, n)[1:] if n else [0.0, 1.0],
                }
            )
    return out
