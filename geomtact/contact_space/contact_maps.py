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
from geomtact.kernels.contact_energy import BLOCK, Cut, Maps, Poses, Samples, contact_energy
from geomtact.se3 import Array
from geomtact.sensing.sensor import Sensor

SHAPE = (48, 64)  # samples of the window, lying
_PIXELS_PER_SAMPLE = 2  # of the height maps
_THREADS = 2
_PART = 512  # poses that a thread takes at a time


@dataclass(frozen=True, eq=False)
class Placements:
    """n poses of the object, in the coordinates of an index.

    Attributes
    ----------
    place : (n,) of the index
    direction : (n,) cell of the index's approach directions
    rotation : (n, 3, 3) R_sensor_object
    centre : (n, 2) object's centre along x and y, sensor frame [m]
    reach : (n,) a guess of how far the object reaches beyond its centre, in the window [m]
    """

    place: NDArray[np.int64]
    direction: NDArray[np.int32]
    rotation: Array
    centre: Array
    reach: Array


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

    def locate(self, T: Array) -> tuple[Placements, Array]:
        """The poses ``T_sensor_object`` (n, 4, 4), for which images under the symmetry may stand, and how far the membrane's apex
        is beyond the object's centre (n,) [m]."""
        index = self.index
        image, direction, turn = index.directions.lookup(np.asarray(T, float).reshape(-1, 4, 4))
        R, centre = image[:, :3, :3], image[:, :3, :3] @ index.mesh.centre + image[:, :3, 3]
        place = index.place_of(index.directions.first_turn[direction] + turn, centre)
        reach = centre[:, 2] + 0.5 * index.sensor.max_penetration
        return Placements(place, direction.astype(np.int32), R, centre[:, :2], reach), centre[:, 2]

    def compare(
        self,
        samples: Samples,
        area: float,
        poses: Placements,
        membrane: Array | None = None,
        depth: Array | None = None,
    ) -> Cut:
        """The contacts at ``poses`` compared with the observed one.

        Parameters
        ----------
        samples : that describe the observed contact
        area : of it, in samples
        membrane : (n,) how far the membrane's apex is beyond the object's centre [m], or else
        depth : (n,) the penetration [m]; by default the deepest
        """
        # from the frame of each map into the sensor's
        tilt = poses.rotation @ self._from_maps[poses.direction]
        n, deepest = len(poses.reach), self.index.sensor.max_penetration
        membrane = np.full(n, np.nan) if membrane is None else membrane
        depth = np.full(n, deepest) if depth is None else depth
        numbers = [each.astype(np.float32) for each in (tilt, poses.centre, poses.reach, membrane, depth)]

        def some(start: int) -> Cut:
            part = slice(start, start + _PART)
            asked = Poses(poses.direction[part], *(each[part] for each in numbers))
            return contact_energy(self.maps, samples, asked, deepest, area)

        with ThreadPoolExecutor(_THREADS) as pool:
            found = list(pool.map(some, range(0, max(n, 1), _PART)))
        return Cut(*(np.concatenate(each) for each in zip(*found, strict=True)))


def sample_pitch(sensor: Sensor) -> float:
    """Pitch of the window's samples [m]."""
    return float(np.sqrt(sensor.pixel_area(sensor.along(SHAPE))))
