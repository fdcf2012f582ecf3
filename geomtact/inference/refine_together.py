"""The leading modes of several sensors taken below the grid, by all contacts at once.

A cell is wider than the contacts of several sensors leave the pose, so its own pose is far from where they agree. Poses
drawn within the most probable cells are cast on every sensor, the likeliest are registered to all contacts together, and a
last search around them follows. Directions that one contact leaves open another may tell.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from geomtact.contact_space.index import Index
from geomtact.inference.posterior import Posterior, Refined
from geomtact.inference.refine import Refinery
from geomtact.registration.filterreg import FilterReg
from geomtact.registration.observability import Spread, moved
from geomtact.registration.protocol import Problem
from geomtact.registration.rim import make_problem
from geomtact.scoring.likelihood import cast_log_likelihood
from geomtact.scoring.overlap import to_grid
from geomtact.se3 import Array, inverse
from geomtact.sensing.contact import Contact
from geomtact.sensing.moments import without_specks

_SHAPE = (24, 32)  # of the casts that choose among many
_CELLS, _DRAWS = 128, 16  # that are looked into, and poses drawn within each
_PER_MODE = 5  # of these cells are searched for each mode that is asked for
_HOPEFUL = 4  # of the poses tried for a cell, that are asked for by more than two sensors
_KEPT = 3  # poses of a cell that are registered
_ROUNDS, _AROUND = 3, 12  # of the last search, each in half the width of the one before
_CHECKED = 4  # of the poses tried for each cell, whether they touch
# Of the joint likelihood at one pose, and share of their mass that the cells looked into keep, whatever is likely within them.
# Chosen, as is 1 / N below, on scenes that the study does not judge (docs/several-sensors.md)
_TRUST, _DOUBT = 0.3, 0.03
_BEFORE = 0.5  # power of what a cell had, against what its likeliest pose explains: both speak of the same images
# nats, for each contact, that a pose explains less than the poses which suit each sensor best: of a right one, of a wrong one
_ALIKE, _UNLIKE = 3.0, 8.0
_NEAR, _FAR = 0.5e-3, 5e-3  # m by which a pose misses a sensor: its standard deviation, and at most
_UNFELT = np.log(0.1)  # that a sensor shows nothing where the object would touch it


@dataclass(frozen=True, eq=False)
class View:
    """What one of several sensors shows.

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
    def mask(self) -> NDArray[np.bool_]:
        """The contact without specks, at the image's own resolution."""
        assert self.contact is not None
        mask = self.contact.mask
        return without_specks(mask, self.refinery.space.sensor.pixel_area(mask.shape))

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
            return np.where(deepest > 0, _UNFELT, 0.0)
        off = np.clip(np.maximum(-deepest, deepest - sensor.max_penetration), 0, _FAR)
        likely = cast_log_likelihood(depths, to_grid(self.mask, shape), sensor.pixel_area(shape))
        return likely - 0.5 * (off / _NEAR) ** 2


def refine_together(
    posterior: Posterior,
    views: Sequence[View],
    k: int,
    seed: int,
    log_prior: NDArray[np.floating] | None = None,
) -> Posterior:
    """``posterior``, on the first sensor's cells, with its leading modes refined against all ``views`` and weighed anew.

    As in ``Refinery.refine``, each cell keeps the pose at which what is seen is likeliest, and what the cells hold together
    is shared out anew by these likelihoods: but only as far as the likeliest pose explains what all sensors show, in the mean
    nearly as well as other poses do what each of them shows. If none does, the right one was not looked into. ``log_prior`` is as
    of ``Posterior.shared_anew``.
    """
    looked_into = posterior.likeliest_cells(_CELLS)
    if not len(looked_into):
        return posterior
    index, search = posterior.index, _Search(posterior.index, views, np.random.default_rng(seed))
    drawn, merit = search.drawn(looked_into)
    within = merit.max(1)  # so likely is what is seen somewhere in each cell
    prior = posterior.cell_log_density(looked_into) + index.log_weight[looked_into]
    chosen = np.argsort(-(prior + _TRUST * within), kind="stable")[: _PER_MODE * k]
    tried, merit = search.around_the_best(*search.registered(drawn[chosen], merit[chosen]))
    home, poses, merit = search.best_of_each_cell(tried.reshape(-1, 4, 4), merit.ravel(), _CHECKED * len(chosen))
    held = posterior.cell_log_density(home) > -np.inf
    home, poses, merit = home[held], poses[held], merit[held]

    # cells in which nothing likely was found count too, as unlikely
    judged = np.union1d(looked_into, home)
    likely = np.full(len(judged), -np.inf)
    np.maximum.at(likely, np.searchsorted(judged, looked_into), within)
    np.maximum.at(likely, np.searchsorted(judged, home), merit)
    unexplained = (search.most.sum() - merit.max(initial=-np.inf)) / search.felt
    explains = float(np.clip((_UNLIKE - unexplained) / (_UNLIKE - _ALIKE), 0, 1))
    # in cells not looked into as good a pose may lie, but the more contacts there are to be explained, the more seldom
    doubt, elsewhere = (1 - (1 - share) * explains for share in (_DOUBT, 1 / search.felt))
    posterior = posterior.shared_anew(judged, _TRUST * likely, doubt, elsewhere, _BEFORE, log_prior)

    leading = np.argsort(-posterior.cell_log_density(home), kind="stable")[: len(chosen)]
    return replace(posterior, refined=search.told(home[leading], poses[leading]))


class _Search:
    """Poses of the object in the first sensor's frame at which several sensors would show what they do.

    Attributes
    ----------
    views : those with contact first; nearly any pose explains the others
    felt : how many have contact
    most : (V,) how likely what each sensor shows is at the pose that suits it best, of all that were tried
    """

    def __init__(self, index: Index, views: Sequence[View], rng: np.random.Generator):
        self.index, self.rng = index, rng
        self.views = sorted(views, key=lambda view: view.contact is None)
        touching = [(view, view.contact) for view in views if view.contact is not None]
        self.base, self.felt = self.views[0], len(touching)
        self.first = self.base.refinery
        self.problem = Problem.joined(
            [make_problem(view.mask, view.refinery.space.sensor, contact.height) for view, contact in touching],
            np.stack([inverse(view.T_sensor_first) for view, _ in touching]),
        )
        self.spread = Spread.of_grid(index.angle_step, index.resolution.step, index.approach)
        self.filterreg = FilterReg(self.first.surface, self.spread)
        self.most = np.full(len(views), -np.inf)

    def log_likelihood(self, T: Array, first: Array | None = None) -> Array:
        """Log likelihood (n, d) of what all sensors show, with the object at ``T`` (n, d, 4, 4); -inf where others of the d are
        likelier for two sensors already. ``first`` (n, d) is the first sensor's, where it is known."""
        n, d = T.shape[:2]
        out, hopeful = np.zeros((n, d)), np.ones((n, d), bool)
        for i, view in enumerate(self.views):
            if i == 2 and d > _HOPEFUL:
                hopeful = out.argsort(1).argsort(1) >= d - _HOPEFUL
            each = view.log_likelihood(T[hopeful]) if i or first is None else first.ravel()
            self.most[i] = max(self.most[i], each.max())
            out[hopeful] += each
        return np.where(hopeful, out, -np.inf)

    def drawn(self, cells: NDArray[np.int64]) -> tuple[Array, Array]:
        """The poses of ``cells`` (n,) and others within them (n, d, 4, 4), about as deep in the first sensor that has contact as
        the cells say; and how likely each is (n, d)."""
        own, level = self.index.poses(cells), cells // self.index.places
        wanted = np.asarray(self.index.resolution.penetrations)[level]
        T, depth = self.index.draw(np.repeat(cells, _DRAWS), self.rng)
        T = np.concatenate([own[:, None], T.reshape(len(cells), _DRAWS, 4, 4)], 1)
        depth = np.concatenate([wanted[:, None], depth.reshape(len(cells), _DRAWS)], 1)
        depths = self.base.depths(T.reshape(-1, 4, 4))
        rise = depths.max((1, 2)) - depth.ravel()
        rise[~np.isfinite(rise)] = 0
        T[..., 2, 3] += rise.reshape(depth.shape)
        known = self.base.likely(depths - rise[:, None, None].astype(np.float32)).reshape(depth.shape)
        return T, self.log_likelihood(T, known)

    def registered(self, T: Array, merit: Array) -> tuple[Array, Array]:
        """``T`` (n, d, 4, 4) and ``merit`` (n, d), and what registration makes of the best of each row."""
        best = np.argsort(-merit, axis=1)[:, :_KEPT]
        start = np.take_along_axis(T, best[..., None, None], 1)
        return self._with(T, merit, self.filterreg.refine(self.problem, start.reshape(-1, 4, 4)).T.reshape(start.shape))

    def around_the_best(self, T: Array, merit: Array) -> tuple[Array, Array]:
        """``T`` (n, d, 4, 4) and ``merit`` (n, d), and others around the best of each row, nearer and nearer."""
        width = 0.25 * self.spread.metres(self.problem.length)
        for _ in range(_ROUNDS):
            best = T[np.arange(len(T)), merit.argmax(1)]
            motion = self.rng.normal(size=(len(T), _AROUND, 6)) * width
            T, merit = self._with(T, merit, moved(best[:, None], motion, self.problem))
            width = width / 2
        return T, merit

    def best_of_each_cell(self, T: Array, merit: Array, most: int) -> tuple[NDArray[np.int64], Array, Array]:
        """The cells (m,) that hold the best of ``T`` (n, 4, 4), at ``most`` so many of them; and in each the pose (m, 4, 4) of
        the highest ``merit``, and that merit (m,)."""
        order = np.argsort(-merit, kind="stable")[:most]
        depth = self.first.space.penetration(T[order])
        touching = np.isfinite(depth)
        order = order[touching]
        home, row = np.unique(self.index.lookup(T[order], depth[touching]), return_index=True)
        return home, T[order[row]], merit[order[row]]

    def told(self, cells: NDArray[np.int64], T: Array) -> dict[int, Refined]:
        """What all contacts tell at poses ``T`` (n, 4, 4), by the cell (n,) that each lies in."""
        found = self.filterreg.refine(self.problem, T)
        out = {}
        for i, cell in enumerate(cells):
            covariance, observable = self.index.cell_covariance(T[i]), np.zeros((0, 6))
            if found.converged[i]:
                covariance, observable = found.covariance[i], found.observable[i]
            out[int(cell)] = Refined(T[i], covariance, observable, self.problem.length, True)
        return out

    def _with(self, T: Array, merit: Array, more: Array) -> tuple[Array, Array]:
        return np.concatenate([T, more], 1), np.concatenate([merit, self.log_likelihood(more)], 1)
