"""Log likelihood of a contact's outline, given where the object should touch the gel.

A contact mask displaces the outline smoothly, by an unknown strength that is marginalised over. So the distance between the two
outlines counts, not the number of pixels that differ: a shape lies in details that have hardly any area.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from geomtact.log_mass import log_mean_exp
from geomtact.se3 import Array
from geomtact.sensing.sensor import Sensor

# All constants are hand-set; strengths and correlation span the moderate and the heavy noise of ``sensing.noise``.
STRENGTHS = (0.2e-3, 0.35e-3, 0.6e-3)  # rms of the displacement [m], equally likely
_CORRELATION = 2e-3  # correlation length of the displacement along the outline, to 1/e, as ``Noise.correlation`` [m]
_OUTLIER = 3.0  # displacement, in strengths, above which a piece of outline is an outlier, such as dust
_STEEPEST = 1.0  # slope of the object beside the contact that counts as a wall
_FLATTEST = 0.05  # least slope by which a depth is turned into a distance
_POINTS = 150  # largest number of points of the observed outline


@dataclass(frozen=True, eq=False)
class OutlineLikelihood:
    """Of one observed contact.

    Attributes
    ----------
    beside : (H, W) how far each pixel is outside the observed outline [m], negative inside of it
    pitch : of these pixels along x and y [m]
    points : (n, 2) column and row on the observed outline
    length : of the observed outline [m]
    field_pitch : (dx, dy) of the fields it is compared with [m]
    """

    beside: NDArray[np.float32]
    pitch: Array
    points: Array
    length: float
    field_pitch: Array

    @classmethod
    def of(cls, mask: NDArray[np.bool_], sensor: Sensor, shape: tuple[int, int]) -> OutlineLikelihood:
        """Of a contact ``mask`` (H, W), to be compared with fields of ``shape`` (h, w) over the same window."""
        pitch = 2 * sensor.half_window / mask.shape[::-1]
        _, points, length = _crossings(np.where(mask, 1.0, -1.0)[None], pitch)
        # They come row by row, left and right in turn: every other one might be the left side alone
        most = min(len(points), _POINTS)
        some = (np.arange(most) + np.random.default_rng(0).random(most)) * len(points) / max(most, 1)
        return cls(
            from_outline(mask, float(np.sqrt(pitch.prod()))),
            pitch,
            points[some.astype(int)],
            float(length.sum()),
            2 * sensor.half_window / shape[::-1],
        )

    def log_likelihood(self, over: NDArray[np.floating]) -> Array:
        """Natural log of the likelihood (n,) up to a constant, ``over`` (n, h, w) being how much deeper [m] the object lies than
        where touch begins; -inf where it lies nowhere so deep."""
        # beside a wall the distance to the level is undefined: about halfway to the next pixel
        over = np.maximum(over, -_STEEPEST * float(np.sqrt(self.field_pitch.prod())))
        which, at, length = _crossings(over, self.field_pitch)
        column, row = np.rint((at + 0.5) * self.field_pitch / self.pitch - 0.5).astype(int).T
        h, w = self.beside.shape
        at_outline = self.beside[np.clip(row, 0, h - 1), np.clip(column, 0, w - 1)]
        at_points = self._from_points(over)
        each = []
        for strength in STRENGTHS:
            expected = np.bincount(which, _squared(at_outline, strength) * length, len(over))
            seen = _squared(at_points, strength).mean(1) * self.length if len(self.points) else 0.0
            each.append(-0.25 * (expected + seen) - self.length * np.log(strength / STRENGTHS[0]))
        out = log_mean_exp(np.stack(each, 1) / (np.sqrt(np.pi) * _CORRELATION))
        return np.where((over > 0).any((1, 2)), out, -np.inf)

    def _from_points(self, over: NDArray[np.floating]) -> Array:
        """How far (n, m) [m] the level 0 of ``over`` (n, h, w) is from each observed point, by its slope there."""
        h, w = over.shape[1:]
        column, row = ((self.points + 0.5) * self.pitch / self.field_pitch - 0.5).T
        i, j = (np.clip(np.floor(x).astype(int), 0, most - 2) for x, most in ((row, h), (column, w)))
        a, b, c, d = over[:, i, j], over[:, i, j + 1], over[:, i + 1, j], over[:, i + 1, j + 1]
        y, x = np.clip(row - i, 0, 1), np.clip(column - j, 0, 1)
        value = (1 - y) * ((1 - x) * a + x * b) + y * ((1 - x) * c + x * d)
        slope_x = ((1 - y) * (b - a) + y * (d - c)) / self.field_pitch[0]
        slope_y = ((1 - x) * (c - a) + x * (d - b)) / self.field_pitch[1]
        return np.asarray(value / np.maximum(np.hypot(slope_x, slope_y), _FLATTEST))


def _squared(distance: NDArray[np.floating], strength: float) -> Array:
    return np.asarray(np.minimum(distance / strength, _OUTLIER).clip(-_OUTLIER) ** 2)


def from_outline(mask: NDArray[np.bool_], pitch: float) -> NDArray[np.float32]:
    """How far (H, W) [m] each pixel is outside the outline of ``mask``, negative inside; the window's border is no outline."""
    image = mask.astype(np.uint8)
    far = float(np.hypot(*mask.shape))
    off = [
        cv2.distanceTransform(side, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) - 0.5
        if not side.all()
        else np.full(mask.shape, far, np.float32)
        for side in (1 - image, image)
    ]
    return np.asarray(pitch * np.where(mask, -off[1], off[0]), np.float32)


def _crossings(field: NDArray[np.floating], pitch: Array) -> tuple[NDArray[np.int64], Array, Array]:
    """Where fields (n, h, w) change their sign between neighbours: which field (m,), column and row (m, 2), and for how much [m]
    of the outline's length each stands (m,), whichever way that runs (Cauchy and Crofton)."""
    which, at, length = [], [], []
    for axis, across in ((2, pitch[1]), (1, pitch[0])):
        along = np.moveaxis(field, axis, 2)
        i, line, k = np.nonzero((along[..., 1:] > 0) != (along[..., :-1] > 0))
        here, there = along[i, line, k].astype(float), along[i, line, k + 1].astype(float)
        between = k + here / (here - there)
        which.append(i)
        at.append(np.stack([between, line] if axis == 2 else [line, between], 1))
        length.append(np.full(len(i), np.pi / 4 * across))
    return np.concatenate(which), np.concatenate(at), np.concatenate(length)
