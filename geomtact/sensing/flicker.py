"""Light that flickers: a camera that reads row after row sees it as grey stripes, in which no gel moves."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from geomtact.se3 import Array
from geomtact.sensing.pixels import median_of

_STRIPS, _IN_STRIP = 5, 5  # of the image across its rows, and places in each at which rows are compared
_LEAST = 0.004  # rms of the stripes' brightness, relative: two thirds of a grey level at most where it matters
# By which a typical pixel's change from the background shrinks without the stripes: in all of the image, in four of five strips,
# and in each colour. Of 220 real images 1.06 at most, a board of pins 1.21, but 0.84 in its strips; of images with stripes
# of 5 % 1.18 at least
_LESS, _LESS_IN_STRIP, _LESS_IN_COLOUR = 1.1, 1.0, 0.95
_DARKEST, _BRIGHTEST = 1 / 255, 0.98  # brightness between which a camera counts light
_MOST = 0.15  # rms that is evened out: of stripes of 20 %
# How far a typical place's colour is off the image's own, rms of its logs. White light: 0.009 on the 9DTact; coloured lamps: 0.08
# (a GelSight) to 0.37 in six sets. Under the bound a contact may be as grey as stripes are
_COLOURED = 0.05
# By which one colour's stripes may differ from those of all. Of stripes of 5 % on 34 real images of coloured gels 32 differ by
# less, half by 0.05; of 2,100 simulated rods, bars and ribs across gels between three lamps none that could be stripes does
_GREY = 0.2


class Evened(NamedTuple):
    """An image without the stripes of flickering light, if it is sure that these are no contact.

    Attributes
    ----------
    image : (H, W, 3) of 0..1, evened out or as it was
    stripes : how bright the stripes were, rms, relative; 0 where there were none
    unsure : why they were not evened out; empty where they were, or where there were none
    """

    image: Array
    stripes: float = 0.0
    unsure: str = ""

    @property
    def warnings(self) -> list[str]:
        """The warning, if any, about the light."""
        seen = f"grey stripes, off the background's brightness by {100 * self.stripes:.1f} % rms"
        do = "keep other lamps off the gel, or expose for whole periods of the mains"
        if self.unsure:
            return [
                f"{seen}, cross the image: flickering light, or a contact all across it. They were not evened out, for "
                f"{self.unsure}. If the light flickers, the contact is wrong: {do}"
            ]
        return [f"the light flickers: {seen}, were evened out; {do}"] if self.stripes else []


def without_flicker(image: NDArray[np.floating], background: NDArray[np.floating], estimated: bool = False) -> Evened:
    """An image (H, W, 3) of 0..1 whose rows, or columns, are as bright as those of its background (H, W, 3), where the change is
    stripes of light.

    A stripe runs over the whole width and is of no colour. The brightness of each row is the median of what it has over that of
    the background, in all colours, so a contact that is less than half as wide as the image does not count. A contact that is
    wider makes stripes itself. It is coloured where coloured lamps stand around the gel, but on a gel in white light it is not.
    So the image stays as it was there, where the background is ``estimated``, and where the stripes are coloured or very strong.
    """
    found = [_stripes(image, background), _stripes(image.swapaxes(0, 1), background.swapaxes(0, 1))]
    rms = [float(np.sqrt((rows**2).mean())) for rows, _ in found]
    if not any(rms):
        return Evened(np.asarray(image))
    along = int(rms[1] > rms[0])
    rows, off_grey = found[along]
    if estimated:
        unsure = "no background was given"
    elif _off_white(background) < _COLOURED:
        unsure = "in white light a contact looks alike"
    elif off_grey > _GREY:
        unsure = "they are stronger in one colour, as a contact is"
    elif rms[along] > _MOST:
        unsure = "lamps hardly flicker so much"
    else:
        evened = np.minimum(image * np.exp(-(rows[:, None] if along else rows[:, None, None])), 1)
        # what is blown out is as bright as that at least
        evened = np.where(image < _BRIGHTEST, evened, np.maximum(evened, np.minimum(background, image)))
        return Evened(evened.astype(image.dtype), rms[along])
    return Evened(np.asarray(image), rms[along], unsure)


def _stripes(image: NDArray[np.floating], background: NDArray[np.floating]) -> tuple[Array, float]:
    """Log of the brightness of each row (H,), 0 where there are no stripes along rows, and how far one colour's are off those of
    all, as a share."""
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
        return none, 0.0
    before, after = (np.abs(each).reshape(h, _STRIPS, -1, 3) for each in (change, change - stripes[:, None, None]))

    def less(*some: slice | int) -> float:
        return median_of(before[some].ravel()) / max(median_of(after[some].ravel()), 1e-9)

    everywhere = slice(None)
    strips = sorted(less(everywhere, i) for i in range(_STRIPS))
    colours = [less(everywhere, everywhere, everywhere, i) for i in range(3)]
    if less() <= _LESS or strips[1] <= _LESS_IN_STRIP or min(colours) <= _LESS_IN_COLOUR:
        return none, 0.0
    shares = np.median(change, axis=1).T @ stripes / (stripes @ stripes)
    return rows, float(np.abs(shares - 1).max())


def _off_white(background: NDArray[np.floating]) -> float:
    """How far a typical place's colour in a background (H, W, 3) is off that of the whole, rms of the logs of its channels."""
    coarse = cv2.resize(background, (_STRIPS * _IN_STRIP,) * 2, interpolation=cv2.INTER_AREA)
    colour = np.log(np.maximum(coarse, _DARKEST))
    colour -= colour.mean(2, keepdims=True)
    colour -= np.median(colour, axis=(0, 1))
    return median_of(np.sqrt((colour**2).mean(2)).ravel())
