"""FilterReg (Gao and Tedrake, CVPR 2019) for contacts: a Gaussian filter as E-step, point to plane or to point as M-step.

Each observed point meets the average of the surface points around it, weighted by a Gaussian that narrows from the spread
of the start poses to the noise of the points, against a constant for outliers. Membrane inside the contact that lies out of
the object, and membrane outside the contact that lies in it, pulls the surface over. All poses are refined at once.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from geomtact.kernels.parts import by_parts
from geomtact.kernels.surface_filter import Fit, Outline, meet, pull
from geomtact.registration.contact_problem import FLAT
from geomtact.registration.fit import FEWEST, Meeting, accept_or_revert, keep_observable
from geomtact.registration.observability import Spread, moved
from geomtact.registration.protocol import Problem, Refinement
from geomtact.registration.surface import Surface
from geomtact.se3 import Array, check_transforms

# All constants are hand-set.
_PART = 16  # poses that a thread takes at a time
_OUTLIER = 0.15  # sum of filter values at which a point counts as half an outlier
_STEPS_BEFORE = 4  # of many poses, before the best are chosen
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
        return contact_filter.accept_or_revert(start, *self._moved(contact_filter, start), self.spread)

    def search(
        self, problem: Problem, T: Array, rate: Callable[[Array], Array], keep: int
    ) -> tuple[NDArray[np.int64], Refinement]:
        """Of many poses ``T`` (k, 4, 4) the ``keep`` that ``rate`` (k, 4, 4) -> (k,) highest after a few steps, as rows, and
        refined from there: the filter is wide again, so that they move farther than by :meth:`refine` alone."""
        contact_filter = ContactFilter(problem, self.surface, self.objective, self.neighbours)
        nearer = self._moved(contact_filter, T, _STEPS_BEFORE)[0]
        rows = np.argsort(-rate(nearer), kind="stable")[:keep]
        return rows, self.refine(problem, nearer[rows])

    def _moved(
        self, contact_filter: ContactFilter, start: Array, most: int | None = None
    ) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Poses (k, 4, 4) after the steps they need, or ``most``, the sinks of the gel (k, c) [m], and whether they rest."""
        problem = contact_filter.problem
        # motions zeta and sinks of the gel are held by their spread before: what is not observable stays where it was
        held = np.append(1 / self.spread.metres(problem.length), np.full(problem.contacts, 1 / problem.sink_std)) ** 2
        state, T, at_rest = np.zeros((len(start), len(held))), start.copy(), np.zeros(len(start), bool)
        sigma, at_end, steps = self.spread.radius(problem.length), 0, 0
        going = np.arange(len(start))
        while len(going) and at_end < _STEPS_AT_END and steps != most and len(problem.points) >= FEWEST:
            sigma, steps = max(contact_filter.narrowest, self.narrowing * sigma), steps + 1
            at_end += sigma == contact_filter.narrowest
            meeting = contact_filter.meet(T[going], state[going, 6:], sigma)
            supported = meeting.support >= FEWEST
            contact_filter.pull(T[going], sigma, meeting)
            slope = meeting.slope - held * state[going]
            information = meeting.information + np.diag(held)
            step = np.linalg.solve(information, slope[..., None])[..., 0]
            expected = (step * slope).sum(1)[supported]  # the square of the step in its standard deviations
            going, step = going[supported], step[supported]
            state[going] += step
            T[going] = moved(T[going], step[:, :6], problem)
            if at_end > 1:
                at_rest[going] = expected < _REST**2
                going = going[~at_rest[going]]
        return T, state[:, 6:], at_rest


class ContactFilter:
    """Which surface each observed point meets at a pose.

    Attributes
    ----------
    narrowest : width of the filter that the points' noise and the gaps between the surface's points leave [m]
    """

    def __init__(self, problem: Problem, surface: Surface, objective: str = "plane", neighbours: int = 6):
        self.problem, self.surface, self.objective, self.neighbours = problem, surface, objective, neighbours
        self.narrowest = float(np.hypot(problem.middle_noise, surface.spacing))
        self._outline = Outline(
            np.ascontiguousarray(problem.points),
            np.ascontiguousarray(problem.facing),
            np.ascontiguousarray(problem.across),
            np.ascontiguousarray(problem.sinking),
            problem.noise,
            problem.weight,
            problem.contact,
        )

    def meet(self, T: Array, sinks: Array, sigma: float) -> Meeting:
        """Filter the surface at poses ``T`` (k, 4, 4) with width ``sigma`` [m], the gel sunk by ``sinks`` (k, c) [m]."""
        problem, surface, k = self.problem, self.surface.at_scale(sigma), len(T)
        voxels, far = surface.voxels, self.surface.far  # made once, not by each thread
        size, to_planes = 6 + problem.contacts, self.objective == "plane"
        fit = Fit(np.zeros((k, size, size)), np.zeros((k, size)), np.zeros(k), np.zeros(k), np.zeros(k, np.int64))

        def some(part: slice) -> None:
            about = problem.centre, problem.length, T[part], sinks[part], sigma, self.neighbours
            found = fit.part(part)
            meet(
                voxels,
                far,
                surface.turn,
                self._outline,
                *about,
                to_planes,
                _OUTLIER,
                _SLOPE_NOISE,
                FLAT,
                found,
            )

        by_parts(some, k, _PART)
        residual = np.sqrt(fit.squared / np.maximum(fit.inliers, 1e-12))
        return Meeting(fit.information, fit.slope, residual, fit.support)

    def pull(self, T: Array, sigma: float, meeting: Meeting) -> None:
        """Add the membrane that is on the wrong side of the surface to the normal equations of ``meeting``."""
        problem, voxels, far = self.problem, self.surface.at_scale(sigma).voxels, self.surface.far
        # all together weigh as much as the points
        each = problem.weight.sum() / max(len(problem.around), 1) / problem.middle_noise**2

        def some(part: slice) -> None:
            about = problem.centre, problem.length, T[part], sigma, meeting.information[part], meeting.slope[part]
            pull(voxels, far, problem.around, problem.side, each, *about)

        by_parts(some, len(T), _PART)

    def accept_or_revert(
        self, start: Array, T: Array, sinks: Array, at_rest: NDArray[np.bool_], spread: Spread
    ) -> Refinement:
        """``T`` (k, 4, 4) moved from ``start`` (k, 4, 4) along observable directions alone, where accepted (see ``fit``)."""
        T = keep_observable(start, T, self.meet(T, sinks, self.narrowest), spread, self.problem)
        return accept_or_revert(start, T, self.meet(T, sinks, self.narrowest), at_rest, spread, self.problem)
