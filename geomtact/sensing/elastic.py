"""Which part of a pressed object an elastic gel really touches: frictionless contact of a rigid body with a half-space.

The gel is an elastic half-space, the object rigid and pressed in by a given depth. The contact is where the pressure
is positive; it is smaller than the part of the object below the undeformed membrane (for a ball by 1/sqrt(2) in
radius), because the gel sinks around the object. For a prescribed depth the contact does not depend on the gel's
stiffness, so the contact modulus is taken as 1.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import fft

Array32 = NDArray[np.float32]

_TOLERANCE = 1e-3  # largest mismatch between gel and object under contact, as a share of the depth
_MAX_ITERATIONS = 200
_LEAST_INFLUENCE = 1e-3  # of the largest, that is inverted as it is


def elastic_mask(depth: ArrayLike, pitch: tuple[float, float]) -> NDArray[np.bool_]:
    """Where an elastic gel touches a rigid object.

    Parameters
    ----------
    depth : (H, W) how far the object lies below the undeformed membrane [m]; negative or -inf where it stays above
    pitch : (along x, along y), pixel size [m]

    Returns
    -------
    mask : (H, W) bool, True where the pressure is positive

    Notes
    -----
    The grid is all there is: outside it the gel is free. For an object that reaches beyond the sensor's window, give
    the depth on a wider grid and cut the window out of the result.
    """
    depth, box = _in_box(depth)
    mask = np.zeros(depth.shape, bool)
    if box is not None:
        mask[box] = _pressure(depth[box], pitch) > 0
    return mask


def elastic_contact(
    depth: ArrayLike, pitch: tuple[float, float], thickness: float = np.inf
) -> tuple[NDArray[np.bool_], Array32]:
    """As :func:`elastic_mask`, and the surface displacement (H, W) [m], >= 0 and equal to ``depth`` in contact.

    Of a gel of finite ``thickness`` [m] the sinking beside the object dies away over that length.
    """
    depth, box = _in_box(depth)
    pressure = np.zeros(depth.shape, np.float32)
    if box is None:
        return pressure > 0, pressure
    pressure[box] = _pressure(depth[box], pitch, thickness)
    return pressure > 0, _displacement(pressure, _spectrum(depth.shape, pitch, thickness))


def _in_box(depth: ArrayLike) -> tuple[Array32, tuple[slice, slice] | None]:
    """Depth as float32 and the box around the part below the membrane: only there can the object be touched."""
    depth = np.asarray(depth, np.float32)
    below = depth > 0
    rows, cols = np.flatnonzero(below.any(1)), np.flatnonzero(below.any(0))
    if not len(rows):
        return depth, None
    return depth, (slice(rows[0], rows[-1] + 1), slice(cols[0], cols[-1] + 1))


def _pressure(depth: Array32, pitch: tuple[float, float], thickness: float = np.inf) -> Array32:
    """Pressure (h, w), for contact modulus 1, by the constrained conjugate gradients of Polonsky and Keer (1999).

    They minimise p K p / 2 - p depth over p >= 0, K the half-space's influence; unlike theirs the load is free and the
    depth given. Steps are preconditioned by K's inverse on a gel that is touched everywhere, after Vollebregt (2014), which
    takes a third of them. Depths are scaled to a maximum of 1, so that float32 serves.
    """
    h, w = depth.shape
    scale = float(depth.max())
    # sizes in steps of 8 let contacts of like size share an influence spectrum
    target = np.full((-(-h // 8) * 8, -(-w // 8) * 8), -1.0, np.float32)
    target[:h, :w] = np.where(depth > 0, depth / scale, -1.0)
    may_touch = target > 0
    spectrum, inverse = _spectrum(target.shape, pitch, thickness), _inverse(target.shape, pitch, thickness)

    allowed = np.where(may_touch, target, 0)
    pressure = np.where(may_touch, np.maximum(_displacement(allowed, inverse), 0), 0)
    pressure *= np.vdot(pressure, allowed) / np.vdot(pressure, _displacement(pressure, spectrum))
    direction = np.zeros_like(pressure)
    previous = 0.0  # squared residual of the last step; 0 restarts the conjugate directions
    for _ in range(_MAX_ITERATIONS):
        gap = _displacement(pressure, spectrum) - target
        touching = pressure > 0
        inside = np.where(touching, gap, 0)
        entered = may_touch & ~touching & (gap < -_TOLERANCE)
        if np.abs(inside).max() < _TOLERANCE and not entered.any():
            break
        eased = np.where(touching, _displacement(inside, inverse), 0)
        square = float(np.vdot(inside, eased))
        direction = eased + (square / previous if previous else 0.0) * np.where(touching, direction, 0)
        sunk = _displacement(direction, spectrum)
        step = np.vdot(inside, direction) / max(float(np.vdot(sunk, direction)), 1e-30)
        pressure = np.maximum(pressure - step * direction, 0)
        again = may_touch & (pressure == 0) & (gap < 0)
        previous = square
        if again.any():
            previous = 0.0
            pressure[again] = np.maximum(-step * _displacement(np.where(again, gap, 0), inverse)[again], 0)
    return (pressure[:h, :w] * scale).astype(np.float32)


def _displacement(pressure: Array32, spectrum: NDArray[np.complex64]) -> Array32:
    """Displacement of the free gel under ``pressure``: a linear convolution (zero padding to twice the size)."""
    h, w = pressure.shape
    size = spectrum.shape[0], 2 * (spectrum.shape[1] - 1)
    return fft.irfft2(fft.rfft2(pressure, size) * spectrum, size)[:h, :w]


@lru_cache(maxsize=64)
def _spectrum(shape: tuple[int, int], pitch: tuple[float, float], thickness: float = np.inf) -> NDArray[np.complex64]:
    """Transform of the influence of one loaded pixel on the others (Love 1929; Johnson 1985, eq. 3.25), which a finite
    ``thickness`` [m] screens."""
    size = [fft.next_fast_len(2 * n, real=True) for n in shape]
    size[1] += size[1] % 2
    x, y = ((np.arange(-(n // 2), n - n // 2 + 1) - 0.5) * d for n, d in zip(size[::-1], pitch, strict=True))
    X, Y = np.meshgrid(x, y)
    # The second difference over the pixel's corners; corners are never on an axis, so no division by zero.
    corner = X * np.arcsinh(Y / np.abs(X)) + Y * np.arcsinh(X / np.abs(Y))
    influence = np.diff(np.diff(corner, axis=0), axis=1) / np.pi
    influence *= np.exp(-np.hypot(*np.meshgrid(x[:-1] + 0.5 * pitch[0], y[:-1] + 0.5 * pitch[1])) / thickness)
    return fft.rfft2(fft.ifftshift(influence)).astype(np.complex64)


@lru_cache(maxsize=64)
def _inverse(shape: tuple[int, int], pitch: tuple[float, float], thickness: float = np.inf) -> NDArray[np.complex64]:
    """Transform of the pressure under a displacement, were the gel touched everywhere."""
    size = np.abs(_spectrum(shape, pitch, thickness))
    return (1 / np.maximum(size, _LEAST_INFLUENCE * size.max())).astype(np.complex64)
