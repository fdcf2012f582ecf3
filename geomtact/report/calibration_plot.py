"""A picture of how well a calibration fits its presses."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from geomtact.report.canvas import COLOURS, png
from geomtact.sensing.calibrate import INNER, ball_slopes
from geomtact.sensing.height import relief

if TYPE_CHECKING:
    from geomtact.sensing.calibrate import SensorCalibration

_SHOWN = 4  # presses


def draw_calibration(found: SensorCalibration, ball_diameter: float) -> bytes:
    """A PNG: some presses with the circles found in them, the depth through each against the ball's, and all slopes against the
    ball's.

    Parameters
    ----------
    ball_diameter : metres
    """
    from matplotlib.figure import Figure

    colour, pitch = found.sensor.colour, found.sensor.pixel_pitch
    assert colour is not None
    some = found.presses[:: max(1, len(found.presses) // _SHOWN)][:_SHOWN]
    figure = Figure(figsize=(12, 8.2), dpi=100, layout="constrained", facecolor="white")
    bands: Any = figure.subfigures(2, 1, height_ratios=[2, 1])
    grid, last = bands[0].subplots(2, _SHOWN), bands[1].subplots(1, 3)
    for axes in grid[:, len(some) :].flat:
        axes.axis("off")
    across = np.linspace(0, 2 * np.pi, 100)
    for (image, profile), press in zip(grid.T, some, strict=False):
        shown = np.clip(0.5 + 1.5 * press.change, 0, 1)
        image.imshow(shown)
        u, v = press.centre
        for share, style in ((1.0, "-"), (INNER, ":")):
            radius = share * press.radius
            image.plot(
                u + radius * np.cos(across), v + radius * np.sin(across) * pitch[0] / pitch[1], style, color="black"
            )
        image.set(xlim=(-0.5, shown.shape[1] - 0.5), ylim=(shown.shape[0] - 0.5, -0.5), xlabel="column [px]")
        image.set_title(press.name.rsplit("/", 1)[-1][-24:], fontsize=9)
        depth = relief(press.change, press.changed, colour, pitch)[round(float(np.clip(v, 0, len(shown) - 1)))]
        x = (np.arange(len(depth)) - u) * pitch[0]
        profile.plot(1e3 * x, 1e3 * depth, color=COLOURS[0], label="from colours")
        ball = 0.5 * ball_diameter
        on = np.abs(x) < INNER * press.radius * pitch[0]
        sphere = np.sqrt(ball**2 - x[on] ** 2)
        profile.plot(
            1e3 * x[on], 1e3 * (sphere + np.median(depth[on] - sphere)), "--", color=COLOURS[1], label="the ball"
        )
        profile.invert_yaxis()
        profile.set(xlabel="x from the centre [mm]")
    grid[0, 0].set_ylabel("row [px]")
    grid[1, 0].set_ylabel("depth [mm]")
    grid[1, 0].legend(frameon=False, fontsize=8)
    measured, true = zip(*(ball_slopes(press, found.sensor, ball_diameter) for press in found.presses), strict=True)
    for k, name in enumerate("xy"):
        axes = last[k]
        axes.hexbin(
            np.concatenate(true)[:, k], np.concatenate(measured)[:, k], gridsize=50, bins="log", cmap="Blues", mincnt=1
        )
        axes.axline((0, 0), slope=1, color="black", lw=0.8)
        axes.set(xlabel=f"slope of the ball along {name}", ylabel="slope measured by colours")
    last[2].hist(1e3 * found.diameters, bins=15, color=COLOURS[0])
    last[2].axvline(1e3 * ball_diameter, color=COLOURS[1], ls="--", label="given")
    last[2].set(xlabel="ball's diameter by each press [mm]", ylabel="presses")
    last[2].legend(fontsize=8)
    return png(figure)
