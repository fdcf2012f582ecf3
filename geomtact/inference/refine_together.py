"""The leading modes of several sensors, or of heights, taken below the grid, by all contacts at once.

A cell is wider than the contacts of several sensors leave the pose, so its own pose is far from where they agree. Poses
drawn within the most probable cells are cast on every sensor, the likeliest of each is registered to all contacts together, and
a last search around the best of these follows. Directions that one contact leaves open another may tell.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from geomtact.contact_space.carry import UNFELT
from geomtact.contact_space.index import Index
from geomtact.inference.posterior import Posterior, Refined
from geomtact.inference.refine import Refinery
from geomtact.registration.filterreg import FilterReg
from geomtact.registration.observability import Spread, moved
from geomtact.registration.protocol import Problem
from geomtact.registration.rim import make_problem
from geomtact.scoring.likelihood import cast_log_likelihood, height_log_likelihood
from geomtact.scoring.overlap import to_grid
from geomtact.se3 import Array, inverse
from geomtact.sensing.contact import Contact
from geomtact.sensing.moments import without_specks

_SHAPE = (24, 32)  # of the casts that choose among many
_CELLS, _PER_MODE = 200, 10  # that are looked into: so many, and more for each mode that is asked for
_DRAWS = 8  # poses drawn within each
_POINTS, _ROUGH = 60, 20  # of each outline, at most: to work out what is told, and to register all that is looked into
_HOPEFUL = 4  # of the poses tried for a cell, that are asked for by more than two sensors
# Of the last search, each in half the width of the one before, and for the better half of the cells
_ROUNDS, _AROUND = 3, 12
_TOLD = 5  # for each mode that is asked for, cells of which it is worked out what the contacts tell
# Power of the joint likelihood at one pose; and the share of their mass that the cells looked into keep, whatever is likely
# within them. Chosen, as are the next, on scenes that the study does not judge (docs/several-sensors.md)
_TRUST, _DOUBT = 0.3, 0.03
# The share that all others keep: halved by every contact, at most, and for how likely those looked into are in the mean, as a
# share of the best of them
_ELSEWHERE, _AT_MOST, _AS_LIKELY = 0.4, 0.2, 5.0
_BEFORE = 0.5  # power of what a cell had, against what its likeliest pose explains: both speak of the same images
# nats, for each contact, that a pose explains less than the poses which suit each sensor best: of a right one, of a wrong one
ALIKE, UNLIKE = 4.0, 8.0
_WORTH = 0.5  # power of the likelihood in the evidence
_OUTLINE = 150.0  # nats that each metre of a contact's outline costs even at the right pose
_NEAR, _FAR = 0.5e-3, 5e-3  # m by which a pose misses a sensor: its standard deviation, and at most


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

    The evidence becomes the mean likelihood under the prior, as far as the cells looked into hold it. ``settings`` tell by how
    many nats a contact the likeliest pose falls short: ``unexplained_nats``, of the poses that suit each sensor best, and, of
    masks alone, ``misfit_nats``, of what is left to chance by the length of the outlines.
    """
    looked_into = posterior.likeliest_cells(_CELLS + _PER_MODE * k)
    if not len(looked_into):
        return posterior
    search = _Search(posterior.index, views, np.random.default_rng(seed))
    tried = search.around_the_best(search.registered(search.drawn(looked_into)))
    home, poses, likely = search.best_of_each_cell(tried)
    held = posterior.cell_log_density(home) > -np.inf
    home, poses, likely = home[held], poses[held], likely[held]

    unexplained = (search.most.sum() - likely.max(initial=-np.inf)) / search.felt
    explains = float(np.clip((UNLIKE - unexplained) / (UNLIKE - ALIKE), 0, 1))
    mass = posterior.cell_log_density(home) + posterior.index.log_weight[home]
    share_elsewhere = _share_elsewhere(mass, _TRUST * likely, search.felt) if search.felt > 1 else 1.0
    doubt, elsewhere = (1 - (1 - share) * explains for share in (_DOUBT, share_elsewhere))
    if len(home):
        known = posterior.index.log_weight if log_prior is None else log_prior
        heights = search.heights(poses)
        explained = known[home] + _WORTH * (likely - heights) + heights
        posterior = replace(posterior, log_evidence=float(np.logaddexp.reduce(explained)))
    posterior = posterior.shared_anew(home, _TRUST * likely, doubt, elsewhere, _BEFORE, log_prior)

    leading = np.argsort(-posterior.cell_log_density(home), kind="stable")[: _TOLD * k]
    told_at = search.told(home[leading], poses[leading])
    said: dict[str, float | None] = {"unexplained_nats": float(unexplained)}
    if not any(view.measured for view in views):
        outline = np.mean([view.outline for view in search.views[: search.felt]])
        said["misfit_nats"] = float(-likely.max(initial=-np.inf) / search.felt - _OUTLINE * outline)
    said = {name: nats if nats is not None and np.isfinite(nats) else None for name, nats in said.items()}
    return replace(posterior, refined=told_at, settings=posterior.settings | said)


def _share_elsewhere(log_mass: Array, log_likelihood: Array, felt: int) -> float:
    """The share of their mass that cells not looked into keep: a pose may lie there that explains ``felt`` contacts as well as
    the best, but seldom, the more of them there are and the more the best of those looked into, with ``log_mass`` (n,) and
    ``log_likelihood`` (n,), stands out of the others."""
    if len(log_mass) < 2:
        return _AT_MOST
    others = np.arange(len(log_mass)) != log_likelihood.argmax()
    log_mass, beside = log_mass[others], log_likelihood[others] - log_likelihood.max()
    in_the_mean = np.logaddexp.reduce(log_mass + beside) - np.logaddexp.reduce(log_mass)
    return float(min(_AT_MOST, _ELSEWHERE / 2**felt + _AS_LIKELY * np.exp(in_the_mean)))


@dataclass(frozen=True, eq=False)
class _Tried:
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
        T_first_sensor = np.stack([inverse(view.T_sensor_first) for view, _ in touching])
        self.problem, self.rough = (
            Problem.joined(
                [make_problem(v.mask, v.refinery.space.sensor, c.height, max_points=points) for v, c in touching],
                T_first_sensor,
            )
            for points in (_POINTS, _ROUGH)
        )
        self.spread = Spread.of_grid(index.angle_step, index.resolution.step, index.approach)
        self.filterreg = FilterReg(self.first.surface, self.spread)
        self.most = np.full(len(views), -np.inf)

    def tried(self, T: Array, hidden: Array) -> _Tried:
        """With the object at ``T`` (n, d, 4, 4); ``hidden`` (n,) as in :class:`_Tried`."""
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
        return _Tried(T, depth, np.where(hopeful, merit, -np.inf), hidden)

    def drawn(self, cells: NDArray[np.int64]) -> _Tried:
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

    def registered(self, tried: _Tried) -> list[_Tried]:
        """What was tried, and what registration makes of the best for each cell."""
        return [tried, self.tried(self.filterreg.refine(self.rough, tried.best()[0]).T[:, None], tried.hidden)]

    def around_the_best(self, tried: list[_Tried]) -> list[_Tried]:
        """What was tried, and others around the best in the better half of the cells, in the better half of those nearer, and
        so on."""
        both = [each.best() for each in tried]
        top = np.stack([merit for _, merit in both])
        best, top = np.stack([T for T, _ in both])[top.argmax(0), np.arange(top.shape[1])], top.max(0)
        width, hidden = 0.25 * self.spread.metres(self.problem.length), tried[0].hidden
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

    def best_of_each_cell(self, tried: Sequence[_Tried]) -> tuple[NDArray[np.int64], Array, Array]:
        """The cells (m,) in which poses were tried that touch; and in each the one (m, 4, 4) of the highest merit, and that merit
        (m,)."""
        T = np.concatenate([each.T.reshape(-1, 4, 4) for each in tried])
        depth, merit = (np.concatenate([getattr(each, name).ravel() for each in tried]) for name in ("depth", "merit"))
        some = np.flatnonzero((depth > 0) & (depth <= self.first.space.sensor.max_penetration) & (merit > -np.inf))
        T, merit = self._best(T[some], depth[some], merit[some])[1:]
        # how deep the best of all those are is worked out exactly, which takes longer
        depth = self.first.space.penetration(T)
        touching = np.isfinite(depth)
        return self._best(T[touching], depth[touching], merit[touching])

    def _best(self, T: Array, depth: Array, merit: Array) -> tuple[NDArray[np.int64], Array, Array]:
        """The cells (m,) that hold poses ``T`` (n, 4, 4) so deep (n,); in each the pose (m, 4, 4) of the highest ``merit``, and
        that merit (m,)."""
        order = np.argsort(-merit, kind="stable")
        home, row = np.unique(self.index.lookup(T[order], depth[order]), return_index=True)
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
