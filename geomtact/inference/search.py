"""Poses at which one sensor, or several, would show what they do: drawn, registered, and sought around the best.

A cell is wider than contacts leave the pose, so its own pose is far from where they agree. Poses drawn within cells are cast on
every sensor, the likeliest of each is registered to all contacts together, and a last search around the best of these follows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from geomtact.contact_space.carry import UNFELT
from geomtact.inference.modes import Refined
from geomtact.inference.posterior import Posterior
from geomtact.inference.refine import Refinery, refined_at
from geomtact.registration.filterreg import FilterReg
from geomtact.registration.icp import Icp
from geomtact.registration.observability import Spread, moved
from geomtact.registration.protocol import Problem
from geomtact.registration.rim import make_problem
from geomtact.scoring.likelihood import cast_log_likelihood, height_log_likelihood
from geomtact.scoring.overlap import to_grid
from geomtact.se3 import Array, inverse
from geomtact.sensing.contact import Contact, SoftMask
from geomtact.sensing.moments import cleaned

_SHAPE = (24, 32)  # of the casts that choose among many
_DRAWS = 8  # poses drawn within each
_POINTS, _ROUGH = 60, 20  # of each outline, at most: to work out what is told, and to register all that is looked into
_HOPEFUL = 4  # of the poses tried for a cell, that are asked for by more than two sensors
_THOROUGH = 25  # cells that ICP has a try at, too
# Of the last search, each in half the width of the one before, and for the better half of the cells
_ROUNDS, _AROUND = 3, 12
_TOLD = 5  # for each mode that is asked for, cells of which it is worked out what the contacts tell
_NARROW = 0.25  # of the grid's spread: standard deviation of the motions that are tried first around a pose
_NEAR, _FAR = 0.5e-3, 5e-3  # m by which a pose misses a sensor: its standard deviation, and at most


@dataclass(frozen=True, eq=False)
class View:
    """What a sensor shows, the only one or one of several.

    Attributes
    ----------
    refinery : of the object on it
    contact : None where it shows none
    T_sensor_first : (4, 4) of the first sensor that has contact, in this one's frame
    """

    refinery: Refinery
    contact: Contact | None
    T_sensor_first: Array

    @cached_property
    def shown(self) -> SoftMask:
        """The contact without specks, at the image's own resolution."""
        assert self.contact is not None
        shown = self.contact.soft_mask
        return cleaned(shown, self.refinery.space.sensor)

    @property
    def mask(self) -> NDArray[np.bool_]:
        """Where it is likelier than not."""
        return self.shown > 0.5

    @property
    def measured(self) -> bool:
        """Whether heights are shown."""
        return self.contact is not None and self.contact.height is not None

    @property
    def outline(self) -> float:
        """Length of the contact's outline within the window [m], whichever way it runs (Cauchy and Crofton)."""
        dx, dy = 2 * self.refinery.space.sensor.half_window / self.mask.shape[::-1]
        across, down = self.mask[:, 1:] != self.mask[:, :-1], self.mask[1:] != self.mask[:-1]
        return float(np.pi / 4 * (across.sum() * dy + down.sum() * dx))

    def log_likelihood(self, T: Array) -> Array:
        """Log likelihood (n,) of what is shown, with the object at ``T`` (n, 4, 4) in the first sensor's frame.

        A pose that does not touch, or is too deep, is the less likely the farther it is from doing so: a search finds its way.
        """
        return self.likely(self.depths(T))

    def depths(self, T: Array) -> NDArray[np.float32]:
        """How far below the membrane the object lies (n, h, w) [m], coarsely."""
        space = self.refinery.space
        return space.caster.depths(space.sensor, self.T_sensor_first @ T, space.sensor.along(_SHAPE))

    def likely(self, depths: NDArray[np.float32]) -> Array:
        """As :meth:`log_likelihood`, from :meth:`depths`."""
        sensor, shape = self.refinery.space.sensor, depths.shape[1:]
        deepest = depths.max((1, 2))
        if self.contact is None:
            return np.where(deepest > 0, np.log(UNFELT), 0.0)
        off = np.clip(np.maximum(-deepest, deepest - sensor.max_penetration), 0, _FAR)
        likely = cast_log_likelihood(depths, to_grid(self.mask, shape), sensor.pixel_area(shape))
        return likely + self.heights(depths) - 0.5 * (off / _NEAR) ** 2

    def heights(self, depths: NDArray[np.float32]) -> Array:
        """Log likelihood (n,) of the heights shown, from :meth:`depths`; 0 where there are none."""
        sensor, shape = self.refinery.space.sensor, depths.shape[1:]
        if self.contact is None or self.contact.height is None:
            return np.zeros(len(depths))
        height = np.asarray(cv2.resize(self.contact.height, shape[::-1], interpolation=cv2.INTER_AREA), np.float32)
        touched = to_grid(self.contact.sure, shape)
        return np.asarray(
            height_log_likelihood(depths, height, touched, sensor.pixel_area(shape), sensor.height_noise), float
        )


@dataclass(frozen=True, eq=False)
class Tried:
    """Poses tried around each of n cells.

    Attributes
    ----------
    T : (n, d, 4, 4) in the first sensor's frame
    depth : (n, d) how deep the object lies in that sensor [m], about
    merit : (n, d) log likelihood of what all sensors show; -inf where others of the d are likelier for two sensors already
    hidden : (n,) how much deeper than a coarse cast shows the object is in that cell: what lies between its rays [m]
    """

    T: Array
    depth: Array
    merit: Array
    hidden: Array

    def best(self) -> tuple[Array, Array]:
        """Of each cell, the pose (n, 4, 4) of the highest merit, and that merit (n,)."""
        return self.T[np.arange(len(self.T)), self.merit.argmax(1)], self.merit.max(1)

    def with_others(self, rows: NDArray[np.int64], others: Tried) -> Tried:
        """The best of each cell alone, in its place those of ``others`` (m, 1) in the cells ``rows`` (m,)."""
        best = np.arange(len(self.T)), self.merit.argmax(1)
        T, depth, merit = (each[best][:, None].copy() for each in (self.T, self.depth, self.merit))
        T[rows], depth[rows], merit[rows] = others.T, others.depth, others.merit
        return Tried(T, depth, merit, self.hidden)


class Search:
    """Poses of the object in the first sensor's frame at which one sensor or several would show what they do, in cells that
    ``posterior`` does not rule out.

    Attributes
    ----------
    views : those with contact first; nearly any pose explains the others
    felt : how many have contact
    most : (V,) how likely what each sensor shows is at the pose that suits it best, of all that were tried
    width : (6,) standard deviation of the motions that are tried first around a pose [m], in the axes of ``problem``
    """

    def __init__(self, posterior: Posterior, views: Sequence[View], rng: np.random.Generator):
        self.posterior, self.index, self.rng = posterior, posterior.index, rng
        index = self.index
        self.views = sorted(views, key=lambda view: view.contact is None)
        touching = [(view, view.contact) for view in views if view.contact is not None]
        self.base, self.felt = self.views[0], len(touching)
        self.first = self.base.refinery
        T_first_sensor = np.stack([inverse(view.T_sensor_first) for view, _ in touching])
        self.problem, self.rough = (
            Problem.joined(
                [make_problem(v.shown, v.refinery.space.sensor, c.height, max_points=points) for v, c in touching],
                T_first_sensor,
            )
            for points in (_POINTS, _ROUGH)
        )
        self.spread = Spread.of_grid(index.angle_step, index.resolution.step, index.approach)
        self.filterreg = FilterReg(self.first.surface, self.spread)
        self.most = np.full(len(views), -np.inf)
        self.width = _NARROW * self.spread.metres(self.problem.length)

    def tried(self, T: Array, hidden: Array) -> Tried:
        """With the object at ``T`` (n, d, 4, 4); ``hidden`` (n,) as in :class:`Tried`."""
        depths = self.base.depths(T.reshape(-1, 4, 4))
        depth = depths.max((1, 2)).reshape(T.shape[:2]) + hidden[:, None]
        merit: Array = self.base.likely(depths).reshape(T.shape[:2])
        self.most[0] = max(self.most[0], merit.max())
        hopeful, d = np.ones(merit.shape, bool), T.shape[1]
        for i, view in enumerate(self.views[1:], 1):
            if i == 2 and d > _HOPEFUL:
                hopeful = merit.argsort(1).argsort(1) >= d - _HOPEFUL
            each = view.log_likelihood(T[hopeful])
            self.most[i] = max(self.most[i], each.max())
            merit[hopeful] += each
        return Tried(T, depth, np.where(hopeful, merit, -np.inf), hidden)

    def drawn(self, cells: NDArray[np.int64]) -> Tried:
        """The poses of ``cells`` (n,) and others within them, about as deep in the first sensor as the cells say."""
        own, level = self.index.poses(cells), cells // self.index.places
        wanted = np.asarray(self.index.resolution.penetrations)[level]
        hidden = wanted - self.base.depths(own).max((1, 2))
        hidden[~np.isfinite(hidden)] = 0
        T, depth = self.index.draw(np.repeat(cells, _DRAWS), self.rng)
        rise = self.base.depths(T).max((1, 2)) + np.repeat(hidden, _DRAWS) - depth
        T[:, 2, 3] += np.where(np.isfinite(rise), rise, 0)
        return self.tried(np.concatenate([own[:, None], T.reshape(len(cells), _DRAWS, 4, 4)], 1), hidden)

    def heights(self, T: Array) -> Array:
        """Log likelihood (n,) of all heights that are shown, with the object at ``T`` (n, 4, 4)."""
        measured = (view for view in self.views if view.measured)
        return sum((view.heights(view.depths(T)) for view in measured), start=np.zeros(len(T)))

    def registered(self, tried: Tried, thorough: bool = False) -> list[Tried]:
        """What was tried, and what registration makes of the best for each cell; if ``thorough``, ICP too of the most hopeful."""
        best, merit = tried.best()
        found = [tried, self.tried(self.filterreg.refine(self.rough, best).T[:, None], tried.hidden)]
        if thorough:
            some = np.sort(np.argsort(-merit, kind="stable")[:_THOROUGH])
            again = Icp(self.first.surface, self.spread).refine(self.rough, best[some]).T
            found.append(tried.with_others(some, self.tried(again[:, None], tried.hidden[some])))
        return found

    def around_the_best(self, tried: list[Tried]) -> list[Tried]:
        """What was tried, and others around the best in the better half of the cells, in the better half of those nearer, and
        so on."""
        both = [each.best() for each in tried]
        top = np.stack([merit for _, merit in both])
        best, top = np.stack([T for T, _ in both])[top.argmax(0), np.arange(top.shape[1])], top.max(0)
        width, hidden = self.width, tried[0].hidden
        for _ in range(_ROUNDS):
            better = np.argsort(-top, kind="stable")[: -(-len(top) // 2)]
            best, top, hidden = best[better], top[better], hidden[better]
            motion = self.rng.normal(size=(len(best), _AROUND, 6)) * width
            around = self.tried(moved(best[:, None], motion, self.problem), hidden)
            tried = [*tried, around]
            nearest, most = around.best()
            best = np.where((most > top)[:, None, None], nearest, best)
            top = np.maximum(most, top)
            width = width / 2
        return tried

    def best_of_each_cell(self, tried: Sequence[Tried]) -> tuple[NDArray[np.int64], Array, Array]:
        """The cells (m,) in which poses were tried that touch; and in each the one (m, 4, 4) of the highest merit, and that merit
        (m,)."""
        T = np.concatenate([each.T.reshape(-1, 4, 4) for each in tried])
        depth, merit = (np.concatenate([getattr(each, name).ravel() for each in tried]) for name in ("depth", "merit"))
        some = np.flatnonzero((depth > 0) & (depth <= self.first.space.sensor.max_penetration) & (merit > -np.inf))
        # how deep the best of all those are is worked out exactly, which takes longer
        return self.by_cell(*self._best(T[some], depth[some], merit[some])[1:])

    def by_cell(self, T: Array, merit: Array) -> tuple[NDArray[np.int64], Array, Array]:
        """The possible cells (m,) that hold poses ``T`` (n, 4, 4) which touch; in each the pose (m, 4, 4) of the highest
        ``merit``, and that merit (m,)."""
        depth = self.first.space.penetration(T)
        touching = np.isfinite(depth)
        home, T, merit = self._best(T[touching], depth[touching], merit[touching])
        possible = self.posterior.cell_log_density(home) > -np.inf
        return home[possible], T[possible], merit[possible]

    def _best(self, T: Array, depth: Array, merit: Array) -> tuple[NDArray[np.int64], Array, Array]:
        """The cells (m,) that hold poses ``T`` (n, 4, 4) so deep (n,); in each the pose (m, 4, 4) of the highest ``merit``, and
        that merit (m,)."""
        order = np.argsort(-merit, kind="stable")
        home, row = np.unique(self.index.lookup(T[order], depth[order]), return_index=True)
        return home, T[order[row]], merit[order[row]]

    def told(self, posterior: Posterior, cells: NDArray[np.int64], T: Array, k: int) -> dict[int, Refined]:
        """What all contacts tell, by the cell, at those of poses ``T`` (n, 4, 4) in ``cells`` (n,) among which the first ``k``
        modes of ``posterior`` will be."""
        leading = np.argsort(-posterior.cell_log_density(cells), kind="stable")[: _TOLD * k]
        cells, T = cells[leading], T[leading]
        found = self.filterreg.refine(self.problem, T)
        by = [found if converged else None for converged in found.converged]
        return refined_at(self.index, cells, T, by, self.problem.length, np.ones(len(cells), bool))
