"""The contact in one image of the sensor: a mask, a depth map or an RGB image becomes a contact."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from geomtact.errors import ImageError, UsageError, nearest_name
from geomtact.sensing.change import as_unit_rgb, check_size, smooth_background
from geomtact.sensing.contact import FAINT, Contact, border_of
from geomtact.sensing.depth_map import depths_of
from geomtact.sensing.drawn import bright_half, two_valued, without_two_colours
from geomtact.sensing.flicker import without_flicker
from geomtact.sensing.height import height_of
from geomtact.sensing.image_faults import calibration_mismatches, faults
from geomtact.sensing.image_file import ImageFile
from geomtact.sensing.local_shape import find_contact, on_grid
from geomtact.sensing.sensor import Sensor

KINDS = ("auto", "mask", "height", "reading")
_DUST = 0.1e-6  # m^2 of contact, under which a touch constrains nothing (docs/robustness.md)
_SPECKS = 100  # pieces and holes no larger than dust, that a mask of one touch has at most
# share in contact of a mask that may be a negative, if all of its border is, or most of it
_NEGATIVE, _NEGATIVE_MOST, _BORDER = 0.5, 0.85, 0.8
_LOSSY = (".jpg", ".jpeg")


@dataclass(frozen=True)
class Observation:
    """One image and the contact it shows.

    Attributes
    ----------
    contact : Contact on the sensor's image grid; an all-False mask means that nothing touches
    kind : "mask", "height" or "reading", as given or as decided
    warnings : what was assumed on the way, one line each
    image : the array as read: (H, W) or (H, W, 3), alpha dropped
    method : by which the contact was found in a tactile image, one of ``CONTACT_METHODS`` but "auto"; None for other kinds
    """

    contact: Contact
    kind: str
    warnings: list[str] = field(default_factory=list)
    image: NDArray[Any] = field(default_factory=lambda: np.zeros((0, 0)), repr=False)
    method: str | None = None


def read_observation(
    image: str | Path | ImageFile | ArrayLike,
    sensor: Sensor | str | Path,
    kind: str = "auto",
    background: str | Path | ArrayLike | None = None,
) -> Observation:
    """Read an image as a contact.

    Parameters
    ----------
    image : path, file or array. ``auto`` takes bool or two-valued as a mask; float (H, W) as a height [m]; 16-bit grey as a
        height in micrometres; three channels, RGB, uint8 or float 0..1, as a tactile image; other grey as a tactile image
    sensor : whose image it is; another size is an error
    kind : "auto", "mask", "height" or "reading"
    background : for a tactile image, the same sensor without contact

    Raises
    ------
    ImageError
        Unreadable, of another size, not finite, negative depths, depths in another unit.
    SensorError, UsageError
        No such sensor; no such ``kind``.
    """
    sensor = Sensor.load(sensor)
    if kind not in KINDS:
        raise UsageError(f"unknown kind {kind!r}{nearest_name(str(kind), KINDS)}")
    warnings: list[str] = []
    method = None
    image = _opened(image)
    name, array = _load(image, "image", warnings)
    if kind in ("auto", "mask"):
        array = without_two_colours(array, name)
    if kind == "auto":
        kind = _decide(array, name, background is not None, warnings)
    array = _in_sensor_frame(array, image, name, kind, sensor, warnings)
    check_size(array, sensor, name)
    if kind != "reading":
        array = _grey(array)
    if background is not None and kind != "reading":
        warnings.append(f"{name}: the background is not used: a {'depth map' if kind == 'height' else kind} needs none")
    if kind == "mask":
        contact = Contact(_mask(array, name, warnings))
    elif kind == "height":
        height = depths_of(array, name, sensor, warnings)
        contact = Contact.of_height(height)
        if not np.array_equal(contact.mask, height > FAINT * height.max()):
            warnings.append(
                f"{name}: the depths fade away, as beside a contact on a soft gel; the contact is where the gel carries pressure"
            )
    else:
        contact, method = _reading(array, name, sensor, background, warnings)
    share, area = float(contact.mask.mean()), float(contact.mask.sum() * sensor.pixel_area(contact.mask.shape))
    if share == 1:
        warnings.append(f"{name}: every pixel is in contact: the contact fills the image, so its outline is not seen")
    elif kind == "mask" and (specks := _specks(contact.mask, sensor)) > _SPECKS:
        warnings.append(
            f"{name}: the mask has {specks} specks and holes as small as dust, as noise has; smooth it, or give the tactile image"
        )
    elif kind == "mask" and _perhaps_negative(contact.mask, share):
        warnings.append(
            f"{name}: {100 * share:.0f} % of the mask is contact; if that is where nothing touches, invert it"
        )
    elif 0 < area < _DUST:
        warnings.append(f"{name}: the contact covers {1e6 * area:.2g} mm2, as dust does: it hardly constrains the pose")
    return Observation(contact, kind, warnings, array, method)


def _opened(source: Any) -> Any:
    """An array or an image file, of a path, too, whose file is read here and nowhere else."""
    return ImageFile.read(source) if isinstance(source, str | Path) else source


def _load(source: Any, role: str, warnings: list[str]) -> tuple[str, NDArray[Any]]:
    """The name and the array (H, W) or (H, W, 3) of an image file or an array; opaque alpha is dropped."""
    if isinstance(source, ImageFile):
        name, array = f"{role} {source.path}" if role == "background" else str(source.path), source.pixels
    else:
        name, array = role, np.asarray(source)
    if array.dtype.kind not in "buif":
        raise ImageError(f"{name}: expected numbers, got an array of {array.dtype}; give bool, integers or floats")
    array = array.astype(array.dtype.newbyteorder("="), copy=False)
    if array.ndim == 3 and array.shape[2] == 1:
        array = array[..., 0]
    if array.size == 0 or array.ndim not in (2, 3) or (array.ndim == 3 and array.shape[2] > 4):
        raise ImageError(f"{name}: expected (H, W) or (H, W, 3), got an array of shape {array.shape}; give one image")
    if array.ndim == 3 and array.shape[2] in (2, 4):
        alpha = array[..., -1]
        opaque = 1.0 if array.dtype.kind == "f" else np.iinfo(array.dtype).max if array.dtype.kind in "ui" else True
        if (alpha != opaque).any():
            raise ImageError(
                f"{name}: the image has transparent pixels; flatten it or save it without an alpha channel"
            )
        array = array[..., :-1] if array.shape[2] == 4 else array[..., 0]
        warnings.append(f"{name}: the opaque alpha channel was dropped")
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        raise ImageError(
            f"{name}: {int((~np.isfinite(array)).sum())} values are NaN or infinite; fill them or set them to 0"
        )
    if array.dtype.kind != "f":
        array = _grey(array)
    return name, array


def _in_sensor_frame(
    array: NDArray[Any], source: Any, name: str, kind: str, sensor: Sensor, warnings: list[str]
) -> NDArray[Any]:
    """An image (H, W, ...) of a ``source``, turned as the sensor's camera is mounted. Masks and depth maps are in the sensor
    frame already, unless the sensor's file states otherwise; so is what ``simulate`` wrote."""
    straight = sensor.straight_from_camera(array)
    if not (sensor.turned or straight):
        return array
    from_file = isinstance(source, ImageFile)
    if from_file and "geomtact:sensor" in source.metadata:
        if sensor.turned:
            warnings.append(
                f"{name}: is not turned or mirrored as the camera is mounted, for its metadata say that geomtact made it in the "
                "sensor frame; if it was changed since, save it without metadata"
            )
        return array
    if kind != "reading" and not sensor.camera_masks:
        if from_file and sensor.turned:
            warnings.append(
                f"{name}: a {'depth map' if kind == 'height' else kind} is taken to be in the sensor frame, so it is not turned "
                "as the camera's images are; if it is as the camera sees, set camera_masks = true in the sensor's file, or give "
                "--rotate"
            )
        return array
    if straight:
        warnings.append(
            f"{name}: {array.shape[1]} x {array.shape[0]} px, straight from the camera: turned by {sensor.driver_rotation_deg} "
            f"degrees counter-clockwise, as the driver of {sensor.name} does"
        )
    return sensor.upright(array)


def _grey(array: NDArray[Any]) -> NDArray[Any]:
    """(H, W) of an image whose channels are alike; any other as it is."""
    return array[..., 0] if array.ndim == 3 and _colourless(array) else array


def _colourless(array: NDArray[Any]) -> bool:
    """Whether the channels of an image (H, W, C) are alike."""
    return bool((array == array[..., :1]).all())


def _plain(array: NDArray[Any]) -> bool:
    """Whether an image shows one value everywhere."""
    return bool(array.min() == array.max())


def _specks(mask: NDArray[np.bool_], sensor: Sensor) -> int:
    """How many pieces and holes of a mask (H, W) are as small as dust; 0 where there cannot be more than a mask may have."""
    # each has a pixel with nothing of its kind above it and to its left
    up, left = (mask[1:] != mask[:-1]), (mask[:, 1:] != mask[:, :-1])
    if (up[:, 1:] & left[1:]).sum() + left[0].sum() + up[:, 0].sum() < _SPECKS:
        return 0
    both = [cv2.connectedComponentsWithStats(each.astype(np.uint8), connectivity=4)[2] for each in (mask, ~mask)]
    pixels = np.concatenate([stats[1:, cv2.CC_STAT_AREA] for stats in both])
    return int((pixels * sensor.pixel_area(mask.shape) <= _DUST).sum())


def _perhaps_negative(mask: NDArray[np.bool_], share: float) -> bool:
    """Whether a mask of which a ``share`` is set may show where nothing touches: its border is set, too."""
    border = float(border_of(mask).mean())
    return border >= (_BORDER if share > _NEGATIVE_MOST else 1.0) and share > _NEGATIVE


def _decide(array: NDArray[Any], name: str, beside_background: bool, warnings: list[str]) -> str:
    # an image of one value beside a background is what a camera shows without light, not a mask of nothing
    if beside_background and _plain(array):
        return "reading"
    if array.ndim == 2:
        if array.dtype == bool or two_valued(array):
            return "mask"
        if array.dtype.kind == "f" or array.dtype == np.uint16:
            return "height"
    if (half := bright_half(array)) is not None and half.any():
        warnings.append(
            f"{name}: nearly black and white, read as a tactile image; "
            "for a mask give --kind mask (and PNG, which keeps it exact)"
        )
    elif array.ndim == 2:
        warnings.append(
            f"{name}: a grey image with many values is read as a tactile image; for a mask or height give --kind"
        )
    return "reading"


def _mask(array: NDArray[Any], name: str, warnings: list[str]) -> NDArray[np.bool_]:
    if array.dtype == bool or (array.ndim == 2 and two_valued(array)):
        return array != 0
    half = bright_half(array)
    if half is not None and (half.any() or Path(name).suffix.lower() in _LOSSY):
        warnings.append(
            f"{name}: the mask is nearly black and white, as compression leaves it: what is over half counts as contact; "
            "better give PNG"
        )
        return half
    if array.ndim == 3:
        raise ImageError(f"{name}: a mask has one channel, got a colour image; save it as grey or give --kind reading")
    if array.min() > 0:
        raise ImageError(
            f"{name}: a mask is 0 where nothing touches, got {array.min():g} to {array.max():g}; set it to 0"
        )
    warnings.append(f"{name}: the mask has more than two values; every pixel that is not 0 counts as contact")
    return array != 0


def _reading(
    array: NDArray[Any], name: str, sensor: Sensor, background: Any, warnings: list[str]
) -> tuple[Contact, str]:
    """The contact in a tactile image, and the method by which it was found."""
    reference = None
    _check_light(array, name)
    if background is None:
        no_depths = "" if sensor.colour is None else ", and there is no depth map without one"
        warnings.append(f"{name}: no background was given; a smooth one was estimated from the image itself{no_depths}")
    else:
        background = _opened(background)
        label, reference = _load(background, "background", warnings)
        reference = _in_sensor_frame(reference, background, label, "reading", sensor, warnings)
        check_size(reference, sensor, label, "take it with the camera settings of the image")
        _check_light(reference, label)
        reference = _rgb(reference, label)
    seen = _rgb(array, name)
    grey = _colourless(seen)
    if reference is not None and _colourless(reference) != grey:
        raise ImageError(
            f"{name}: one of image and background has colours, the other is grey; give both as the camera made them"
        )
    seen, reference = as_unit_rgb(seen, name), None if reference is None else as_unit_rgb(reference, "background")
    if reference is None:
        coarse = on_grid(seen)
        light = without_flicker(coarse, smooth_background(coarse), estimated=True)
    else:
        light = without_flicker(seen, reference)
        seen = light.image
    warnings.extend(f"{name}: {each}" for each in light.warnings)
    warnings.extend(f"{name}: {fault}" for fault in faults(seen, reference))
    touch = find_contact(seen, reference, sensor)
    if touch.method != sensor.contact_method != "auto":
        warnings.append(
            f"{name}: all change is along one colour, which gives no slope, so {sensor.contact_method} cannot be used; "
            "what changes more than half as much as anywhere counts as contact"
        )
    height = None
    if sensor.colour is not None and reference is not None:
        if grey:
            warnings.append(f"{name}: the image is grey, so the sensor's colours give no depth map: give it in colour")
        else:
            height = height_of(seen, reference, sensor)
            warnings.extend(f"{name}: {fault}" for fault in calibration_mismatches(reference, sensor.colour))
    return Contact(touch.mask, height, probability=touch.probability), touch.method


def _check_light(array: NDArray[Any], name: str) -> None:
    """Refuse a camera's image that shows one value everywhere."""
    if _plain(array):
        raise ImageError(
            f"{name}: every pixel is {array.min():g}, as of a camera without light or wholly blown out; check lamps and exposure"
        )


def _rgb(array: NDArray[Any], name: str) -> NDArray[Any]:
    """(H, W, 3) uint8 or float 0..1; grey is repeated."""
    if array.dtype == np.uint16:
        array = array / float(np.iinfo(np.uint16).max)
    elif array.dtype.kind in "ui" and array.dtype != np.uint8:
        if array.min() < 0 or array.max() > 255:
            raise ImageError(
                f"{name}: a tactile image of {array.dtype} must lie in 0..255, got {array.min()} to {array.max()}; give uint8 or "
                "uint16, or depths as uint16 (micrometres) with --kind height"
            )
        array = array.astype(np.uint8)
    elif array.dtype == bool:
        array = array.astype(float)
    if array.dtype.kind == "f" and (array.min() < 0 or array.max() > 1):
        raise ImageError(
            f"{name}: a float tactile image must lie in 0..1, got {array.min():.4g} to {array.max():.4g}; divide by 255"
        )
    return np.repeat(array[..., None], 3, -1) if array.ndim == 2 else array
