"""What choices bring against what they cost, drawn from the study's JSON alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import cycle
from typing import Any

from geomtact.report.canvas import COLOURS, coloured, png
from tools.studies.common.names import Named, write_names

_SHAPES = ("o", "s", "^", "D", "v", "P", "X")
_DEFAULT, _THESIS = "balanced", "the thesis's network"
_SAME = "calibration"  # a choice that takes the default's time
_TICKS = (-5, -2, -1, -0.5, -0.2, -0.1, 0, 0.1, 0.2, 0.5, 1, 2, 5)  # nats


def draw_costs(content: Mapping[str, Any]) -> bytes:
    """A PNG with a row for each object and, for several, one for their mean: information and error against the time of one touch
    and of three sensors, error of a known contact face, and information against the time of preparing.

    The line joins the Pareto-optimal variants; the default is ringed, the thesis's network boxed.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    rows = {name: _points(part) for name, part in content["parts"].items()}
    if len(rows) > 1:
        rows[f"mean over {len(rows)} parts"] = _mean(list(rows.values()))
    ways = {name: way for part in content["parts"].values() for name, way in part["ways"].items()}
    choices = list(dict.fromkeys(way["choice"] for way in ways.values() if way["choice"] != _SAME))
    looks = dict(zip(choices, zip(cycle(COLOURS), cycle(_SHAPES), strict=False), strict=False))
    panels = (
        ("one touch", "ms", "gain", "time of a touch [ms]", "one touch: information [nats]", 1),
        ("one touch", "ms", "mssd", "time of a touch [ms]", "one touch: median MSSD [mm]", -1),
        ("three sensors", "ms", "gain", "time of three touches [ms]", "three sensors: information [nats]", 1),
        ("three sensors", "ms", "mssd", "time of three touches [ms]", "three sensors: median MSSD [mm]", -1),
        ("known side", "ms", "mssd", "time of a touch [ms]", "known contact face: median MSSD [mm]", -1),
        ("one touch", "ready", "gain", "time of preparing [s]", "one touch: information [nats]", 1),
    )
    judged = [panel for panel in panels if any(panel[0] in points for points in rows.values())]
    width, height = 25 / len(panels) * len(judged), 3.9 * len(rows) + 0.5
    figure = Figure(figsize=(width, height), dpi=90, layout="constrained", facecolor="white")
    canvas = FigureCanvasAgg(figure)
    grid = figure.subplots(len(rows), len(judged), squeeze=False)
    named: list[tuple[Any, list[Named]]] = []
    for line, (title, points) in zip(grid, rows.items(), strict=True):
        for axes, (scene, x, y, xlabel, ylabel, best) in zip(line, judged, strict=True):
            known = {n: (p[x], p[y]) for n, p in points.get(scene, {}).items()}
            some = {n: (a, b) for n, (a, b) in known.items() if a is not None and b is not None}
            if x == "ready":  # most variants are prepared as the default is
                some = {n: p for n, p in some.items() if n == _DEFAULT or p[0] != some[_DEFAULT][0]}
            named.append((axes, _draw(axes, some, {n: looks[ways[n]["choice"]] for n in some}, best)))
            axes.set_xlabel(xlabel)
            axes.set_ylabel(ylabel)
        line[0].set_title(title, loc="left", fontweight="bold")
    handles = [
        figure.axes[0].plot([], [], shape, color=colour, label=choice)[0] for choice, (colour, shape) in looks.items()
    ]
    figure.legend(handles=handles, loc="outside upper center", ncols=len(handles), frameon=False)
    canvas.draw()
    figure.set_layout_engine("none")  # names are placed between the points as these now lie
    for axes, points_here in named:
        write_names(axes, points_here, 6.5)
    return png(figure)


def draw_modelled(content: Mapping[str, Any]) -> bytes:
    """A PNG: the ablations [nats] for each object and kind of scene, with paired 95 % intervals."""
    from matplotlib.figure import Figure

    parts = content["parts"]
    kinds = ("one touch", "three sensors", "known side")
    modelled = {name: {s: p["scenes"].get(s, {}).get("modelled", {}) for s in kinds} for name, p in parts.items()}
    scenes = [s for s in kinds if any(of[s] for of in modelled.values())]
    names = list(dict.fromkeys(n for of in modelled.values() for s in scenes for n in of[s]))
    figure = Figure(
        figsize=(6.2 * len(scenes) + 1, 0.42 * len(names) + 1.4), dpi=100, layout="constrained", facecolor="white"
    )
    grid = figure.subplots(1, len(scenes), squeeze=False, sharey=True)[0]
    for axes, scene in zip(grid, scenes, strict=True):
        for k, ((part, of), colour) in enumerate(coloured(modelled.items())):
            told = of[scene]
            for i, name in enumerate(names):
                if name in told:
                    mean, low, high = told[name]["adds"]
                    y = i + 0.16 * (k - (len(parts) - 1) / 2)
                    axes.errorbar(mean, y, xerr=[[mean - low], [high - mean]], fmt="o", ms=4, color=colour, lw=1)
            axes.plot([], [], "o", color=colour, label=part)
        axes.axvspan(-0.05, 0.05, color="0.9", zorder=0, lw=0)
        axes.axvline(0, color="0.6", lw=0.8)
        axes.set_xscale("symlog", linthresh=0.2, linscale=0.6)
        axes.set_xticks([t for t in _TICKS if axes.get_xlim()[0] <= t <= axes.get_xlim()[1]])
        axes.xaxis.set_major_formatter("{x:g}")
        axes.minorticks_off()
        axes.set_title(scene)
        axes.set_xlabel("adds [nats]; grey: less than 0.05")
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(alpha=0.3, axis="x")
    grid[0].set_yticks(range(len(names)), names)
    grid[0].invert_yaxis()
    grid[0].legend(frameon=False, fontsize=8)
    return png(figure)


def _points(part: Mapping[str, Any]) -> dict[str, dict[str, dict[str, float | None]]]:
    """For each kind of scene the time and gain of each variant, but for those calibrated otherwise: they lie on the default."""
    return {
        scene: {
            name: {
                "ms": f["ms_quantiles"][1],
                "gain": f["gain_mean"],
                "mssd": f["mssd_mm_median"],
                "ready": part["ways"][name]["prepare_s"],
            }
            for name, f in entry["figures"].items()
            if part["ways"][name]["choice"] != _SAME
        }
        for scene, entry in part["scenes"].items()
    }


def _mean(parts: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, dict[str, float | None]]]:
    """The means over all parts of the variants that all have; None where one is missing."""
    out: dict[str, dict[str, dict[str, float | None]]] = {}
    for scene, ways in parts[0].items():
        for name in [each for each in ways if all(each in part[scene] for part in parts)]:
            for key in ways[name]:
                values = [part[scene][name][key] for part in parts]
                mean = None if None in values else sum(values) / len(values)
                out.setdefault(scene, {}).setdefault(name, {})[key] = mean
    return out


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
        axes.plot(x, y, shape, color=colour, ms=5, zorder=3)
        around = {_DEFAULT: "o", _THESIS: "s"}.get(name)
        if around:
            axes.plot(x, y, around, ms=13, mfc="none", mec="black", zorder=2)
    axes.margins(0.12)
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
