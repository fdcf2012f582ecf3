"""What a camera behind a gel shows of its indentation: coloured lamps at the side light slopes that face them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geomtact.se3 import Array

SPOILT = {"none": 0.0, "moderate": 1 / 255, "heavy": 3 / 255}  # standard deviation of each pixel's brightness
_GREY = 0.45  # brightness of an example's background in the middle
_BRIGHTER = 0.6  # by which a slope of one that faces a lamp is


@dataclass(frozen=True, eq=False)
class Lamps:
    """How the light of three channels follows the gel's slope.

    Attributes
    ----------
    response : (3, 2, 3) by what share each channel gets brighter for a slope of one along x and y: in the middle of the image,
        and how much more at its right and at its lower border, since lamps are near
    shading : (3,) by what share it gets darker for a slope of one any way
    limit : share beyond which it gets no brighter and no darker
    """

    response: Array
    shading: Array
    limit: float

    @classmethod
    def around(cls, first: float = np.pi / 2) -> Lamps:
        """Red, green and blue lamps far away, spread evenly around the gel; ``first`` is the red one's angle [rad]."""
        angle = first + 2 * np.pi / 3 * np.arange(3)
        response = np.zeros((3, 2, 3))
        # depth that grows along an axis is a slope that faces the other way
        response[..., 0] = -_BRIGHTER * np.stack([np.cos(angle), np.sin(angle)], 1)
        return cls(response, np.zeros(3), 1.0)


def render(height: ArrayLike, pitch: tuple[float, float], background: ArrayLike, lamps: Lamps) -> NDArray[np.float32]:
    """The tactile image (H, W, 3), RGB 0..1, of a gel that is pressed in.

    Parameters
    ----------
    height : (H, W) how deep [m]
    pitch : of a pixel along x and y [m]
    background : (H, W, 3) what is shown without contact, 0..1
    """
    height, background = np.asarray(height, float), np.asarray(background, float)
    h, w = height.shape
    y, x = np.gradient(height, pitch[1], pitch[0])
    place = np.stack([np.ones((h, w)), *np.meshgrid(np.linspace(-1, 1, w), np.linspace(-1, 1, h))])
    brighter = np.einsum("hwk,ckp,phw->hwc", np.stack([x, y], -1), lamps.response, place, optimize=True)
    brighter -= lamps.shading * (x**2 + y**2)[..., None]
    return np.clip(background * (1 + lamps.limit * np.tanh(brighter / lamps.limit)), 0, 1).astype(np.float32)


def example_reading(
    height: ArrayLike, pitch: tuple[float, float], noise: float, rng: np.random.Generator
) -> NDArray[np.uint8]:
    """A tactile image (H, W, 3), RGB, of a gel between three lamps, pressed in by ``height`` (H, W) [m]; ``noise`` is
    of each pixel."""
    h, w = np.shape(height)
    x, y = np.meshgrid(np.linspace(-1, 1, w), np.linspace(-1, 1, h))
    lamps = Lamps.around()
    # darker towards the corners, as behind a lens, and in each colour brighter towards its lamp
    nearer = np.einsum("hwk,ck->hwc", np.stack([x, y], -1), -lamps.response[..., 0])
    background = _GREY * (1 - 0.2 * (x**2 + y**2))[..., None] * (1 + 0.4 * nearer)
    shown = render(height, pitch, background, lamps) + noise * rng.normal(size=(h, w, 3))
    return np.rint(255 * np.clip(shown, 0, 1)).astype(np.uint8)
