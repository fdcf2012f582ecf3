"""Light that flickers: a camera that reads row after row sees it as grey stripes, in which no gel moves."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from geomtact.se3 import Array
from geomtact.sensing.pixels import median_of

_STRIPS, _IN_STRIP = 5, 5  # of the image across its rows, and places in each at which rows are compared
_LEAST = 0.004  # rms of the stripes' brightness, relative: two thirds of a grey level at most where it matters
# By which a typical pixel's change from the background shrinks without the stripes: in all of the image, in four of five strips,
# and in each colour. Of 220 real readings 1.06 at most, a board of pins 1.21, but 0.84 in its strips; of readings with stripes
# of 5 % 1.18 at least
_LESS, _LESS_IN_STRIP, _LESS_IN_COLOUR = 1.1, 1.0, 0.95
_DARKEST, _BRIGHTEST = 1 / 255, 0.98  # brightness between which a camera counts light


def without_flicker(image: NDArray[np.floating], background: NDArray[np.floating]) -> tuple[Array, float]:
    """An image (H, W, 3) of 0..1 whose rows, or columns, are as bright as those of its background, where the change is stripes of
    light; and how bright these were, rms, relative: 0 where there are none, and the image is as it was.

    A stripe runs over the whole width and is of no colour. The brightness of each row is the median of what it has over that of
    the background, in all colours, so a contact that is less than half as wide as the image does not count.
    """
    down, across = _stripes(image, background), _stripes(image.swapaxes(0, 1), background.swapaxes(0, 1))
    rms = [float(np.sqrt((each**2).mean())) for each in (down, across)]
    if not any(rms):
        return np.asarray(image), 0.0
    evened = np.minimum(image * np.exp(-(down[:, None, None] if rms[0] >= rms[1] else across[:, None])), 1)
    # what is blown out is as bright as that at least
    evened = np.where(image < _BRIGHTEST, evened, np.maximum(evened, np.minimum(background, image)))
    return evened.astype(image.dtype), max(rms)


def _stripes(image: NDArray[np.floating], background: NDArray[np.floating]) -> Array:
    """Log of the brightness of each row (H,), 0 where there are no stripes along rows."""
    h, none = len(image), np.zeros(len(image))
    seen, rest = (
        cv2.resize(each, (_STRIPS * _IN_STRIP, h), interpolation=cv2.INTER_AREA) for each in (image, background)
    )
    change = np.log(np.maximum(seen, _DARKEST) / np.maximum(rest, _DARKEST))
    change -= np.median(change, axis=0)
    rows = np.median(change.reshape(h, -1), axis=1)
    slow = np.linalg.qr(np.polynomial.legendre.legvander(np.linspace(-1, 1, h), 2))[0]
    stripes = rows - slow @ (slow.T @ rows)
    if np.sqrt((stripes**2).mean()) < _LEAST:
        return none
    before, after = (np.abs(each).reshape(h, _STRIPS, -1, 3) for each in (change, change - stripes[:, None, None]))

    def less(*some: slice | int) -> float:
        return median_of(before[some].ravel()) / max(median_of(after[some].ravel()), 1e-9)

    everywhere = slice(None)
    strips = sorted(less(everywhere, i) for i in range(_STRIPS))
    colours = [less(everywhere, everywhere, everywhere, i) for i in range(3)]
    found = less() > _LESS and strips[1] > _LESS_IN_STRIP and min(colours) > _LESS_IN_COLOUR
    return rows if found else none
