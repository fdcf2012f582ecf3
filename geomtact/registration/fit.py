"""How what was observed lies on the surface at some poses, and which of them can be believed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geomtact.registration.observability import Spread, motion_of, moved, observable_subspace, summary, without_sinks
from geomtact.registration.protocol import Problem, Refinement
from geomtact.se3 import Array

FEWEST = 6  # points on the surface without which no pose is believed
_SHARE = 0.3  # of the points that must lie on it
_LOOSE = 1.5  # residual, in units of the noise, beyond which a pose is not believed
_RAN = 4.0  # standard deviations of the start that a pose may move


@dataclass(frozen=True, eq=False)
class Meeting:
    """How what was observed lies on the surface at k poses, with c contacts.

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
    """``T`` (k, 4, 4) where it can be believed: the starts (k, 4, 4) elsewhere.

    A pose is believed that came to rest near its start, with what was observed on the surface.
    """
    zeta = motion_of(start, T, problem) / spread.metres(problem.length)
    ran = np.linalg.norm(zeta.reshape(-1, 2, 3), axis=2)
    believed = (
        at_rest
        & np.isfinite(T).all((1, 2))
        & np.isfinite(meeting.information).all((1, 2))
        & (meeting.support >= max(FEWEST, _SHARE * len(problem.points)))
        & (meeting.residual < _LOOSE)
        & (ran < _RAN).all(1)
    )
    out = np.where(believed[:, None, None], T, start)
    covariance, observable = np.zeros((len(T), 6, 6)), []
    for i in range(len(T)):
        information = np.zeros((6, 6))
        if believed[i]:
            # noise larger than assumed gives less information
            information = without_sinks(meeting.information[i], problem.sink_std) / max(1.0, meeting.residual[i]) ** 2
        covariance[i], rows = summary(out[i], information, spread, problem)
        observable.append(rows)
    return Refinement(out, believed, covariance, observable, meeting.residual, meeting.support, problem.length)
