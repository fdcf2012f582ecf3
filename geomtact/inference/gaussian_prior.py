"""An uncertain pose that was known before."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geomtact.errors import InputError
from geomtact.se3 import Array, adjoint, check_pose, exp, inverse, log, transform


@dataclass(frozen=True, eq=False)
class GaussianPrior:
    """An uncertain pose, from a vision system or a ``Mode``.

    Relative to the uniform, the density at T exp(xi^) is proportional to that of xi ~ N(0, covariance), for rotations of at most
    half a turn.

    Its mass in a cell is the share of poses drawn from it that touch there. Where it covers too many cells for that, it is the
    density at the cell's pose, widened by a cell's own spread.

    Attributes
    ----------
    T : (4, 4), in the posterior's frame
    covariance : (6, 6) of xi = (rx, ry, rz, tx, ty, tz), in the object's frame [rad, m], positive definite

    Raises
    ------
    PoseError, InputError
    """

    T: Array
    covariance: Array

    def __post_init__(self) -> None:
        T, C = check_pose(self.T, "GaussianPrior"), np.asarray(self.covariance, float)
        wrong = None
        if C.shape != (6, 6):
            wrong = f"the shape {C.shape}"
        elif not np.allclose(C, C.T):
            wrong = "one that is not symmetric"
        elif not (np.linalg.eigvalsh(C) > 0).all():
            wrong = f"one with an eigenvalue of {np.linalg.eigvalsh(C).min():.2g}"
        if wrong:
            raise InputError(
                "GaussianPrior: expected a symmetric positive definite covariance (6, 6), variances in radians and metres "
                f"squared, got {wrong}"
            )
        object.__setattr__(self, "T", T)
        object.__setattr__(self, "covariance", C)

    def __call__(self, T: Array) -> Array:
        """Log density (n,), not normalised, at poses (n, 4, 4)."""
        xi = log(inverse(self.T) @ T)
        return np.asarray(-0.5 * np.einsum("ni,ni->n", xi, np.linalg.solve(self.covariance, xi.T).T))

    def covariance_about(self, point: Array) -> Array:
        """As :attr:`covariance`, of shifts of ``point`` (3,) of the object."""
        to_point = adjoint(transform(np.eye(3), -point))
        return np.asarray(to_point @ self.covariance @ to_point.T)

    def draw(self, n: int, rng: np.random.Generator) -> Array:
        """Up to ``n`` poses (m, 4, 4) from it: all of ``n`` draws of a narrow one, fewer of one with wide rotations."""
        xi = rng.multivariate_normal(np.zeros(6), self.covariance, n)
        angle = np.linalg.norm(xi[:, :3], axis=1)
        # the exponential takes less volume, the larger the angle (Barfoot, State Estimation for Robotics, ch. 7)
        kept = (angle <= np.pi) & (rng.random(n) < np.sinc(angle / (2 * np.pi)) ** 4)
        return self.T @ exp(xi[kept])


def given_turns(covariance: Array, k: int) -> tuple[Array, Array]:
    """Of a covariance (k + 3, k + 3) of ``k`` turns and of shifts: the mean shift for each turn (3, k), and the covariance (3, 3)
    of shifts that is left where the turns are known."""
    gain = np.asarray(np.linalg.solve(covariance[:k, :k], covariance[:k, k:]).T)
    return gain, covariance[k:, k:] - gain @ covariance[:k, k:]
