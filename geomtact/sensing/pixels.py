"""Images (H, W) and (H, W, C) on their own pixels: smoothed, measured, and regions without what is small."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from geomtact.se3 import Array

Mask = NDArray[np.bool_]


def blurred(image: NDArray[np.floating], sigma: float) -> Any:
    """``image`` (H, W) or (H, W, C) smoothed by ``sigma`` [px], in single precision."""
    return cv2.GaussianBlur(image.astype(np.float32), (0, 0), sigma, borderType=cv2.BORDER_REFLECT)


def transformed(image: Array, matrix: Array) -> Array:
    """``matrix`` (D, C) applied to each pixel of ``image`` (H, W, C)."""
    return np.asarray(cv2.transform(image, matrix))


def size_of(change: Array) -> Array:
    """How large (H, W) a change of colour (H, W, 3) is, in all channels together."""
    return np.sqrt(np.einsum("hwc,hwc->hw", change, change))


def median_of(values: NDArray[Any]) -> float:
    """The median of ``values`` (n,), none of them NaN, in a fraction of ``np.median``'s time."""
    below = (len(values) - 1) // 2
    parted = np.partition(values, below)
    return float(parted[below] if len(values) % 2 else np.mean([parted[below], parted[below + 1 :].min()]))


def pixels_apart(sigma: float) -> int:
    """Pixels from one to the next that is independent, where all are smoothed by ``sigma``; an odd number."""
    return 2 * round(0.75 * sigma) + 1


def every(step: int, n: int) -> slice:
    """Every ``step``-th of ``n`` pixels, ``step`` odd: the same ones from either end, so that a mirrored image gives the same."""
    left = (n - 1) % step
    start = (left + step * (left % 2)) // 2
    return slice(start, n - start, step)


def opened(mask: Mask, n: int) -> Mask:
    """``mask`` (H, W) without what is less than 2 ``n`` + 1 pixels wide."""
    return _morphed(mask, cv2.MORPH_OPEN, n)


def closed(mask: Mask, n: int) -> Mask:
    """``mask`` (H, W) with gaps that are less than 2 ``n`` + 1 pixels wide."""
    return _morphed(mask, cv2.MORPH_CLOSE, n)


def _morphed(mask: Mask, operation: int, n: int) -> Mask:
    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    return np.asarray(cv2.morphologyEx(mask.astype(np.uint8), operation, cross, iterations=n), bool)


def filled(mask: Mask) -> Mask:
    """``mask`` (H, W) with its holes: what cannot be reached from outside the image."""
    around = np.pad(~mask, 1, constant_values=True).astype(np.uint8)
    _, labels = cv2.connectedComponents(around, connectivity=4)
    return np.asarray(labels != labels[0, 0])[1:-1, 1:-1]
