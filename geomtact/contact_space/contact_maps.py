"""Contacts at any pose, on demand: cut from one height map per approach direction of an index.

A stored contact belongs to one pose of a cell. Between stored poses the contact of a small feature moves by more than its own
size, so what a touch constrains within a cell is lost. Here the contact is made at the pose that is asked for.
"""

from __future__ import annotations

import contextlib
import zipfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar
from weakref import WeakKeyDictionary

import cv2
import numpy as np
from numpy.typing import NDArray

from geomtact.contact_space.heightmap import NOTHING, HeightMap
from geomtact.contact_space.index import Index
from geomtact.files import write_whole
from geomtact.geometry.approach import facing
from geomtact.kernels.contact_energy import BLOCK, COARSER, Cut, Maps, Poses, Samples, contact_energy
from geomtact.kernels.depth_loss import Indentation, depth_loss
from geomtact.kernels.parts import by_parts
from geomtact.se3 import Array
from geomtact.sensing.sensor import Sensor
from geomtact.threads import thread_count

SHAPE = (48, 64)  # samples of the window, lying
_PIXELS_PER_SAMPLE = 2  # of the height maps
_CENTRING = 1.5  # samples of the window
_PART = 256  # poses that a thread takes at a time
_FORMAT = 1  # of the file in an index's folder
_LEVELS = 65_534  # of the heights in it, besides one for where the object is not
_T = TypeVar("_T")


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
    """The height maps of an index, one for each of its approach directions.

    Attributes
    ----------
    index, maps
    from_maps : rotations (D, 3, 3) from the maps' frames into the object's
    """

    index: Index
    maps: Maps
    from_maps: Array

    @classmethod
    def of(cls, index: Index) -> ContactMaps:
        """Those of ``index``: as they are in memory or lie in its folder of the cache, else cast now, 20 ms each for an object of
        100 mm, and written there."""
        if index not in _OPENED:
            path = None if index.folder is None else index.folder / f"maps-{_FORMAT}.npz"
            heights = None if path is None else _read(path)
            if heights is None:
                images, low, step = _rounded(_cast(index))
                if path is not None:
                    with contextlib.suppress(OSError):  # a read-only cache costs the casts each time, no more
                        _write(path, images, low, step)
                heights = _heights(images, low, step)
            maps = _maps(heights, sample_pitch(index.sensor) / _PIXELS_PER_SAMPLE)
            _OPENED[index] = maps, np.swapaxes(facing(index.directions.vectors), 1, 2)
        return cls(index, *_OPENED[index])

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickled without what the index's folder holds."""
        return ContactMaps.of, (self.index,)

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
        deepest = self.index.sensor.max_penetration
        found = self._by_parts(
            lambda asked: contact_energy(self.maps, samples, asked, deepest, area), poses, membrane, depth
        )
        return Cut(*(np.concatenate(each) for each in zip(*found, strict=True)))

    def depth_loss(self, indentation: Indentation, poses: Placements, membrane: Array) -> Array:
        """How badly a depth map fits the object (n,) at ``poses``, with the ``membrane`` as of :meth:`compare`."""
        deepest = self.index.sensor.max_penetration
        found = self._by_parts(lambda asked: depth_loss(self.maps, asked, indentation, deepest), poses, membrane, None)
        return np.concatenate(found).astype(float)

    def _by_parts(
        self, of: Callable[[Poses], _T], poses: Placements, membrane: Array | None, depth: Array | None
    ) -> list[_T]:
        """``of`` some poses after the others."""
        # from the frame of each map into the sensor's
        tilt = poses.rotation @ self.from_maps[poses.direction]
        n = len(poses.reach)
        membrane = np.full(n, np.nan) if membrane is None else membrane
        depth = np.full(n, self.index.sensor.max_penetration) if depth is None else depth
        numbers = [each.astype(np.float32) for each in (tilt, poses.centre, poses.reach, membrane, depth)]

        def some(part: slice) -> _T:
            return of(Poses(poses.direction[part], *(each[part] for each in numbers)))

        return by_parts(some, n, _PART)


def located(index: Index, T: Array) -> tuple[Placements, Array]:
    """The poses ``T_sensor_object`` (n, 4, 4), for which images under the symmetry may stand, and how far the membrane's apex is
    beyond the object's centre (n,) [m]."""
    image, direction, turn = index.directions.lookup(np.asarray(T, float).reshape(-1, 4, 4))
    R, centre = image[:, :3, :3], image[:, :3, :3] @ index.mesh.centre + image[:, :3, 3]
    place = index.place_of(index.directions.first_turn[direction] + turn, centre)
    reach = centre[:, 2] + 0.5 * index.sensor.max_penetration
    return Placements(place, direction.astype(np.int32), R, centre[:, :2], reach), centre[:, 2]


_OPENED: WeakKeyDictionary[Index, tuple[Maps, Array]] = WeakKeyDictionary()


def _cast(index: Index) -> NDArray[np.float32]:
    """Heights (D, n, n) [m] along each approach direction; ``NOTHING`` where the object is not."""
    pixel = sample_pitch(index.sensor) / _PIXELS_PER_SAMPLE

    def one(a: Array) -> NDArray[np.float32]:
        return HeightMap.cast(index.space.caster, a, index.mesh.centre, index.mesh.reach, 0.0, pixel).heights

    with ThreadPoolExecutor(thread_count()) as pool:
        return np.stack(list(pool.map(one, index.directions.vectors)))


def _maps(heights: NDArray[np.float32], pixel: float) -> Maps:
    # a block reaches half its side from its centre, and half a pixel more where it is cut
    side = 2 * int(np.ceil(BLOCK / 2 * _PIXELS_PER_SAMPLE * np.sqrt(2) + 1)) + 1
    square, off = np.ones((side, side), np.uint8), -heights.shape[1] % COARSER

    def widest(map_: NDArray[np.float32]) -> NDArray[np.float32]:
        whole = cv2.copyMakeBorder(cv2.dilate(map_, square), 0, off, 0, off, cv2.BORDER_REPLICATE)
        parts = whole.reshape(len(whole) // COARSER, COARSER, -1, COARSER)
        return np.asarray(parts.max((1, 3)), np.float32)

    return Maps(heights, np.stack([widest(each) for each in heights]), pixel)


def _rounded(heights: NDArray[np.float32]) -> tuple[NDArray[np.uint16], float, float]:
    """``heights`` (D, n, n) as 16-bit images, 0 where there is nothing; the least of them, and their step."""
    there = heights > NOTHING / 2
    low, high = float(heights[there].min()), float(heights[there].max())
    step = max(high - low, 1e-9) / _LEVELS
    return np.where(there, np.rint((np.where(there, heights, low) - low) / step) + 1, 0).astype(np.uint16), low, step


def _write(path: Path, images: NDArray[np.uint16], low: float, step: float) -> None:
    """Write what :func:`_rounded` gives."""
    coded = [cv2.imencode(".png", image)[1] for image in images]

    def write(temporary: Path) -> None:
        with open(temporary, "wb") as file:
            np.savez(
                file,
                allow_pickle=False,
                bytes=np.concatenate(coded),
                ends=np.cumsum([len(each) for each in coded]),
                scale=np.array([low, step]),
            )

    write_whole(path, write)


def _heights(images: NDArray[np.uint16], low: float, step: float) -> NDArray[np.float32]:
    return np.where(images > 0, np.float32(low - step) + np.float32(step) * images, np.float32(NOTHING))


def _decoded(png: NDArray[np.uint8]) -> NDArray[np.uint16]:
    return np.asarray(cv2.imdecode(png, cv2.IMREAD_UNCHANGED), np.uint16)


def _read(path: Path) -> NDArray[np.float32] | None:
    """The heights that :func:`_write` wrote; None where there is nothing that can be read."""
    with contextlib.suppress(OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, cv2.error):
        with np.load(path, allow_pickle=False) as data:
            coded, ends, (low, step) = data["bytes"], data["ends"], data["scale"]
        with ThreadPoolExecutor(thread_count()) as pool:
            images = list(pool.map(_decoded, np.split(coded, ends[:-1])))
        return _heights(np.stack(images), float(low), float(step))
    return None


def centring_std(sensor: Sensor) -> float:
    """Standard deviation [m] by which objects are placed about where a contact's centroid is the observed one."""
    return _CENTRING * sample_pitch(sensor)


def sample_pitch(sensor: Sensor) -> float:
    """Pitch of the window's samples [m]."""
    return float(np.sqrt(sensor.pixel_area(sensor.along(SHAPE))))
