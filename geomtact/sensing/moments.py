"""A contact summed up by its moments: where it lies, how large it is, and how it is stretched."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geomtact.sensing.patches import labelled
from geomtact.sensing.sensor import Sensor

FEATURES = ("centroid x", "centroid y", "log area", "log size", "stretch along x", "stretch along the diagonal")
_SPECK = 0.15e-6  # m^2: a patch below this is dust when there is a contact ten times as large


def moments(masks: NDArray[Any], sensor: Sensor) -> NDArray[np.float32]:
    """Moments (n, 6) of contact masks (n, h, w), bool or probabilities, that cover the window, as named in ``FEATURES``.

    Lengths are shares of the window's half diagonal, so that the features have no unit.
    """
    n, h, w = masks.shape
    X, Y, pixel = _powers(sensor, h, w)
    # the sums over all pixels of 1, x, y and their products, first along the rows
    sums = Y @ (masks.reshape(n * h, w).astype(np.float32) @ X).reshape(n, h, 3)
    count = np.maximum(sums[:, 0, 0], 1)
    mx, my, xx, xy, yy = (sums[:, j, i] / count for j, i in ((0, 1), (1, 0), (0, 2), (1, 1), (2, 0)))
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
def _powers(sensor: Sensor, h: int, w: int) -> tuple[NDArray[np.float32], NDArray[np.float32], float]:
    """1, x and x^2 of the columns (w, 3), 1, y and y^2 of the rows (3, h), and a pixel's area, in units of the window's
    half diagonal."""
    scale = float(np.hypot(*sensor.half_window))
    x, y = (c / scale for c in sensor.pixel_centres((h, w)))
    X, Y = (np.stack([np.ones_like(c), c, c * c]).astype(np.float32) for c in (x, y))
    return np.ascontiguousarray(X.T), Y, float((x[1] - x[0]) * (y[1] - y[0]))


def moments_of(mask: NDArray[Any], sensor: Sensor) -> NDArray[np.float32]:
    """:func:`moments` (6,) of one mask (h, w), without dust."""
    return moments(cleaned(mask, sensor)[None], sensor)[0]


def cleaned(mask: NDArray[Any], sensor: Sensor) -> NDArray[Any]:
    """:func:`without_specks`, of a mask (h, w) that covers the window."""
    return without_specks(mask, sensor.pixel_area(mask.shape))


def without_specks(mask: NDArray[Any], pixel_area: float) -> NDArray[Any]:
    """``mask`` (h, w), of pixels of ``pixel_area`` [m^2], without patches that are dust beside a far larger contact; bool, or the
    probability of contact at each pixel."""
    if mask.dtype != bool:
        touched = mask > 0.5
        return np.where(touched & ~without_specks(touched, pixel_area), 0, mask)
    labels, count = labelled(mask)
    areas = count * pixel_area
    dust = areas < min(_SPECK, areas[1:].max(initial=0) / 10)
    if not dust[1:].any():
        return mask
    dust[0] = True
    return ~np.take(dust, labels)
