"""The fit of the observed points to the surface at refined poses, and which of these poses are accepted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geomtact.registration.observability import Spread, motion_of, moved, observable_subspace, summary, without_sinks
from geomtact.registration.protocol import Problem, Refinement
from geomtact.se3 import Array

# All constants are hand-set.
FEWEST = 6  # least number of points on the surface for which a pose is accepted
_LEAST_SUPPORT = 0.3  # least share of the points on the surface for which a pose is accepted
_MOST_RESIDUAL = 1.5  # largest residual for which a pose is accepted, in units of the noise
_MOST_MOTION = 4.0  # largest motion from the start for which a pose is accepted, in standard deviations of the starts


@dataclass(frozen=True, eq=False)
class Meeting:
    """The fit of the observed points to the surface at k poses, with c contacts.

    Attributes
    ----------
    information, slope : (k, 6 + c, 6 + c), (k, 6 + c) normal equations about zeta (see observability) and the sinks
    residual : (k,) rms distance of the points from the surface, in units of their noise
    support : (k,) how many points lie on the surface
    """

    information: Array
    slope: Array
    residual: Array
    support: NDArray[np.int64]


def keep_observable(start: Array, T: Array, meeting: Meeting, spread: Spread, problem: Problem) -> Array:
    """``T`` (k, 4, 4) moved back to ``start`` (k, 4, 4) along all directions that are not observable where they meet."""
    zeta = motion_of(start, T, problem)
    for i, each in enumerate(meeting.information):
        information = without_sinks(each, problem.sink_std)
        if np.isfinite(information).all():
            measure, move, _ = observable_subspace(information, spread, problem.length)
            zeta[i] = move @ (measure @ zeta[i])
    return moved(start, zeta, problem)


def accept_or_revert(
    start: Array, T: Array, meeting: Meeting, at_rest: NDArray[np.bool_], spread: Spread, problem: Problem
) -> Refinement:
    """``T`` (k, 4, 4) where it is accepted: the starts (k, 4, 4) elsewhere.

    A pose is accepted that came to rest near its start, with the observed points on the surface.
    """
    zeta = motion_of(start, T, problem) / spread.metres(problem.length)
    ran = np.linalg.norm(zeta.reshape(-1, 2, 3), axis=2)
    accepted = (
        at_rest
        & np.isfinite(T).all((1, 2))
        & np.isfinite(meeting.information).all((1, 2))
        & (meeting.support >= max(FEWEST, _LEAST_SUPPORT * len(problem.points)))
        & (meeting.residual < _MOST_RESIDUAL)
        & (ran < _MOST_MOTION).all(1)
    )
    out = np.where(accepted[:, None, None], T, start)
    covariance, observable = np.zeros((len(T), 6, 6)), []
    for i in range(len(T)):
        information = np.zeros((6, 6))
        if accepted[i]:
            # noise larger than assumed gives less information
            information = without_sinks(meeting.information[i], problem.sink_std) / max(1.0, meeting.residual[i]) ** 2
        covariance[i], rows = summary(out[i], information, spread, problem)
        observable.append(rows)
    return Refinement(out, accepted, covariance, observable, meeting.residual, meeting.support, problem.length)
