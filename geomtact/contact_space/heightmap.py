"""Height maps of the object and the windows cut out of them (thesis 6.1.3, made fast).

Seen along one approach direction, the object is a height map. Every turn about the sensor's axis and every shift of
the window is a cut from it, so one cast serves thousands of poses. A perspective camera sees a point at depth h
through the pixel at 1 / (1 - h/D) times its position; the cuts are therefore taken at several depths.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from geomtact.contact_space.resolution import PIXELS_PER_MASK_PIXEL
from geomtact.geometry.approach import facing
from geomtact.se3 import Array, transform
from geomtact.sensing.cast import Caster
from geomtact.sensing.sensor import Sensor

NOTHING = -1e3  # height [m] where the object is not
CELL_PIXELS = 5  # pixels of a lattice cell, along each side: odd, so that its centre is one
_RAYS = 2e6  # cast at a time, at most
_VERTICAL = Sensor("orthographic", (8, 8), (1.0, 1.0), 0.0, 1.0)


@dataclass(frozen=True)
class HeightMap:
    """How far the object reaches along one approach direction beyond its centre.

    Attributes
    ----------
    heights : (n, n) [m], ``NOTHING`` where the object is not; the centre is the middle pixel, turn 0
    widest : (n, n) [m], the largest height within a mask pixel
    pixel : [m]
    """

    heights: NDArray[np.float32]
    widest: NDArray[np.float32]
    pixel: float

    @classmethod
    def cast(cls, caster: Caster, a: Array, centre: Array, reach: float, margin: float, pixel: float) -> HeightMap:
        """Seen along approach ``a``; ``reach`` [m] holds the object, ``margin`` [m] is left free around it."""
        half = int(np.ceil(reach / pixel))
        s = np.arange(-half, half + 1) * pixel
        R = facing(a)
        T = transform(R, -R @ centre)[None]
        bands = np.array_split(s, np.ceil(len(s) ** 2 / _RAYS))  # a ray takes a hundred times the memory of its height
        rays = (np.stack(np.meshgrid(s, band), -1).reshape(-1, 2) for band in bands)
        depth = np.concatenate([caster.ray_depths(_VERTICAL, T, some)[0] for some in rays])
        heights = np.where(np.isfinite(depth), depth, NOTHING).astype(np.float32).reshape(len(s), len(s))
        # the deepest points of an object are its corners, which fall between the rays
        corners = (caster.vertices - centre) @ R.T
        ij = np.rint(corners[:, :2] / pixel).astype(np.int64) + half
        np.maximum.at(heights, (ij[:, 1], ij[:, 0]), -corners[:, 2].astype(np.float32))
        heights = np.pad(heights, int(np.ceil(margin / pixel)), constant_values=NOTHING)
        widest = cv2.dilate(heights, np.ones((PIXELS_PER_MASK_PIXEL,) * 2, np.uint8))
        return cls(heights, np.asarray(widest, np.float32), pixel)

    def turned(self, turn: float, lattice: Lattice) -> NDArray[np.float32]:
        """The heights turned by ``turn`` [rad] about the centre, on ``lattice``."""
        h, w = lattice.shape
        c, s = np.cos(turn), np.sin(turn)
        # the map from a pixel here to the pixel there: p_there = Rz(-turn) p_here
        A = np.zeros((2, 3))
        A[:, :2] = np.array([[c, s], [-s, c]]) * (lattice.pixel / self.pixel)
        A[:, 2] = len(self.heights) // 2 - A[:, :2] @ [w // 2, h // 2]
        turned = cv2.warpAffine(
            self.heights,
            A,
            (w, h),
            flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=NOTHING,
        )
        return np.asarray(turned, np.float32)


@dataclass(frozen=True)
class Lattice:
    """The lattice of window positions over the object's centre, ``CELL_PIXELS`` squared pixels to a cell.

    ``cells`` (ny, nx) lattice cells, the object's centre in the middle of the middle one, are surrounded by ``pad``
    (py, px) pixels, half a window.
    """

    pixel: float
    cells: tuple[int, int]
    pad: tuple[int, int]

    @classmethod
    def make(cls, reach: float, sensor: Sensor, step: float) -> Lattice:
        half = sensor.half_window[::-1]
        cells = 2 * np.ceil((reach + half) / step - 0.5).astype(int) + 1
        pad = np.ceil(half / step * CELL_PIXELS).astype(int) + 2
        return cls(step / CELL_PIXELS, (int(cells[0]), int(cells[1])), (int(pad[0]), int(pad[1])))

    @property
    def shape(self) -> tuple[int, int]:
        return self.cells[0] * CELL_PIXELS + 2 * self.pad[0], self.cells[1] * CELL_PIXELS + 2 * self.pad[1]

    def blocks(self, image: NDArray) -> NDArray:
        """``image`` (..., h, w) without its padding, cell by cell: (..., ny * nx, CELL_PIXELS ** 2)."""
        (ny, nx), (py, px), m = self.cells, self.pad, CELL_PIXELS
        inner = image[..., py : py + ny * m, px : px + nx * m]
        inner = inner.reshape(*image.shape[:-2], ny, m, nx, m).swapaxes(-3, -2)
        return inner.reshape(*image.shape[:-2], ny * nx, m * m)

    def positions(self, cell: NDArray[np.int64], pixel: NDArray[np.int64]) -> Array:
        """x and y (n, 2) [m] of pixels ``pixel`` (n,) of cells ``cell`` (n,), from the object's centre."""
        (ny, nx), m = self.cells, CELL_PIXELS
        x = cell % nx * m + pixel % m - nx * m // 2
        y = cell // nx * m + pixel // m - ny * m // 2
        return np.stack([x, y], 1) * self.pixel


def allowed(
    heights: NDArray[np.float32], lattice: Lattice, sensor: Sensor, penetrations: Sequence[float]
) -> NDArray[np.bool_]:
    """Window centres (P, h, w) of a turned map at which the object touches and clears the sensor's housing elsewhere."""
    deepest: dict[tuple[int, int], NDArray[np.float32]] = {}
    out = []
    for d in penetrations:
        kw, kh = (2 * np.floor(_half_window_at(sensor, d) / lattice.pixel).astype(int) + 1).tolist()
        if (kw, kh) not in deepest:
            deepest[kw, kh] = _deepest_allowed(heights, (kw, kh), sensor.housing_depth)
        out.append(deepest[kw, kh] >= d)
    return np.stack(out)


def _deepest_allowed(
    heights: NDArray[np.float32], window: tuple[int, int], housing_depth: float | None
) -> NDArray[np.float32]:
    """How deep (h, w) [m] the object may press into a window (w, h) pixels wide; negative where nothing is in it."""
    kernel = np.ones(window[::-1], np.uint8)
    if housing_depth is None:
        there = cv2.dilate((heights > NOTHING / 2).astype(np.uint8), kernel)
        return np.where(there > 0, np.float32(np.inf), np.float32(-1))
    inside = cv2.dilate(heights, kernel, borderType=cv2.BORDER_CONSTANT, borderValue=NOTHING)
    left, right = _beyond(heights.max(0), window[0] // 2)
    above, below = _beyond(heights.max(1), window[1] // 2)
    outside = np.maximum(np.maximum(left, right)[None], np.maximum(above, below)[:, None])
    # pressed d deep, the object outside reaches d less the difference below the membrane
    return np.where(inside > NOTHING / 2, inside - outside + np.float32(housing_depth), np.float32(-1))


def _half_window_at(sensor: Sensor, depth: float) -> Array:
    """Half width and height (2,) [m] of what the camera sees ``depth`` below the membrane: it narrows towards it."""
    rim = sensor.lift(np.diag(sensor.half_window))
    half = np.diag(rim[:, :2])
    return half * (1 - depth / (sensor.camera_distance + rim[:, 2])) if sensor.camera_distance else half


@dataclass(frozen=True)
class Window:
    """The sensor's window: where each mask pixel looks, at each depth, and the contacts cut from height maps."""

    sensor: Sensor
    mask_shape: tuple[int, int]
    penetrations: tuple[float, ...]

    def masks(self, there: HeightMap, turn: float, centres: Array) -> tuple[NDArray[np.bool_], Array]:
        """Contact at every penetration, for windows at ``centres`` (n, 2) [m] over the object turned by ``turn``.

        Returns
        -------
        masks : (P, n, h*w) bool
        z : (P, n) height of the object's centre above the membrane's apex at that penetration [m]
        """
        c, s = np.cos(turn), np.sin(turn)
        back = np.array([[c, s], [-s, c]])  # Rz(-turn)
        stride, half = there.heights.shape[1], len(there.heights) // 2

        def flat(xy: Array) -> NDArray[np.int64]:
            ij = np.rint(xy @ back.T / there.pixel).astype(np.int64)
            return ij[:, 1] * stride + ij[:, 0]

        base = (flat(centres) + half * stride + half)[:, None]
        heights, widest = there.heights.ravel(), there.widest.ravel()
        surface = [(h, np.take(heights, base + flat(p)) - self._sag) for h, p in self._levels]
        out = np.zeros((len(self.penetrations), len(centres), len(self._sag)), bool)
        z = np.zeros(out.shape[:2])
        for i, d in enumerate(self.penetrations):
            p, sag = self._deepest[i]
            reach = np.take(widest, base + flat(p)) - sag
            z[i] = reach.max(1, initial=NOTHING) - d
            level = z[i].astype(np.float32)[:, None]
            for h, height in surface:
                if h <= d:
                    out[i] |= height >= level + np.float32(h)
            # a contact smaller than a pixel still touches somewhere
            out[i, np.arange(len(centres)), reach.argmax(1)] = True
        return out, z

    @cached_property
    def _membrane(self) -> Array:
        x, y = self.sensor.pixel_centres(self.mask_shape)
        return self.sensor.lift(np.stack(np.meshgrid(x, y), -1).reshape(-1, 2))

    @cached_property
    def _sag(self) -> NDArray[np.float32]:
        return (-self._membrane[:, 2]).astype(np.float32)

    def _seen(self, depth: float) -> Array:
        """Where (h*w, 2) [m] each mask pixel's ray is when it is ``depth`` below the membrane that it meets."""
        p = self._membrane[:, :2]
        if not self.sensor.camera_distance:
            return p
        return p * (1 - depth / (self.sensor.camera_distance + self._membrane[:, 2:]))

    @cached_property
    def _levels(self) -> list[tuple[float, Array]]:
        """Depths, from 0 to the deepest, at which rays are tested, so close that a ray moves at most a mask pixel."""
        deepest, n = self.penetrations[-1], 1
        if self.sensor.camera_distance:
            drift = self.sensor.half_window.max() * deepest / self.sensor.camera_distance
            n += int(np.ceil(drift / (2 * self.sensor.half_window.max() / max(self.mask_shape))))
        return [(float(h), self._seen(float(h))) for h in np.linspace(0, deepest, n, endpoint=n > 1)]

    @cached_property
    def _deepest(self) -> list[tuple[Array, NDArray[np.float32]]]:
        seen = [self._seen(d) for d in self.penetrations]
        return [(p, self.sensor.sag(*p.T).astype(np.float32)) for p in seen]


def _beyond(profile: NDArray[np.float32], half: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """For each position, the maximum of ``profile`` more than ``half`` before it, and more than ``half`` after it."""
    low = np.full(half + 1, NOTHING, np.float32)
    before = np.concatenate([low, np.maximum.accumulate(profile)])[: len(profile)]
    after = np.concatenate([np.maximum.accumulate(profile[::-1])[::-1], low])[-len(profile) :]
    return before, after
