"""The object's surface as registration sees it: points with normals, and which of them are nearest."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from geomtact.errors import MeshError
from geomtact.kernels.surface_filter import Nearest, Voxels
from geomtact.se3 import Array, unit

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

# All constants are hand-set.
_LEAST = 2  # least number of points of a surface
_FEWEST_POINTS = 2000  # number of points above which a surface can be made coarser
_DENSE = 1.5  # points per width of a filter, along a line
_TURN = 2.0  # distance that a difference of 1 between normals counts as, in gaps between points
_DEEP = 1e-3  # least value of that distance [m]: faces parallel to the membrane lie about so deep below it
_SIDE = 3.0  # side of a voxel, in gaps between points
_MOST_VOXELS = 100_000  # of places far from the surface
_FACES = 4  # nearest points whose normals are averaged there
_MARGIN = 10e-3  # around the surface that these fill [m]


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

    def __post_init__(self) -> None:
        if len(self.points) < _LEAST:
            raise MeshError(f"a surface needs {_LEAST} points or more, got {len(self.points)}; sample it more densely")

    @cached_property
    def spacing(self) -> float:
        """Side of the patch of surface that a point stands for, in the median [m]."""
        some = self.points[:: max(1, len(self.points) // 1000)]
        return 2 * float(np.median(self.tree.query(some, k=2)[0][:, 1]))

    @cached_property
    def tree(self) -> cKDTree:
        from scipy.spatial import cKDTree

        return cKDTree(self.points)

    @cached_property
    def turn(self) -> float:
        """How far away a point counts as whose normal differs by 1 [m]."""
        return max(_TURN * self.spacing, _DEEP)

    @cached_property
    def voxels(self) -> Voxels:
        """The points, by where they are."""
        low, extent = self.points.min(0), np.ptp(self.points, 0)
        side = _side(extent, _SIDE * self.spacing, 10 * _MOST_VOXELS)
        shape = np.floor(extent / side).astype(np.int64) + 1
        cell = np.ravel_multi_index(tuple(((self.points - low) / side).astype(np.int64).T), tuple(shape))
        order = np.argsort(cell, kind="stable")
        first = np.searchsorted(cell[order], np.arange(shape.prod() + 1))
        return Voxels(self.points[order], self.normals[order], first, shape, low, side)

    @cached_property
    def far(self) -> Nearest:
        """Which point is nearest, of places anywhere."""
        low, extent = self.points.min(0) - _MARGIN, np.ptp(self.points, 0) + 2 * _MARGIN
        side = _side(extent, _DEEP, _MOST_VOXELS)
        shape = np.ceil(extent / side).astype(np.int64)
        places = low + side * (np.indices(shape).reshape(3, -1).T + 0.5)
        # beside an edge the mean normal of the faces that meet there says which side a place is on, that of one does not
        distance, nearest = self.tree.query(places, k=range(1, min(_FACES, len(self.points)) + 1), workers=-1)
        normals = unit(self.normals[nearest].mean(1))
        return Nearest(self.points[nearest[:, 0]], normals, distance[:, 0], shape, low, side)

    @cached_property
    def coarser(self) -> Surface | None:
        """Every fourth point: the surface at twice the spacing; None where few are left."""
        return Surface(self.points[::4], self.normals[::4]) if len(self.points) > _FEWEST_POINTS else None

    def at_scale(self, sigma: float) -> Surface:
        """The surface by as many points as a filter ``sigma`` [m] wide needs."""
        if sigma < _DENSE * 2 * self.spacing or self.coarser is None:
            return self
        return self.coarser.at_scale(sigma)


def _side(extent: Array, least: float, most: int) -> float:
    """Of voxels that fill ``extent`` (3,) [m]: ``least``, or more where they would be more than about ``most``."""
    side = max(least, 1e-9)
    while np.prod(np.ceil(extent / side) + 1) > most:
        side *= 1.25
    return side
