"""Images that are drawn rather than seen by a camera: masks in two values or two colours, and what compression makes of them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from geomtact.errors import ImageError

SEEN = 16  # colours that a camera's image has at least; of 178 in colour the poorest has 1043
_UNLIT = 5  # up to which a camera counts without light
_EVERY = 16  # px between those looked at first
# grey values near black and near white, and the share of an image that is either
_DARK, _BRIGHT, _CLEAR = 32, 223, 0.95


def two_valued(array: NDArray[Any]) -> bool:
    """Whether an image (H, W) has zeros and one other value, below 0 only of whole numbers; a single value counts if it is how
    masks say yes or no."""
    low, top = array.min(), array.max()
    if top == low:
        return bool(top in (0, 1, 255))
    other = low if top == 0 and array.dtype.kind == "i" else top
    return bool(((array == 0) | (array == other)).all())


def without_two_colours(array: NDArray[Any], name: str) -> NDArray[Any]:
    """A mask (H, W) of an image (H, W, 3) in two colours, of which black is no contact; any other image as it is.

    Raises
    ------
    ImageError
        It is drawn in other colours than two, or in two of which none is black; or (H, W) in two whole numbers, none of them 0.
    """
    if array.ndim == 2 and not array.all():
        return array
    if array.ndim == 3 and array.dtype == np.uint8 and array.max() <= _UNLIT:
        return array
    colours = _few_colours(array)
    if colours is None or (array.ndim == 2 and len(colours) != 2):
        return array
    if len(colours) == 2 and not colours.any(1).all():
        return np.asarray(array.any(-1))
    given = " and ".join(str(tuple(colour.tolist()) if len(colour) > 1 else colour[0]) for colour in colours[:2])
    raise ImageError(
        f"{name}: expected a camera's image, or a mask that is black where nothing touches, got "
        + (f"{len(colours)} colours" if len(colours) > 2 else f"nothing but {given}")
        + "; draw contact white and all else black"
    )


def bright_half(image: NDArray[Any]) -> NDArray[np.bool_] | None:
    """What is over half (H, W) in an image (H, W) or (H, W, 3), uint8, that is nearly black and white, as lossy compression
    leaves a mask; None of any other."""
    if image.dtype != np.uint8:
        return None
    brightest = image.max(-1) if image.ndim == 3 else image
    clear = (brightest < _DARK) | (brightest > _BRIGHT)
    return brightest > 127 if clear.mean() > _CLEAR else None


def _few_colours(array: NDArray[Any]) -> NDArray[Any] | None:
    """The colours (n, 3), or whole grey values (n, 1), of an image that has fewer than a camera's; None of any other."""
    if array.ndim == 2 and (array.dtype == np.uint16 or array.dtype.kind not in "ui"):
        return None
    pixels = array[..., None] if array.ndim == 2 else array
    for some in (pixels[::_EVERY, ::_EVERY], pixels):
        colours = np.unique(some.reshape(-1, some.shape[-1]), axis=0)
        if len(colours) >= SEEN:
            return None
    return colours
