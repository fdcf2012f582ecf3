"""Contacts at any pose, on demand: cut from one height map per approach direction of an index.

A stored contact belongs to one pose of a cell. Between stored poses the contact of a small feature moves by more than its own
size, so what a touch constrains within a cell is lost. Here the contact is made at the pose that is asked for.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from geomtact.contact_space.heightmap import HeightMap
from geomtact.contact_space.index import Index
from geomtact.geometry.approach import facing
from geomtact.kernels.contact_energy import Maps, Samples, contact_energy
from geomtact.se3 import Array
from geomtact.sensing.sensor import Sensor

SHAPE = (48, 64)  # samples of the window, lying
BLOCK = 4  # samples along each side of a block
_PIXELS_PER_SAMPLE = 2  # of the height maps
_THREADS = 2
_PART = 512  # poses that a thread takes at a time


@dataclass(frozen=True, eq=False)
class Placements:
    """n poses of the object, in the coordinates of an index.

    Attributes
    ----------
    direction : (n,) cell of the index's approach directions
    rotation : (n, 3, 3) R_sensor_object
    centre : (n, 2) object's centre along x and y, sensor frame [m]
    reach : (n,) how far the object reaches beyond its centre, in the window [m]: a guess, or as it was found
    """

    direction: NDArray[np.int32]
    rotation: Array
    centre: Array
    reach: Array


@dataclass(frozen=True, eq=False)
class Compared:
    """What a comparison of n contacts with the observed one gives; see ``kernels.contact_energy``.

    Attributes
    ----------
    energy : (n, depths) [m^3]; inf where the object is not in the window
    reach : (n,) [m]; -inf where the object is not in the window
    centroid : (n, 2) of the contact [m]
    """

    energy: NDArray[np.float32]
    reach: NDArray[np.float32]
    centroid: NDArray[np.float32]

    @property
    def touches(self) -> NDArray[np.bool_]:
        """Where (n,) the object is in the window."""
        return np.isfinite(self.reach)


@dataclass(frozen=True, eq=False)
class ContactMaps:
    """The height maps of an index, one for each of its approach directions."""

    index: Index
    maps: Maps

    @classmethod
    def cast(cls, index: Index) -> ContactMaps:
        """Cast all of them: 20 ms each for an object of 100 mm."""
        sensor, mesh = index.sensor, index.mesh
        pixel = sample_pitch(sensor) / _PIXELS_PER_SAMPLE

        def one(a: Array) -> NDArray[np.float32]:
            return HeightMap.cast(index.space.caster, a, mesh.centre, mesh.reach, 0.0, pixel).heights

        with ThreadPoolExecutor(_THREADS) as pool:
            heights = np.stack(list(pool.map(one, index.directions.vectors)))
        # a block reaches half its side from its centre, and half a pixel more where it is cut
        side = 2 * int(np.ceil(BLOCK / 2 * _PIXELS_PER_SAMPLE * np.sqrt(2) + 1)) + 1
        widest = np.stack(
            [np.asarray(cv2.dilate(each, np.ones((side, side), np.uint8)), np.float32) for each in heights]
        )
        return cls(index, Maps(heights, widest, pixel))

    @cached_property
    def _from_maps(self) -> Array:
        """Rotations (D, 3, 3) from the maps' frames into the object's."""
        return np.swapaxes(facing(self.index.directions.vectors), 1, 2)

    def locate(self, T: Array, penetration: Array) -> Placements:
        """The poses ``T_sensor_object`` (n, 4, 4), which press ``penetration`` (n,) [m] deep; images under the symmetry may stand
        for them."""
        image, direction, _ = self.index.directions.lookup(np.asarray(T, float).reshape(-1, 4, 4))
        centre = image[:, :3, :3] @ self.index.mesh.centre + image[:, :3, 3]
        return Placements(direction.astype(np.int32), image[:, :3, :3], centre[:, :2], centre[:, 2] + penetration)

    def compare(self, samples: Samples, poses: Placements, area: float) -> Compared:
        """The contacts at ``poses`` compared with the one that ``samples`` describe, whose area is that of ``area`` samples."""
        # from the frame of each map into the sensor's
        tilt = (poses.rotation @ self._from_maps[poses.direction]).astype(np.float32)
        centre, reach = poses.centre.astype(np.float32), poses.reach.astype(np.float32)
        deepest = self.index.sensor.max_penetration

        def some(start: int) -> tuple[NDArray[np.float32], ...]:
            part = slice(start, start + _PART)
            arrays = (poses.direction[part], tilt[part], centre[part], reach[part])
            return contact_energy(self.maps, samples, *arrays, deepest, area)

        with ThreadPoolExecutor(_THREADS) as pool:
            found = list(pool.map(some, range(0, max(len(reach), 1), _PART)))
        energy, reached, centroid = (np.concatenate(arrays) for arrays in zip(*found, strict=True))
        return Compared(energy, reached, centroid)


def sample_pitch(sensor: Sensor) -> float:
    """Pitch of the window's samples [m]."""
    return float(np.sqrt(sensor.pixel_area(sensor.along(SHAPE))))
