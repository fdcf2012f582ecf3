"""Which directions of a pose a contact constrains, and which it leaves open.

Small motions are taken about the contact's centre, rotations times the contact's length, so that all six are metres
at the contact: zeta = S A xi, with xi the twist of T exp(xi^). How sharply the rim fixes zeta is compared with the
spread before; directions in which the rim adds little keep their variance and are not called observable.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from geomtact.errors import PoseError
from geomtact.geometry.approach import NO_TILT, Approach
from geomtact.registration.protocol import Problem
from geomtact.se3 import Array, apply, exp, hat, inverse, log, transform

_LEAST_TURN = 0.02  # least spread of start rotations, before it is divided by sqrt(12) [rad]; hand-set
# Information over that of the start poses, both [1/m^2], above which a direction is observable. Derived: the contact alone then
# fixes it to a quarter of the grid's step.
GAIN = 4 / 3


@dataclass(frozen=True)
class Spread:
    """How far start poses may be off: standard deviations, each greater than 0.

    Attributes
    ----------
    rotation : about each axis [rad]
    translation : of the contact, along each axis [m]
    tilt : about the axes in the plane of the (first) membrane, where it is not as ``rotation`` [rad]
    """

    rotation: float
    translation: float
    tilt: float | None = None

    def __post_init__(self) -> None:
        if not min(self.metres(1.0)) > 0:
            raise PoseError(f"the spread of start poses must be greater than 0, got {self}")

    @classmethod
    def of_grid(cls, angle_step: float, step: float, approach: Approach | None = None) -> Spread:
        """Of poses uniform in a cell of ``angle_step`` [rad], the widest of the grid, and ``step`` [m], no farther tilted than
        ``approach`` allows; where symmetry leaves no rotation to search, registration is still free to turn a little."""
        rotation, tilt = max(angle_step, _LEAST_TURN) / np.sqrt(12), None
        if approach is not None:
            tilt = min(rotation, max(NO_TILT, 2 * max(half for _, half in approach) / np.sqrt(12)))
        return cls(rotation, step / np.sqrt(12), tilt)

    def metres(self, length: float) -> Array:
        """(6,) standard deviations of zeta [m]."""
        tilt = self.rotation if self.tilt is None else self.tilt
        turned = np.array([tilt, tilt, self.rotation])
        return np.concatenate([turned * length, np.full(3, self.translation)])

    def radius(self, length: float) -> float:
        """How far a point of the contact may be off, standard deviation along one axis [m]."""
        return float(np.hypot(self.rotation * length, self.translation))


def without_sinks(information: Array, sink_std: float) -> Array:
    """Information (6, 6) about zeta, from that about zeta and the sinks of c contacts (6 + c, 6 + c), when the sinks are free.

    A sink acts as a shift of the object along the membrane's normal does, so that one contact's information about that shift
    is capped at 1 / sink_std^2.
    """
    cross, sinks = information[:6, 6:], information[6:, 6:]
    return information[:6, :6] - cross @ np.linalg.solve(sinks + np.eye(len(sinks)) / sink_std**2, cross.T)


def observable_subspace(information: Array, spread: Spread, length: float) -> tuple[Array, Array, Array]:
    """The observable directions of zeta: rows (r, 6) that measure them, columns (6, r) that move along them, their gains (r,).

    ``information`` (6, 6) [1/m^2] is the inverse covariance that the rim alone would give.
    """
    std = spread.metres(length)
    gain, axes = np.linalg.eigh(std[:, None] * information * std)
    axes = axes[:, gain > GAIN]
    return axes.T / std, std[:, None] * axes, gain[gain > GAIN]


def moved(T: Array, zeta: ArrayLike, problem: Problem) -> Array:
    """Poses (..., 4, 4) after the motions ``zeta`` (..., 6), in the problem's axes about the contact's centre."""
    about = transform(np.eye(3), problem.centre)
    return about @ exp(np.asarray(zeta, float) / np.repeat([problem.length, 1.0], 3)) @ inverse(about) @ T


def motion_of(start: Array, T: Array, problem: Problem) -> Array:
    """Inverse of :func:`moved`: the zeta (..., 6) that takes ``start`` to ``T``."""
    about = transform(np.eye(3), problem.centre)
    return log(inverse(about) @ T @ inverse(start) @ about) * np.repeat([problem.length, 1.0], 3)


def summary(T: Array, information: Array, spread: Spread, problem: Problem) -> tuple[Array, Array]:
    """Covariance (6, 6) of xi and the observable directions (r, 6), from the information (6, 6) about zeta.

    The covariance combines the contact's information with the spread of the start poses, which it never exceeds.
    """
    std = spread.metres(problem.length)
    measure, move, gain = observable_subspace(information, spread, problem.length)
    # in observable directions the variance std**2 becomes std**2 / (1 + gain)
    covariance = np.diag(std**2) - (move * (gain / (1 + gain))) @ move.T
    to_zeta = zeta_of_xi(T, problem)
    back = np.linalg.inv(to_zeta)
    scale = np.repeat([problem.length, 1.0], 3)
    rows = measure @ to_zeta / scale
    observable = np.linalg.qr(rows.T)[0].T if len(rows) else np.zeros((0, 6))
    covariance = back @ covariance @ back.T
    return 0.5 * (covariance + covariance.T), observable


def zeta_of_xi(T: Array, problem: Problem) -> Array:
    """(6, 6) S A: xi moves the object about its own origin and axes, zeta about the contact's centre in sensor axes."""
    R = T[:3, :3]
    centre = apply(inverse(T), problem.centre[None])[0]
    out = np.zeros((6, 6))
    out[:3, :3] = problem.length * R
    out[3:, :3] = -R @ hat(centre)
    out[3:, 3:] = R
    return out
