"""The leading modes of a posterior refined by registration (thesis 6.3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray

from geomtact.contact_space.index import Index
from geomtact.contact_space.space import ContactSpace
from geomtact.geometry.distance import PoseDistance, mode_radius
from geomtact.inference.distribution import Refined
from geomtact.inference.posterior import Posterior
from geomtact.inference.registered import Search
from geomtact.registration.filterreg import FilterReg
from geomtact.registration.icp import Icp
from geomtact.registration.observability import Spread
from geomtact.registration.protocol import Problem, Refinement, Refiner
from geomtact.registration.surface import Surface
from geomtact.se3 import Array

_SURFACE_POINTS = 30_000  # points of the object's surface that registration uses; hand-set


@dataclass(frozen=True, eq=False)
class ModeRefiner:
    """Refines poses of one object on one sensor."""

    space: ContactSpace

    @cached_property
    def surface(self) -> Surface:
        """The object's surface."""
        return Surface(*self.space.mesh.sample_surface(_SURFACE_POINTS, seed=0))

    def refiners(self, index: Index, thorough: bool) -> list[Refiner]:
        """FilterReg for the grid of ``index``; ICP too if ``thorough``."""
        filterreg = self._filterreg(index)
        return [filterreg, Icp(self.surface, filterreg.spread)] if thorough else [filterreg]

    def _filterreg(self, index: Index) -> FilterReg:
        return FilterReg(self.surface, Spread.of_grid(index.angle_step, index.resolution.step, index.approach))

    def searching(self, index: Index, problem: Problem) -> Search:
        """What registers many poses (n, 4, 4) to all contacts of ``problem``."""
        return partial(self._filterreg(index).search, problem)

    def refine(self, posterior: Posterior, problem: Problem, k: int, thorough: bool = True) -> Posterior:
        """The ``posterior`` with the hearts of its ``k`` leading modes moved to where registration against all contacts, the
        ``problem``, finds a denser pose, if it is resolved within the cells; by FilterReg, and by ICP too if ``thorough``."""
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
        refined = _refined_at(posterior.index, T[best, numbers], each, problem.length, best > 0)
        return replace(posterior, refined=refined)


def _refined_at(
    index: Index, T: Array, by: Sequence[Refinement | None], length: float, moved: NDArray[np.bool_]
) -> dict[int, Refined]:
    """The refined poses ``T`` (n, 4, 4) of n modes, with the covariance and observable directions of the refinement that found
    each; where none did, with the spread of poses over a cell."""
    out = {}
    for i, (pose, found) in enumerate(zip(T, by, strict=True)):
        covariance = index.cell_covariance(pose) if found is None else found.covariance[i]
        observable = np.zeros((0, 6)) if found is None else found.observable[i]
        out[i] = Refined(pose, covariance, observable, length, bool(moved[i]))
    return out
