"""FilterReg (Gao and Tedrake, CVPR 2019) for the rim of a contact: a Gaussian filter as E-step, point to plane as M-step.

Each rim point meets the average of the surface points around it, weighted by a Gaussian that narrows from the spread
of the start poses to the noise of the rim, against a constant for outliers.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geomtact.registration.fit import Fit, Meeting, gather, judged, rejected
from geomtact.registration.observability import Spread, jacobian, moved
from geomtact.registration.protocol import Problem, Refinement, Surface
from geomtact.registration.rim import near_surface
from geomtact.se3 import Array, apply, inverse

_NEIGHBOURS = 5
_OUTLIER = 0.05  # filter value at which a rim point counts as half an outlier
_STEPS_AT_END = 12  # with the narrowest filter, at most
_REST = 0.5  # of the noise that the last step may be
_STRETCH = np.array([1.0, 1.0, 3.0])  # the rim is known better across the membrane (z) than along it
_SLOPE_NOISE = 0.2  # noise across the membrane, as a share of that along it


@dataclass(frozen=True)
class FilterReg:
    """Refines poses of one object against the rim of a contact.

    Attributes
    ----------
    surface : the object's surface, points denser than the sensor's pixels
    spread : how far the start poses may be off
    narrowing : of the filter at each step; the smaller, the fewer steps
    """

    surface: Surface
    spread: Spread
    narrowing: float = 0.6
    name: str = "filterreg"

    def refine(self, problem: Problem, T: Array) -> Refinement:
        """Refine the poses ``T`` (k, 4, 4), T_sensor_object, one after the other."""
        fits = [self._refine_one(problem, start) for start in np.asarray(T, float).reshape(-1, 4, 4)]
        return gather(fits, problem, self.spread)

    def _refine_one(self, problem: Problem, start: Array) -> Fit:
        reach = 3 * self.spread.radius(problem.length) + 2 * problem.pitch
        points, normals = near_surface(self.surface, problem, start, reach)
        if not len(points):
            return rejected(start)
        rim_filter = RimFilter(problem, start, points, normals, self.surface.spacing)
        # the motion zeta and the rim's offset along z are held by what was known before: what the rim does not tell
        # stays where it was
        held = np.append(1 / self.spread.metres(problem.length), 1 / problem.sink_std) ** 2
        state, T, sigma, at_end, at_rest = np.zeros(7), start, reach / 3, 0, False
        while at_end < _STEPS_AT_END and not at_rest:
            sigma = max(rim_filter.narrowest, self.narrowing * sigma)
            at_end += sigma == rim_filter.narrowest
            meeting = rim_filter.meet(T, state[6], sigma)
            if meeting.support < 6:
                return rejected(start)
            step = np.linalg.solve(meeting.information + np.diag(held), meeting.slope - held * state)
            state += step
            T = moved(T, step[:6], problem)
            at_rest = bool(at_end > 1 and np.linalg.norm(step[:6]) < _REST * problem.noise)
        return judged(start, T, meeting, at_rest, self.spread, problem)


class RimFilter:
    """Which surface each rim point meets, for poses close to ``start``.

    Parameters
    ----------
    problem : with a rim
    start : (4, 4) T_sensor_object at which the surface is given
    points, normals : (s, 3) of the surface that may have made the rim, sensor frame at ``start``
    spacing : of those points [m]

    Attributes
    ----------
    narrowest : width of the filter that the rim's noise and the gaps between the surface's points leave [m]
    """

    def __init__(self, problem: Problem, start: Array, points: Array, normals: Array, spacing: float):
        from scipy.spatial import cKDTree

        self.problem, self.start, self.points, self.normals = problem, start, points, normals
        self.narrowest = float(np.hypot(problem.noise, spacing))
        self._tree = cKDTree(points * _STRETCH)

    def meet(self, T: Array, sink: float, sigma: float) -> Meeting:
        """Filter the surface at pose ``T`` with width ``sigma`` [m] for a rim ``sink`` [m] above the surface."""
        problem = self.problem
        # the rim moves under the surface instead of the surface over the rim: one tree serves all poses
        motion = T @ inverse(self.start)
        lowered = problem.rim - sink / problem.rays[:, 2:] * problem.rays
        rim = apply(inverse(motion), lowered)
        outward = problem.outward @ motion[:3, :3]
        distance, index = self._tree.query(rim * _STRETCH, k=min(_NEIGHBOURS, len(self.points)))
        distance, index = distance.reshape(len(rim), -1), index.reshape(len(rim), -1)
        n = self.normals[index]
        # a surface that faces another way along the membrane has not made this part of the rim
        across = np.einsum("ijk,ik->ij", n, outward)
        alike = np.clip(across / np.linalg.norm(n[..., :2], axis=2), 0, 1)
        filtered = alike * np.exp(-0.5 * (distance / sigma) ** 2)
        total = filtered.sum(1)
        share = filtered / np.maximum(total, 1e-300)[:, None]
        target = np.einsum("ij,ijk->ik", share, self.points[index])
        normal = np.einsum("ij,ijk->ik", share, n)
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
        inlier = total / n.shape[1]
        inlier = inlier / (inlier + _OUTLIER)

        # noise along the membrane shows along the normal only as far as the surface is steep
        lateral = np.hypot(np.linalg.norm(normal[:, :2], axis=1), _SLOPE_NOISE)
        error = ((rim - target) * normal).sum(1)
        J = jacobian(lowered, normal @ motion[:3, :3].T, problem)
        J = np.concatenate([J, J[:, 5:]], 1)  # lowering the rim does what raising the object does
        weight = inlier * problem.independence / (problem.noise * lateral) ** 2
        return Meeting(
            information=(J * weight[:, None]).T @ J,
            slope=-(J * weight[:, None]).T @ error,
            residual=float(np.sqrt((inlier * (error / lateral) ** 2).sum() / max(inlier.sum(), 1e-12))),
            support=int((inlier > 0.5).sum()),
        )
