"""What the shared encoder gets of a contact: a small image of the window, and its moments, for numpy and torch alike."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

SHAPE = (24, 32)  # of what the network sees: the whole window, lying
BESIDE = 8  # numbers beside the pixels: six moments, and two of the grid's cell
_PIXEL = 2 / SHAPE[1] / float(np.hypot(1, SHAPE[0] / SHAPE[1]))  # in units of the window's half diagonal


def moment_features(sums: Any, xp: Any) -> Any:
    """The six moments (n, 6) of contacts as in ``sensing.moments``, brought to a spread near 1.

    ``sums`` (n, 6) are the images times ``BASIS``; ``xp`` is numpy or torch.
    """
    area = sums[:, 0].clip(min=0.25)
    mx, my, xx, xy, yy = (sums[:, 1:] / area[:, None]).T
    xx = (xx - mx * mx).clip(min=0) + _PIXEL**2 / 12
    yy = (yy - my * my).clip(min=0) + _PIXEL**2 / 12
    xy = xy - mx * my
    middle = (xx + yy) / 2
    spread = xp.minimum(xp.hypot((xx - yy) / 2, xy), middle - _PIXEL**2 / 24)
    large, small = middle + spread, middle - spread
    stretch, angle = 0.5 * xp.log(large / small), xp.arctan2(2 * xy, xx - yy)
    size = (0.5 * xp.log(area * _PIXEL**2) + 2, 0.25 * xp.log(large * small) + 1.2)
    return xp.stack([3 * mx, 3 * my, *size, stretch * xp.cos(angle), stretch * xp.sin(angle)], 1)


def _basis() -> NDArray[np.float32]:
    y, x = (((np.arange(n) - (n - 1) / 2) * _PIXEL) for n in SHAPE)
    X, Y = (c.ravel() for c in np.meshgrid(x, y))
    return np.stack([np.ones_like(X), X, Y, X * X, X * Y, Y * Y], 1).astype(np.float32)


BASIS = _basis()  # (768, 6): sums of an image's pixels times 1, x, y and their products
