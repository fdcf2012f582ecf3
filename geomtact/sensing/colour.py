"""A gel's slope by its colour: photometric stereo, learned from presses of a ball.

Each component of the slope is a polynomial of second degree in the changes of the three channels from the background, and its
weights vary over the image as polynomials of second degree too, because lamps are near. Where the colour has not changed the gel
is flat.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geomtact.errors import SensorError
from geomtact.se3 import Array

TERMS = 54  # 9 of colour, each times 6 of the place
_RIDGE = 1e-4  # of the mean square of each term
_ROWS = 64  # of an image that are worked out at a time
_KEPT = 9  # pixels along the shorter side of the background that is kept


@dataclass(frozen=True)
class ColourTable:
    """The slope of the gel by its change of colour.

    Attributes
    ----------
    weights : 2 x ``TERMS``, of the slope along x and along y
    slope_rms : by how much slopes, which have no unit, were off where the table was not fitted: under other presses of the ball,
        or of another's table in its other half
    height_rms : by how much depths are off where nothing touches, before they are set to 0 there [m]; 0 where no press gave it
    contact_depth : how deep the gel is pressed in at the border of what counts as contact [m]; 0 where no press gave it
    background : h rows of w times R, G, B, 0..1: the untouched gel as it was then, coarsely; None where that was not kept
    """

    weights: tuple[tuple[float, ...], tuple[float, ...]]
    slope_rms: float
    height_rms: float
    contact_depth: float
    background: tuple[tuple[float, ...], ...] | None = None

    def __post_init__(self) -> None:
        if [len(w) for w in self.weights] != [TERMS, TERMS] or not np.isfinite(self.weights).all():
            raise SensorError(f"colour.weights must be 2 x {TERMS} finite numbers; calibrate the sensor again")
        if not all(np.isfinite(v) and v >= 0 for v in (self.slope_rms, self.height_rms, self.contact_depth)):
            raise SensorError("colour.slope_rms, height_rms_mm and contact_depth_mm must be numbers >= 0")
        if self.background is not None:
            length = len(self.background[0])
            if not length or length % 3 or any(len(row) != length for row in self.background):
                raise SensorError("colour.background must be rows of R, G, B, all as long; calibrate the sensor again")
            if not all(0 <= v <= 1 for row in self.background for v in row):
                raise SensorError("colour.background must be brightness from 0 to 1; calibrate the sensor again")

    @property
    def rest(self) -> Array | None:
        """``background`` (h, w, 3)."""
        return None if self.background is None else np.reshape(self.background, (len(self.background), -1, 3))

    def brighter(self, background: Array) -> float:
        """How many times as bright a background (H, W, 3) is as that of the calibration; 1 where that was not kept."""
        if self.rest is None:
            return 1.0
        now, then = (float(np.median(each.mean(-1))) for each in (coarse(background, self.rest.shape), self.rest))
        return now / then if min(now, then) > 0 else 1.0

    def slopes(self, change: Array) -> Array:
        """The slope (H, W, 2) of the indentation's depth along x and y, of a change of colour (H, W, 3)."""
        h, w = change.shape[:2]
        out = np.empty((h, w, 2))
        for first in range(0, h, _ROWS):
            v, u = np.mgrid[first : min(first + _ROWS, h), :w]
            features = terms(change[first : first + _ROWS].reshape(-1, 3), u.ravel(), v.ravel(), (h, w))
            out[first : first + _ROWS] = (features @ np.asarray(self.weights).T).reshape(*u.shape, 2)
        return out


def coarse(image: Array, shape: tuple[int, ...]) -> Array:
    """``image`` (H, W, 3) as its means over h x w parts of it, of ``shape`` = (h, w, ...)."""
    import cv2

    return np.asarray(cv2.resize(image, shape[1::-1], interpolation=cv2.INTER_AREA))


def kept(background: Array) -> tuple[tuple[float, ...], ...]:
    """A background (H, W, 3) of 0..1 as a table keeps it."""
    scale = _KEPT / min(background.shape[:2])
    small = coarse(background, tuple(round(scale * n) for n in background.shape[:2]))
    return tuple(tuple(float(f"{v:.3g}") for v in row.ravel()) for row in np.clip(small, 0, 1))


def terms(change: Array, u: NDArray, v: NDArray, shape: tuple[int, int]) -> Array:
    """The table's terms (n, ``TERMS``) of changes of colour (n, 3) at columns ``u`` (n,) and rows ``v`` (n,) of an image
    ``shape`` = (H, W)."""
    i, j = np.triu_indices(3)
    colour = np.concatenate([change, change[:, i] * change[:, j]], 1)
    x, y = (u + 0.5) / shape[1] * 2 - 1, (v + 0.5) / shape[0] * 2 - 1
    place = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], 1)
    return np.asarray((colour[:, :, None] * place[:, None, :]).reshape(len(change), -1))


def fit_weights(features: Array, slopes: Array) -> Array:
    """Weights (2, ``TERMS``) that lead from terms (n, ``TERMS``) to ``slopes`` (n, 2): least squares, the large ones damped."""
    scale = np.sqrt((features**2).mean(0)) + 1e-12
    A = features / scale
    normal = np.einsum("ni,nj->ij", A, A) / len(A) + _RIDGE * np.eye(A.shape[1])
    return np.asarray((np.linalg.solve(normal, np.einsum("ni,nk->ik", A, slopes) / len(A)) / scale[:, None]).T)
