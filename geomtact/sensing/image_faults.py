"""What may be wrong with a tactile image or its background, found by comparing the two, coarsely."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geomtact.se3 import Array
from geomtact.sensing.colour import ColourTable, coarse

_COARSE = 48  # pixels along the shorter side
_DARK, _DARK_SHARE = 0.02, 0.5  # all channels below this, in more than this share of the pixels
_BRIGHT, _BRIGHT_SHARE = 0.995, 0.4  # any channel above this
# of colour (0..1), by which half of the pixels are off at most, but for a gain and one offset a channel: of 103 real images
# with their own backgrounds 0.062, with those of other sensors 0.109 or more
_MISMATCH = 0.085
_BETTER = 0.5  # of what a tactile image is off as it is, that it is off otherwise, where it was meant to be so
_LEAST = 0.02  # off by less is no fault
# widths [px] of structure, fine and less so (moved markers are fine alone, a board of pins is neither), and the share of the
# change in it that the background may bring: with the own one 0.19 at most, with another press in its place half
_STRUCTURE, _BRINGS = ((0.0, 3.0), (2.0, 5.0)), 0.27
_DRIFT = 0.2  # change of brightness since the background
# brightness over the median around of a hole (in 103 real images it is 0.55 at least), all channels of a glare where they are
# not so bright around, and the share of an image that is so
_AROUND, _HOLE, _WHITE, _GREY, _TORN_SHARE = 29, 0.4, 0.9, 0.7, 0.002

_CHANNELS = "channels"
_TURNS = {
    "half": "turned by 180 degrees",
    "mirror": "mirrored left to right",
    "upside": "mirrored top to bottom",
    "left": "turned by 90 degrees to the left",
    "right": "turned by 90 degrees to the right",
}


def faults(image: Array, background: Array | None) -> list[str]:
    """What seems wrong with a tactile image (H, W, 3) of 0..1 and its background: one line each, none where nothing does."""
    out = exposure(image, "the image")
    if background is not None:
        out += exposure(background, "the background")
    out = out or _torn(image)
    if out or background is None:
        return out
    if np.array_equal(image, background):
        return [
            "the image and its background are the same, pixel for pixel, so no contact can be seen: give one of the touch, and "
            "beside it one of the untouched gel"
        ]
    seen, rest = _coarse(image), _coarse(background)
    gain = float(np.median(seen.mean(-1)) / max(float(np.median(rest.mean(-1))), 1e-6))
    seen /= max(gain, 1e-6)
    off, other = _likelier(seen, rest)
    if other == _CHANNELS:
        return [
            "red and blue seem to be exchanged: the image's channels fit the background's in the order BGR; give RGB"
        ]
    if other:
        return [f"the image fits the background {_TURNS[other]}; give both as the camera made them"]
    if off > _MISMATCH:
        return [
            f"the background seems to be of another sensor or light: half of the image is off by more than {100 * off:.0f} % of "
            "full brightness; take one with this sensor, untouched, now"
        ]
    return _background_outdated(rest, seen, gain)


def calibration_mismatches(background: Array, colour: ColourTable) -> list[str]:
    """What seems wrong with images of a calibrated sensor whose background is (H, W, 3), 0..1, in the sensor frame: it is
    compared with the one that the ``colour`` was fitted with, where that was kept."""
    if colour.rest is None:
        return []
    gain = colour.brighter(background)
    off, other = _likelier(coarse(background, colour.rest.shape) / gain, colour.rest)
    if other == _CHANNELS:
        return [
            "red and blue seem to be exchanged in the image and its background alike: the background fits that of the sensor's "
            "calibration in the order BGR; give RGB"
        ]
    if other:
        return [
            f"image and background seem to be {_TURNS[other]} since the sensor was calibrated: give them as the presses were, or "
            "say how the camera is mounted (--rotate, --mirror, or camera_rotation_deg in the sensor's file)"
        ]
    if off > _MISMATCH:
        return [
            f"the background differs from that of the sensor's calibration: half of it is off by more than {100 * off:.0f} % of "
            "full brightness; calibrate the sensor again, with this gel and light"
        ]
    if abs(gain - 1) <= _DRIFT:
        return []
    way = "brighter" if gain > 1 else "darker"
    return [
        f"image and background are {100 * abs(gain - 1):.0f} % {way} than when the sensor was calibrated: depths are scaled for "
        "that; better set the light and the exposure as they were"
    ]


def _likelier(seen: NDArray[np.floating], rest: NDArray[np.floating]) -> tuple[float, str | None]:
    """By how much an image (h, w, 3) is off one at rest, and what was done to it if it is off far less when that is undone."""
    off = _off(seen, rest)
    if off < _LEAST:
        return off, None
    others = {_CHANNELS: seen[..., ::-1], "half": seen[::-1, ::-1], "mirror": seen[:, ::-1], "upside": seen[::-1]}
    if seen.shape[0] == seen.shape[1]:
        others |= {"left": np.rot90(seen, -1), "right": np.rot90(seen)}
    best, least = min(((name, _off(other, rest)) for name, other in others.items()), key=lambda found: found[1])
    return off, best if least < _BETTER * off else None


def exposure(image: Array, name: str) -> list[str]:
    """Whether an image (H, W, 3) of 0..1 is nearly black, or blown out."""
    dark = float((image.max(-1) < _DARK).mean())
    bright = float((image > _BRIGHT).any(-1).mean())
    if dark > _DARK_SHARE:
        return [f"{name} is black in {100 * dark:.0f} % of its pixels; check the lamps and the exposure"]
    if bright > _BRIGHT_SHARE:
        return [f"{name} is overexposed in {100 * bright:.0f} % of its pixels; lower the exposure"]
    return []


def _torn(image: Array) -> list[str]:
    """Whether an image (H, W, 3) has holes: a gel reflects light all over, pressed on or not, where its coating is whole."""
    import cv2

    small = _coarse(image)
    brightest, least = small.max(-1), small.min(-1)
    around = [cv2.medianBlur(np.round(255 * each).astype(np.uint8), _AROUND) / 255 for each in (brightest, least)]
    holes = float(((brightest < _HOLE * around[0]) | ((least > _WHITE) & (around[1] < _GREY))).mean())
    if holes <= _TORN_SHARE:
        return []
    return [
        f"the gel seems to be torn, or dirty: {100 * max(holes, 0.01):.0f} % of the image are black, or glare, where all around "
        "is lit; look at it, and change it"
    ]


def _background_outdated(rest: NDArray[np.floating], seen: NDArray[np.floating], gain: float) -> list[str]:
    """Whether a background ``rest`` of the same sensor shows a contact, or another brightness than ``seen`` by ``gain``."""
    if _brought_by(rest, seen) > _BRINGS:
        return ["the background seems to show a contact: give one of the untouched gel"]
    if abs(gain - 1) <= _DRIFT:
        return []
    way = "brighter" if gain > 1 else "darker"
    return [
        f"the image is {100 * abs(gain - 1):.0f} % {way} than the background; the light has changed: take a new background"
    ]


def _coarse(image: Array) -> NDArray[np.floating]:
    import cv2

    h, w = image.shape[:2]
    scale = _COARSE / min(h, w)
    small = cv2.resize(image.astype(np.float32), (round(w * scale), round(h * scale)), interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.GaussianBlur(small, (0, 0), 1.0))


def _brought_by(rest: NDArray[np.floating], seen: NDArray[np.floating]) -> float:
    """Which share of the change between two coarse images is structure of ``rest``: none if that is smooth, all if ``seen`` is,
    half if both show a contact; 0 where hardly anything changes."""
    import cv2

    def within(image: NDArray[np.floating], least: float, most: float) -> Array:
        fine = cv2.GaussianBlur(image, (0, 0), least) if least else image
        return np.asarray(fine - cv2.GaussianBlur(image, (0, 0), most), float)

    shares = []
    for widths in _STRUCTURE:
        own = within(rest, *widths)
        change = within(seen, *widths) - own
        if np.quantile(np.abs(change), 0.99) < _LEAST:
            return 0.0
        shares.append(float(-(own * change).sum() / (change**2).sum()))
    return min(shares)


def _off(seen: NDArray[np.floating], rest: NDArray[np.floating]) -> float:
    """By how much half of the pixels differ at most, but for an offset of each channel: contacts cover less than half of them."""
    off = seen - rest
    off = off - np.median(off, axis=(0, 1))
    return float(np.median(np.linalg.norm(off, axis=-1)))
