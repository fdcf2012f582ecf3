"""What a camera sees of a gel between lamps: each lights the slopes that face it and throws shadows behind what is pressed in."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from geomtact.se3 import Array

_REACH = 12  # distances, growing by the same factor, at which something may stand between a pixel and a lamp


@dataclass(frozen=True, eq=False)
class Lamps:
    """K lamps around the gel.

    Attributes
    ----------
    place : (K, 3) column, row [px] from the middle of the image, and height above the gel towards the camera
    colour : (K, 3) what each adds to the three channels
    ambient : (3,) light from everywhere, in shares of what lamps make of the untouched gel
    soft : by how much [tangent] the height of a lamp differs over its width: shadows fade over it
    falloff : power of the distance with which light fades
    """

    place: Array
    colour: Array
    ambient: Array
    soft: float
    falloff: float


def lit(height: NDArray[np.floating], lamps: Lamps) -> NDArray[np.float32]:
    """Light (h, w, 3) that a gel pressed in by ``height`` (h, w) [px] sends to the camera; of an untouched one 1 + ``ambient`` in
    the mean."""
    height = np.asarray(height, np.float32)
    h, w = height.shape
    x, y = np.meshgrid(np.arange(w, dtype=np.float32) - (w - 1) / 2, np.arange(h, dtype=np.float32) - (h - 1) / 2)
    slope_y, slope_x = np.gradient(height)
    upright = 1 / np.sqrt(1 + slope_x**2 + slope_y**2)
    out, flat = np.zeros((h, w, 3), np.float32), np.zeros(3)
    for (at_x, at_y, up), colour in zip(lamps.place, lamps.colour, strict=True):
        far = np.sqrt((at_x - x) ** 2 + (at_y - y) ** 2 + up**2)
        strength = (np.hypot(at_x, at_y) / far) ** lamps.falloff / far
        facing = np.maximum(up - (at_x - x) * slope_x - (at_y - y) * slope_y, 0) * upright
        out += (strength * facing * _unshaded(height, at_x, at_y, up, lamps.soft))[..., None] * colour
        flat += (strength * up).mean() * colour
    return (out / flat + lamps.ambient).astype(np.float32)


def _unshaded(height: NDArray[np.float32], at_x: float, at_y: float, up: float, soft: float) -> NDArray[np.float32]:
    """The share (h, w) of a lamp that is seen over what stands between it and the gel."""
    h, w = height.shape
    far = float(np.hypot(at_x, at_y))
    horizon = np.full((h, w), -np.inf, np.float32)
    for t in np.geomspace(1.0, 0.5 * max(h, w), _REACH):
        M = np.array([[1, 0, t * at_x / far], [0, 1, t * at_y / far]], np.float32)
        nearer = cv2.warpAffine(
            height, M, (w, h), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, borderMode=cv2.BORDER_REPLICATE
        )
        horizon = np.maximum(horizon, (nearer - height) / np.float32(t))
    return np.clip((up / far - horizon) / soft + 0.5, 0, 1)
