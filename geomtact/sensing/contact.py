"""What one touch measures: where the object presses, and how deep where the image shows it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

# Shares of the deepest: to which a gel is pressed in at the border of a contact, as under a ball on a thick gel (Hertz), and from
# which on it surely lies on the object: beside a flat punch it is half as deep out to 1.4 radii, and this deep to 1.1
HALF, SURE = 0.5, 0.7
_FADING = 0.35  # slope at the border of what is pressed in, in shares of the steepest, under which it fades away there
_BORDER = 2  # px
# Share of the deepest that the median of what is pressed in falls short of where most of that is the gel beside the contact, or
# noise: it is 0.29 under a cone, 0.5 under a ball
_SHALLOW = 0.22
FAINT = 0.01  # share of the deepest that is no indentation
# The gel carries pressure where that is at least this share of the largest, and this deep; both hand-set
_CARRYING, _DEEP = 0.2, 0.2
# px: widths by which the pressure is smoothed, the first by which it exceeds its noise
_SMOOTHED = (0.8, 1.6, 3.2, 6.4)
_CLEARLY = 4.0  # standard deviations of the noise of the pressure that the least of it exceeds; hand-set

SoftMask = NDArray[np.bool_] | NDArray[np.float32]  # (H, W) whether each pixel is in contact, or how probably


@dataclass(frozen=True)
class Contact:
    """A contact on the sensor's image grid.

    Attributes
    ----------
    mask : (H, W) bool, True where the object touches (the thesis's local shape)
    height : (H, W) float32, how deep the gel is pressed in [m], >= 0, beside an elastic contact too; None where there is
        only the mask
    share : of the deepest, from which on the gel surely lies on the object, within the mask: ``HALF`` where the mask is the
        contact already, ``SURE`` where it is guessed from depths that fade away
    probability : (H, W) float32 that each pixel is in contact, more than half within the mask; None where there is none
    """

    mask: NDArray[np.bool_]
    height: NDArray[np.float32] | None = None
    share: float = HALF
    probability: NDArray[np.float32] | None = None

    @property
    def soft_mask(self) -> SoftMask:
        """What scores and registration take: the probabilities where there are any, else the mask."""
        return self.mask if self.probability is None else self.probability

    @classmethod
    def of_height(cls, height: NDArray[np.float32]) -> Contact:
        """Of a map (H, W) of how deep the gel is pressed in [m].

        A rigid gel is pressed in where it is touched. An elastic one sinks beside the object too, and that fades away: then the
        contact is taken to be where the gel carries pressure; or, where noise hides that, where it surely lies on the object.
        """
        pressed = height > FAINT * height.max()
        if not pressed.any():
            return cls(pressed, height)
        slope = np.hypot(*np.gradient(height))
        within = cv2.erode(pressed.astype(np.uint8), np.ones((3, 3), np.uint8), iterations=_BORDER, borderValue=1)
        border = slope[pressed & (within == 0)]
        if border.size:
            fades = np.median(border) < _FADING * np.quantile(slope[pressed], 0.95)
            fades |= np.median(height[pressed]) < _SHALLOW * height.max()
        else:  # all of the gel is pressed in: by what fills the window, or less and less towards its border
            fades = np.median(np.r_[height[0], height[-1], height[:, 0], height[:, -1]]) < HALF * height.max()
        if not fades or np.array_equal(pressed, height > HALF * height.max()):
            return cls(pressed, height)
        carrying = _carrying(height)
        return cls(height > SURE * height.max() if carrying is None else carrying, height, SURE)

    @property
    def sure_depth(self) -> float:
        """How deep the gel is pressed in where it surely lies on the object, at least [m]."""
        assert self.height is not None
        return self.share * float(self.height.max(where=self.mask, initial=0))

    @property
    def sure(self) -> NDArray[np.bool_]:
        """Where (H, W) the gel surely lies on the object: all of it, where that fills the window."""
        assert self.height is not None
        return self.mask if self.mask.all() else self.deeper(self.sure_depth)

    def deeper(self, depth: float) -> NDArray[np.bool_]:
        """Where (H, W) the contact is deeper than ``depth`` [m]."""
        assert self.height is not None
        return self.mask & (self.height > depth)


def _carrying(height: NDArray[np.float32]) -> NDArray[np.bool_] | None:
    """Where (H, W) a gel that is pressed in by ``height`` (H, W) carries pressure; None where noise hides it.

    An elastic half-space takes a pressure of the spatial frequency k in proportion to k times the depth (Johnson 1985), and the
    gel beside a contact carries none.
    """
    h, w = height.shape
    beyond = max(h, w) // 2
    wide = np.pad(height, beyond, "edge")
    k = 2 * np.pi * np.hypot(np.fft.fftfreq(wide.shape[0])[:, None], np.fft.rfftfreq(wide.shape[1]))
    by_frequency, deepest = np.fft.rfft2(wide) * k, float(height.max())
    for width in _SMOOTHED:
        smooth = np.fft.irfft2(by_frequency * np.exp(-0.5 * (k * width) ** 2), wide.shape)
        pressure = smooth[beyond : beyond + h, beyond : beyond + w]
        least, free = _CARRYING * pressure.max(), pressure[height < _DEEP * deepest]
        noise = 1.5 * np.median(np.abs(free - np.median(free))) if free.size else 0.0
        if least > _CLEARLY * noise:
            return np.asarray((pressure > least) & (height > _DEEP * deepest))
    return None


def border_of(image: NDArray[Any]) -> NDArray[Any]:
    """The outermost pixels (n,) of an image (H, W), each once."""
    return np.concatenate([image[[0, -1]].ravel(), image[1:-1, [0, -1]].ravel()])
