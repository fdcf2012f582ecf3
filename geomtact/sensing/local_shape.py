"""From an RGB reading to the contact mask (the thesis's local shape), without a calibration of the lights.

The difference from the background is taken as a linear image of the gel's slope. Its two strongest colour directions
span the slope; the 2x2 map that is left unknown is the one that makes the slope field a gradient (free of curl). Its
integral is the gel's indentation up to a factor; the rim of the contact is where, on the way up, the gel is steepest. Or
the pressure that bends an elastic gel so is worked out, and the contact is where there is any. A network does without.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from geomtact.errors import ImageError, UsageError, nearest_name
from geomtact.se3 import Array
from geomtact.sensing.image_file import read_image
from geomtact.sensing.sensor import CONTACT_METHODS, Sensor

Mask = NDArray[np.bool_]
BySlope = Callable[[Array, Mask, Mask, float, Array], tuple[Array, Mask]]  # slope, felt, strong, sigma, pitch

_GREY = 1 / 255
_GRID = 120  # pixels along an image's shorter side, which is smoothed by one of them
_STRONG, _WEAK = 8.0, 3.0  # in units of the image's own noise
_NOISE_SHARE = 0.03  # noise over signal above which the image is smoothed more
_PRESSED = 0.3  # of the largest pressure, that counts as contact: the best in simulated readings of many gels and lamps
_ONE_COLOUR = 0.03  # power of the second colour over that of the first, under which there is but one: a white gel's
_EITHER_WAY = 0.6  # of what gets darker over what gets brighter, or the reverse, from which on slopes are seen
_SURELY = 0.501  # probability of what counts as contact, at least
_CURL_LIMIT = 0.45  # share of curl above which the colours do not behave like slopes


def contact_mask(
    image: Any, background: Any = None, sensor: Sensor | str | None = None, method: str | None = None
) -> Mask:
    """Where the object touches, in an RGB reading.

    Parameters
    ----------
    image : (H, W, 3) uint8 or float 0..1, RGB; or a path
    background : (H, W, 3) the same sensor without contact, or a path; None: a smooth one is estimated from the image itself,
        which serves for contacts much smaller than the window
    sensor : gives the pixel pitch where columns and rows differ, and the size to check; None: square pixels
    method : "classical": within the rim where the gel is steepest, by its slope, which colours tell up to a factor; "pressure":
        where, by that slope, a thick elastic gel is pressed on; or "learned": by a network trained on simulated readings alone,
        where colours tell the slope. None: as the sensor says, "classical" without one

    Returns
    -------
    (H, W) bool; all False where nothing stands out of the image's own noise

    Raises
    ------
    ImageError, SensorError
        What is given is no RGB image, not of the sensor's size or the background's, or no sensor.
    UsageError
        There is no such ``method``.
    """
    return find_contact(image, background, sensor, method)[0]


def find_contact(
    image: Any, background: Any = None, sensor: Sensor | str | None = None, method: str | None = None
) -> tuple[Mask, NDArray[np.float32] | None]:
    """As :func:`contact_mask`, and the probability (H, W) that each pixel is in contact, where the ``method`` tells that."""
    if method is not None and method not in CONTACT_METHODS:
        raise UsageError(f"contact_mask: no method named {method!r}{nearest_name(str(method), CONTACT_METHODS)}")
    image = as_unit_rgb(image, "image")
    pitch = np.ones(2)
    if sensor is not None:
        sensor = Sensor.load(sensor)
        method = method or sensor.contact_method
        pitch = np.asarray(sensor.pixel_pitch) / min(sensor.pixel_pitch)
        check_size(image, sensor, "image")
    reference = None if background is None else same_size(as_unit_rgb(background, "background"), image)
    size = image.shape[1::-1]
    image, reference = _on_grid(image), None if reference is None else _on_grid(reference)
    # a second look smooths more where noise asks for it
    sigma = min(image.shape[:2]) / _GRID
    change, felt, strong, noise = _change(image, reference, sigma)
    if felt.any():
        noise_share = noise / float(np.quantile(_size(change)[felt], 0.9))
        if noise_share > _NOISE_SHARE:
            sigma *= min(noise_share / _NOISE_SHARE, 2.0)
            change, felt, strong, _ = _change(image, reference, sigma)
    if not felt.any():
        return np.zeros(size[::-1], bool), None
    if method == "learned" and not _colours(change, felt)[2]:
        probability = _by_network(change, image, felt)
        mask = _components(_filled(probability > 0.5), probability, strong, sigma)
        # what is no contact by its size or for want of change is none by its probability either
        probability = np.where(mask, np.maximum(probability, _SURELY), np.where(probability > 0.5, 0, probability))
        full = np.asarray(cv2.resize(probability, size, interpolation=cv2.INTER_LINEAR), np.float32)
        return full > 0.5, full
    pressed, mask = _by_colour(change, felt, strong, sigma, pitch, _by_pressure if method == "pressure" else _by_rim)
    mask = _components(mask, pressed, strong, sigma)
    return np.asarray(cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_LINEAR) > 0.5), None


def _on_grid(image: Array) -> Array:
    """``image`` (H, W, 3) on ``_GRID`` pixels along its shorter side: finer ones tell nothing that smoothing leaves."""
    share = min(1.0, _GRID / min(image.shape[:2]))
    return np.asarray(cv2.resize(image, None, fx=share, fy=share, interpolation=cv2.INTER_AREA))


def _colours(change: Array, felt: Mask) -> tuple[Array, Array, bool]:
    """Powers (3,), ascending, and directions (3, 3) in columns of the colours along which all that is felt changes; and whether
    it is but one, as of a white gel, which tells no slope."""
    values = change[felt]
    power, colours = np.linalg.eigh(values.T @ values / len(values))
    return power, colours, bool(power[1] <= _ONE_COLOUR * power[2])


def _by_colour(
    change: Array, felt: Mask, strong: Mask, sigma: float, pitch: Array, by_slope: BySlope
) -> tuple[Array, Mask]:
    """How much the gel is pressed in (H, W), up to a factor, and the contact: by its slope, where colours tell that."""
    power, colours, one = _colours(change, felt)
    if one:
        return _half_as_large(_one_way(change @ colours[:, 2], felt), felt)
    slope = _slope_field(_transformed(change, (colours[:, 1:] / np.sqrt(power[1:])).T), felt, sigma, pitch)
    if slope is None:
        return _half_as_large(_size(change), felt)
    return by_slope(slope, felt, strong, sigma, pitch)


def _by_rim(slope: Array, felt: Mask, strong: Mask, sigma: float, pitch: Array) -> tuple[Array, Mask]:
    """The gel's indentation (H, W), up to a factor, and the contact: within the rim where it is steepest."""
    height = integrate(slope, pitch)
    height = _indentation(_inwards(height, felt) * height, felt)
    return height, _inside_rim(height, slope, felt, sigma)


def _by_pressure(slope: Array, felt: Mask, strong: Mask, sigma: float, pitch: Array) -> tuple[Array, Mask]:
    """The pressure (H, W), up to a factor, that gives an elastic half-space this ``slope``, and the contact: where there is any.

    A wave of pressure of number k sinks in by 1/k of it (Johnson 1985, 13.2), so pressure is k times the height: the Riesz
    transform of the gradient, as noisy as that and no more.
    """
    height, pressed = _of_gradient(slope, pitch, 2, 1)
    pressed *= _inwards(height, felt)
    mask = (pressed > _PRESSED * np.quantile(pressed[strong], 0.98)) & felt
    mask = _opened(_filled(mask), max(1, round(sigma)))
    return np.maximum(pressed, 0) * felt, mask


def _one_way(along: Array, felt: Mask) -> Array:
    """By how much (H, W) a gel of one colour changes that gets brighter ``along`` (H, W) or darker: a white one as it does where
    it is pressed in most, a grey picture of lit slopes either way."""
    brighter, darker = (max(float(np.quantile(way * along[felt], 0.98)), 0.0) for way in (1, -1))
    if min(brighter, darker) > _EITHER_WAY * max(brighter, darker):
        return np.abs(along)
    return np.maximum(along if brighter > darker else -along, 0)


def _half_as_large(size: Array, felt: Mask) -> tuple[Array, Mask]:
    """``size`` (H, W) where it is felt, and where it is more than half of the largest."""
    size = size * felt
    return size, _filled(size > 0.5 * np.quantile(size[felt], 0.95))


def _by_network(change: Array, image: Array, felt: Mask) -> Array:
    """The probability (H, W) of contact, none where nothing is felt."""
    from geomtact.sensing.mask_network import contact_probability

    return np.asarray(contact_probability(change, image) * felt, float)


def smooth_background(image: Array) -> Array:
    """A background (H, W, 3) for ``image`` (H, W, 3): the smooth surface (degree 5) that most of its pixels lie on."""
    h, w = image.shape[:2]
    along_y, along_x = (np.polynomial.chebyshev.chebvander(np.linspace(-1, 1, n), 5) for n in (h, w))
    terms = [(i, j) for i in range(6) for j in range(6 - i)]
    basis = np.stack([np.outer(along_y[:, i], along_x[:, j]).ravel() for i, j in terms], -1)
    values = image.reshape(-1, 3)
    keep = np.ones(len(values), bool)
    for _ in range(8):
        fit = basis @ np.linalg.lstsq(basis[keep][::7], values[keep][::7], rcond=None)[0]
        error = np.abs(values - fit).sum(1)
        keep = error <= np.quantile(error, 0.7)
    return fit.reshape(image.shape)


def as_unit_rgb(image: Any, name: str) -> Array:
    """An image (H, W, 3), uint8 or float 0..1, or its path, as float32 0..1; what is none is refused under its ``name``."""
    if isinstance(image, str | Path):
        image = read_image(image)[..., :3]
    image = np.asarray(image)
    if image.ndim != 3 or image.shape[2] != 3 or min(image.shape[:2]) < 8:
        raise ImageError(f"{name}: expected an RGB image (H, W, 3), got an array of shape {image.shape}")
    if image.dtype == np.uint8:
        return np.asarray(cv2.LUT(image, (np.arange(256) / 255).astype(np.float32)))
    if image.dtype.kind != "f":
        raise ImageError(f"{name}: expected uint8 or float 0..1, got {image.dtype}; convert it")
    image = image.astype(np.float32)
    if not np.isfinite(image).all() or image.min() < 0 or image.max() > 1:
        raise ImageError(f"{name}: expected finite values from 0 to 1, got NaN or others; divide by the white value")
    return image


def check_size(image: Array, sensor: Sensor, name: str) -> None:
    """Refuse an image (H, W, 3) that is not of the sensor's size."""
    if image.shape[:2] != sensor.image_size_px[::-1]:
        raise ImageError(
            f"{name}: expected {sensor.image_size_px[0]} x {sensor.image_size_px[1]} px for sensor {sensor.name}, "
            f"got {image.shape[1]} x {image.shape[0]} px; name the sensor that took it"
        )


def same_size(background: Array, image: Array) -> Array:
    """The background (H, W, 3); one of another size than the image is refused."""
    if background.shape != image.shape:
        raise ImageError(
            f"background: expected the size of the image, {image.shape[1]} x {image.shape[0]} px, "
            f"got {background.shape[1]} x {background.shape[0]} px; take it with the same sensor"
        )
    return background


def colour_change(image: NDArray[np.floating], background: NDArray[np.floating]) -> tuple[Array, Mask]:
    """The smoothed change (H, W, 3) of an image 0..1 from its background, and where (H, W) it is felt."""
    change, felt, _, _ = _change(image, background, min(image.shape[:2]) / 120)
    return change, felt


def _change(image: Any, background: Any, sigma: float) -> tuple[Array, Mask, Mask, float]:
    """The smoothed change (H, W, 3) from the background, where it is felt and where strongly so, and its noise."""
    smooth = _blurred(image, sigma)
    reference = smooth_background(smooth) if background is None else _blurred(background, sigma)
    change = _without_light_drift(smooth, reference, max(1, round(sigma)))
    # an estimated background is off by more than the noise: what most pixels are off by counts as noise too
    floor = 0.0 if background is not None else float(np.median(_size(change)))
    return change, *_felt(change, sigma, floor)


def _without_light_drift(image: Array, reference: Array, step: int) -> Array:
    """``image`` minus the background, whose brightness is fitted per channel (gain, offset) to the calmer half of one in
    ``step`` pixels each way."""
    gains, offsets = np.empty(3, image.dtype), np.empty(3, image.dtype)
    for c in range(3):
        x, y = (each[::step, ::step, c].ravel() for each in (reference, image))
        calm_x, calm_y = x, y
        for _ in range(6):
            mean_x, mean_y = calm_x.mean(), calm_y.mean()
            dx = calm_x - mean_x
            variance = dx @ dx / dx.size
            gain = np.clip(dx @ calm_y / dx.size / variance, 0.8, 1.25) if variance > _GREY**2 else dx.dtype.type(1)
            offset = mean_y - gain * mean_x
            error = np.abs(y - gain * x - offset)
            calm = np.flatnonzero(error <= np.median(error))
            calm_x, calm_y = x[calm], y[calm]
        gains[c], offsets[c] = gain, offset
    return image - gains * reference - offsets


def _felt(change: Array, sigma: float, floor: float) -> tuple[Mask, Mask, float]:
    """The regions (H, W) that stand out of the noise somewhere, those places, and the noise: hysteresis."""
    step, apart = max(1, round(3 * sigma)), _apart(sigma)
    noise2 = 0.0
    for c in range(3):
        # second differences over three smoothing lengths cancel slopes, and most pixels lie outside any rim
        lines = (a[:, ::apart] for a in (change[..., c], change[..., c].T))
        second = [np.abs(a[2 * step :: apart] - 2 * a[step:-step:apart] + a[: -2 * step : apart]) for a in lines]
        deviation = np.median(np.concatenate([s.ravel() for s in second])) / 0.6745 / np.sqrt(6)
        noise2 += max(float(deviation), 0.25 * _GREY) ** 2
    noise = max(np.sqrt(noise2), floor)
    size = _size(change)
    strong = _opened(size > max(_STRONG * noise, 5 * _GREY), max(1, round(sigma)))
    weak = size > max(_WEAK * noise, 0.05 * float(size.max()))
    weak = _filled(_closed(weak, max(1, round(2 * sigma))))
    n, labels = cv2.connectedComponents(weak.astype(np.uint8), connectivity=4)
    kept = np.bincount(labels[strong], minlength=n) > 0
    kept[0] = False
    return kept[labels], strong, float(noise)


def _slope_field(plane: Array, felt: Mask, sigma: float, pitch: Array) -> Array | None:
    """The gel's slope (H, W, 2) up to a factor, of a change in two colours (H, W, 2); None where these do not tell it."""
    plane = _blurred(plane, sigma)
    some = (slice(None, None, _apart(sigma)),) * 2
    along_y, along_x = (np.gradient(plane, axis=axis)[some] / pitch[1 - axis] for axis in (0, 1))
    curl = np.concatenate([along_y, -along_x], -1)[felt[some]]
    residual, maps = np.linalg.eigh(curl.T @ curl)
    if residual[0] > _CURL_LIMIT * residual[-1]:
        return None
    return _transformed(plane, maps[:, 0].reshape(2, 2))


def integrate(slope: Array, pitch: Array) -> Array:
    """The height (H, W) whose gradient is nearest to ``slope``, mirrored at the border (Frankot, Chellappa 1988)."""
    return _of_gradient(slope, pitch, 2)[0]


def _of_gradient(slope: Array, pitch: Array, *powers: int) -> list[Array]:
    """For each of the ``powers``, the field (H, W) whose waves are those of ``slope`` along their direction, over their number to
    that power less one; mirrored at the border: a sum of cosines, and its slope along an axis one of sines there."""
    from scipy import fft

    h, w = slope.shape[:2]
    kx = (np.pi * np.arange(w) / (w * pitch[0])).astype(slope.dtype)
    ky = (np.pi * np.arange(h)[:, None] / (h * pitch[1])).astype(slope.dtype)
    along_x = _sines(fft.dct(slope[..., 0], axis=0, norm="ortho"), 1)
    along_y = _sines(fft.dct(slope[..., 1], axis=1, norm="ortho"), 0)
    k = np.hypot(kx, ky)
    k[0, 0] = 1.0
    waves = -(kx * along_x + ky * along_y)
    return [np.asarray(fft.idctn(waves / k**power, norm="ortho")) for power in powers]


def _sines(values: Array, axis: int) -> Array:
    """The sine transform of ``values`` along ``axis``, in the order of the cosines, of which the first has no sine."""
    from scipy import fft

    out = np.roll(fft.dst(values, axis=axis, norm="ortho"), 1, axis)
    out[(slice(None),) * axis + (0,)] = 0
    return np.asarray(out)


def _inwards(height: Array, felt: Mask) -> float:
    """1 where the gel is pressed in towards larger ``height`` (H, W), else -1."""
    if (~felt).mean() > 0.15:
        depth = cv2.distanceTransform(felt.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_3)[felt]
        inward = ((height[felt] - height[felt].mean()) * depth).sum()
    else:
        # a contact that fills the window: the dome's difference from the object is curved downwards over most of it
        inward = -np.median(cv2.Laplacian(height, -1)[felt])
    return -1.0 if inward < 0 else 1.0


def _indentation(height: Array, felt: Mask) -> Array:
    """``height`` (H, W) with its zero set: the gel rests where nothing is felt, pressed in elsewhere."""
    unfelt = float((~felt).mean())
    rest = np.median(height[~felt]) if unfelt > 0.05 else np.quantile(height, 0.02)
    return np.maximum(height - rest, 0) * felt


def _inside_rim(height: Array, slope: Array, felt: Mask, sigma: float) -> Mask:
    """Where the walk uphill to the deepest indentation no longer meets a slope much steeper than the one underfoot.

    Inside a contact the gel takes the object's shape; outside it relaxes, and the slope dies away from the rim on.
    """
    steep = np.hypot(slope[..., 0], slope[..., 1])
    ahead = _blurred(_uphill_maximum(height, steep), 2 * sigma)
    share = steep / np.maximum(ahead, 1e-12)
    share[height > 0.6 * float(height.max())] = 1.0
    inside = (height > 0.1 * float(height.max())) & (share >= _steepest_fall(share, felt))
    return _opened(_filled(inside), max(1, round(2 * sigma)))


def _steepest_fall(share: Array, felt: Mask) -> float:
    """The level of ``share`` (H, W) on whose contour it falls fastest in the mean."""
    edges = np.linspace(0.4, 0.9, 21)
    fall = np.hypot(*np.gradient(share))[felt]
    bins = np.searchsorted(edges, share[felt], side="right")
    count = np.bincount(bins, minlength=22)[1:-1]
    mean = np.bincount(bins, fall, minlength=22)[1:-1] / np.maximum(count, 1)
    mean = np.convolve(np.pad(mean, 2, mode="edge"), np.ones(5) / 5, mode="valid")
    return float(edges[int(mean.argmax())] + 0.0125)


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


def _transformed(image: Array, matrix: Array) -> Array:
    """``matrix`` (D, C) applied to each pixel of ``image`` (H, W, C)."""
    return np.asarray(cv2.transform(image, matrix))


def _size(change: Array) -> Array:
    """Of a change of colour (H, W, 3), (H, W)."""
    return np.sqrt(np.einsum("hwc,hwc->hw", change, change))


def _apart(sigma: float) -> int:
    """Pixels from one to the next that tells something else, where all are smoothed by ``sigma``."""
    return max(1, round(1.5 * sigma))


def _blurred(image: Array, sigma: float) -> Any:
    """``image`` (H, W, C) smoothed by ``sigma`` [px], in single precision."""
    return cv2.GaussianBlur(image.astype(np.float32), (0, 0), sigma, borderType=cv2.BORDER_REFLECT)


def _opened(mask: Mask, n: int) -> Mask:
    """``mask`` (H, W) without what is not 2 ``n`` pixels wide."""
    return _morphed(mask, cv2.MORPH_OPEN, n)


def _closed(mask: Mask, n: int) -> Mask:
    """``mask`` (H, W) with what is not 2 ``n`` pixels wide beside it."""
    return _morphed(mask, cv2.MORPH_CLOSE, n)


def _morphed(mask: Mask, operation: int, n: int) -> Mask:
    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    return np.asarray(cv2.morphologyEx(mask.astype(np.uint8), operation, cross, iterations=n), bool)


def _filled(mask: Mask) -> Mask:
    """``mask`` (H, W) with its holes: what cannot be reached from outside the image."""
    around = np.pad(~mask, 1, constant_values=True).astype(np.uint8)
    _, labels = cv2.connectedComponents(around, connectivity=4)
    return np.asarray(labels != labels[0, 0])[1:-1, 1:-1]
