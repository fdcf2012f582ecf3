"""A picture of what each more sensor adds, drawn from the study's JSON alone (the thesis's Figure 13)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from geomtact.report.canvas import coloured, png


def draw_touches(content: Mapping[str, Any]) -> bytes:
    """A PNG: information and error against the number of sensors, a line for each part."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 4), dpi=110, layout="constrained", facecolor="white")
    left, right = figure.subplots(1, 2)
    for (name, part), colour in coloured(content["parts"].items()):
        figures = part["figures"]
        sensors = [f["sensors"] for f in figures]
        left.plot(sensors, [f["gain_mean"] for f in figures], "o-", color=colour, label=name)
        right.plot(
            sensors, [f["mssd_mm_median"] for f in figures], "o-", color=colour, label=f"{name}, first mode (MSSD)"
        )
        right.plot(sensors, [f["add10_mm_median"] for f in figures], "s:", color=colour, mfc="white")
    left.set_ylabel("information at the true pose [nats]")
    left.set_ylim(bottom=0)
    right.set_yscale("log")
    right.yaxis.set_major_formatter("{x:g}")
    right.set_ylabel("median error [mm]")
    right.plot([], [], "s:", color="0.4", mfc="white", label="best of ten modes (mean point distance)")
    for axes in (left, right):
        axes.set_xlabel("sensors that touch at once")
        axes.set_xticks(sensors)
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(alpha=0.3)
    left.set_title("How much is known")
    right.set_title("How far off the first mode and the best of ten are")
    left.legend(frameon=False)
    right.legend(frameon=False, fontsize=8)
    return png(figure)
