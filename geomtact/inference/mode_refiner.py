"""The leading modes of one contact mask refined by registration (thesis 6.3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geomtact.contact_space.index import Index
from geomtact.contact_space.space import ContactSpace
from geomtact.geometry.distance import PoseDistance, mode_radius
from geomtact.inference.distribution import Refined
from geomtact.inference.modes import leading_cells
from geomtact.inference.posterior import Posterior
from geomtact.inference.registered import Search
from geomtact.inference.reweight import reweight_cells
from geomtact.registration.contact_problem import make_problem
from geomtact.registration.filterreg import FilterReg
from geomtact.registration.icp import Icp
from geomtact.registration.observability import Spread
from geomtact.registration.protocol import Problem, Refinement, Refiner
from geomtact.registration.surface import Surface
from geomtact.scoring.likelihood import cast_log_likelihood
from geomtact.scoring.overlap import to_grid
from geomtact.se3 import Array
from geomtact.sensing.contact import Contact
from geomtact.sensing.moments import cleaned, moments

_SURFACE_POINTS = 30_000  # points of the object's surface that registration uses; hand-set
LIKELIHOOD_POWER = 0.5  # power of the likelihood at one pose that reweights the cell around it; hand-set
_SHAPE = (36, 48)  # of the casts by which refinements are compared


@dataclass(frozen=True, eq=False)
class ModeRefiner:
    """Refines poses of one object on one sensor."""

    space: ContactSpace

    @cached_property
    def surface(self) -> Surface:
        """The object's surface."""
        return Surface(*self.space.mesh.sample_surface(_SURFACE_POINTS, seed=0))

    @property
    def _shape(self) -> tuple[int, int]:
        return self.space.sensor.along(_SHAPE)

    def refiners(self, index: Index, thorough: bool) -> list[Refiner]:
        """FilterReg for the grid of ``index``; ICP too if ``thorough``."""
        filterreg = self._filterreg(index)
        return [filterreg, Icp(self.surface, filterreg.spread)] if thorough else [filterreg]

    def _filterreg(self, index: Index) -> FilterReg:
        return FilterReg(self.surface, Spread.of_grid(index.angle_step, index.resolution.step, index.approach))

    def searching(self, index: Index, problem: Problem) -> Search:
        """What registers many poses (n, 4, 4) to all contacts of ``problem``."""
        return partial(self._filterreg(index).search, problem)

    def refine(self, posterior: Posterior, contact: Contact, k: int, thorough: bool = True) -> Posterior:
        """``posterior`` with its ``k`` leading modes refined against the observed ``contact``, and reweighted.

        Each mode keeps the likeliest of three kinds of pose: the cell's own, the same shifted to the observed centroid, and the
        result of each registration from there. These likelihoods then share out the mass of the modes' cells.

        Parameters
        ----------
        contact : on any grid over the window; its depths are not used
        thorough : whether ICP registers too, or FilterReg alone
        """
        cells = leading_cells(posterior, k)
        if not len(cells):
            return posterior
        index, sensor = posterior.index, self.space.sensor
        shown = cleaned(contact.soft_mask, sensor)
        problem, mask = make_problem(shown, sensor), shown > 0.5
        start = index.poses(cells)
        candidates = [start, self._centred(posterior, mask, cells, start)]
        refinements = [refiner.refine(problem, candidates[-1]) for refiner in self.refiners(index, thorough)]
        poses = np.stack([*candidates, *(r.T for r in refinements)])
        winner, likelihood = self._best(mask, poses)
        by = [refinements[best - len(candidates)] if best >= len(candidates) else None for best in winner]
        refined = refined_at(index, cells, poses[winner, np.arange(len(cells))], by, problem.length, winner > 0)
        return replace(reweight_cells(posterior, cells, LIKELIHOOD_POWER * likelihood), refined=refined)

    def register(self, posterior: Posterior, problem: Problem, k: int, thorough: bool = True) -> Posterior:
        """An explored ``posterior`` with the hearts of its ``k`` leading modes moved to where registration against all contacts,
        the ``problem``, finds a denser pose; ``thorough`` as of :meth:`refine`."""
        explored = posterior.explored
        if explored is None or not len(explored.hearts) or not k:
            return posterior
        hearts = explored.settled_hearts(k)
        found = [refiner.refine(problem, hearts) for refiner in self.refiners(posterior.index, thorough)]
        T = np.stack([hearts, *(each.T for each in found)])
        density = np.full(T.shape[:2], -np.inf)
        density[0] = explored.density.log_density(explored.hearts[:k])
        distance, radius = PoseDistance(self.space.mesh), mode_radius(self.space.mesh)
        near = np.stack([distance.within(heart, T[1:, i], radius) for i, heart in enumerate(hearts)], 1)
        near[near] = np.isfinite(self.space.penetration(T[1:][near]))
        density[1:][near] = explored.density.log_density(T[1:][near])
        best = density.argmax(0)
        # where no registration helped, the covariance is that of the first one
        by = [found[max(b - 1, 0)] for b in best]
        each = [one if one.converged[i] else None for i, one in enumerate(by)]
        numbers = np.arange(len(hearts))
        refined = refined_at(posterior.index, numbers, T[best, numbers], each, problem.length, best > 0)
        return replace(posterior, refined=refined)

    def _best(self, mask: NDArray[np.bool_], poses: Array) -> tuple[NDArray[np.int64], Array]:
        """At which of the poses (c, n, 4, 4) ``mask`` is most likely, for each of n modes, the first where none touches;
        and how likely (n,)."""
        # a rejected refinement is its own start: each pose is cast once
        different, which = np.unique(poses.reshape(-1, 16), axis=0, return_inverse=True)
        log_likelihood = self.log_likelihood(mask, different.reshape(-1, 4, 4))[which.ravel()].reshape(poses.shape[:2])
        todo = np.arange(poses.shape[1])
        while len(todo):  # only winners are checked for contact, which costs more
            best = log_likelihood[:, todo].argmax(0)
            off = ~np.isfinite(self.space.penetration(poses[best, todo])) & np.isfinite(log_likelihood[best, todo])
            log_likelihood[best[off], todo[off]] = -np.inf
            todo = todo[off]
        best = log_likelihood.argmax(0)
        return best, log_likelihood[best, np.arange(len(best))]

    def log_likelihood(self, mask: NDArray[np.bool_], T: ArrayLike) -> Array:
        """Log likelihood (n,) of ``mask`` given the contact cast at poses ``T`` (n, 4, 4)."""
        sensor = self.space.sensor
        seen = to_grid(mask, self._shape)
        depths = self.space.caster.depths(sensor, np.asarray(T, float), self._shape)
        return cast_log_likelihood(depths, seen, sensor.pixel_area(seen.shape))

    def _centred(self, posterior: Posterior, contact: NDArray[np.bool_], cells: NDArray[np.int64], T: Array) -> Array:
        """``T`` shifted in the membrane's plane, by at most a lattice step, towards the observed centroid."""
        sensor, index = self.space.sensor, posterior.index
        scale = float(np.hypot(*sensor.half_window))
        seen = moments(to_grid(contact, self._shape)[None], sensor)[0, :2] * scale
        shift = np.clip(seen - index.moments[:2, cells].T * scale, -index.resolution.step, index.resolution.step)
        out = T.copy()
        out[:, :2, 3] += shift
        target = np.array(index.resolution.penetrations)[cells // index.places]
        deepest = self.space.caster.depths(sensor, out, self._shape).max((1, 2))
        out[:, 2, 3] += np.where(np.isfinite(deepest), deepest - target, 0.0)
        return out


def refined_at(
    index: Index,
    cells: NDArray[np.int64],
    T: Array,
    by: Sequence[Refinement | None],
    length: float,
    moved: NDArray[np.bool_],
) -> dict[int, Refined]:
    """The refined poses ``T`` (n, 4, 4) by their ``cells`` (n,), with the covariance and observable directions of the refinement
    that found each; where none did, with the spread of poses over a cell."""
    covariance, observable = np.zeros((len(cells), 6, 6)), [np.zeros((0, 6))] * len(cells)
    for i, found in enumerate(by):
        if found is not None:
            covariance[i], observable[i] = found.covariance[i], found.observable[i]
    alone = np.array([found is None for found in by], bool)
    covariance[alone] = index.cell_covariance(T[alone])
    return {
        int(cell): Refined(T[i], covariance[i], observable[i], length, bool(moved[i])) for i, cell in enumerate(cells)
    }
