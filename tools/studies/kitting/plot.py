"""How many objects fit their fixture, against its clearance and the touches allowed: drawn from the study's JSON alone."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from geomtact.report.canvas import coloured, png

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_RIGHT, _WRONG, _REFUSED = "#0072B2", "#D55E00", "#DDDDDD"


def draw_kitting(content: Mapping[str, Any]) -> bytes:
    """A PNG: the share placed right against the clearance, and what became of all objects against the touches allowed.

    Parameters
    ----------
    content : of the JSON that ``python -m tools.studies kitting --out`` writes
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure

    parts = content["parts"]
    settings = next(iter(parts.values()))["settings"]
    most, goal = settings["touches"], settings["goal_mm"]
    with mpl.rc_context({"font.size": 9, "axes.titlesize": 10}):
        figure = Figure(figsize=(11, 4.2), dpi=110, layout="constrained", facecolor="white")
        left, right = figure.subplots(1, 2)
        ticks: list[tuple[float, str]] = []
        for k, ((name, part), colour) in enumerate(coloured(parts.items())):
            some = [f for f in part["figures"] if f["touches"] == most and f["n"]]
            share = [100 * f["right"] / f["n"] for f in some]
            low, high = zip(*(f["interval"] for f in some), strict=True)
            bars = [[s - 100 * a for s, a in zip(share, low, strict=True)]]
            bars += [[100 * b - s for s, b in zip(share, high, strict=True)]]
            # side by side, so that the intervals do not overlap
            where = [f["clearance_mm"] * 1.05 ** (k - 0.5 * (len(parts) - 1)) for f in some]
            left.errorbar(where, share, bars, fmt="o-", color=colour, capsize=2, lw=1.4, ms=4, label=name)
            start = k * (most + 1.2)
            _bars(right, start, [f for f in part["figures"] if f["clearance_mm"] == goal and f["n"]])
            ticks += [(start + touches, f"{touches}") for touches in range(1, most + 1)]
            right.text(start + 0.5 * (most + 1), -11, name, ha="center", va="top")
    right.set_xticks(*zip(*ticks, strict=True))
    left.axhline(95, color="0.5", lw=0.8, ls="--")
    left.set_xscale("log")
    left.set_xticks(settings["clearances_mm"], [f"{c:g}" for c in settings["clearances_mm"]])
    left.minorticks_off()
    left.set(ylim=(0, 102), xlabel="clearance of the fixture, on all sides [mm]", ylabel="placed right [%]")
    left.set_title(f"With at most {most} touches of a jaw")
    left.legend(frameon=False, loc="lower right")
    right.set(ylim=(0, 102), ylabel="objects [%]", title=f"At {goal:g} mm clearance, by the touches allowed")
    for label, colour in (("placed right", _RIGHT), ("placed wrong", _WRONG), ("refused", _REFUSED)):
        right.bar(0, 0, color=colour, label=label)
    right.legend(frameon=False, ncols=3, loc="upper center", bbox_to_anchor=(0.5, -0.16))
    for axes in (left, right):
        axes.spines[["top", "right"]].set_visible(False)
    return png(figure)


def _bars(axes: Axes, start: float, figures: list[Mapping[str, Any]]) -> None:
    """A stacked bar for each number of touches, to the right of ``start``."""
    for f in figures:
        bottom = 0.0
        for key, colour in (("right", _RIGHT), ("wrong", _WRONG), ("refused", _REFUSED)):
            share = 100 * f[key] / f["n"]
            axes.bar(start + f["touches"], share, 0.85, bottom=bottom, color=colour)
            bottom += share
