"""How a membrane bulges: what presses of two balls of different size determine, and those of one ball do not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from geomtact.errors import InputError
from geomtact.se3 import Array
from geomtact.sensing.calibrate import SensorCalibration, diameter_from_colours, samples_on, weights_of
from geomtact.sensing.press import Press
from geomtact.sensing.sensor import Sensor

_LEAST_SIZE_RATIO = 1.3  # of the diameters of the two balls
_BEND = 5.0  # half diagonals of the window: radius of a membrane that is tried
_STEPS = 3  # towards the one that is found
_HOLLOW = 4.0  # standard deviations by which a curvature must be below 0 to count as negative
_LEAST_BEND = 1.1  # half diagonals that the membrane's radius has at least
_RESAMPLED = 400


def membrane_curvature(
    first: SensorCalibration, first_ball: float, second: SensorCalibration, second_ball: float
) -> tuple[float, float]:
    """How a membrane bulges, from presses of two balls of different size: its curvature [1/m], and the standard deviation.

    Taken for flat, a membrane that bulges takes so much off the curvature of every ball, which one ball alone leaves unnoticed:
    its colours are fitted to what they are stated to show. Of two balls each is then measured wrongly by the other's colours, the
    larger one as too large. The curvature sought is that with which neither is.

    Parameters
    ----------
    first, second : presses of either ball by one sensor, calibrated each by its own
    first_ball, second_ball : their diameters [m]

    Raises
    ------
    InputError
        The balls are of nearly one size, which determines nothing; or give a bulge that no window of this size has, or a hollow.
    """
    if max(first_ball, second_ball) < _LEAST_SIZE_RATIO * min(first_ball, second_ball):
        raise InputError(
            f"balls of {1e3 * first_ball:g} and {1e3 * second_ball:g} mm determine nothing of the membrane: one should be "
            f"{_LEAST_SIZE_RATIO:g} times as large as the other, or larger"
        )
    balls = ((first.presses, 0.5 * first_ball), (second.presses, 0.5 * second_ball))
    flat = _cross_measured(balls, replace(first.sensor, membrane_radius=0.0))
    half_diagonal = float(np.hypot(*first.sensor.half_window))
    bend = gained = _BEND * half_diagonal

    def curvature(rows: Sequence[NDArray[np.int64]]) -> float:
        return float(np.nanmedian(flat[0][rows[0]]) - np.nanmedian(flat[1][rows[1]])) / gained

    every = [np.arange(len(each)) for each in flat]
    for _ in range(_STEPS):
        bent = _cross_measured(balls, replace(first.sensor, membrane_radius=bend))
        a, b = (there - here for here, there in zip(flat, bent, strict=True))
        # by the diameter of the larger ball, for a curvature of one
        gained = float(np.nanmedian(b) - np.nanmedian(a)) * bend
        bend = 1 / max(curvature(every), 1 / bend / _STEPS)
        if not bend > _LEAST_BEND * half_diagonal:
            raise InputError(
                f"the balls contradict each other: they would have the membrane bulge by 1/{1e3 * bend:.1f} mm, more than a "
                "window of this size can; check both diameters and the pixel pitch"
            )
    rng, found = np.random.default_rng(0), curvature(every)
    drawn = [curvature([rng.integers(len(each), size=len(each)) for each in flat]) for _ in range(_RESAMPLED)]
    std = float(np.std(drawn))
    if found < -_HOLLOW * std:
        raise InputError(
            f"the balls contradict each other: they would have the membrane be hollow, with a curvature of {1e-3 * found:.3f} "
            f"1/mm, standard deviation {1e-3 * std:.3f}; check that the two diameters are not exchanged"
        )
    return found, std


def _cross_measured(balls: Sequence[tuple[Sequence[Press], float]], sensor: Sensor) -> list[Array]:
    """For either ball the log of its diameter on each press, by the colours fitted to the other's presses, over its own."""
    weights = [weights_of([samples_on(press, sensor, radius) for press in presses]) for presses, radius in balls]
    return [
        np.log([diameter_from_colours(press, sensor, other) / (2 * radius) for press in presses])
        for (presses, radius), other in zip(balls, reversed(weights), strict=True)
    ]
