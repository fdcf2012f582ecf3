"""Readings to learn from: presses under random lamps, on random backgrounds, with the noise of cameras and gels.

How a sensor is lit is drawn anew for every reading, so that the network learns what all sensors have in common: the gel bends
around what it is touched by.
"""

from __future__ import annotations

import cv2
import kornia
import numpy as np
import torch
from numpy.typing import NDArray

from geomtact.se3 import Array
from geomtact.sensing.local_shape import colour_change
from geomtact.sensing.mask_network import seen_change
from geomtact.sensing.render import Lamps, render

Image = NDArray[np.float32]


def random_reading(height: NDArray[np.floating], rng: np.random.Generator) -> tuple[Image, Image]:
    """A reading (h, w, 3) of a gel pressed in by ``height`` (h, w) [px], and its background (h, w, 3)."""
    background = _background(height.shape, rng)
    # as the camera sees them: both blurred, the reading with a light that has drifted, and each with noise of its own
    lamps = _lamps(rng)
    shown = np.stack([_shadowed(render(height, (1.0, 1.0), background, lamps), background, lamps, rng), background])
    shown[0] = _dusty(_scattered(shown[0] - background, rng) + background, rng)
    shown = _blurred(shown @ _crosstalk(rng), float(rng.uniform(0.2, 1.5)))
    shown[0] = shown[0] * rng.normal(1, 0.01, 3) + rng.normal(0, 0.005, 3)
    noise = rng.uniform(0.3, 2.5) / 255
    shown = np.clip(shown + noise * rng.normal(size=shown.shape), 0, 1)
    return shown[0].astype(np.float32), shown[1].astype(np.float32)


def random_change(height: NDArray[np.floating], rng: np.random.Generator) -> Image:
    """What the network sees (3, h', w') of a random reading of a gel pressed in by ``height`` (h, w) [px]."""
    image, background = random_reading(height, rng)
    return seen_change(colour_change(image.astype(float), background.astype(float))[0])


def _lamps(rng: np.random.Generator) -> Lamps:
    """Of three colours around the gel, near or far, some weaker; or any."""
    lamps = Lamps.around(rng.uniform(0, 2 * np.pi))
    response = lamps.response * rng.uniform(0.3, 1.5, (3, 1, 1))
    response[..., 0] += rng.normal(0, rng.choice([0.05, 0.3]), (3, 2))
    strength = np.abs(response[..., 0]).max()
    response[..., 1:] = rng.normal(0, 0.25 * strength, (3, 2, 2))
    return Lamps(response[rng.permutation(3)], rng.uniform(0, 0.4, 3), float(rng.uniform(0.25, 1.5)))


def _shadowed(image: Image, background: Image, lamps: Lamps, rng: np.random.Generator) -> Image:
    """What lies behind a slope that faces away from a lamp gets darker in its colour, too: (h, w, 3)."""
    if rng.random() < 0.5:
        return image
    change, length = image - background, int(rng.integers(4, 20))
    darker = np.minimum(change, 0)
    out = change.copy()
    for c, away in enumerate(lamps.response[..., 0]):
        along = away / max(float(np.linalg.norm(away)), 1e-9)
        for t in np.linspace(0, length, 5)[1:]:
            M = np.array([[1, 0, t * along[0]], [0, 1, t * along[1]]], np.float32)
            tail = cv2.warpAffine(np.ascontiguousarray(darker[..., c]), M, image.shape[1::-1])
            out[..., c] += rng.uniform(0, 0.4) * (1 - t / (length + 1)) * tail
    return np.clip(out + background, 0, 1).astype(np.float32)


def _scattered(change: Image, rng: np.random.Generator) -> Image:
    """A change of colour (h, w, 3), some of it spread far and wide by the gel."""
    spread = cv2.GaussianBlur(change, (0, 0), float(rng.uniform(5, 20)))
    return (change + rng.uniform(0, 1.0) * (rng.random() < 0.6) * spread).astype(np.float32)


def _background(shape: tuple[int, ...], rng: np.random.Generator) -> Image:
    """Smooth, of any colour, darker or brighter towards any side; at times with markers."""
    h, w = shape
    y, x = np.meshgrid(np.linspace(-1, 1, h), np.linspace(-1, 1, w), indexing="ij")
    terms = np.stack([np.ones((h, w)), x, y, x * x, x * y, y * y])
    weights = rng.normal(0, 1, (6, 3)) * np.array([0, 0.15, 0.15, 0.1, 0.1, 0.1])[:, None]
    weights[0] = rng.uniform(0.25, 0.7, 3)
    out = np.clip(np.einsum("phw,pc->hwc", terms, weights), 0.05, 0.95)
    if rng.random() < 0.15:
        out *= 1 - 0.6 * _markers((h, w), rng)[..., None]
    return out.astype(np.float32)


def _markers(shape: tuple[int, int], rng: np.random.Generator) -> Array:
    """Dots (h, w) on a grid, 1 within them."""
    apart, radius = rng.uniform(9, 20), rng.uniform(1, 2.5)
    y, x = np.mgrid[: shape[0], : shape[1]] + rng.uniform(0, apart, (2, 1, 1))
    off = np.hypot(x % apart - apart / 2, y % apart - apart / 2)
    return np.asarray(1 / (1 + np.exp(3 * (off - radius))))


def _dusty(image: Image, rng: np.random.Generator) -> Image:
    """With a few dark or bright specks."""
    out = image.copy()
    for _ in range(rng.poisson(1.0)):
        v, u = rng.integers(out.shape[:2])
        r = int(rng.integers(1, 3))
        out[max(v - r, 0) : v + r, max(u - r, 0) : u + r] *= rng.uniform(0.6, 1.3)
    return out


def _crosstalk(rng: np.random.Generator) -> Array:
    """(3, 3): what each colour of the lamps adds to each channel of the camera."""
    mix = np.eye(3) + rng.uniform(0, 0.5, (3, 3)) * (rng.random() < 0.7)
    return np.asarray(mix / mix.sum(0))


def _blurred(images: Array, sigma: float) -> Image:
    """Images (n, h, w, 3) out of focus by ``sigma`` [px]."""
    x = torch.from_numpy(np.ascontiguousarray(images, np.float32)).permute(0, 3, 1, 2)
    out = kornia.filters.gaussian_blur2d(x, (9, 9), (sigma, sigma), border_type="replicate")
    return np.asarray(out.permute(0, 2, 3, 1).numpy())
