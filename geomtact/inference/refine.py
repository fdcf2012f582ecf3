"""The leading modes taken below the grid by registration (thesis 6.3)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geomtact.contact_space.index import Index
from geomtact.contact_space.space import ContactSpace
from geomtact.inference.posterior import Posterior, Refined
from geomtact.registration.filterreg import FilterReg
from geomtact.registration.icp import Icp
from geomtact.registration.observability import Spread
from geomtact.registration.protocol import Refiner, Surface
from geomtact.registration.rim import make_problem
from geomtact.scoring.overlap import to_grid
from geomtact.se3 import Array
from geomtact.sensing.moments import moments, without_specks

_SURFACE_POINTS = 30_000
_LEAST_TURN = 0.02  # rad
_SHAPE = (48, 64)  # of the casts that judge a refinement


@dataclass(frozen=True, eq=False)
class Refinery:
    """Refines poses of one object on one sensor."""

    space: ContactSpace

    @cached_property
    def _surface(self) -> Surface:
        mesh = self.space.mesh
        points, normals = mesh.sample_surface(_SURFACE_POINTS, seed=0)
        return Surface(points, normals)

    def _refiners(self, index: Index) -> list[Refiner]:
        # where symmetry leaves no rotation to search, registration is still free to turn a little
        rotation, step = max(index.angle_step, _LEAST_TURN), index.resolution.step
        spread = Spread(rotation / np.sqrt(12), step / np.sqrt(12))
        return [FilterReg(self._surface, spread), Icp(self._surface, spread)]

    def refine(self, posterior: Posterior, mask: NDArray[np.bool_], k: int) -> dict[int, Refined]:
        """The ``k`` leading modes of ``posterior`` refined against the observed ``mask`` (h, w), by pose id.

        Of the cell's own pose, the same with the contact's centroid moved onto the observed one, and what each
        registration makes of that, the pose that agrees best with the observed contact is kept: a refinement that
        does not raise a mode's agreement is dropped.
        """
        cells = posterior.leading_cells(k)
        if not len(cells):
            return {}
        index, sensor = posterior.index, self.space.sensor
        contact = without_specks(mask, sensor)
        problem = make_problem(contact, sensor)
        start = index.poses(cells)
        candidates = [start, self._centred(posterior, contact, cells, start)]
        refinements = [refiner.refine(problem, candidates[-1]) for refiner in self._refiners(index)]
        poses = np.stack([*candidates, *(r.T for r in refinements)])
        # a rejected refinement is its own start: each pose is cast once
        different, which = np.unique(poses.reshape(-1, 16), axis=0, return_inverse=True)
        merit = self.agreement(contact, different.reshape(-1, 4, 4))[which.ravel()].reshape(poses.shape[:2])
        out = {}
        for i, cell in enumerate(cells):
            best = int(merit[:, i].argmax())
            T = poses[best, i]
            covariance, observable = index.cell_covariance(T), np.zeros((0, 6))
            if best >= len(candidates):
                found = refinements[best - len(candidates)]
                covariance, observable = found.covariance[i], found.observable[i]
            out[int(cell)] = Refined(T, covariance, observable, problem.length, best > 0)
        return out

    def agreement(self, mask: NDArray[np.bool_], T: ArrayLike) -> Array:
        """How well the contact cast at poses ``T`` (n, 4, 4) agrees with ``mask``, 0 to 1; -inf off the contact space.

        Intersection over union, at the depth of contour that agrees best: an elastic gel touches less than the part
        of the object below the membrane, by an unknown depth.
        """
        T = np.asarray(T, float)
        sensor = self.space.sensor
        wide = sensor.half_window[0] >= sensor.half_window[1]
        shape = _SHAPE if wide else _SHAPE[::-1]
        seen = to_grid(mask, shape).ravel()
        depth = self.space.caster.depths(sensor, T, shape).reshape(len(T), -1)
        out = np.zeros(len(T))
        for share in (0.0, 0.25, 0.5):
            felt = depth > np.maximum(depth.max(1, keepdims=True), 0) * share
            union = (felt | seen).sum(1)
            out = np.maximum(out, (felt & seen).sum(1) / np.maximum(union, 1))
        out[~np.isfinite(self.space.penetration(T))] = -np.inf
        return out

    def _centred(self, posterior: Posterior, contact: NDArray[np.bool_], cells: NDArray[np.int64], T: Array) -> Array:
        """``T`` shifted in the membrane's plane, by at most a lattice step, towards the observed centroid."""
        sensor, index = self.space.sensor, posterior.index
        scale = float(np.hypot(*sensor.half_window))
        seen = moments(contact[None], sensor)[0, :2] * scale
        shift = np.clip(seen - index.moments[:2, cells].T * scale, -index.resolution.step, index.resolution.step)
        out = T.copy()
        out[:, :2, 3] += shift
        depths = np.array(index.resolution.penetrations)[cells // index.places]
        return self.space.settle(out, depths, steps=4)[0]
