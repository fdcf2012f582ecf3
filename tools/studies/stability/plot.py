"""A picture of how estimates hold as conditions get worse, drawn from the study's JSON alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import cycle
from textwrap import fill
from typing import Any

from geomtact.report.canvas import COLOURS, png

_ACROSS = 4
_TOGETHER = "all objects"
_LINE = 50  # letters under an axis
_SEVENTH = "#8C564B"  # colour, of as many objects
_IN_A_ROW = 6  # of the legend


def draw_stability(content: Mapping[str, Any]) -> bytes:
    """A PNG: for each sweep the gain and the expected gain; and below how many truths the 90 % region holds, with the 99 %
    intervals of all objects together, and the share of undetected failures.

    What is promised lies on a light ground. Objects differ by colour; all together are black.
    """
    from matplotlib.figure import Figure

    sweeps = {part: told["sweeps"] for part, told in content["parts"].items()}
    colours = dict(zip(sweeps, cycle((*COLOURS, _SEVENTH)), strict=False))
    names = list(dict.fromkeys(name for some in sweeps.values() for name in some))
    if len(sweeps) > 1:
        sweeps[_TOGETHER], colours[_TOGETHER] = content["together"], "black"
    across = min(_ACROSS, max(1, len(names)))
    down = -(-len(names) // across)
    figure = Figure(figsize=(4.2 * across, 4.4 * down + 0.4), dpi=100, layout="constrained", facecolor="white")
    grid = figure.subplots(2 * down, across, squeeze=False, height_ratios=[3, 2] * down)
    for axes in grid.ravel():
        axes.set_visible(False)
    for number, name in enumerate(names):
        row, column = divmod(number, across)
        pair = grid[2 * row, column], grid[2 * row + 1, column]
        _draw(pair, [(colours[p], some[name]) for p, some in sweeps.items() if name in some])
    handles: list[Any] = [figure.axes[0].plot([], [], "o-", color=c, label=p)[0] for p, c in colours.items()]
    styles = (
        ("o-", "above: gain, below: truths in the 90 % region"),
        ("--", "above: expected gain"),
        (":", "below: undetected failures"),
    )
    handles += [figure.axes[0].plot([], [], style, color="0.4", label=label)[0] for style, label in styles]
    handles.append(figure.axes[0].fill_between([], [], color="0.94", label="promised to hold"))
    figure.legend(handles=handles, loc="outside upper center", ncols=_IN_A_ROW, frameon=False)
    return png(figure)


def _draw(pair: Sequence[Any], parts: Sequence[tuple[str, Mapping[str, Any]]]) -> None:
    """One sweep of each object, with its colour, into the two axes of ``pair``, the last with intervals.

    An object may lack levels that others have.
    """
    nats, shares = pair
    sweep = max((each for _, each in parts), key=lambda each: len(each["levels"]))
    levels = list(dict.fromkeys(at["level"] for each in (sweep, *(e for _, e in parts)) for at in each["levels"]))
    for colour, each in parts:
        figures = [at["figures"] for at in each["levels"]]
        here = [levels.index(at["level"]) for at in each["levels"]]
        nats.plot(here, [f["gain_mean"] for f in figures], "o-", color=colour, ms=4)
        nats.plot(here, [f["claimed_mean"] for f in figures], "--", color=colour)
        held = [f["coverage"][1] for f in figures]
        beyond = [[100 * (c["share"] - c["low"]) for c in held], [100 * (c["high"] - c["share"]) for c in held]]
        last = each is parts[-1][1]
        shares.errorbar(
            here,
            [100 * c["share"] for c in held],
            beyond if last else None,
            fmt="o-",
            color=colour,
            ms=4,
            elinewidth=0.8,
        )
        shares.plot(here, [100 * f["silent"] for f in figures], ":", color=colour)
    for axes in pair:
        axes.set_visible(True)
        for i, level in enumerate(levels):
            if level in sweep["inside"]:
                axes.axvspan(i - 0.5, i + 0.5, color="0.94", zorder=0, lw=0)
        axes.set_xlim(-0.5, len(levels) - 0.5)
        axes.set_xticks(range(len(levels)), [f"{level:g}" for level in levels])
        axes.spines[["top", "right"]].set_visible(False)
    shares.axhline(90, color="0.7", lw=0.8)
    nats.tick_params(labelbottom=False)
    nats.axhline(0, color="0.7", lw=0.8)
    nats.set_ylabel("information [nats]")
    shares.set_ylabel("of all touches [%]")
    shares.set_ylim(-3, 103)
    shares.set_xlabel(fill(sweep["title"], _LINE))
