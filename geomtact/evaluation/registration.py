"""Registration judged: from how far off a pose still finds home, in what the contact tells, and what it does in the rest."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from geomtact.contact_space.space import ContactSpace
from geomtact.evaluation.contact_class import contact_class
from geomtact.evaluation.information import fisher_information, told_directions
from geomtact.evaluation.touches import PENETRATION, Touch
from geomtact.registration.filterreg import FilterReg
from geomtact.registration.icp import Icp
from geomtact.registration.observability import Spread, motion_of, moved
from geomtact.registration.protocol import Problem, Refiner, Surface
from geomtact.registration.rim import make_problem
from geomtact.se3 import Array
from geomtact.sensing.noise import Noise

TURNS_DEG = (0.0, 2.5, 5.0, 10.0, 20.0)  # of the start poses about the contact's centre
SHIFTS_MM = (0.0, 1.0, 2.0, 4.0, 8.0)  # along the membrane
OWN = ("none", "icp", "filterreg", "both")
SUCCESS_MM = 0.5  # error in what the contact tells


class Method(Protocol):
    """Takes one start pose (4, 4) to a better one, and says whether it believes that it did."""

    def __call__(self, problem: Problem, start: Array) -> tuple[Array, bool]: ...


@dataclass(frozen=True)
class Trial:
    """One start pose taken home by one method. Millimetres at the contact; rotations times its length.

    Attributes
    ----------
    touch : number of the touch, the same for all methods and start errors
    contact : one of ``contact_class.CLASSES``
    told : how many of the six directions the contact tells
    start_mm, error_mm : distance from the truth along those, before and after
    drift_mm : distance from the start along all others
    converged : as the method says
    """

    touch: int
    contact: str
    elastic: bool
    method: str
    turn_deg: float
    shift_mm: float
    told: int
    start_mm: float
    error_mm: float
    drift_mm: float
    converged: bool
    ms: float


def trials(
    space: ContactSpace,
    touches: Sequence[Touch],
    methods: Mapping[str, Method],
    step: float,
    noise: Noise,
    seed: int,
    turns_deg: Sequence[float] = TURNS_DEG,
    shifts_mm: Sequence[float] = SHIFTS_MM,
    first: int = 0,
) -> Iterator[list[Trial]]:
    """The trials of each touch: from one start pose for every pair of a turn and a shift, by every method.

    Start poses are turned about a random axis and shifted along the membrane in a random direction, and then settled at a
    random penetration, as a pose of a grid is.

    Parameters
    ----------
    step : of the grid [m]; a direction is told where the exact simulator fixes it to a quarter of that
    noise : that ``touches`` were made with
    first : touches before it are left out; the others come out as if they were not
    """
    for number, touch in enumerate(touches[first:], first):
        rng = np.random.default_rng([seed, number])
        problem = make_problem(touch.mask, space.sensor)
        kind = contact_class(space, touch.T_sensor_object)
        information = fisher_information(space, touch.T_sensor_object, touch.elastic, problem, noise)
        told, rest = told_directions(information, step / 4)
        out = []
        for turn in turns_deg:
            for shift in shifts_mm:
                start = _start(space, touch.T_sensor_object, problem, np.radians(turn), 1e-3 * shift, rng)
                before = motion_of(touch.T_sensor_object, start, problem)
                for name, method in methods.items():
                    began = time.perf_counter()
                    T, converged = method(problem, start)
                    ms = 1e3 * (time.perf_counter() - began)
                    after = motion_of(touch.T_sensor_object, T, problem)
                    sizes = (told @ before, told @ after, rest @ (after - before))
                    off, left, drift = (1e3 * float(np.linalg.norm(size)) for size in sizes)
                    who = (number, kind, touch.elastic, name, turn, shift, len(told))
                    out.append(Trial(*who, off, left, drift, bool(converged), ms))
        yield out


def _start(
    space: ContactSpace, T: Array, problem: Problem, turn: float, shift: float, rng: np.random.Generator
) -> Array:
    """``T`` turned [rad] and shifted [m], and settled where it touches; after ten tries only moved."""
    for _ in range(10):
        axis, way = rng.normal(size=3), rng.uniform(0, 2 * np.pi)
        axis *= turn * problem.length / np.linalg.norm(axis)
        start = moved(T, [*axis, 0.0, 0.0, 0.0], problem)
        start[:2, 3] += [shift * np.cos(way), shift * np.sin(way)]
        depth = rng.uniform(PENETRATION[0], min(PENETRATION[1], space.sensor.max_penetration))
        settled, ok = space.settle(start[None], depth)
        if ok[0]:
            return settled[0]
    return start


def own_methods(surface: Surface, spread: Spread) -> dict[str, Method]:
    """geomtact's refiners by name, and what no refinement gives."""
    filterreg, icp = _method(FilterReg(surface, spread)), _method(Icp(surface, spread))

    def both(problem: Problem, start: Array) -> tuple[Array, bool]:
        T, one = filterreg(problem, start)
        T, other = icp(problem, T)
        return T, one or other

    return {"none": lambda problem, start: (start, True), "icp": icp, "filterreg": filterreg, "both": both}


def _method(refiner: Refiner) -> Method:
    def refine(problem: Problem, start: Array) -> tuple[Array, bool]:
        found = refiner.refine(problem, start[None])
        return found.T[0], bool(found.converged[0])

    return refine


def summarise(trials: Sequence[Trial]) -> dict[str, Any]:
    """Success by contact class, method and start error, and the medians of time, error and drift by method.

    Touches that tell nothing are left out of the success. ``lost`` names the cells in which FilterReg succeeds less often
    than the best of the other libraries, beyond what chance allows: a 95 % interval of the paired difference.
    """
    told = [t for t in trials if t.told]
    out: dict[str, Any] = {"methods": {}, "success": {t.contact: [] for t in trials}, "lost": []}
    for name, some in _grouped(trials, "method").items():
        errors = [t.error_mm for t in some if t.told]
        drifts = [t.drift_mm for t in some if t.converged]
        out["methods"][name] = {
            "ms_median": float(np.median([t.ms for t in some])),
            "success": float(np.mean([error < SUCCESS_MM for error in errors])) if errors else None,
            "converged": len(drifts) / len(some),
            "drift_mm_median": float(np.median(drifts)) if drifts else None,
            "error_mm_median": float(np.median(errors)) if errors else None,
        }
    for (kind, turn, shift), here in _grouped(told, "contact", "turn_deg", "shift_mm").items():
        won = {n: np.array([t.error_mm < SUCCESS_MM for t in some]) for n, some in _grouped(here, "method").items()}
        rates = {name: float(each.mean()) for name, each in won.items()}
        start = {"turn_deg": turn, "shift_mm": shift}
        out["success"][kind].append({**start, "n": len(next(iter(won.values()))), "rates": rates})
        best = max((name for name in rates if name not in OWN), key=rates.__getitem__, default=None)
        if best is not None and _loses(won["filterreg"], won[best]):
            out["lost"].append({"contact": kind, **start, "to": best})
    return out


def _grouped(trials: Sequence[Trial], *keys: str) -> dict[Any, list[Trial]]:
    """Trials by the value of a field, or by those of several, in the order in which they come."""
    of = attrgetter(*keys)
    out: dict[Any, list[Trial]] = {}
    for trial in trials:
        out.setdefault(of(trial), []).append(trial)
    return out


def _loses(won: NDArray[np.bool_], other: NDArray[np.bool_]) -> bool:
    """Whether ``won`` (n,) is true less often than ``other`` of the same trials, beyond a 95 % interval of the difference."""
    difference = won.astype(float) - other
    if len(difference) < 2:
        return False
    return bool(difference.mean() + 1.96 * difference.std(ddof=1) / np.sqrt(len(difference)) < 0)
