"""What a refiner is given, what it gives back, and the protocol that every refiner follows."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from geomtact.se3 import Array

if TYPE_CHECKING:
    from scipy.spatial import cKDTree


@dataclass(frozen=True, eq=False)
class Surface:
    """The object's surface as points with normals, dense against the sensor's pixels.

    Attributes
    ----------
    points : (M, 3) object frame [m]
    normals : (M, 3) outward unit normals, object frame
    """

    points: Array
    normals: Array

    @cached_property
    def spacing(self) -> float:
        """Side of the patch of surface that a point stands for, in the median [m]."""
        some = self.points[:: max(1, len(self.points) // 1000)]
        return 2 * float(np.median(self.tree.query(some, k=2)[0][:, 1]))

    @cached_property
    def tree(self) -> cKDTree:
        from scipy.spatial import cKDTree

        return cKDTree(self.points)


@dataclass(frozen=True, eq=False)
class Problem:
    """One observed contact, ready for registration. Sensor frame, metres.

    Attributes
    ----------
    rim : (n, 3) points of the contact's outline on the membrane, evenly spaced
    outward : (n, 3) unit vectors parallel to z = 0 that point out of the contact
    rays : (n, 3) unit vectors from the camera through the rim
    centre : (3,) centre of the contact
    length : size of the contact (rms distance from its centre); rotations are scaled by it
    spacing : between neighbouring rim points
    pitch : of the image's pixels
    noise : standard deviation of the rim along ``outward``
    correlation : length over which that noise is alike: closer rim points tell the same thing
    sink_std : by how much the whole rim may lie above the surface because an elastic gel sinks around the object
    """

    rim: Array
    outward: Array
    rays: Array
    centre: Array
    length: float
    spacing: float
    pitch: float
    noise: float
    correlation: float
    sink_std: float

    @property
    def independence(self) -> float:
        """Share of the rim points that tell something new: their spacing over the noise's correlation length."""
        return min(1.0, self.spacing / self.correlation)


@dataclass(frozen=True, eq=False)
class Refinement:
    """Refined poses with what is known about them. Where ``converged`` is False, ``T`` is the start.

    Attributes
    ----------
    T : (k, 4, 4) T_sensor_object
    converged : (k,) bool: enough of the rim lies on the surface, and the pose has stopped moving
    covariance : (k, 6, 6) of xi = (rx, ry, rz, tx, ty, tz) in T exp(xi^), radians and metres
    observable : k arrays (r, 6) of orthonormal rows: the directions of xi that the contact tells, rotations times length
    residual : (k,) rms distance of the rim from the surface, measured along the membrane [m]; inf without support
    support : (k,) how many rim points lie on the surface
    length : by which rotations are scaled in ``observable`` [m]
    """

    T: Array
    converged: NDArray[np.bool_]
    covariance: Array
    observable: list[Array]
    residual: Array
    support: NDArray[np.int64]
    length: float


class Refiner(Protocol):
    """Moves poses so that the object's surface meets the rim of one contact."""

    @property
    def name(self) -> str: ...

    def refine(self, problem: Problem, T: Array) -> Refinement:
        """Refine the poses ``T`` (k, 4, 4), T_sensor_object."""
        ...
