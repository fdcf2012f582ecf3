"""Calibrating a sensor's colours: from presses of one ball, the gel's slope by its colour (photometric stereo).

Under the ball the gel has the ball's shape (``ball``), so the slope is given all over the contact once its centre is: that of the
circle which the contact's outline is (``press``). The outline is that of the imprint, which is wider than the contact: only the
inner part is used, and no depth is needed, but for a near camera. The pixel pitch must be given: a ball of another size, seen
by another pitch, looks the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import binary_erosion

from geomtact.errors import InputError, UsageError
from geomtact.se3 import Array
from geomtact.sensing.ball import OnBall, from_middle
from geomtact.sensing.change import check_size
from geomtact.sensing.colour import ColourTable, fit_weights, kept, terms
from geomtact.sensing.height import relief
from geomtact.sensing.noise import correlation_length
from geomtact.sensing.press import SAME, Press, find_presses, named_image
from geomtact.sensing.sensor import Sensor

_FEWEST = 3  # presses
INNER = 0.6  # share of the imprint's radius within which the gel surely lies on the ball
_MEASURED = 0.5  # share of it within which the ball is measured
_OUTER = 2.2  # times the imprint's radius, beyond which the gel is flat
_PIXELS, _FLAT_PIXELS = 3000, 1000  # of a press that are used, at most
_EVERYWHERE = 0.9  # share of presses that may change one place: more, and all lie there or the background shows one
_SPAN = 0.5  # of the window along each side, over which presses should be spread
_AGREES, _HOPELESS = 0.1, 2.0  # by which presses may measure the ball wrongly, in the median: unnoticed, and at most
_APART = 0.4  # by which one press may measure it otherwise than the median of them


@dataclass(frozen=True, eq=False)
class SensorCalibration:
    """A calibrated sensor, and how well the presses agree with it.

    Attributes
    ----------
    sensor : with its colours
    presses : that were used
    left_out : why others were not, by their names
    diameters : (n,) of the ball [m], measured on each press by a table that was fitted to the others
    warnings : signs of a poor calibration, one line each
    """

    sensor: Sensor
    presses: list[Press]
    left_out: dict[str, str]
    diameters: Array
    warnings: list[str]


def calibrate(
    presses: Sequence[Any],
    ball_diameter: float,
    background: Any,
    pixel_pitch: float | tuple[float, float] | None = None,
    sensor: Sensor | str | None = None,
    name: str | None = None,
) -> Sensor:
    """A sensor whose colours give depths, from presses of one ball; :func:`calibrate_sensor` also returns how well.

    Parameters
    ----------
    presses : images (H, W, 3) RGB, or their paths, of one ball pressed in at several places, three at least; a dozen are better
    ball_diameter : metres
    background : the same sensor without contact: an image (H, W, 3) RGB, or its path
    pixel_pitch : of the images [m], or along x and along y; that of ``sensor`` by default
    sensor : whose geometry to keep, by name, file or itself; by default an orthographic, flat one of the images' size
    name : of the new sensor

    Raises
    ------
    UsageError
        Fewer than three images were given; the diameter or the pitch is not in metres; or neither a pitch nor a sensor was given:
        presses of unknown depth do not determine the pitch. The largest possible is named.
    InputError
        Fewer than three images show the whole round imprint of a ball that may be so large; or what they show is contradictory.
    ImageError, SensorError
        An image, or the sensor, cannot be read.
    """
    return calibrate_sensor(presses, ball_diameter, background, pixel_pitch, sensor, name).sensor


def calibrate_sensor(
    presses: Sequence[Any],
    ball_diameter: float,
    background: Any,
    pixel_pitch: float | tuple[float, float] | None = None,
    sensor: Sensor | str | None = None,
    name: str | None = None,
) -> SensorCalibration:
    """As :func:`calibrate`, with what it rests on."""
    if isinstance(presses, str | Path) or len(presses) < _FEWEST:
        given = "one path" if isinstance(presses, str | Path) else f"{len(presses)}"
        raise UsageError(
            f"presses: expected a list of {_FEWEST} images or more, got {given}; press the ball in at a dozen places"
        )
    if not (np.isfinite(ball_diameter) and 1e-4 < ball_diameter < 0.1):
        raise UsageError(f"ball_diameter: expected metres, 0.0001 to 0.1, got {ball_diameter}; 6.31 mm is 0.00631")
    mounted = None if sensor is None else Sensor.load(sensor)
    reference = named_image(background, "background", mounted)[1]
    pitch = mounted.pixel_pitch if pixel_pitch is None and mounted is not None else pixel_pitch
    found, left_out = find_presses(presses, reference, None if pitch is None else _pair(pitch), mounted)
    radius = 0.5 * ball_diameter
    # the pitch with which no imprint is wider than the ball
    most = radius / max((press.radius for press in found), default=np.inf)
    if pitch is None:
        bound = f"; it is at most {1e3 * most:.4f} mm, the ball's radius over the largest imprint's" if found else ""
        raise UsageError(
            "pixel_pitch: none was given (--pitch-mm, --pins or --sensor), and presses of unknown depth do not give it: measure "
            f"how many pixels a known length takes on the membrane{bound}"
        )
    pitch = _pair(pitch)
    for press in [p for p in found if p.radius * pitch[0] >= radius]:
        left_out[press.name] = f"an imprint of {2e3 * press.radius * pitch[0]:.2f} mm is wider than the ball"
        found.remove(press)
    if len(found) < _FEWEST:
        why = "; ".join(f"{name}: {reason}" for name, reason in list(left_out.items())[:3])
        raise InputError(
            f"calibrate: {_FEWEST} presses or more are needed, {len(found)} of {len(presses)} serve ({why})"
        )
    _check_rest(found)
    base = mounted or Sensor("calibrated", reference.shape[1::-1], pitch, 0.0, 2e-3)
    check_size(reference, base, "background")
    sensor, diameters = _fitted(found, replace(base, name=name or base.name, pixel_pitch=pitch), radius)
    assert sensor.colour is not None
    sensor = replace(sensor, colour=replace(sensor.colour, background=kept(reference)))
    off = float(np.nanmedian(diameters)) / ball_diameter - 1 if np.isfinite(diameters).any() else np.inf
    if not abs(off) < _HOPELESS:
        raise InputError(
            f"calibrate: {len(found)} presses contradict each other: colours fitted to all but one measure the ball "
            f"{100 * abs(off):.0f} % wrongly on that one; press one ball in a dozen times, all over the window"
        )
    without_ball = sum(why != SAME for why in left_out.values())
    warnings = []
    if pitch[0] > most:
        warnings = [
            f"some imprints are wider than the ball, which allows a pitch of {1e3 * most:.4f} mm at most; {1e3 * pitch[0]:.4f} "
            "was given: measure it, and the ball"
        ]
    return SensorCalibration(
        sensor, found, left_out, diameters, [*warnings, *_warnings(found, without_ball, diameters, off)]
    )


def _check_rest(presses: Sequence[Press]) -> None:
    """Refuse presses of which nearly all change one place, as they do against a background in which something is pressed in."""
    everywhere = np.mean([press.changed for press in presses], axis=0) >= _EVERYWHERE
    if everywhere.sum() > np.pi * np.median([press.radius for press in presses]) ** 2:
        v, u = (int(np.median(each)) for each in np.nonzero(everywhere))
        raise InputError(
            f"calibrate: nearly all presses differ from the background around column {u}, row {v}: it was taken with something "
            "pressed in there, under other light, or all presses lie there; take it without contact just before the presses, and "
            "press all over the window"
        )


def _fitted(presses: list[Press], sensor: Sensor, radius: float) -> tuple[Sensor, Array]:
    """``sensor`` with the colours of a ball of ``radius`` [m], and its diameter (n,) [m] on each press by the others."""
    samples = [samples_on(press, sensor, radius) for press in presses]
    diameters, slope_rms, height_noise, correlation = _left_one_out(presses, samples, sensor, radius)
    x, y = (tuple(map(float, row)) for row in weights_of(samples))
    colour = ColourTable((x, y), slope_rms, 0.0, 0.0)
    noise, depth = _at_rest(presses, colour, sensor.pixel_pitch)
    colour = replace(colour, height_rms=noise, contact_depth=depth)
    return replace(sensor, colour=colour, height_noise=height_noise, height_correlation=correlation), diameters


def _warnings(presses: Sequence[Press], without_ball: int, diameters: Array, off: float) -> list[str]:
    """The warnings of a calibration by these presses; ``without_ball`` further images show no ball of that size.

    The other presses measure the ball's ``diameters`` (n,) [m] on each, NaN where they see none, wrongly by a share ``off`` in
    the median.
    """
    out = []
    if without_ball > len(presses):
        out.append(
            f"on {without_ball} presses no ball of that size was found, on {len(presses)} it was: depths may be wrong; see why "
            "each is left out, and press one ball in a dozen times, not deeper than to its middle, wholly within the window"
        )
    window = np.array(presses[0].mask.shape[::-1])
    spans = np.ptp([press.centre for press in presses], axis=0) / window
    if spans.min() < _SPAN:
        out.append(
            f"the presses lie within {100 * spans[0]:.0f} % of the window's width and {100 * spans[1]:.0f} % of its height: "
            "elsewhere depths may be far off; press the ball in all over"
        )
    if abs(off) > _AGREES:
        out.append(
            f"colours fitted to all presses but one measure the ball {100 * abs(off):.0f} % too "
            f"{'large' if off > 0 else 'small'} on that one: too few presses, or not all of one ball; press it in a dozen times, "
            "all over the window"
        )
    like_most = np.abs(diameters / np.nanmedian(diameters) - 1) <= _APART
    outliers = [press.name for press, fits in zip(presses, like_most, strict=True) if not fits]
    if outliers:
        named = ", ".join(outliers[:3]) + (f" and {len(outliers) - 3} more" if len(outliers) > 3 else "")
        out.append(
            f"on {named} no ball is seen, or one more than {100 * _APART:.0f} % larger or smaller than on most presses: look "
            "whether the contact is whole and of the same ball, and leave out what is not"
        )
    return out


def _pair(pitch: float | tuple[float, float]) -> tuple[float, float]:
    x, y = np.broadcast_to(np.asarray(pitch, float), 2)
    if not (min(x, y) > 1e-6 and max(x, y) < 1e-2):
        raise UsageError(f"pixel_pitch: expected metres, 0.000001 to 0.01, got {pitch}; 0.0634 mm is 0.0000634")
    return float(x), float(y)


def samples_on(press: Press, sensor: Sensor, radius: float) -> tuple[Array, Array]:
    """Terms (n, ``TERMS``) and slopes (n, 2) of pixels on a ball of ``radius`` [m], and of pixels far from it: at rest."""
    on = OnBall.within(press, sensor, INNER)
    some = np.random.default_rng(0).permutation(len(on.xy))[:_PIXELS]
    apart = np.linalg.norm(from_middle(press, sensor), axis=-1)
    v, u = np.nonzero(apart > _OUTER * press.radius * sensor.pixel_pitch[0])
    far = np.random.default_rng(0).permutation(len(v))[:_FLAT_PIXELS]
    flat = terms(press.change[v[far], u[far]], u[far], v[far], press.mask.shape)
    slopes = np.concatenate([on.slopes(radius)[some], np.zeros((len(far), 2))])
    return np.concatenate([on.features[some], flat]), slopes


def weights_of(samples: Sequence[tuple[Array, Array]]) -> Array:
    """Weights (2, ``TERMS``) fitted to terms and slopes of several presses."""
    return fit_weights(np.concatenate([f for f, _ in samples]), np.concatenate([s for _, s in samples]))


def _left_one_out(
    presses: Sequence[Press], samples: Sequence[tuple[Array, Array]], sensor: Sensor, radius: float
) -> tuple[Array, float, float, float]:
    """By the others' colours: the ball's diameter (n,) [m] on each press, and how far off slopes (rms) and depths [m] (median
    of the presses' rms, their offset aside) are on a ball of ``radius`` [m], and over what length [m] depths are."""
    diameters, squares, beside = np.zeros(len(presses)), [], []
    for i, press in enumerate(presses):
        weights = weights_of([s for k, s in enumerate(samples) if k != i])
        x, y = (tuple(map(float, row)) for row in weights)
        on = OnBall.within(press, sensor, INNER)
        depths = relief(press.change, press.changed, ColourTable((x, y), 0, 0, 0), sensor.pixel_pitch)
        off = depths[on.at] - on.height(radius)
        image = np.full(np.ptp(on.at, axis=1) + 1, np.nan)
        image[tuple(np.array(on.at) - np.min(on.at, axis=1, keepdims=True))] = off - off.mean()
        beside.append(image)
        features, true = samples[i]
        sloping = true.any(1)
        squares.append(((features[sloping] @ weights.T - true[sloping]) ** 2).mean())
        diameters[i] = diameter_from_colours(press, sensor, weights)
    return (
        diameters,
        float(np.sqrt(np.mean(squares))),
        float(np.median([np.nanstd(image) for image in beside])),
        correlation_length(beside, sensor.pixel_pitch),
    )


def ball_slopes(press: Press, sensor: Sensor, ball_diameter: float) -> tuple[Array, Array]:
    """Slopes (n, 2) that the colours of a calibrated sensor give on the inner part of a press, and those of the ball."""
    assert sensor.colour is not None
    on = OnBall.within(press, sensor, INNER)
    return on.features @ np.asarray(sensor.colour.weights).T, on.slopes(0.5 * ball_diameter)


def measured_diameter(press: Press, sensor: Sensor) -> float:
    """Diameter [m] of the ball of a press, by the colours of a calibrated sensor."""
    assert sensor.colour is not None
    return diameter_from_colours(press, sensor, np.asarray(sensor.colour.weights))


def diameter_from_colours(press: Press, sensor: Sensor, weights: Array) -> float:
    """Diameter [m] of the ball of a press, as ``weights`` (2, ``TERMS``) of colours give it."""
    on = OnBall.within(press, sensor, _MEASURED)
    return on.diameter(on.features @ weights.T)


def _at_rest(presses: Sequence[Press], colour: ColourTable, pitch: tuple[float, float]) -> tuple[float, float]:
    """How far (rms) from 0 the depth is outside of the contact, and how deep it is at the border of the contact [m]: medians."""
    noise, depth = [], []
    for press in presses:
        below = relief(press.change, press.changed, colour, pitch)
        border = press.mask & ~binary_erosion(press.mask, border_value=1)
        depth.append(float(np.median(below[border])))
        if not press.changed.all():
            noise.append(float(np.sqrt((below[~press.changed] ** 2).mean())))
    return float(np.median(noise)) if noise else 0.0, max(0.0, float(np.median(depth)))
