"""What spoils a contact mask on a real sensor: a trembling outline, specks of dirt, a patch that was not detected."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geomtact.se3 import Array


@dataclass(frozen=True)
class Noise:
    """How strongly a mask is spoilt. Lengths are metres.

    Attributes
    ----------
    outline_rms : root mean square of the outline's displacement along any one direction, so along its own normal
    correlation : (least, largest) length over which that displacement's correlation falls to 1/e; one is drawn a touch
    specks : how many false spots of contact there are anywhere in the window
    speck_diameter : of each speck
    missing_probability : how often a round patch of the contact is missing
    missing_radius : (least, largest) radius of that patch, as a share of the radius of a disk of the contact's area
    """

    outline_rms: float
    correlation: tuple[float, float] = (1e-3, 3e-3)
    specks: int = 0
    speck_diameter: float = 0.35e-3
    missing_probability: float = 0.0
    missing_radius: tuple[float, float] = (0.3, 0.6)


CLEAN = Noise(outline_rms=0.0)
MODERATE = Noise(outline_rms=0.2e-3, specks=2)
HEAVY = Noise(outline_rms=0.5e-3, specks=6, missing_probability=0.7)


def perturb(mask: ArrayLike, pitch: tuple[float, float], noise: Noise, rng: np.random.Generator) -> NDArray[np.bool_]:
    """A spoilt copy (H, W) bool of the contact ``mask`` (H, W).

    Parameters
    ----------
    mask : (H, W) bool
    pitch : (along x, along y), pixel size [m]
    noise : how strongly
    rng : source of randomness; the same state gives the same result
    """
    mask = np.asarray(mask, bool)
    x, y = (np.arange(n) * d for n, d in zip(mask.shape[::-1], pitch, strict=True))
    if noise.outline_rms > 0 and mask.any():
        mask = _displaced(mask, x, y, pitch, noise, rng)
    mask = mask.copy()
    if rng.random() < noise.missing_probability and mask.any():
        row, col = np.argwhere(mask)[rng.integers(mask.sum())]
        radius = rng.uniform(*noise.missing_radius) * np.sqrt(mask.sum() * pitch[0] * pitch[1] / np.pi)
        mask &= ~_disk(x, y, x[col], y[row], radius)
    for _ in range(noise.specks):
        row, col = rng.integers(len(y)), rng.integers(len(x))
        mask |= _disk(x, y, x[col], y[row], 0.5 * noise.speck_diameter)
    return mask


def smooth_field(x: Array, y: Array, correlation: float, rng: np.random.Generator) -> Array:
    """A random field (len(y), len(x)) of variance 1 at every point whose correlation falls to 1/e at ``correlation``.

    White noise under a Gaussian filter of standard deviation s has the correlation exp(-r^2 / 4 s^2), so s is half the
    correlation length. The noise sits on nodes s/2 apart that reach beyond the window: its border is no special place.
    """
    sigma = 0.5 * correlation
    weights = []
    for at in (y, x):
        nodes = np.arange(at[0] - 4 * sigma, at[-1] + 4 * sigma, sigma / 2)
        weight = np.exp(-0.5 * ((at[:, None] - nodes) / sigma) ** 2)
        weights.append(weight / np.linalg.norm(weight, axis=1, keepdims=True))
    return weights[0] @ rng.normal(size=(weights[0].shape[1], weights[1].shape[1])) @ weights[1].T


def correlation_length(errors: Sequence[Array], pitch: tuple[float, float]) -> float:
    """Over what length [m] ``errors``, images (h, w) of the mean 0 with NaN where there is none, correlate: to 1/e, as of
    :func:`smooth_field`. Where they do farther than they reach, it is how far they reach."""
    shape = tuple(2 * max(each.shape[axis] for each in errors) for axis in (0, 1))
    product, count = np.zeros(shape), np.zeros(shape)
    for each in errors:
        known = np.isfinite(each)
        product += np.fft.ifft2(np.abs(np.fft.fft2(np.where(known, each, 0.0), shape)) ** 2).real
        count += np.fft.ifft2(np.abs(np.fft.fft2(known.astype(float), shape)) ** 2).real
    count = np.rint(count)
    lags = [n * np.fft.fftfreq(n) * step for n, step in zip(shape, pitch[::-1], strict=True)]
    lag = np.hypot(lags[0][:, None], lags[1])
    ring = (lag / max(pitch)).astype(np.int64).ravel()
    pairs = np.bincount(ring, count.ravel())
    some = pairs > 0
    share = np.bincount(ring, product.ravel())[some] / pairs[some]
    length = np.bincount(ring, (lag * count).ravel())[some] / pairs[some]
    below = int(np.argmax(share < share[0] / np.e))
    if not below:
        return float(length.max())
    return float(np.interp(-share[0] / np.e, -share[below - 1 : below + 1], length[below - 1 : below + 1]))


def _displaced(
    mask: NDArray[np.bool_], x: Array, y: Array, pitch: tuple[float, float], noise: Noise, rng: np.random.Generator
) -> NDArray[np.bool_]:
    """``mask`` moved by a smooth random vector field; a contact cut by the border continues beyond it."""
    import cv2

    correlation = rng.uniform(*noise.correlation)
    col, row = np.meshgrid(np.arange(len(x), dtype=np.float32), np.arange(len(y), dtype=np.float32))
    col -= noise.outline_rms / pitch[0] * smooth_field(x, y, correlation, rng)
    row -= noise.outline_rms / pitch[1] * smooth_field(x, y, correlation, rng)
    image = 255 * mask.astype(np.uint8)
    return cv2.remap(image, col, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) > 127


def _disk(x: Array, y: Array, x0: float, y0: float, radius: float) -> NDArray[np.bool_]:
    """Pixels (len(y), len(x)) whose centres lie within ``radius`` of (x0, y0)."""
    return (x - x0) ** 2 + (y[:, None] - y0) ** 2 <= radius**2
