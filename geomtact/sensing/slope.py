"""The gel's slope by colours that are not calibrated, and the heights and the pressure that go with a slope."""

from __future__ import annotations

import numpy as np

from geomtact.se3 import Array
from geomtact.sensing.pixels import Mask, blurred, transformed

_CURL_LIMIT = 0.45  # share of curl above which the colours do not behave like slopes


def slope_field(plane: Array, changed: Mask, sigma: float, pitch: Array) -> Array | None:
    """The gel's slope (H, W, 2) up to a factor, of a change in two colours (H, W, 2); None where these do not determine it."""
    plane = blurred(plane, sigma)
    along_y, along_x = (np.gradient(plane, axis=axis) / pitch[1 - axis] for axis in (0, 1))
    curl = np.concatenate([along_y, -along_x], -1)[changed]
    residual, maps = np.linalg.eigh(curl.T @ curl)
    if residual[0] > _CURL_LIMIT * residual[-1]:
        return None
    return transformed(plane, maps[:, 0].reshape(2, 2))


def integrate(slope: Array, pitch: Array) -> Array:
    """The height (H, W) whose gradient is nearest to ``slope`` (H, W, 2), mirrored at the border (Frankot, Chellappa 1988).

    ``pitch`` (2,) is that of columns and rows, of any unit, which is the height's too where the slope has none.
    """
    return of_gradient(slope, pitch, 2)[0]


def of_gradient(slope: Array, pitch: Array, *powers: int) -> list[Array]:
    """For each of the ``powers`` p, the field (H, W) with the waves -i k . g(k) / |k|^p, where g(k) are those of ``slope``
    (H, W, 2): the height for 2, the pressure for 1. Mirrored at the border: a sum of cosines, and its slope along an axis one of
    sines there. ``pitch`` (2,) as of :func:`integrate`."""
    from scipy import fft

    h, w = slope.shape[:2]
    kx = (np.pi * np.arange(w) / (w * pitch[0])).astype(slope.dtype)
    ky = (np.pi * np.arange(h)[:, None] / (h * pitch[1])).astype(slope.dtype)
    along_x = _sines(fft.dct(slope[..., 0], axis=0, norm="ortho"), 1)
    along_y = _sines(fft.dct(slope[..., 1], axis=1, norm="ortho"), 0)
    k = np.hypot(kx, ky)
    k[0, 0] = 1.0
    waves = -(kx * along_x + ky * along_y)
    return [np.asarray(fft.idctn(waves / k**power, norm="ortho")) for power in powers]


def _sines(values: Array, axis: int) -> Array:
    """The sine transform of ``values`` along ``axis``, in the order of the cosines, of which the first has no sine."""
    from scipy import fft

    out = np.roll(fft.dst(values, axis=axis, norm="ortho"), 1, axis)
    out[(slice(None),) * axis + (0,)] = 0
    return np.asarray(out)
