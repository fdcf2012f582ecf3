"""A depth map as it is given: its unit and its zero checked against what the gel can do, and what else they may be."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from geomtact.errors import ImageError
from geomtact.sensing.contact import FAINT, HALF, border_of
from geomtact.sensing.sensor import Sensor

_DEEPEST, _SHALLOWEST = 1.5, 0.01  # of max_penetration, between which the deepest point of a touch is expected
_IMPOSSIBLE = 10.0  # of max_penetration, over which a unit is wrong
_LEAST = 1e-6  # m that no indentation is as shallow as, so that its unit is wrong
# Slope that half of a contact of this area [m2] or more does not exceed: of 1196 simulated rigid contacts of 23 objects, 0.03 to
# 1.5 mm deep, the median slope is 1.79 at most, of 360 elastic ones 0.06
_STEEP, _AREA = 3.0, 1e-6
_MOST = (
    0.75  # share that most of the values of noise have: half of it is negative, 0.9 and more less than half the largest
)
_BORDER, _NEAR_HIGHEST = 0.8, 0.1  # share of the border, and of the range of depths, by which distances are suspected


def depths_of(array: NDArray[Any], name: str, sensor: Sensor, warnings: list[str]) -> NDArray[np.float32]:
    """How deep the gel is pressed in (H, W) [m], of a depth map in float metres or 16-bit micrometres.

    Doubtful values are reported in ``warnings``.

    Raises
    ------
    ImageError
        It is in colour, of another type, negative, of distances from the camera, or surely in another unit.
    """
    if array.ndim == 3:
        raise ImageError(f"{name}: a depth map has one channel, got a colour image; give --kind reading")
    if array.dtype != np.uint16 and array.dtype.kind != "f":
        raise ImageError(
            f"{name}: depths must be float (metres) or 16-bit (micrometres), got {array.dtype}; convert them: what one step "
            "of grey is, its maker says"
        )
    height = array * (1e-6 if array.dtype == np.uint16 else 1.0)
    lowest, highest = float(height.min()), float(height.max())
    most = sensor.max_penetration
    expected = f"{name}: expected depths in metres up to about {most:g}"
    if lowest < -1e-6 and _all_noise(height, sensor):
        warnings.append(
            f"{name}: depths of {1e6 * lowest:.2g} to {1e6 * highest:.2g} micrometres are noise about 0: taken as no contact"
        )
        return np.zeros(height.shape, np.float32)
    if lowest < -1e-6 and not _noise_below(height, sensor):
        deepest = max(-lowest, highest)
        raise ImageError(
            f"{name}: depths of the gel's indentation are >= 0; the lowest is {lowest:.4g} m: where contact is negative "
            "negate them, and set the gel at rest to 0; clip noise that is left below it, numpy.maximum(depths, 0)"
            + (f"; {_units(deepest, sensor)}" if deepest > _DEEPEST * most else "")
        )
    if -lowest > sensor.height_noise:
        warnings.append(f"{name}: depths down to {lowest * 1e6:.2g} micrometres were set to 0")
    if highest > _DEEPEST * most and lowest > highest / 2:
        raise ImageError(
            f"{expected}, 0 where the gel is at rest, got {lowest:.4g} to {highest:.4g}, as distances from the camera are: take "
            "them off those of the untouched gel, in metres"
        )
    counted = " (16-bit grey counts micrometres)" if array.dtype == np.uint16 else ""
    if highest > _IMPOSSIBLE * most:
        what = "give other units as float metres" if counted else _units(highest, sensor)
        raise ImageError(
            f"{expected}, the largest is {highest:.4g}{counted}; {what}; or is it a camera's image: --kind reading"
        )
    if 0 < highest < _LEAST:
        raise ImageError(
            f"{expected}, the largest is {highest:.4g}; these look divided by 1000 once too often{counted}"
        )
    if _like_distances(height, sensor):
        warnings.append(
            f"{name}: the border is as deep as anything, and the inside is not, as in a map of distances to the gel; if it is "
            f"one, give the distances at rest less these, as {highest:.4g} - depths"
        )
    as_pixels = f"if they are pixels times 0.001, multiply by {1e3 * sensor.pixel_pitch[0]:.4g}, pixel_pitch_mm"
    if highest > _DEEPEST * most:
        warnings.append(
            f"{name}: depths up to {1e3 * highest:.2f} mm exceed the sensor's max_penetration_mm, {1e3 * most:g}; {as_pixels}"
            f"{', or else ' + units if (units := _likely_units(highest, sensor)) else ''}"
        )
    elif _too_steep(height, sensor):
        warnings.append(
            f"{name}: half of the contact is steeper than {np.degrees(np.arctan(_STEEP)):.0f} degrees; {as_pixels}"
        )
    elif 0 < highest < _SHALLOWEST * most:
        warnings.append(
            f"{name}: depths up to {1e6 * highest:.2g} micrometres only; are they in metres, or 16-bit micrometres?"
        )
    return np.maximum(height, 0).astype(np.float32)


def _units(highest: float, sensor: Sensor) -> str:
    """How to make metres of depths up to ``highest``."""
    likely = _likely_units(highest, sensor)
    return f"multiply {likely}" if likely else "no usual unit makes a touch of them: give metres"


def _likely_units(highest: float, sensor: Sensor) -> str:
    """The units in which depths up to ``highest`` are a touch, with what makes metres of them."""
    units = {
        "millimetres": 1e-3,
        "centimetres": 1e-2,
        "inches": 25.4e-3,
        "micrometres": 1e-6,
        "pixels (of gs_sdk)": sensor.pixel_pitch[0],
    }
    most = sensor.max_penetration
    likely = {unit: to for unit, to in units.items() if _SHALLOWEST * most <= highest * to <= _DEEPEST * most}
    return ", or ".join(f"{unit} by {to:.4g}" for unit, to in likely.items())


def _noise_below(height: NDArray[np.floating], sensor: Sensor) -> bool:
    """Whether what is negative in depths (H, W) [m] is noise of the gel at rest, about 0.

    Then it is no lower than the sensor's noise makes any of as many pixels; its like above 0 is no contact; and what is as
    near to 0 as it is not mostly negative, as the gel at rest is that lies lower.
    """
    below = -float(height.min())
    near = height[np.abs(height) <= below]
    most = min(_extreme_noise(height, sensor), HALF * float(height.max()))
    return below <= most and float((near < 0).mean()) <= _MOST


def _all_noise(height: NDArray[np.floating], sensor: Sensor) -> bool:
    """Whether depths (H, W) [m] are noise about 0 and nothing else: about as large above as below, mostly less than half of
    that, and nowhere larger than noise of their own root mean square makes any of the square of as many pixels."""
    below, above = -float(height.min()), float(height.max())
    least, most = min(below, above), max(below, above)
    small = np.abs(height) < HALF * least
    own = float(np.sqrt(2 * np.mean(height**2) * 2 * np.log(height.size)))
    alike = HALF * most <= least and most <= min(own, _extreme_noise(height, sensor))
    return alike and float(small.mean()) >= _MOST and 1 - _MOST <= float((height < 0).mean()) <= _MOST


def _extreme_noise(height: NDArray[np.floating], sensor: Sensor) -> float:
    """The largest [m] of as many normally distributed depths (H, W) as these, as the sensor's noise makes them."""
    return sensor.height_noise * float(np.sqrt(2 * np.log(height.size)))


def _like_distances(height: NDArray[np.floating], sensor: Sensor) -> bool:
    """Whether most of the border of depths (H, W) [m] is about as high as any, and something inside is lower by a touch."""
    lowest, highest = float(height.min()), float(height.max())
    high = border_of(height) >= highest - (highest - lowest) * _NEAR_HIGHEST
    return highest - lowest > _SHALLOWEST * sensor.max_penetration and float(high.mean()) >= _BORDER


def _too_steep(height: NDArray[np.floating], sensor: Sensor) -> bool:
    """Whether half of what is pressed in is steeper than any contact that an object makes."""
    pressed = height > FAINT * height.max()
    if pressed.sum() * sensor.pixel_area(height.shape) < _AREA:
        return False
    along_y, along_x = np.gradient(height, *sensor.pixel_pitch[::-1])
    return bool(np.median(np.hypot(along_x, along_y)[pressed]) > _STEEP)
