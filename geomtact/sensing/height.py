"""How deep the gel is pressed in at each pixel of an RGB image, for a sensor whose colours are calibrated."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from geomtact.errors import SensorError
from geomtact.se3 import Array
from geomtact.sensing.change import as_unit_rgb, check_size, colour_change, same_size
from geomtact.sensing.colour import ColourTable
from geomtact.sensing.flicker import without_flicker
from geomtact.sensing.sensor import Sensor
from geomtact.sensing.slope import integrate

_SOME = 0.02  # share of the image in which the gel must rest, to find where it rests


def contact_height(image: Any, background: Any, sensor: Sensor | str) -> NDArray[np.float32]:
    """Depth of the gel's indentation in an RGB image, by photometric stereo.

    Parameters
    ----------
    image : (H, W, 3) uint8 or float 0..1, RGB; or a path
    background : (H, W, 3) the same sensor without contact, under the same light; or a path
    sensor : calibrated by :func:`geomtact.calibrate`, as its file or as it comes from there

    Returns
    -------
    (H, W) metres, >= 0, in the sensor frame; 0 where no colour changed. Where image and background are darker or brighter than
    when     the sensor was calibrated, that is made up for

    Raises
    ------
    SensorError
        The sensor's colours are not calibrated.
    ImageError
        Images of other sizes, or not of the kinds above.
    """
    sensor = Sensor.load(sensor)
    if sensor.colour is None:
        raise SensorError(
            f"sensor {sensor.name}: its colours are not calibrated, so a tactile image has no depth map; press a ball of known "
            "diameter and run 'geomtact calibrate', or use contact_mask"
        )
    image = sensor.upright(as_unit_rgb(image, "image"))
    check_size(image, sensor, "image")
    background = same_size(sensor.upright(as_unit_rgb(background, "background")), image, "background", "image")
    return height_of(without_flicker(image, background).image, background, sensor)


def height_of(image: Array, background: Array, sensor: Sensor) -> NDArray[np.float32]:
    """As :func:`contact_height`, of images (H, W, 3) of 0..1 in the frame of a calibrated sensor, without flickering light."""
    assert sensor.colour is not None
    change, changed = colour_change(image, background)
    change = change / sensor.colour.brighter(background)
    return (np.maximum(relief(change, changed, sensor.colour, sensor.pixel_pitch), 0) * changed).astype(np.float32)


def relief(change: Array, changed: NDArray[np.bool_], colour: ColourTable, pitch: tuple[float, float]) -> Array:
    """Depth (H, W) [m] of the gel below its rest, of a ``change`` of colour (H, W, 3), present where ``changed`` (H, W)."""
    depth = integrate(colour.slopes(change), np.asarray(pitch))
    rest = np.median(depth[~changed]) if (~changed).mean() > _SOME else depth.min()
    return np.asarray(depth - rest)
