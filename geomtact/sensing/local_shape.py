"""From an RGB image to the contact mask (the thesis's local shape), without a calibration of the lights.

The difference from the background is taken as a linear image of the gel's slope. Its two strongest colour directions
span the slope; the 2x2 map that is left unknown is the one that makes the slope field a gradient (free of curl). Its
integral is the gel's indentation up to a factor; the rim of the contact is where, on the way up, the gel is steepest
(``registration/contact_problem.py`` registers that rim). Or the pressure that bends an elastic gel so is worked
out, and the contact is where there is any. A network needs no linear image: it is asked where light is blown out, or the gel
bulges.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from geomtact.errors import UsageError, nearest_name
from geomtact.se3 import Array
from geomtact.sensing.change import GRID, as_unit_rgb, background_of, change_from, check_size, smooth_background
from geomtact.sensing.flicker import without_flicker
from geomtact.sensing.pixels import Mask, blurred, filled, median_of, opened, size_of, transformed
from geomtact.sensing.sensor import CONTACT_METHODS, Sensor
from geomtact.sensing.slope import integrate, of_gradient, slope_field

BySlope = Callable[[Array, Mask, Mask, float, Array], tuple[Array, Mask]]  # slope, changed, strong, sigma, pitch

_NOISE_SHARE = 0.03  # noise over signal above which the image is smoothed more
_PRESSED = 0.3  # of the largest pressure, that counts as contact: the best in simulated images of many gels and lamps
_ONE_COLOUR = 0.03  # power of the second colour over that of the first, under which there is but one: a white gel's
_EITHER_WAY = 0.6  # of what gets darker over what gets brighter, or the reverse, from which on slopes are seen
_HARDLY_LESS = 0.1  # of the fastest fall, by which others fall less fast that count too
_SURELY = 0.501  # probability of what counts as contact, at least
# Brightness above which a camera shows less change than elsewhere. And the share of changed pixels so bright, more than a glint,
# above which colours are no linear image of slopes.
_NEARLY_WHITE, _BLOWN_OUT = 0.95, 0.01


class _Colours(NamedTuple):
    """Powers (3,), ascending, and directions (3, 3) in columns of the colours along which an image changes; and whether it is but
    one, as of a white gel, which gives no slope."""

    power: Array
    directions: Array
    one: bool


class FoundContact(NamedTuple):
    """A contact as found in a tactile image.

    Attributes
    ----------
    mask : (H, W) bool, where the object touches
    probability : (H, W) float32 that each pixel is in contact; None where ``method`` does not give it
    method : by which it was found, one of ``CONTACT_METHODS`` but "auto"; "classical" where all change is along one colour
    """

    mask: Mask
    probability: NDArray[np.float32] | None
    method: str


def contact_mask(
    image: Any, background: Any = None, sensor: Sensor | str | None = None, method: str | None = None
) -> Mask:
    """Where the object touches, in an RGB image.

    Parameters
    ----------
    image : (H, W, 3) uint8 or float 0..1, RGB; or a path
    background : (H, W, 3) the same sensor without contact, or a path; None: a smooth one is estimated from the image itself,
        which serves for contacts much smaller than the window
    sensor : gives the pixel pitch where columns and rows differ, the size to check, and how the camera is mounted; None: square
        pixels
    method : "classical": within the rim where the gel is steepest, by its slope, which colours give up to a factor; "pressure":
        where, by that slope, a thick elastic gel is pressed on; "learned": by a network trained on simulated images alone;
        or "auto": learned where more than a hundredth of what changes is blown out, or the sensor's gel bulges, else classical.
        On a white gel, all of whose change is along one colour, each takes what changes more than half as much as anywhere.
        None: as the sensor says, "auto" without one

    Returns
    -------
    (H, W) bool, in the sensor frame where a sensor is given; all False where nothing stands out of the image's own noise

    Raises
    ------
    ImageError, SensorError
        What is given is no RGB image, not of the sensor's size or the background's, or no sensor.
    UsageError
        There is no such ``method``.
    """
    if sensor is not None:
        sensor = Sensor.load(sensor)
        image = sensor.upright(as_unit_rgb(image, "image"))
        background = None if background is None else sensor.upright(as_unit_rgb(background, "background"))
    if background is not None:
        image = as_unit_rgb(image, "image")
        background = background_of(background, image)
        image = without_flicker(image, background).image
    return find_contact(image, background, sensor, method).mask


def find_contact(
    image: Any, background: Any = None, sensor: Sensor | str | None = None, method: str | None = None
) -> FoundContact:
    """As :func:`contact_mask`, of images in the sensor frame and without flickering light, with how it was
    found."""
    if method is not None and method not in CONTACT_METHODS:
        raise UsageError(f"contact_mask: no method named {method!r}{nearest_name(str(method), CONTACT_METHODS)}")
    image = as_unit_rgb(image, "image")
    pitch = np.ones(2)
    if sensor is not None:
        sensor = Sensor.load(sensor)
        method = method or sensor.contact_method
        pitch = np.asarray(sensor.pixel_pitch) / min(sensor.pixel_pitch)
        check_size(image, sensor, "image")
    reference = None if background is None else background_of(background, image)
    return contact_of(image, reference, method or CONTACT_METHODS[0], pitch, does_bulge(sensor))


def does_bulge(sensor: Sensor | None) -> bool:
    """Whether the sensor's gel bulges: then colours at rest differ from place to place, and are no linear image of slopes."""
    return sensor is not None and bool(sensor.membrane_radius)


def contact_of(image: Array, reference: Array | None, method: str, pitch: Array, bulges: bool = False) -> FoundContact:
    """As :func:`find_contact`, of images (H, W, 3) of 0..1 whose columns and rows are as far apart as ``pitch`` (2,) says, in the
    smaller of both; of a gel that ``bulges``, or is flat."""
    size = image.shape[1::-1]
    image, estimated = on_grid(image), reference is None
    reference = smooth_background(image) if reference is None else on_grid(reference)
    # a second look smooths more where noise asks for it
    sigma = min(image.shape[:2]) / GRID
    change, changed, strong, noise = change_from(image, reference, sigma, estimated)
    if changed.any():
        noise_share = noise / float(np.quantile(size_of(change)[changed], 0.9))
        if noise_share > _NOISE_SHARE:
            sigma *= min(noise_share / _NOISE_SHARE, 2.0)
            change, changed, strong, _ = change_from(image, reference, sigma, estimated)
    if not changed.any():
        return FoundContact(np.zeros(size[::-1], bool), None, "classical" if method == "auto" else method)
    if method == "auto":
        method = "learned" if bulges or _blown_out(changed, image, reference) > _BLOWN_OUT else "classical"
    colours = _colours(change, changed)
    if colours.one:
        method = "classical"
    if method == "learned":
        probability = _by_network(change, image, changed)
        mask = _components(filled(probability > 0.5), probability, strong, sigma)
        # what is no contact by its size or for want of change is none by its probability either
        probability = np.where(mask, np.maximum(probability, _SURELY), np.where(probability > 0.5, 0, probability))
        full = np.asarray(cv2.resize(probability, size, interpolation=cv2.INTER_LINEAR), np.float32)
        return FoundContact(full > 0.5, full, method)
    by_slope = _by_pressure if method == "pressure" else _by_rim
    pressed, mask = _by_colour(change, colours, changed, strong, sigma, pitch, by_slope)
    mask = _components(mask, pressed, strong, sigma)
    mask = np.asarray(cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_LINEAR) > 0.5)
    return FoundContact(mask, None, method)


def on_grid(image: Array) -> Array:
    """``image`` (H, W, 3) on ``GRID`` pixels along its shorter side: smoothing leaves nothing of finer ones."""
    share = min(1.0, GRID / min(image.shape[:2]))
    size = [round(share * n) for n in image.shape[1::-1]]
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA))


def _blown_out(changed: Mask, *images: Array) -> float:
    """Share of what is ``changed`` (H, W) where a channel of one of the ``images`` (H, W, 3) is about as bright as it can be."""
    bright = [(image >= _NEARLY_WHITE).any(-1) for image in images]
    return float(np.logical_or.reduce(bright)[changed].mean())


def _colours(change: Array, changed: Mask) -> _Colours:
    """Those along which the changed pixels vary."""
    values = change[changed]
    power, directions = np.linalg.eigh(values.T @ values / len(values))
    return _Colours(power, directions, bool(power[1] <= _ONE_COLOUR * power[2]))


def _by_colour(
    change: Array, colours: _Colours, changed: Mask, strong: Mask, sigma: float, pitch: Array, by_slope: BySlope
) -> tuple[Array, Mask]:
    """How much the gel is pressed in (H, W), up to a factor, and the contact: by its slope, where colours give that."""
    if colours.one:
        return _half_as_large(_one_way(change @ colours.directions[:, 2], changed), changed)
    plane = transformed(change, (colours.directions[:, 1:] / np.sqrt(colours.power[1:])).T)
    slope = slope_field(plane, changed, sigma, pitch)
    if slope is None:
        return _half_as_large(size_of(change), changed)
    return by_slope(slope, changed, strong, sigma, pitch)


def _by_rim(slope: Array, changed: Mask, strong: Mask, sigma: float, pitch: Array) -> tuple[Array, Mask]:
    """The gel's indentation (H, W), up to a factor, and the contact: within the rim where it is steepest."""
    height = integrate(slope, pitch)
    height = _indentation(_inwards(height, changed) * height, changed)
    return height, _inside_rim(height, slope, changed, sigma)


def _by_pressure(slope: Array, changed: Mask, strong: Mask, sigma: float, pitch: Array) -> tuple[Array, Mask]:
    """The pressure (H, W), up to a factor, that gives an elastic half-space this ``slope``, and the contact: where there is any.

    A wave of pressure of number k sinks in by 1/k of it (Johnson 1985, 13.2), so pressure is k times the height: the Riesz
    transform of the gradient, as noisy as that and no more.
    """
    height, pressed = of_gradient(slope, pitch, 2, 1)
    pressed *= _inwards(height, changed)
    mask = (pressed > _PRESSED * np.quantile(pressed[strong], 0.98)) & changed
    mask = opened(filled(mask), max(1, round(sigma)))
    return np.maximum(pressed, 0) * changed, mask


def _one_way(along: Array, changed: Mask) -> Array:
    """By how much (H, W) a gel of one colour changes that gets brighter ``along`` (H, W) or darker: a white one as it does where
    it is pressed in most, a grey picture of lit slopes either way."""
    brighter, darker = (max(float(np.quantile(way * along[changed], 0.98)), 0.0) for way in (1, -1))
    if min(brighter, darker) > _EITHER_WAY * max(brighter, darker):
        return np.abs(along)
    return np.maximum(along if brighter > darker else -along, 0)


def _half_as_large(size: Array, changed: Mask) -> tuple[Array, Mask]:
    """``size`` (H, W) where ``changed``, and where it is more than half of the largest."""
    size = size * changed
    return size, filled(size > 0.5 * np.quantile(size[changed], 0.95))


def _by_network(change: Array, image: Array, changed: Mask) -> Array:
    """The probability (H, W) of contact, 0 where no colour changed."""
    from geomtact.sensing.mask_network import contact_probability

    return np.asarray(contact_probability(change, image) * changed, float)


def _inwards(height: Array, changed: Mask) -> float:
    """1 where the gel is pressed in towards larger ``height`` (H, W), else -1."""
    if (~changed).mean() > 0.15:
        depth = cv2.distanceTransform(changed.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_3)[changed]
        inward = ((height[changed] - height[changed].mean()) * depth).sum()
    else:
        # a contact that fills the window: the dome's difference from the object is curved downwards over most of it
        inward = -median_of(cv2.Laplacian(height, -1)[changed])
    return -1.0 if inward < 0 else 1.0


def _indentation(height: Array, changed: Mask) -> Array:
    """``height`` (H, W) with its zero set: the gel rests where no colour changed, pressed in elsewhere."""
    unchanged = float((~changed).mean())
    rest = median_of(height[~changed]) if unchanged > 0.05 else np.quantile(height, 0.02)
    return np.maximum(height - rest, 0) * changed


def _inside_rim(height: Array, slope: Array, changed: Mask, sigma: float) -> Mask:
    """Where the walk uphill to the deepest indentation no longer meets a slope much steeper than the one underfoot.

    Inside a contact the gel takes the object's shape; outside it relaxes, and the slope dies away from the rim on.
    """
    steep = np.hypot(slope[..., 0], slope[..., 1])
    ahead = blurred(_uphill_maximum(height, steep), 2 * sigma)
    share = steep / np.maximum(ahead, 1e-12)
    share[height > 0.6 * float(height.max())] = 1.0
    inside = (height > 0.1 * float(height.max())) & (share >= _steepest_fall(share, changed))
    return opened(filled(inside), max(1, round(2 * sigma)))


def _steepest_fall(share: Array, changed: Mask) -> float:
    """The level of ``share`` (H, W) on whose contour it falls fastest in the mean: the mean of those where it hardly falls less
    fast, so that of two alike neither wins by a rounding error."""
    edges = np.linspace(0.4, 0.9, 21)
    fall = np.hypot(*np.gradient(share))[changed]
    bins = np.searchsorted(edges, share[changed], side="right")
    count = np.bincount(bins, minlength=22)[1:-1]
    mean = np.bincount(bins, fall, minlength=22)[1:-1] / np.maximum(count, 1)
    mean = np.convolve(np.pad(mean, 2, mode="edge"), np.ones(5) / 5, mode="valid")
    fastest = np.maximum(mean - (1 - _HARDLY_LESS) * mean.max(), 1e-12)
    return float((0.5 * (edges[1:] + edges[:-1])) @ fastest / fastest.sum())


def _uphill_maximum(height: Array, value: Array) -> Array:
    """The largest ``value`` (H, W) on the steepest way up from each pixel to its summit of ``height`` (H, W)."""
    h, w = height.shape
    index = np.arange(h * w, dtype=np.int32).reshape(h, w)
    padded = np.pad(height, 1, constant_values=-np.inf)
    best, target = height.copy(), index.copy()
    for dy, dx in ((dy, dx) for dy in (-1, 0, 1) for dx in (-1, 0, 1)):
        neighbour = padded[1 + dy : 1 + dy + h, 1 + dx : 1 + dx + w]
        np.copyto(target, index + np.int32(dy * w + dx), where=neighbour > best)
        best = np.maximum(best, neighbour)
    way, out = target.ravel(), value.ravel().copy()
    # pointer jumping: every round doubles the length of way that is seen
    while True:
        out = np.maximum(out, out.take(way))
        further = way.take(way)
        if np.array_equal(further, way):
            return out.reshape(h, w)
        way = further


def _components(mask: Mask, height: Array, strong: Mask, sigma: float) -> Mask:
    """The components of ``mask`` that are pressed in, backed by a strong change and larger than the smoothing."""
    n, labels = cv2.connectedComponents(mask.astype(np.uint8), connectivity=4)
    deep = mask & (height > 0.3 * height.max())
    area, backed, pressed = (np.bincount(labels[where], minlength=n) for where in (mask, strong, deep))
    keep = (area > np.pi * (2 * sigma) ** 2) & (backed > 0) & (pressed > 0)
    keep[0] = False
    return keep[labels]
