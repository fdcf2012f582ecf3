"""Registration judged: from how far off a pose converges in observable directions, and how far it drifts in the rest."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from operator import attrgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import binomtest, chi2

from geomtact.contact_space.contact_class import contact_class
from geomtact.contact_space.resolution import Resolution
from geomtact.contact_space.space import ContactSpace
from geomtact.contact_space.touches import Touch, penetrations
from geomtact.evaluation import LEVELS
from geomtact.geometry.rotations import Directions
from geomtact.registration.contact_problem import make_problem
from geomtact.registration.filterreg import FilterReg
from geomtact.registration.icp import Icp
from geomtact.registration.observability import Spread, motion_of, moved, zeta_of_xi
from geomtact.registration.protocol import Problem, Refiner
from geomtact.registration.surface import Surface
from geomtact.scoring.overlap import to_grid
from geomtact.se3 import Array, inverse, log, transform
from geomtact.sensing.noise import Noise
from geomtact.sensing.sensor import Sensor
from tools.studies.registration.information import agreement, fisher_information, split
from tools.studies.registration.shapes import SHAPES

TURNS_DEG = (0.0, 2.5, 5.0, 10.0, 20.0)  # of the start poses about the contact's centre
SHIFTS_MM = (0.0, 1.0, 2.0, 4.0, 8.0)  # along the membrane
FAR = Spread(np.radians(6), 3e-3)  # of starts that are turned and shifted by these
FROM_GRID = 3  # starts a touch that are as far off as a grid's poses
OWN = ("none", "icp", "filterreg", "both", "thesis")
SUCCESS_MM = 0.5  # error in observable directions
_MASK_NEIGHBOURS = 200  # within a filled mask, the nearest points alone pull nowhere
MASK = (48, 64)  # half a pixel of such a mask is what a refined pose may lose


@dataclass(frozen=True)
class Seen:
    """One contact, as a mask (H, W) and as registration sees it."""

    mask: NDArray[np.bool_]
    problem: Problem


@dataclass(frozen=True)
class End:
    """Where a method ends: its pose (4, 4), whether it believes in it, and the covariance (6, 6) of xi and the observable
    directions (r, 6) that it states, as in ``Refinement``."""

    T: Array
    converged: bool
    covariance: Array | None = None
    observable: Array | None = None


@dataclass(frozen=True, eq=False)
class Grid:
    """Where a grid's poses lie, without the grid: rotations, and a lattice of the object's centre over the window."""

    directions: Directions
    resolution: Resolution

    @cached_property
    def spread(self) -> Spread:
        return Spread.of_grid(self.directions.angle_step(self.resolution.turn_step), self.resolution.step)

    def near(self, space: ContactSpace, T: Array, rng: np.random.Generator) -> tuple[Array, Array]:
        """The pose (4, 4) of the cell that holds ``T`` (4, 4), on a lattice moved at random, and the pose that is ``T`` but for
        the object's symmetry to which it is near."""
        same, k, j = self.directions.lookup(T[None])
        same, R = same[0], self.directions.rotations()[0][self.directions.first_turn[k[0]] + j[0]]
        centre = same[:3, :3] @ space.mesh.centre + same[:3, 3]
        phase = rng.uniform(-0.5, 0.5, 2)
        centre[:2] = (np.rint(centre[:2] / self.resolution.step + phase) - phase) * self.resolution.step
        bins = np.array(self.resolution.penetrations)
        depth = bins[np.abs(bins - space.penetration(T[None])[0]).argmin()]
        settled, touches = space.settle(transform(R, centre - R @ space.mesh.centre)[None], depth)
        return (settled[0] if touches[0] else same), same


Method = Callable[[Seen, Array], End]  # takes a start pose (4, 4) to a better one


@dataclass(frozen=True)
class Trial:
    """One start pose taken home by one method. Millimetres at the contact; rotations times its length.

    Attributes
    ----------
    touch : number of the touch, the same for all methods and start errors
    contact : one of ``contact_class.CLASSES``, or the name of a bare shape
    turn_deg, shift_mm : how far off the start is; None for one as far off as the grid's poses
    told : how many of the six directions are observable
    start_mm, error_mm : distance from the truth along those, before and after
    drift_mm : distance from the start along all others
    converged : as the method reports
    level : mass of the region, in the observable directions, that just holds the truth; None where none is stated
    agrees : share of directions on whose observability method and exact simulator agree
    """

    touch: int
    contact: str
    elastic: bool
    method: str
    turn_deg: float | None
    shift_mm: float | None
    told: int
    start_mm: float
    error_mm: float
    drift_mm: float
    converged: bool
    ms: float
    level: float | None = None
    agrees: float | None = None


def trials(
    space: ContactSpace,
    touches: Sequence[Touch],
    methods: Callable[[Spread], Mapping[str, Method]],
    grid: Grid,
    noise: Noise,
    seed: int,
    turns_deg: Sequence[float] = TURNS_DEG,
    shifts_mm: Sequence[float] = SHIFTS_MM,
    first: int = 0,
) -> Iterator[list[Trial]]:
    """The trials of each touch: from one start pose for every pair of a turn and a shift, and from some as far off as those of
    the grid, by every method.

    Start poses are turned about a random axis and shifted along the membrane in a random direction, and then settled at a
    random penetration, as a pose of a grid is.

    Parameters
    ----------
    methods : by name, for starts of a given spread: methods know how far off starts may be
    grid : on which the object is searched for
    noise : that ``touches`` were made with
    first : touches before it are left out; the others come out as if they were not
    """
    spread = grid.spread
    near = methods(spread)
    far = methods(Spread(max(spread.rotation, FAR.rotation), max(spread.translation, FAR.translation)))
    for number, touch in enumerate(touches[first:], first):
        rng = np.random.default_rng([seed, number])
        T = touch.T_sensor_object
        seen = Seen(touch.mask, make_problem(touch.mask, space.sensor))
        kind = space.mesh.name if space.mesh.name in SHAPES else contact_class(space, T)
        information = fisher_information(space, T, touch.elastic, seen.problem, noise)
        told, rest = split(information, spread, seen.problem.length)
        out = []
        offs: list[tuple[float | None, float | None]] = [(turn, shift) for turn in turns_deg for shift in shifts_mm]
        for turn, shift in offs + [(None, None)] * FROM_GRID:
            if turn is None or shift is None:
                start, true = grid.near(space, T, rng)
            else:
                start, true = _start(space, T, seen.problem, partial(_off, turn, shift), rng), T
            before = motion_of(true, start, seen.problem)
            for name, method in (near if turn is None else far).items():
                began = time.perf_counter()
                end = method(seen, start)
                ms = 1e3 * (time.perf_counter() - began)
                after = motion_of(true, end.T, seen.problem)
                sizes = (told @ before, told @ after, rest @ (after - before))
                off, left, drift = (1e3 * float(np.linalg.norm(size)) for size in sizes)
                who = (number, kind, touch.elastic, name, turn, shift, round(float(np.trace(told))))
                said = _said(end, true, information, spread, seen.problem)
                out.append(Trial(*who, off, left, drift, bool(end.converged), ms, *said))
        yield out


def _said(
    end: End, T: Array, information: Array, spread: Spread, problem: Problem
) -> tuple[float | None, float | None]:
    """How far out the truth ``T`` lies in the stated covariance of the observable directions, and in how many of all directions
    these agree with the exact ``information``."""
    if end.covariance is None or end.observable is None or not end.converged:
        return None, None
    rows = end.observable * np.repeat([problem.length, 1.0], 3)
    off, level = rows @ log(inverse(end.T) @ T), None
    if len(rows):
        level = float(chi2.cdf(off @ np.linalg.solve(rows @ end.covariance @ rows.T, off), len(rows)))
    rows = rows @ np.linalg.inv(zeta_of_xi(end.T, problem))
    return level, agreement(information, rows, spread, problem.length)


def _off(turn_deg: float, shift_mm: float, rng: np.random.Generator) -> Array:
    """A rotation vector [rad] and a shift along the membrane [m], (5,), of these sizes, in random directions."""
    axis, way = rng.normal(size=3), rng.uniform(0, 2 * np.pi)
    shift = 1e-3 * shift_mm * np.array([np.cos(way), np.sin(way)])
    return np.append(np.radians(turn_deg) * axis / np.linalg.norm(axis), shift)


def _start(
    space: ContactSpace,
    T: Array,
    problem: Problem,
    draw: Callable[[np.random.Generator], Array],
    rng: np.random.Generator,
) -> Array:
    """``T`` turned and shifted by what ``draw`` gives, and settled where it touches; after ten tries only moved."""
    for _ in range(10):
        off = draw(rng)
        start = moved(T, [*(off[:3] * problem.length), 0.0, 0.0, 0.0], problem)
        start[:2, 3] += off[3:]
        depth = rng.uniform(*penetrations(space))
        settled, ok = space.settle(start[None], depth)
        if ok[0]:
            return settled[0]
    return start


def own_methods(space: ContactSpace, surface: Surface, spread: Spread) -> dict[str, Method]:
    """geomtact's refiners by name, the thesis's, and what no refinement gives."""
    filterreg, icp = _method(FilterReg(surface, spread)), _method(Icp(surface, spread))

    def both(seen: Seen, start: Array) -> End:
        one = filterreg(seen, start)
        other = icp(seen, one.T)
        return other if other.converged else one

    return {
        "none": lambda seen, start: End(start, True),
        "icp": icp,
        "filterreg": filterreg,
        "both": both,
        "thesis": thesis_refinement(space, spread),
    }


def _method(refiner: Refiner) -> Method:
    def refine(seen: Seen, start: Array) -> End:
        found = refiner.refine(seen.problem, start[None])
        return End(found.T[0], bool(found.converged[0]), found.covariance[0], found.observable[0])

    return refine


def thesis_refinement(space: ContactSpace, spread: Spread) -> Method:
    """The thesis's refinement (6.3): FilterReg from the points of the simulated local shape to those of the sensed one."""

    def refine(seen: Seen, start: Array) -> End:
        sensor = space.sensor
        simulated = space.caster.depths(sensor, start[None], sensor.along(MASK))[0] > 0
        points, sensed = (_mask_points(mask, sensor) for mask in (simulated, seen.mask))
        if len(points) < 6 or len(sensed) < 6:
            return End(start, False)
        towards = np.array([0.0, 0.0, -1.0])
        n, none = len(sensed), np.zeros((0, 3))
        problem = replace(
            seen.problem,
            points=sensed,
            facing=np.tile(towards, (n, 1)),
            across=np.zeros((n, 3)),
            sinking=np.zeros((n, 3)),
            noise=np.full(n, seen.problem.pitch),
            weight=np.ones(n),
            contact=np.zeros(n, np.int64),
            around=none,
            centre=sensed.mean(0),
            side=np.zeros(0, np.int64),
        )
        surface = Surface(points, np.tile(towards, (len(points), 1)))
        found = FilterReg(surface, spread, objective="point", neighbours=_MASK_NEIGHBOURS).refine(
            problem, np.eye(4)[None]
        )
        return End(found.T[0] @ start, bool(found.converged[0]))

    return refine


def _mask_points(mask: NDArray[np.bool_], sensor: Sensor) -> Array:
    """The contact pixels of a mask, on a grid of ``MASK``, as points (n, 3) of the membrane's plane."""
    shape = sensor.along(MASK)
    rows, cols = np.nonzero(to_grid(mask, shape))
    x, y = sensor.pixel_centres(shape)
    return np.column_stack([x[cols], y[rows], np.zeros(len(rows))])


def summarise(trials: Sequence[Trial], half_pixel_mm: float) -> dict[str, Any]:
    """All figures: by method over all start errors, by method from the grid's poses, over all contacts and for each kind, success
    by contact and start error, and drift by contact.

    Touches without an observable direction are left out of success and errors. ``lost`` names the cells in which
    FilterReg succeeds less often than the best of the other libraries, beyond what chance allows.

    Parameters
    ----------
    half_pixel_mm : of a mask; a refined pose that is farther from the truth than its start by more has got worse
    """
    basin, gridded = ([t for t in trials if (t.turn_deg is None) == grid] for grid in (False, True))
    out: dict[str, Any] = {
        "methods": {name: _over_all(some) for name, some in _grouped(basin, "method").items()},
        "from_grid": {name: _from_grid(some, half_pixel_mm) for name, some in _grouped(gridded, "method").items()},
        "from_grid_by_contact": {
            kind: {name: _from_grid(few, half_pixel_mm) for name, few in _grouped(some, "method").items()}
            for kind, some in _grouped(gridded, "contact").items()
        },
        "success": {t.contact: [] for t in trials},
        "drift": {},
        "lost": [],
    }
    for (kind, name), some in _grouped([t for t in gridded if t.converged], "contact", "method").items():
        drifts = np.quantile([t.drift_mm for t in some], [0.5, 0.9])
        out["drift"].setdefault(kind, {})[name] = {
            "n": len(some),
            "median_mm": drifts[0],
            "of_90_percent_mm": drifts[1],
        }
    told = [t for t in basin if t.told]
    for (kind, turn, shift), here in _grouped(told, "contact", "turn_deg", "shift_mm").items():
        won = {n: np.array([t.error_mm < SUCCESS_MM for t in some]) for n, some in _grouped(here, "method").items()}
        rates = {name: float(each.mean()) for name, each in won.items()}
        start = {"turn_deg": turn, "shift_mm": shift}
        out["success"][kind].append({**start, "n": len(next(iter(won.values()))), "rates": rates})
        peers = [name for name in rates if name not in OWN]
        best = max(peers, key=rates.__getitem__, default=None)
        if best is not None and _loses(won["filterreg"], won[best], len(peers)):
            out["lost"].append({"contact": kind, **start, "to": best})
    return out


def _over_all(some: Sequence[Trial]) -> dict[str, Any]:
    errors = [t.error_mm for t in some if t.told]
    drifts = [t.drift_mm for t in some if t.converged]
    return {
        "ms_median": float(np.median([t.ms for t in some])),
        "success": float(np.mean([error < SUCCESS_MM for error in errors])) if errors else None,
        "converged": len(drifts) / len(some),
        "drift_mm_median": float(np.median(drifts)) if drifts else None,
        "error_mm_median": float(np.median(errors)) if errors else None,
    }


def _from_grid(some: Sequence[Trial], half_pixel_mm: float) -> dict[str, Any]:
    told, stated = [t for t in some if t.told], [t for t in some if t.level is not None]
    before, after = (np.array([getattr(t, name) for t in told]) for name in ("start_mm", "error_mm"))
    inside = [float(np.mean([t.level <= mass for t in stated])) for mass in LEVELS] if stated else None  # type: ignore[operator]
    return {
        "n": len(some),
        "error_mm_median": float(np.median(after)) if len(told) else None,
        "of_start": float(np.median(after) / np.median(before)) if len(told) else None,
        "worse": float((after > before + half_pixel_mm).mean()) if len(told) else None,
        "stated": len(stated),
        "coverage": inside and dict(zip(map(str, LEVELS), inside, strict=True)),
        "agreement": float(np.mean([t.agrees for t in stated])) if stated else None,  # type: ignore[misc]
    }


def _grouped(trials: Sequence[Trial], *keys: str) -> dict[Any, list[Trial]]:
    """Trials by the value of a field, or by those of several, in the order in which they come."""
    of = attrgetter(*keys)
    out: dict[Any, list[Trial]] = {}
    for trial in trials:
        out.setdefault(of(trial), []).append(trial)
    return out


def _loses(won: NDArray[np.bool_], other: NDArray[np.bool_], peers: int) -> bool:
    """Whether ``won`` (n,) is true less often than ``other`` of the same trials, the best of ``peers``, beyond chance: an exact
    sign test at 5 %, shared among the peers."""
    better, worse = int((won & ~other).sum()), int((other & ~won).sum())
    return worse > better and bool(binomtest(better, better + worse).pvalue < 0.05 / peers)
