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
    left.set_ylabel("information gain [nats]")
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
    left.set_title(_gain_found(content))
    right.set_title(_error_found(content))
    left.legend(frameon=False)
    right.legend(frameon=False, fontsize=9)
    return png(figure)


def _gain_found(content: Mapping[str, Any]) -> str:
    gains = [[f["gain_mean"] for f in part["figures"]] for part in content["parts"].values()]
    ratios = [each[1] / each[0] for each in gains]
    return f"Two sensors gain {min(ratios):.1f} to {max(ratios):.1f} times as much as one"


def _error_found(content: Mapping[str, Any]) -> str:
    most = [part["figures"][-1] for part in content["parts"].values()]
    off = [f["mssd_mm_median"] for f in most]
    return f"{most[0]['sensors']} sensors: the first mode is {min(off):.1f} to {max(off):.1f} mm off"
