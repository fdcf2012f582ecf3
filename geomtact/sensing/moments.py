"""A contact summed up by its moments: where it lies, how large it is, and how it is stretched."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from geomtact.sensing.sensor import Sensor

FEATURES = ("centroid x", "centroid y", "log area", "log size", "stretch along x", "stretch along the diagonal")
_SPECK = 0.15e-6  # m^2: a patch below this is dust when there is a contact ten times as large


def moments(masks: NDArray[np.bool_], sensor: Sensor) -> NDArray[np.float32]:
    """Moments (n, 6) of contact masks (n, h, w) that cover the sensor's window, as named in ``FEATURES``.

    Lengths are shares of the window's half diagonal, so that the features have no unit.
    """
    n, h, w = masks.shape
    basis, pixel = _basis(sensor, h, w)
    sums = masks.reshape(n, -1).astype(np.float32) @ basis
    count = np.maximum(sums[:, 0], 1)
    mx, my, xx, xy, yy = (sums[:, 1:] / count[:, None]).T
    # a pixel has an extent of its own
    xx = np.maximum(xx - mx * mx, 0) + pixel / 12
    yy = np.maximum(yy - my * my, 0) + pixel / 12
    xy = xy - mx * my
    half_trace = (xx + yy) / 2
    spread = np.minimum(np.hypot((xx - yy) / 2, xy), half_trace - pixel / 24)
    large, small = half_trace + spread, half_trace - spread
    stretch = 0.5 * np.log(large / small)
    angle = np.arctan2(2 * xy, xx - yy)
    columns = (mx, my, np.log(count * pixel), 0.25 * np.log(large * small))
    return np.stack([*columns, stretch * np.cos(angle), stretch * np.sin(angle)], 1).astype(np.float32)


@lru_cache(maxsize=8)
def _basis(sensor: Sensor, h: int, w: int) -> tuple[NDArray[np.float32], float]:
    """1, x, y and their products at every pixel (h w, 6), and a pixel's area, in units of the window's half diagonal."""
    scale = float(np.hypot(*sensor.half_window))
    x, y = (c / scale for c in sensor.pixel_centres((h, w)))
    X, Y = (c.ravel() for c in np.meshgrid(x, y))
    basis = np.stack([np.ones_like(X), X, Y, X * X, X * Y, Y * Y], 1).astype(np.float32)
    return basis, float((x[1] - x[0]) * (y[1] - y[0]))


def without_specks(mask: NDArray[np.bool_], sensor: Sensor) -> NDArray[np.bool_]:
    """``mask`` (h, w) without patches that are dust beside a far larger contact."""
    n, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    areas = stats[:, cv2.CC_STAT_AREA] * (4 * sensor.half_window.prod() / mask.size)
    dust = areas < min(_SPECK, areas[1:].max(initial=0) / 10)
    dust[0] = True
    return ~dust[labels] if n > 1 else mask
