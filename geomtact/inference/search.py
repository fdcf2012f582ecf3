"""Search for the poses that explain the images of one sensor or several: draw, register, and refine around the best.

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

from geomtact.contact_space.cell_transfer import MISSED_CONTACT_SHARE
from geomtact.inference.distribution import Refined, cell_log_density
from geomtact.inference.mode_refiner import ModeRefiner, refined_at
from geomtact.inference.posterior import Posterior
from geomtact.registration.contact_problem import make_problem
from geomtact.registration.filterreg import FilterReg
from geomtact.registration.observability import Spread, moved
from geomtact.registration.protocol import Problem
from geomtact.scoring.likelihood import cast_log_likelihood, depth_map_log_likelihood
from geomtact.scoring.overlap import to_grid
from geomtact.se3 import Array, inverse
from geomtact.sensing.contact import Contact, SoftMask
from geomtact.sensing.moments import cleaned

_SHAPE = (24, 32)  # pixels of the casts by which many poses are compared
_DRAWS = 8  # poses drawn within each cell
# All constants of the search are hand-set.
_POINTS = 60  # largest number of points of an outline, for observable directions
ROUGH_POINTS = 20  # largest number of points of an outline, to register many poses
_HOPEFUL = 4  # number of poses per cell that the third and later sensors evaluate
_ROUNDS, _AROUND = 3, 12  # rounds of the last search, each for the better half of the cells, and poses per cell in each
_REFINED_PER_MODE = 5  # number of cells, for each requested mode, whose pose is registered by all points
_FIRST_WIDTH = 0.25  # standard deviation of the first motions around a pose, as a share of the grid's spread
_MISS_STD, _MOST_MISS = 0.5e-3, 5e-3  # distance by which a pose misses a sensor: std and largest value [m]


@dataclass(frozen=True, eq=False)
class SensorView:
    """The image of one sensor, the only one or one of several.

    Attributes
    ----------
    refiner : of the object on it
    contact : None where it shows none
    T_sensor_first : (4, 4) of the first sensor that has contact, in this one's frame
    """

    refiner: ModeRefiner
    contact: Contact | None
    T_sensor_first: Array

    @cached_property
    def soft_mask(self) -> SoftMask:
        """The contact without specks, at the image's own resolution."""
        assert self.contact is not None
        soft_mask = self.contact.soft_mask
        return cleaned(soft_mask, self.refiner.space.sensor)

    @property
    def mask(self) -> NDArray[np.bool_]:
        """Where it is likelier than not."""
        return self.soft_mask > 0.5

    @property
    def has_height(self) -> bool:
        """Whether depths are measured."""
        return self.contact is not None and self.contact.height is not None

    def log_likelihood(self, T: Array) -> Array:
        """Log likelihood (n,) of the image, with the object at ``T`` (n, 4, 4) in the first sensor's frame.

        The likelihood of a pose that misses, or is too deep, falls with its distance: that guides the search.
        """
        return self.likelihood_of_depths(self.depths(T))

    def depths(self, T: Array) -> NDArray[np.float32]:
        """How far below the membrane the object lies (n, h, w) [m], coarsely."""
        space = self.refiner.space
        return space.caster.depths(space.sensor, self.T_sensor_first @ T, space.sensor.along(_SHAPE))

    def likelihood_of_depths(self, depths: NDArray[np.float32]) -> Array:
        """As :meth:`log_likelihood`, from :meth:`depths`."""
        sensor, shape = self.refiner.space.sensor, depths.shape[1:]
        deepest = depths.max((1, 2))
        if self.contact is None:
            return np.where(deepest > 0, np.log(MISSED_CONTACT_SHARE), 0.0)
        off = np.clip(np.maximum(-deepest, deepest - sensor.max_penetration), 0, _MOST_MISS)
        likely = cast_log_likelihood(depths, to_grid(self.mask, shape), sensor.pixel_area(shape))
        return likely + self.depth_likelihood(depths) - 0.5 * (off / _MISS_STD) ** 2

    def depth_likelihood(self, depths: NDArray[np.float32]) -> Array:
        """Log likelihood (n,) of the measured depth map, from :meth:`depths`; 0 without one."""
        sensor, shape = self.refiner.space.sensor, depths.shape[1:]
        if self.contact is None or self.contact.height is None:
            return np.zeros(len(depths))
        height = np.asarray(cv2.resize(self.contact.height, shape[::-1], interpolation=cv2.INTER_AREA), np.float32)
        touched = to_grid(self.contact.sure, shape)
        return np.asarray(
            depth_map_log_likelihood(depths, height, touched, sensor.pixel_area(shape), sensor.height_noise), float
        )


@dataclass(frozen=True, eq=False)
class Candidates:
    """Poses tried around each of n cells.

    Attributes
    ----------
    T : (n, d, 4, 4) in the first sensor's frame
    depth : (n, d) how deep the object lies in that sensor [m], about
    log_likelihood : (n, d) of all images; -inf where others of the d are likelier for two sensors already
    hidden : (n,) how much deeper than a coarse cast shows the object is in that cell: what lies between its rays [m]
    """

    T: Array
    depth: Array
    log_likelihood: Array
    hidden: Array

    def best(self) -> tuple[Array, Array]:
        """Of each cell, the pose (n, 4, 4) of the highest log_likelihood, and that log_likelihood (n,)."""
        return self.T[np.arange(len(self.T)), self.log_likelihood.argmax(1)], self.log_likelihood.max(1)


def joint_problem(views: Sequence[SensorView], max_points: int = _POINTS) -> Problem:
    """All contacts of ``views`` together, in the first sensor's frame, with so many points of each outline at most."""
    touching = [(view, view.contact) for view in views if view.contact is not None]
    problems = [
        make_problem(view.soft_mask, view.refiner.space.sensor, contact.height, max_points=max_points)
        for view, contact in touching
    ]
    return Problem.joined(problems, np.stack([inverse(view.T_sensor_first) for view, _ in touching]))


class Search:
    """Poses of the object in the first sensor's frame at which one sensor or several would show what they do, in cells that
    ``posterior`` does not rule out.

    Attributes
    ----------
    views : those with contact first; nearly any pose explains the others
    n_contacts : number of views with contact
    best : (V,) how likely what each sensor shows is at the pose that suits it best, of all that were tried
    width : (6,) standard deviation of the motions that are tried first around a pose [m], in the axes of ``problem``
    """

    def __init__(self, posterior: Posterior, views: Sequence[SensorView], rng: np.random.Generator):
        self.posterior, self.index, self.rng = posterior, posterior.index, rng
        index = self.index
        self.views = sorted(views, key=lambda view: view.contact is None)
        self.base, self.n_contacts = self.views[0], sum(view.contact is not None for view in views)
        self.first = self.base.refiner
        self.problem, self.rough = (joint_problem(views, points) for points in (_POINTS, ROUGH_POINTS))
        self.spread = Spread.of_grid(index.angle_step, index.resolution.step, index.approach)
        self.filterreg = FilterReg(self.first.surface, self.spread)
        self.best = np.full(len(views), -np.inf)
        self.width = _FIRST_WIDTH * self.spread.metres(self.problem.length)

    def candidates(self, T: Array, hidden: Array) -> Candidates:
        """With the object at ``T`` (n, d, 4, 4); ``hidden`` (n,) as in :class:`Candidates`."""
        depths = self.base.depths(T.reshape(-1, 4, 4))
        depth = depths.max((1, 2)).reshape(T.shape[:2]) + hidden[:, None]
        log_likelihood: Array = self.base.likelihood_of_depths(depths).reshape(T.shape[:2])
        self.best[0] = max(self.best[0], log_likelihood.max())
        hopeful, d = np.ones(log_likelihood.shape, bool), T.shape[1]
        for i, view in enumerate(self.views[1:], 1):
            if i == 2 and d > _HOPEFUL:
                hopeful = log_likelihood.argsort(1).argsort(1) >= d - _HOPEFUL
            each = view.log_likelihood(T[hopeful])
            self.best[i] = max(self.best[i], each.max())
            log_likelihood[hopeful] += each
        return Candidates(T, depth, np.where(hopeful, log_likelihood, -np.inf), hidden)

    def drawn(self, cells: NDArray[np.int64]) -> Candidates:
        """The poses of ``cells`` (n,) and others within them, about as deep in the first sensor as the cells say."""
        own, level = self.index.poses(cells), cells // self.index.places
        target = np.asarray(self.index.resolution.penetrations)[level]
        hidden = target - self.base.depths(own).max((1, 2))
        hidden[~np.isfinite(hidden)] = 0
        T, depth = self.index.draw(np.repeat(cells, _DRAWS), self.rng)
        rise = self.base.depths(T).max((1, 2)) + np.repeat(hidden, _DRAWS) - depth
        T[:, 2, 3] += np.where(np.isfinite(rise), rise, 0)
        return self.candidates(np.concatenate([own[:, None], T.reshape(len(cells), _DRAWS, 4, 4)], 1), hidden)

    def depth_log_likelihood(self, T: Array) -> Array:
        """Log likelihood (n,) of all measured depth maps, with the object at ``T`` (n, 4, 4)."""
        measured = (view for view in self.views if view.has_height)
        return sum((view.depth_likelihood(view.depths(T)) for view in measured), start=np.zeros(len(T)))

    def registered(self, candidates: Candidates) -> list[Candidates]:
        """What was tried, and what registration makes of the best for each cell."""
        best, _ = candidates.best()
        return [candidates, self.candidates(self.filterreg.refine(self.rough, best).T[:, None], candidates.hidden)]

    def around_the_best(self, candidates: list[Candidates]) -> list[Candidates]:
        """What was tried, and others around the best in the better half of the cells, in the better half of those nearer, and
        so on."""
        both = [each.best() for each in candidates]
        top = np.stack([log_likelihood for _, log_likelihood in both])
        best, top = np.stack([T for T, _ in both])[top.argmax(0), np.arange(top.shape[1])], top.max(0)
        width, hidden = self.width, candidates[0].hidden
        for _ in range(_ROUNDS):
            better = np.argsort(-top, kind="stable")[: -(-len(top) // 2)]
            best, top, hidden = best[better], top[better], hidden[better]
            motion = self.rng.normal(size=(len(best), _AROUND, 6)) * width
            around = self.candidates(moved(best[:, None], motion, self.problem), hidden)
            candidates = [*candidates, around]
            nearest, most = around.best()
            best = np.where((most > top)[:, None, None], nearest, best)
            top = np.maximum(most, top)
            width = width / 2
        return candidates

    def best_of_each_cell(self, candidates: Sequence[Candidates]) -> tuple[NDArray[np.int64], Array, Array]:
        """The cells (m,) with candidates that touch, the likeliest pose (m, 4, 4) in each, and its log likelihood (m,)."""
        T = np.concatenate([each.T.reshape(-1, 4, 4) for each in candidates])
        depth, log_likelihood = (
            np.concatenate([getattr(each, name).ravel() for each in candidates]) for name in ("depth", "log_likelihood")
        )
        some = np.flatnonzero(
            (depth > 0) & (depth <= self.first.space.sensor.max_penetration) & (log_likelihood > -np.inf)
        )
        # only the best of all those get their exact depth, which takes longer
        _, T, log_likelihood = self._best(T[some], depth[some], log_likelihood[some])
        depth = self.first.space.penetration(T)
        touching = np.isfinite(depth)
        home, T, log_likelihood = self._best(T[touching], depth[touching], log_likelihood[touching])
        possible = cell_log_density(self.posterior, home) > -np.inf
        return home[possible], T[possible], log_likelihood[possible]

    def _best(self, T: Array, depth: Array, log_likelihood: Array) -> tuple[NDArray[np.int64], Array, Array]:
        """As :meth:`best_of_each_cell`, of poses ``T`` (n, 4, 4) at the given ``depth`` (n,) in any cells."""
        order = np.argsort(-log_likelihood, kind="stable")
        home, row = np.unique(self.index.lookup(T[order], depth[order]), return_index=True)
        return home, T[order[row]], log_likelihood[order[row]]

    def refined(self, posterior: Posterior, cells: NDArray[np.int64], T: Array, k: int) -> dict[int, Refined]:
        """Covariances and observable directions by all contacts, at those of poses ``T`` (n, 4, 4) in ``cells`` (n,) among which
        the first ``k`` modes of ``posterior`` will be."""
        leading = np.argsort(-cell_log_density(posterior, cells), kind="stable")[: _REFINED_PER_MODE * k]
        cells, T = cells[leading], T[leading]
        found = self.filterreg.refine(self.problem, T)
        by = [found if converged else None for converged in found.converged]
        return refined_at(self.index, cells, T, by, self.problem.length, np.ones(len(cells), bool))
