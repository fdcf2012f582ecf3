"""A picture of how soon touches make sure, chosen or random, drawn from the study's JSON alone."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from geomtact.report.canvas import png

_STYLES = {
    "best": ("#0072B2", "-", "touches chosen for the most expected information"),
    "random": ("#D55E00", "--", "at random"),
}


def draw_touches_until_sure(content: Mapping[str, Any]) -> bytes:
    """A PNG: for each object, the share of runs that are sure after each number of touches."""
    from matplotlib.figure import Figure

    parts = content["parts"]
    figure = Figure(figsize=(3.1 * len(parts), 3.6), dpi=110, layout="constrained", facecolor="white")
    for axes, (name, part) in zip(
        figure.subplots(1, len(parts), squeeze=False, sharey=True)[0], parts.items(), strict=True
    ):
        for policy, (colour, line, label) in _STYLES.items():
            share = part["figures"][policy]["sure_after"]
            axes.step(range(len(share)), [100 * s for s in share], line, where="post", color=colour, label=label)
        axes.set_title("{}: {:.2f} times the touches".format(name, part["figures"]["ratio"][0]), fontsize=10)
        axes.set_xlabel("touches after the first")
        axes.set_ylim(0, 102)
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(alpha=0.3)
    figure.axes[0].set_ylabel("runs in which one mode holds 95 % [%]")
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=2, frameon=False)
    return png(figure)
