"""Tactile images to learn from: presses under random lamps, with the noise of cameras and gels.

How a sensor is lit is drawn anew for every image, so that the network learns what all sensors have in common: the gel bends
around what it is touched by.
"""

from __future__ import annotations

import cv2
import kornia
import numpy as np
import torch
from numpy.typing import NDArray

from geomtact.se3 import Array
from geomtact.sensing.change import colour_change
from geomtact.sensing.mask_network import seen
from tools.training.lamps import Lamps, lit

Image = NDArray[np.float32]

SKIN = 2.0  # px over which the gel's coating rounds it off, at most
ELEVATION = (6.0, 45.0)  # deg of lamps above the gel
AMBIENT = 1.5  # of what lamps make of the untouched gel, at most
BRIGHT = 0.35  # share of tactile images of which one channel is so bright that it may be blown out
NOISE = (0.3 / 255, 6 / 255)
_DRAWS = 4


def random_reading(
    height: NDArray[np.floating], rng: np.random.Generator, rest: NDArray[np.floating] | float = 0.0
) -> tuple[Image, Image]:
    """A tactile image (h, w, 3) of a gel pressed in by ``height`` (h, w) [px], and its background (h, w, 3). Untouched it lies at
    ``rest`` (h, w) [px] towards the camera."""
    h, w = height.shape
    flat = np.zeros((h, w), np.float32) + np.asarray(rest, np.float32)
    lamps = random_lamps((h, w), rng, float(flat.max()))
    bent: Image = np.asarray(height, np.float32)
    bent = np.asarray(cv2.GaussianBlur(bent, (0, 0), float(rng.uniform(0.01, SKIN))), np.float32)
    light = np.stack([lit(flat + bent, lamps), lit(flat, lamps)])
    light[0] = _dusty(np.maximum(_scattered(light[0] - light[1], rng) + light[1], 0), rng)
    shown = _photographed(light * _paint(bent, rng)[..., None], rng)
    # each with its own noise, the pressed one under light that has drifted; what is blown out is cut off last
    drift = rng.choice([0.3, 1.0, 3.0])
    shown[0] = shown[0] * rng.normal(1, 0.01 * drift, 3) + rng.normal(0, 0.005 * drift, 3) + _uneven((h, w), rng)
    noise = np.exp(rng.uniform(*np.log(NOISE)))
    shown = np.clip(shown + noise * rng.normal(size=shown.shape), 0, 1)
    return shown[0].astype(np.float32), shown[1].astype(np.float32)


def random_sight(
    height: NDArray[np.floating], rng: np.random.Generator, rest: NDArray[np.floating] | float = 0.0
) -> Image | None:
    """What the network sees (``CHANNELS``, h', w') of a :func:`random_reading`; None where none shows anything, under a few draws
    of lamps."""
    for _ in range(_DRAWS):
        image, background = random_reading(height, rng, rest)
        change, felt = colour_change(image, background)
        if felt.any():
            return seen(change, image)
    return None


def random_lamps(shape: tuple[int, int], rng: np.random.Generator, rim: float = 0.0) -> Lamps:
    """Three of one colour each, or more of any, around an image of ``shape`` (h, w) or on three of its sides: near or far, low or
    high above the ``rim`` of the gel [px]."""
    k = 3 if rng.random() < 0.6 else int(rng.integers(4, 7))
    around = 2 * np.pi / k * np.arange(k)
    if k == 3 and rng.random() < 0.5:  # on three sides of a square gel
        around = np.pi / 2 * np.arange(k)
    angle = rng.uniform(0, 2 * np.pi) + around + rng.normal(0, rng.choice([0.05, 0.3]), k)
    far = 0.5 * np.hypot(*shape) * np.exp(rng.uniform(0, 1.6) + rng.normal(0, 0.15, k))
    up = rim + far * np.tan(np.radians(rng.uniform(*ELEVATION)))
    colour = np.eye(3)[rng.permutation(3)] if k == 3 else rng.dirichlet([0.4] * 3, k)
    # each channel of the camera sees something of all colours
    mix = np.eye(3) + rng.uniform(0, 0.5, (3, 3)) * (rng.random() < 0.7)
    colour = 1e-3 + colour * rng.uniform(0.4, 1.5, (k, 1)) @ mix
    ambient = rng.uniform(0, AMBIENT) * rng.uniform(0.6, 1.4, 3)
    place = np.stack([far * np.cos(angle), far * np.sin(angle), up], 1)
    return Lamps(place, colour, ambient, float(rng.uniform(0.05, 0.6)), float(rng.uniform(0, 2)))


def _photographed(light: Image, rng: np.random.Generator) -> Array:
    """Tactile images of ``light`` (2, h, w, 3), 1 what a camera tells at most: the second, without contact, of a
    random brightness in each channel, at times so bright in one that much of the image is blown out."""
    exposure = np.clip(rng.uniform(0.15, 0.75) + rng.normal(0, 0.1, 3), 0.08, 0.95)
    if rng.random() < BRIGHT:
        exposure[rng.integers(3)] = rng.uniform(0.8, 1.2)
    shown = exposure * (light / np.median(light[1], (0, 1))) ** rng.uniform(0.45, 1)
    return np.maximum(_blurred(shown, float(rng.uniform(0.2, 1.5))), 0).astype(float)


def _scattered(change: Image, rng: np.random.Generator) -> Image:
    """A change of light (h, w, 3), some of it spread far and wide by the gel."""
    spread = cv2.GaussianBlur(change, (0, 0), float(rng.uniform(5, 20)))
    return (change + rng.uniform(0, 1.0) * (rng.random() < 0.6) * spread).astype(np.float32)


def _paint(bent: Image, rng: np.random.Generator) -> Image:
    """What share (2, h, w) of its light the coating of a gel, ``bent`` (h, w) [px] and at rest, sends to the camera: less of it
    towards the corners, at times with markers, which move along with the gel."""
    h, w = bent.shape
    y, x = np.meshgrid(np.linspace(-1, 1, h), np.linspace(-1, 1, w), indexing="ij")
    out = np.stack(2 * [1 - rng.uniform(0, 0.3) * (x**2 + y**2)])
    if rng.random() < 0.15:
        out *= 1 - 0.6 * _markers(bent, rng)
    return out.astype(np.float32)


def _markers(bent: Image, rng: np.random.Generator) -> Array:
    """Dots (2, h, w) on a grid, 1 within them: of a gel that is ``bent`` (h, w) [px], drawn along by that, and at rest."""
    apart, radius = rng.uniform(9, 20), rng.uniform(1, 2.5)
    at_rest = np.mgrid[: bent.shape[0], : bent.shape[1]] + rng.uniform(0, apart, (2, 1, 1))
    along: Array = rng.normal(0, 0.1, 2)[:, None, None] * bent + rng.normal(0, 0.5) * np.stack([*np.gradient(bent)])
    off = np.stack([np.hypot(*(place % apart - apart / 2)) for place in (at_rest + along, at_rest)])
    return np.asarray(1 / (1 + np.exp(3 * (off - radius))))


def _dusty(image: Image, rng: np.random.Generator) -> Image:
    """With a few dark or bright specks."""
    out = image.copy()
    for _ in range(rng.poisson(1.0)):
        v, u = rng.integers(out.shape[:2])
        r = int(rng.integers(1, 3))
        out[max(v - r, 0) : v + r, max(u - r, 0) : u + r] *= rng.uniform(0.6, 1.3)
    return out


def _uneven(shape: tuple[int, ...], rng: np.random.Generator) -> Image:
    """A smooth field (h, w, 3) of up to one and a half 255ths (rms): a gel that has not quite come to rest."""
    field = cv2.GaussianBlur(
        rng.normal(size=(*shape[:2], 3)).astype(np.float32), (0, 0), float(np.exp(rng.uniform(1, 3)))
    )
    return np.asarray(rng.uniform(0, 1.5) / 255 * field / field.std(), np.float32)


def _blurred(images: Array, sigma: float) -> Image:
    """Images (n, h, w, 3) out of focus by ``sigma`` [px]."""
    x = torch.from_numpy(np.ascontiguousarray(images, np.float32)).permute(0, 3, 1, 2)
    out = kornia.filters.gaussian_blur2d(x, (9, 9), (sigma, sigma), border_type="replicate")
    return np.asarray(out.permute(0, 2, 3, 1).numpy())
