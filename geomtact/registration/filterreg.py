"""FilterReg (Gao and Tedrake, CVPR 2019) for contacts: a Gaussian filter as E-step, point to plane or to point as M-step.

Each observed point meets the average of the surface points around it, weighted by a Gaussian that narrows from the spread
of the start poses to the noise of the points, against a constant for outliers. Membrane inside the contact that lies out of
the object, and membrane outside the contact that lies in it, pulls the surface over. All poses are refined at once.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from geomtact.registration.contact_problem import FLAT
from geomtact.registration.fit import FEWEST, Meeting, accept_or_revert, keep_observable
from geomtact.registration.observability import Spread, jacobian, moved
from geomtact.registration.protocol import Problem, Refinement, Surface
from geomtact.se3 import Array, apply, check_transforms, inverse, unit

# All constants are hand-set.
_A_THREAD = 2000  # points per thread in queries of the nearest surface
_FEWER = 2  # surface points around each point that is only inside or outside
_OUTLIER = 0.15  # sum of filter values at which a point counts as half an outlier
_STEPS_AT_END = 8  # largest number of steps with the narrowest filter
_REST = 1.0  # largest last step of a converged pose, in its standard deviations
_SLOPE_NOISE = 0.45  # noise across the membrane, as a share of that along it: a gel sinks unevenly around a contact


@dataclass(frozen=True)
class FilterReg:
    """Refines poses of one object against its contacts.

    Attributes
    ----------
    surface : the object's surface, points denser than the sensor's pixels
    spread : how far the start poses may be off
    narrowing : of the filter at each step; the smaller, the fewer steps
    objective : whether points are drawn to the surface's planes or to its points
    neighbours : how many surface points a filter takes in, at most
    """

    surface: Surface
    spread: Spread
    narrowing: float = 0.55
    objective: Literal["plane", "point"] = "plane"
    neighbours: int = 6
    name: str = "filterreg"

    def refine(self, problem: Problem, T: Array) -> Refinement:
        """Refine the poses ``T`` (k, 4, 4) of the object in the problem's frame."""
        start = check_transforms(T, "start pose").reshape(-1, 4, 4)
        contact_filter = ContactFilter(problem, self.surface, self.objective, self.neighbours)
        # motions zeta and sinks of the gel are held by their spread before: what is not observable stays where it was
        held = np.append(1 / self.spread.metres(problem.length), np.full(problem.contacts, 1 / problem.sink_std)) ** 2
        state, T, at_rest = np.zeros((len(start), len(held))), start.copy(), np.zeros(len(start), bool)
        sigma, at_end = self.spread.radius(problem.length), 0
        going = np.arange(len(start))
        while len(going) and at_end < _STEPS_AT_END and len(problem.points) >= FEWEST:
            sigma = max(contact_filter.narrowest, self.narrowing * sigma)
            at_end += sigma == contact_filter.narrowest
            meeting = contact_filter.meet(T[going], state[going, 6:], sigma)
            supported = meeting.support >= FEWEST
            slope = meeting.slope - held * state[going]
            information = meeting.information + np.diag(held)
            if len(problem.around):
                pull = contact_filter.pull(T[going], sigma)
                information[:, :6, :6] += pull[0]
                slope[:, :6] += pull[1]
            step = np.linalg.solve(information, slope[..., None])[..., 0]
            expected = (step * slope).sum(1)[supported]  # the square of the step in its standard deviations
            going, step = going[supported], step[supported]
            state[going] += step
            T[going] = moved(T[going], step[:, :6], problem)
            if at_end > 1:
                at_rest[going] = expected < _REST**2
                going = going[~at_rest[going]]
        return contact_filter.accept_or_revert(start, T, state[:, 6:], at_rest, self.spread)


class ContactFilter:
    """Which surface each observed point meets at a pose.

    Attributes
    ----------
    narrowest : width of the filter that the points' noise and the gaps between the surface's points leave [m]
    """

    def __init__(self, problem: Problem, surface: Surface, objective: str = "plane", neighbours: int = 6):
        self.problem, self.surface, self.objective, self.neighbours = problem, surface, objective, neighbours
        self.narrowest = float(np.hypot(problem.middle_noise, surface.spacing))

    def meet(self, T: Array, sinks: Array, sigma: float) -> Meeting:
        """Filter the surface at poses ``T`` (k, 4, 4) with width ``sigma`` [m], the gel sunk by ``sinks`` (k, c) [m]."""
        problem = self.problem
        points = problem.points + sinks[:, problem.contact, None] * problem.sinking
        target, normal, inlier = self._filtered(T, points, sigma)
        # noise along the membrane shows along the normal only as far as the surface is steep
        lateral = problem.noise * np.hypot(np.einsum("knj,nj->kn", normal, problem.facing), _SLOPE_NOISE)
        error = ((points - target) * normal).sum(-1)
        if self.objective == "plane":
            planes = [(normal, error, lateral)]
        else:
            axes = [np.broadcast_to(axis, points.shape) for axis in np.eye(3)]
            planes = [(axis, (points - target)[..., i], problem.noise) for i, axis in enumerate(axes)]
        own = problem.contact[:, None] == np.arange(problem.contacts)
        size = 6 + problem.contacts
        information, slope = np.zeros((len(T), size, size)), np.zeros((len(T), size))
        for axis, off, noise in planes:
            sunk = np.einsum("knj,nj->kn", axis, problem.sinking)
            J = np.concatenate([jacobian(points, axis, problem), sunk[..., None] * own], -1)
            more = _normal_equations(J, off, inlier * problem.weight / noise**2)
            information, slope = information + more[0], slope + more[1]
        squared = (inlier * (error / lateral) ** 2).sum(1)
        return Meeting(
            information=information,
            slope=slope,
            residual=np.sqrt(squared / np.maximum(inlier.sum(1), 1e-12)),
            support=(inlier > 0.5).sum(1),
        )

    def accept_or_revert(
        self, start: Array, T: Array, sinks: Array, at_rest: NDArray[np.bool_], spread: Spread
    ) -> Refinement:
        """``T`` (k, 4, 4) moved from ``start`` (k, 4, 4) along observable directions alone, where accepted (see ``fit``)."""
        T = keep_observable(start, T, self.meet(T, sinks, self.narrowest), spread, self.problem)
        return accept_or_revert(start, T, self.meet(T, sinks, self.narrowest), at_rest, spread, self.problem)

    def pull(self, T: Array, sigma: float) -> tuple[Array, Array]:
        """Normal equations (k, 6, 6), (k, 6) of the membrane that is on the wrong side of the surface."""
        problem = self.problem
        points = np.broadcast_to(problem.around, (len(T), *problem.around.shape))
        near, normals, off = self._nearest(T, points, _FEWER, sigma)
        distance2 = (off**2).sum(-1)
        share = np.exp(-0.5 * (distance2 - distance2.min(-1, keepdims=True)) / sigma**2)
        share /= share.sum(-1, keepdims=True)
        above = np.einsum("kni,knij,knij->kn", share, normals, off)
        normal = unit(np.einsum("kni,knij->knj", share, normals)) @ np.swapaxes(T[:, :3, :3], 1, 2)
        wrong = problem.side * above > 0
        # all together weigh as much as the points; what is deeper on the wrong side than the filter is wide may itself be wrong
        each = problem.weight.sum() / len(problem.around) / problem.middle_noise**2
        return _normal_equations(
            jacobian(points, normal, problem), above, wrong * each / (1 + (above / (3 * sigma)) ** 2)
        )

    def _filtered(self, T: Array, points: Array, sigma: float) -> tuple[Array, Array, Array]:
        """The E-step: where the points (k, n, 3) meet the surface, its normals there, and how surely (k, n)."""
        R = T[:, :3, :3]
        facing, across = self.problem.facing @ R, self.problem.across @ R
        near, normals, off = self._nearest(T, points, self.neighbours, sigma, facing)
        face, lean = (np.einsum("knij,knj->kni", normals, v) for v in (facing, across))
        slope = np.hypot(face, lean)
        # a surface that faces another way, or runs along the membrane, has not made this part of the outline
        alike = np.where(slope > FLAT, np.clip(face / np.maximum(slope, FLAT), 0, 1), 0)
        filtered = alike * np.exp(-0.5 * (off**2).sum(-1) / sigma**2)
        total = filtered.sum(-1)
        share = filtered / np.maximum(total, 1e-300)[..., None]
        target, normal = (np.einsum("kni,knij->knj", share, v) for v in (near, normals))
        return apply(T, target), unit(normal) @ np.swapaxes(R, 1, 2), total / (total + _OUTLIER)

    def _nearest(
        self, T: Array, points: Array, most: int, sigma: float, facing: Array | None = None
    ) -> tuple[Array, Array, Array]:
        """Nearest surface (k, n, i, 3) of points (k, n, 3), its normals, and the points' distance from it: object frame.

        Where ``facing`` (k, n, 3) is given, in the object's frame, surface that looks that way counts as nearer.
        """
        at = apply(inverse(T), points)
        surface = self.surface.at_scale(sigma)
        most = min(most, len(surface.points))
        tree, asked = surface.tree, at
        if facing is not None:
            tree, asked = surface.facing_tree, np.concatenate([at, surface.turn * facing], -1)
        asked = asked.reshape(-1, asked.shape[-1])
        workers = max(1, min(os.cpu_count() or 1, len(asked) // _A_THREAD))  # one touch has too few points for threads
        index = tree.query(asked, k=range(1, most + 1), workers=workers)[1]
        index = index.reshape(*at.shape[:-1], most)
        near = surface.points[index]
        return near, surface.normals[index], at[..., None, :] - near


def _normal_equations(J: Array, error: Array, weight: Array) -> tuple[Array, Array]:
    """(k, p, p) and (k, p) from the slopes (k, n, p) of errors (k, n) and their weights (k, n)."""
    weighted = np.swapaxes(J * weight[..., None], 1, 2)
    return weighted @ J, -(weighted @ error[..., None])[..., 0]
