"""One refined pose, whether it can be believed, and how the fits of several modes become one result."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geomtact.registration.observability import Spread, summary, without_sink
from geomtact.registration.protocol import Problem, Refinement
from geomtact.se3 import Array, apply, inverse


@dataclass(frozen=True, eq=False)
class Fit:
    """One refined pose; ``information`` (6, 6) about zeta (see observability) is zero where it did not converge."""

    T: Array
    converged: bool
    information: Array
    residual: float
    support: int


@dataclass(frozen=True, eq=False)
class Meeting:
    """How the rim lies on the surface at one pose.

    Attributes
    ----------
    information, slope : (7, 7), (7,) normal equations about zeta (see observability) and the rim's offset along z
    residual : rms distance of the rim from the surface, measured along the membrane [m]
    support : how many rim points lie on the surface
    """

    information: Array
    slope: Array
    residual: float
    support: int


def rejected(start: Array, residual: float = np.inf, support: int = 0) -> Fit:
    """The start pose, about which nothing was learnt."""
    return Fit(start, False, np.zeros((6, 6)), residual, support)


def gather(fits: list[Fit], problem: Problem, spread: Spread) -> Refinement:
    """One Refinement of all fits."""
    told_of = [summary(fit.T, fit.information, spread, problem) for fit in fits]
    return Refinement(
        T=np.array([fit.T for fit in fits]).reshape(-1, 4, 4),
        converged=np.array([fit.converged for fit in fits], bool),
        covariance=np.array([covariance for covariance, _ in told_of]).reshape(-1, 6, 6),
        observable=[rows for _, rows in told_of],
        residual=np.array([fit.residual for fit in fits]),
        support=np.array([fit.support for fit in fits], int),
        length=problem.length,
    )


def judged(start: Array, T: Array, meeting: Meeting, at_rest: bool, spread: Spread, problem: Problem) -> Fit:
    """The fit to ``T``, or the start pose unless the rim lies on the surface and the pose came to rest nearby."""
    ran = np.linalg.norm(apply(T @ inverse(start), problem.centre[None])[0] - problem.centre)
    turned = np.arccos(np.clip((np.trace(T[:3, :3].T @ start[:3, :3]) - 1) / 2, -1, 1))
    believed = (
        at_rest
        and np.isfinite(T).all()
        and np.isfinite(meeting.information).all()
        and meeting.support >= max(6, 0.3 * len(problem.rim))
        and meeting.residual < 3 * problem.noise
        and ran < 4 * spread.translation
        and turned < 4 * spread.rotation
    )
    if not believed:
        return rejected(start, meeting.residual, meeting.support)
    # noise larger than assumed tells less
    information = meeting.information[:6, :6] / max(1.0, meeting.residual / problem.noise) ** 2
    return Fit(T, True, without_sink(information, problem.sink_std), meeting.residual, meeting.support)
