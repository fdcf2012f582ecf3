"""Information gain and error of each choice against its time, drawn from the study's JSON alone."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import cycle
from statistics import geometric_mean
from typing import Any

import numpy as np

from geomtact.report.canvas import COLOURS, coloured, png
from tools.studies.common.names import Named, write_names

_SHAPES = ("o", "s", "^", "D", "v", "P", "X")
_DEFAULT, _GRID_ALONE, _THESIS = "balanced", "the grid alone", ("the thesis's network", "the grid alone, cosine")
_SCENES = ("one touch", "three sensors")
_FONT = 9
# key of a figure, its axis, and 1 where more of it is better
_PANELS = (("gain_mean", "information gain [nats]", 1), ("mssd_mm_median", "median error of mode 1, MSSD [mm]", -1))


def draw_costs(content: Mapping[str, Any]) -> bytes:
    """A PNG of four panels: information gain and error of mode 1 against the time of one touch and of three sensors, in the mean
    over all objects.

    The line joins the Pareto-optimal variants; the default is ringed, the thesis's way of comparing contacts boxed.
    """
    import matplotlib as mpl
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    parts = list(content["parts"].values())
    choices = {name: variant["choice"] for part in parts for name, variant in part["variants"].items()}
    looks = dict(zip(dict.fromkeys(choices.values()), zip(cycle(COLOURS), cycle(_SHAPES), strict=False), strict=False))
    scenes = [scene for scene in _SCENES if all(scene in part["scenes"] for part in parts)]
    with mpl.rc_context({"font.size": _FONT}):
        figure = Figure(figsize=(5.2 * len(scenes), 8), dpi=110, layout="constrained", facecolor="white")
        canvas = FigureCanvasAgg(figure)
        grid = figure.subplots(len(_PANELS), len(scenes), squeeze=False)
        named: list[tuple[Any, list[Named]]] = []
        shown = set()
        for column, scene in zip(grid.T, scenes, strict=True):
            for axes, (key, label, best) in zip(column, _PANELS, strict=True):
                points = means(content, scene, key)
                shown |= {choices[name] for name in points}
                named.append((axes, _draw(axes, points, {n: looks[choices[n]] for n in points}, best)))
                axes.set_xlabel("time [ms]")
                axes.set_ylabel(label)
            column[0].set_title(_finding(scene, means(content, scene, "gain_mean")), loc="left", fontsize=_FONT + 1)
        handles = [
            figure.axes[0].plot([], [], shape, color=colour, label=choice)[0]
            for choice, (colour, shape) in looks.items()
            if choice in shown
        ]
        figure.legend(handles=handles, loc="outside upper center", ncols=len(handles), frameon=False)
        canvas.draw()
        figure.set_layout_engine("none")  # names are placed between the points as these now lie
        for axes, points_here in named:
            write_names(axes, points_here, _FONT)
        return png(figure)


def draw_ablations(content: Mapping[str, Any]) -> bytes:
    """A PNG: the gain of each choice [nats] for each object and kind of scene, with paired 95 % intervals."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    parts = content["parts"]
    scenes = list(dict.fromkeys(scene for part in parts.values() for scene in part["scenes"]))
    found = {
        name: {scene: part["scenes"].get(scene, {}).get("ablations", {}) for scene in scenes}
        for name, part in parts.items()
    }
    scenes = [scene for scene in scenes if any(of[scene] for of in found.values())]
    names = list(dict.fromkeys(name for of in found.values() for scene in scenes for name in of[scene]))
    with mpl.rc_context({"font.size": _FONT}):
        size = 3.6 * len(scenes) + 2.5, 0.42 * len(names) + 1.4
        figure = Figure(figsize=size, dpi=110, layout="constrained", facecolor="white")
        grid = figure.subplots(1, max(len(scenes), 1), squeeze=False, sharey=True)[0]
        for axes, scene in zip(grid, scenes, strict=False):
            for k, ((part, of), colour) in enumerate(coloured(found.items())):
                for i, name in enumerate(names):
                    if name in of[scene]:
                        mean, low, high = of[scene][name]["gain"]
                        y = i + 0.16 * (k - (len(parts) - 1) / 2)
                        axes.errorbar(mean, y, xerr=[[mean - low], [high - mean]], fmt="o", ms=4, color=colour, lw=1)
                axes.plot([], [], "o", color=colour, label=part)
            axes.axvspan(-0.05, 0.05, color="0.9", zorder=0, lw=0)
            axes.axvline(0, color="0.6", lw=0.8)
            axes.set_title(scene, fontsize=_FONT)
            axes.set_xlabel("gain [nats]")
            axes.spines[["top", "right"]].set_visible(False)
            axes.grid(alpha=0.3, axis="x")
        grid[0].set_yticks(range(len(names)), names)
        grid[0].invert_yaxis()
        grid[0].legend(frameon=False)
        return png(figure)


def means(content: Mapping[str, Any], scene: str, key: str) -> dict[str, tuple[float, float]]:
    """Time [ms] and a figure of each variant that all objects have, in the mean over them; errors and times are multiplied."""
    each = [part["scenes"][scene]["figures"] for part in content["parts"].values()]
    out = {}
    for name in [name for name in each[0] if all(name in figures for figures in each)]:
        values = [figures[name][key] for figures in each]
        if None not in values:
            ms = geometric_mean([figures[name]["ms_quantiles"][1] for figures in each])
            out[name] = ms, float(np.mean(values)) if key == "gain_mean" else geometric_mean(values)
    return out


def _finding(scene: str, gains: Mapping[str, tuple[float, float]]) -> str:
    if _GRID_ALONE not in gains:
        return scene
    more, ratio = gains[_DEFAULT][1] - gains[_GRID_ALONE][1], gains[_DEFAULT][0] / gains[_GRID_ALONE][0]
    return f"{scene}: balanced gains {more:.1f} nats more than\nthe grid alone, in {ratio:.0f} times the time"


def _draw(axes: Any, points: Mapping[str, tuple[float, float]], looks: Mapping[str, Any], best: int) -> list[Named]:
    """Points (time, value) and the front, and what is to be named; ``best`` is 1 where more is better."""
    from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter

    front: list[tuple[float, float]] = []
    for x, y in sorted(points.values(), key=lambda p: (p[0], -best * p[1])):
        if not front or best * y > best * front[-1][1]:
            front.append((x, y))
    axes.plot(*zip(*front, strict=True), color="0.75", lw=1, zorder=1, drawstyle="steps-post")
    for name, (x, y) in points.items():
        colour, shape = looks[name]
        axes.plot(x, y, shape, color=colour, ms=6, zorder=3)
        around = "o" if name == _DEFAULT else "s" if name in _THESIS else None
        if around:
            axes.plot(x, y, around, ms=13, mfc="none", mec="black", zorder=2)
    axes.margins(0.14)
    axes.set_xscale("log")
    if best < 0:
        axes.set_yscale("log")
    for axis in (axes.xaxis, axes.yaxis) if best < 0 else (axes.xaxis,):
        low, high = axis.get_view_interval()
        ticks = (1,) if high > 1000 * low else (1, 3) if high > 100 * low else (1, 2, 5)
        axis.set_major_locator(LogLocator(subs=ticks) if high > 5 * low else MaxNLocator(5))
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter(NullFormatter())
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(alpha=0.25)
    return [Named(name, looks[name][0], x, y) for name, (x, y) in points.items()]
