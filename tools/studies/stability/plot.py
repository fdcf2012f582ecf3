"""A picture of how estimates hold as conditions get worse, drawn from the study's JSON alone."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from geomtact.report.canvas import COLOURS, png

_HELD, _BEYOND = COLOURS[0], COLOURS[1]
_PROMISED = 85, 95  # %, of the truths in the 90 % region
_SLANT = 0.6  # rows that the levels of a sweep take


def draw_stability(content: Mapping[str, Any]) -> bytes:
    """A PNG with a row for each sweep: how many truths the 90 % region holds, and how many failures are undetected, at each
    level of all objects together, from the mildest level (above) to the worst (below).

    Levels in the promised range are filled.
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure

    rows = _rows(content)
    with mpl.rc_context({"font.size": 9}):
        figure = Figure(figsize=(10, 0.34 * len(rows) + 1.6), dpi=110, layout="constrained", facecolor="white")
        left, right = figure.subplots(1, 2, sharey=True)
        left.axvspan(*_PROMISED, color="0.92", lw=0)
        for row, (_, sweep) in enumerate(rows):
            points = list(_points(row, sweep))
            for axes, k in ((left, 1), (right, 2)):
                axes.plot([p[k] for p in points], [p[0] for p in points], "-", color="0.7", lw=0.8)
                for point in points:
                    axes.plot(point[k], point[0], "o", ms=4.5, **_style(point[3]))
        left.set_yticks(range(len(rows)), [name for name, _ in rows])
        left.invert_yaxis()
        left.set_xlim(-2, 102)
        left.set_xlabel("true poses in the 90 % region [%]")
        right.set_xlabel("undetected failures [% of the touches]")
        right.set_xlim(left=-1)
        for axes in (left, right):
            axes.grid(axis="y", alpha=0.3)
            axes.spines[["top", "right"]].set_visible(False)
        left.plot([], [], "o", **_style(True), label="promised to hold")
        left.plot([], [], "o", **_style(False), label="beyond")
        figure.legend(loc="outside lower center", ncols=2, frameon=False)
        left.set_title(_regions_found(rows))
        right.set_title(_failures_found(rows))
        return png(figure)


def _style(promised: bool) -> dict[str, str]:
    return {"color": _HELD} if promised else {"color": _BEYOND, "mfc": "white"}


def _rows(content: Mapping[str, Any]) -> list[tuple[str, Mapping[str, Any]]]:
    """Each sweep of all objects together, or of the one object that there is, with its name."""
    together = content.get("together") or next(iter(content["parts"].values()))["sweeps"]
    return list(together.items())


def _points(row: int, sweep: Mapping[str, Any]) -> Iterator[tuple[float, float, float, bool]]:
    """Where each level stands, the share [%] of truths in the 90 % region, that of undetected failures, and whether the level is
    in the promised range."""
    levels = sweep["levels"]
    for k, at in enumerate(levels):
        y = row + _SLANT * (k / max(len(levels) - 1, 1) - 0.5)
        f = at["figures"]
        yield y, 100 * f["coverage"][1]["share"], 100 * f["silent"], at["level"] in sweep["inside"]


def _regions_found(rows: list[tuple[str, Mapping[str, Any]]]) -> str:
    held = [p[1] for row, (_, sweep) in enumerate(rows) for p in _points(row, sweep) if p[3]]
    return f"In the promised range the 90 % region\nholds {min(held):.0f} to {max(held):.0f} % of the true poses"


def _failures_found(rows: list[tuple[str, Mapping[str, Any]]]) -> str:
    silent = [(p[2], p[3]) for row, (_, sweep) in enumerate(rows) for p in _points(row, sweep)]
    within, beyond = (max((s for s, promised in silent if promised == which), default=0.0) for which in (True, False))
    return f"Undetected failures: at most {within:.0f} % in the\npromised range, {beyond:.0f} % beyond it"
