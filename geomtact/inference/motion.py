"""Models of how an object moves from one frame of a sequence to the next."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from geomtact.geometry.mesh import Mesh
from geomtact.se3 import Array


@runtime_checkable
class Motion(Protocol):
    """How an object may move from one frame to the next: a frozen dataclass of lengths [m] and angles [rad] of 0 or more."""

    def twists(self, mesh: Mesh, n: int, rng: np.random.Generator) -> Array:
        """Draw ``n`` motions xi (n, 6) about the object's centre, rotation first [rad, m]."""
        ...


@dataclass(frozen=True)
class UniformBall:
    """The thesis's motion: from one frame to the next, anything up to ``radius`` [m] in mean point distance."""

    radius: float = 8e-3

    def twists(self, mesh: Mesh, n: int, rng: np.random.Generator) -> Array:
        """Motions xi (n, 6) about the object's centre, uniform over the ball to first order [rad, m]."""
        points = mesh.surface_points(256) - mesh.centre
        J = np.zeros((len(points), 3, 6))
        J[:, :, 3:] = np.eye(3)
        J[:, :, :3] = np.cross(np.eye(3), points[:, None]).swapaxes(1, 2)
        # a ball in root mean square distance is an ellipsoid; the mean is no larger, and seldom below three quarters of it
        half = np.linalg.inv(np.linalg.cholesky(np.einsum("pia,pib->ab", J, J) / len(points))).T
        found = np.zeros((0, 6))
        while len(found) < n:
            g = rng.normal(size=(n, 6))
            g *= rng.random((n, 1)) ** (1 / 6) / np.linalg.norm(g, axis=1, keepdims=True)
            xi = 1.3 * self.radius * g @ half.T
            distance = np.linalg.norm(np.einsum("pia,na->npi", J, xi), axis=2).mean(1)
            found = np.concatenate([found, xi[distance <= self.radius]])
        return found[:n]


@dataclass(frozen=True)
class GaussianTwist:
    """Normally distributed motion about the object's centre from one frame to the next.

    Attributes
    ----------
    rotation : standard deviation about each axis [rad]
    translation : standard deviation along each axis [m]
    """

    rotation: float
    translation: float

    def twists(self, mesh: Mesh, n: int, rng: np.random.Generator) -> Array:
        """Motions xi (n, 6) about the object's centre [rad, m]."""
        return rng.normal(size=(n, 6)) * np.repeat([self.rotation, self.translation], 3)
