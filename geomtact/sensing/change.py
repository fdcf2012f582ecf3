"""What has changed in a tactile image since its background: colours, where these changed, and images that do not compare."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from geomtact.errors import ImageError
from geomtact.se3 import Array
from geomtact.sensing.image_file import read_image
from geomtact.sensing.pixels import Mask, blurred, closed, every, filled, median_of, opened, pixels_apart, size_of
from geomtact.sensing.sensor import Sensor, alike_in_aspect

GRID = 120  # smoothing lengths along an image's shorter side
Image = NDArray[np.floating]  # (H, W, 3) of 0..1
_GREY = 1 / 255
_APART = 3  # pixels from one to the next that a smooth background is fitted to
_STRONG, _WEAK = 8.0, 3.0  # in units of the image's own noise


def colour_change(image: Image, background: Image) -> tuple[Array, Mask]:
    """The smoothed change (H, W, 3) of an image 0..1 from its background, and where (H, W) it exceeds the noise."""
    change, changed, _, _ = change_from(image, background, min(image.shape[:2]) / GRID)
    return change, changed


def change_from(
    image: Image, background: Image, sigma: float, estimated: bool = False
) -> tuple[Array, Mask, Mask, float]:
    """The smoothed change (H, W, 3) from the background, which may be ``estimated``, where it exceeds the noise, where
    strongly so, and its noise."""
    change = _without_light_drift(blurred(image, sigma), blurred(background, sigma), 2 * round(0.5 * sigma - 0.5) + 1)
    # an estimated background is off by more than the noise: what most pixels are off by counts as noise too
    floor = median_of(size_of(change).ravel()) if estimated else 0.0
    return change, *_changed(change, sigma, floor)


def smooth_background(image: Array) -> Array:
    """A background (H, W, 3) for ``image`` (H, W, 3): the smooth surface (degree 5) that most of its pixels lie on."""
    h, w = image.shape[:2]
    along_y, along_x = (np.polynomial.chebyshev.chebvander(np.linspace(-1, 1, n), 5) for n in (h, w))
    terms = np.array([(i, j) for i in range(6) for j in range(6 - i)])
    rows, columns = every(_APART, h), every(_APART, w)
    basis = np.einsum("yk,xk->yxk", along_y[rows][:, terms[:, 0]], along_x[columns][:, terms[:, 1]]).reshape(
        -1, len(terms)
    )
    values = image[rows, columns].reshape(-1, 3)
    keep = np.ones(len(values), bool)
    for _ in range(8):
        fit = np.linalg.lstsq(basis[keep], values[keep], rcond=None)[0]
        error = np.abs(values - basis @ fit).sum(1)
        keep = error <= np.quantile(error, 0.7)
    surface = np.zeros((6, 6, 3))
    surface[terms[:, 0], terms[:, 1]] = fit
    return np.asarray(np.einsum("yi,xj,ijc->yxc", along_y, along_x, surface, optimize=True))


def _without_light_drift(image: Array, reference: Array, step: int) -> Array:
    """``image`` minus the background, whose brightness is fitted per channel (gain, offset) to the calmer half of one in
    ``step`` pixels each way."""
    rows, columns = (every(step, n) for n in image.shape[:2])
    gains, offsets = np.empty(3, image.dtype), np.empty(3, image.dtype)
    for c in range(3):
        x, y = (each[rows, columns, c].ravel() for each in (reference, image))
        calm_x, calm_y = x, y
        for _ in range(6):
            mean_x, mean_y = calm_x.sum() / calm_x.size, calm_y.sum() / calm_y.size
            dx = calm_x - mean_x
            variance = dx @ dx / dx.size
            gain = np.clip(dx @ calm_y / dx.size / variance, 0.8, 1.25) if variance > _GREY**2 else dx.dtype.type(1)
            offset = mean_y - gain * mean_x
            error = np.abs(y - gain * x - offset)
            calm = np.flatnonzero(error <= median_of(error))
            calm_x, calm_y = x.take(calm), y.take(calm)
        gains[c], offsets[c] = gain, offset
    return image - gains * reference - offsets


def _changed(change: Array, sigma: float, floor: float) -> tuple[Mask, Mask, float]:
    """The regions (H, W) that stand out of the noise somewhere, those places, and the noise: hysteresis."""
    step, apart = max(1, round(3 * sigma)), pixels_apart(sigma)
    noise2 = 0.0
    for c in range(3):
        # second differences over three smoothing lengths cancel slopes, and most pixels lie outside any rim
        lines = (a[:, every(apart, a.shape[1])] for a in (change[..., c], change[..., c].T))
        second = [
            np.abs(a[2 * step :] - 2 * a[step:-step] + a[: -2 * step])[every(apart, len(a) - 2 * step)] for a in lines
        ]
        deviation = median_of(np.concatenate([s.ravel() for s in second])) / 0.6745 / np.sqrt(6)
        noise2 += max(float(deviation), 0.25 * _GREY) ** 2
    noise = max(np.sqrt(noise2), floor)
    size = size_of(change)
    strong = opened(size > max(_STRONG * noise, 5 * _GREY), max(1, round(sigma)))
    weak = size > max(_WEAK * noise, 0.05 * float(size.max()))
    weak = filled(closed(weak, max(1, round(2 * sigma))))
    n, labels = cv2.connectedComponents(weak.astype(np.uint8), connectivity=4)
    kept = np.bincount(labels[strong], minlength=n) > 0
    kept[0] = False
    return kept[labels], strong, float(noise)


def as_unit_rgb(image: Any, name: str) -> Array:
    """An image (H, W, 3), uint8 or float 0..1, or its path, as float32 0..1; what is none is refused under its ``name``."""
    if isinstance(image, str | Path):
        name, image = str(image), read_image(image)
        image = image[..., :3] if image.ndim == 3 else image
    if image is None:
        raise ImageError(f"{name}: expected an RGB image (H, W, 3) or its path, got none; give it")
    image = np.asarray(image)
    if image.ndim != 3 or image.shape[2] != 3 or min(image.shape[:2]) < 8:
        raise ImageError(
            f"{name}: expected an RGB image (H, W, 3) of 8 pixels or more a side, got an array of shape {image.shape}; give one "
            "image, in colour, as the camera made it"
        )
    if image.dtype == np.uint8:
        return np.asarray(cv2.LUT(image, (np.arange(256) / 255).astype(np.float32)))
    if image.dtype.kind != "f":
        raise ImageError(f"{name}: expected uint8 or float 0..1, got {image.dtype}; convert it")
    image = image.astype(np.float32)
    if not np.isfinite(image).all():
        raise ImageError(f"{name}: expected finite values from 0 to 1, got NaN or infinite ones; fill them")
    if image.min() < 0 or image.max() > 1:
        given = f"{image.min():g} to {image.max():g}"
        raise ImageError(f"{name}: expected values from 0 to 1, got {given}; divide by the white value")
    return image


def check_size(array: NDArray[Any], sensor: Sensor, name: str, do: str | None = None) -> None:
    """Refuse an image (H, W, ...) of another size than the sensor's.

    ``do`` is the advice, unless width and height are exchanged.
    """
    height, width = array.shape[:2]
    if (width, height) == sensor.image_size_px:
        return
    expected, given = "{} x {} px".format(*sensor.image_size_px), f"{width} x {height} px"
    if (height, width) == sensor.image_size_px and sensor.camera_rotation_deg in (90, 270):
        hint = (
            f"it was turned by {sensor.camera_rotation_deg} degrees, and image_size_px is that after it: write it so into a "
            "sensor file of its own, or leave the turn out"
        )
    elif (height, width) == sensor.image_size_px:
        hint = (
            "width and height are exchanged: say how the camera is mounted (--rotate 90 turns images counter-clockwise, 270 "
            "clockwise; or camera_rotation_deg in the sensor's file), or name the sensor that took it; an array has rows first, "
            "(height, width)"
        )
    elif do is not None:
        hint = do
    elif (
        sensor.border_fraction
        and width > sensor.image_size_px[0]
        and alike_in_aspect(array.shape, sensor.image_size_px)
    ):
        rows, columns = sensor.cut(array.shape)
        hint = (
            f"cut the camera's whole frame to rows {rows.start} to {rows.stop - 1} and columns {columns.start} to "
            f"{columns.stop - 1}, counted from 0, and scale it to {expected}; if it is cut already, only scale it"
        )
    elif width * sensor.image_size_px[1] == height * sensor.image_size_px[0]:
        hint = "the shape agrees: scale a mask to that, or describe this resolution in a sensor file of its own"
    else:
        hint = "name the sensor that took it, or give a sensor file of the image's resolution"
    raise ImageError(f"{name}: expected {expected} for sensor {sensor.name} (width x height), got {given}; {hint}")


def background_of(background: Any, image: Array) -> Array:
    """The ``background`` of an ``image`` (H, W, 3), by :func:`as_unit_rgb`; one of another size is refused."""
    return same_size(as_unit_rgb(background, "background"), image, "background", "image")


def same_size(image: Array, other: Array, name: str, of: str) -> Array:
    """``image`` (H, W, 3), which is refused under its ``name`` if it is not of the size of the ``other``, which is ``of``."""
    if image.shape != other.shape:
        raise ImageError(
            f"{name}: expected the size of the {of}, {other.shape[1]} x {other.shape[0]} px, got {image.shape[1]} x "
            f"{image.shape[0]} px; take both with the same sensor"
        )
    return image
