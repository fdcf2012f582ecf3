"""A picture of how well an object is localized, by number of sensors."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from geomtact.evaluation import Accuracy
from geomtact.report.canvas import COLOURS, coloured, png


def finding(figures: Sequence[Accuracy]) -> str:
    """One sentence on what the figures mean."""
    ends = [figures[0], figures[-1]] if len(figures) > 1 else figures
    reached = [f"{f.error_mm_median:.1f} mm off with {_count(f.sensors)}" for f in ends]
    return f"Half of the most probable poses are at most {' and '.join(reached)}"


def draw_evaluation(figures: Sequence[Accuracy], title: str, mode_radius_mm: float) -> bytes:
    """A PNG: information gain, pose error, coverage and time, each by number of sensors."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 8), dpi=110, layout="constrained", facecolor="white")
    figure.suptitle(f"{title}\n{finding(figures)}", fontsize=11)
    (gain, error), (inside, time) = figure.subplots(2, 2)
    sensors = [f.sensors for f in figures]

    mean = [np.nan if f.information_gain_nats is None else f.information_gain_nats for f in figures]
    wide = [f.standard_error_nats or 0.0 for f in figures]
    gain.errorbar(
        sensors, mean, wide, fmt="o-", capsize=3, color=COLOURS[0], label="at the true pose, with standard error"
    )
    expected = [f.expected_information_gain_nats for f in figures]
    gain.plot(sensors, expected, "s:", mfc="white", color=COLOURS[1], label="expected by the posterior")
    gain.set(ylabel="information gain [nats]", ylim=(0, None))
    gain.set_title("Information gain", fontsize=11)

    for name, style, values in (
        ("90 % of first modes", "^--", [f.error_mm_90_percent for f in figures]),
        ("median first mode", "o-", [f.error_mm_median for f in figures]),
        ("median best of 5 modes", "s:", [f.best_of_5_error_mm_median for f in figures]),
    ):
        error.plot(sensors, values, style, color=COLOURS[0], mfc="white" if style[0] == "s" else None, label=name)
    error.axhline(mode_radius_mm, color="0.5", lw=1, label="mode radius")
    error.set(yscale="log", ylabel="pose error, MSSD [mm]")
    error.yaxis.set_major_formatter("{x:g}")
    error.set_title("Pose error, modulo symmetry", fontsize=11)

    inside.plot([0, 100], [0, 100], color="0.5", lw=1)
    shifts = np.linspace(-1, 1, len(figures)) if len(figures) > 1 else [0.0]
    for (f, colour), shift in zip(coloured(figures), shifts, strict=True):
        level, share, low, high = 100 * np.array([[c.nominal, c.share, c.low, c.high] for c in f.coverage]).T
        inside.errorbar(
            level + shift, share, [share - low, high - share], fmt="o", capsize=2, color=colour, label=_count(f.sensors)
        )
    inside.set(xlim=(40, 100), ylim=(0, 103), xlabel="HPD credible level [%]", ylabel="empirical coverage [%]")
    inside.set_title("Calibration, with 95 % intervals", fontsize=11)

    time.plot(sensors, [f.ms_median for f in figures], "o-", color=COLOURS[0], label="median")
    time.set(ylabel="time of a localization [ms]", ylim=(0, None))
    time.set_title("Time", fontsize=11)

    for axes in (gain, error, time):
        axes.set_xlabel("sensors that touch at once")
        axes.set_xticks(sensors)
    for axes in (gain, error, inside, time):
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(alpha=0.3)
        axes.legend(frameon=False, fontsize=9, loc="lower left" if axes is error else "best")
    return png(figure)


def _count(sensors: int) -> str:
    return "1 sensor" if sensors == 1 else f"{sensors} sensors"
