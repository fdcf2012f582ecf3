"""A picture of how the errors of one touch from a known contact face are distributed, drawn from the study's JSON
alone (the thesis's Figure 12)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from geomtact.report.canvas import png

_ROWS = {
    "best": "best",
    "refined best": "refined\nbest",
    "answer": "answer",
    "best10": "best10",
    "answer10": "answer10",
}
_COLOURS = ("#0072B2", "#56B4E9", "#D55E00", "#009E73", "#A6D854")
_BIN, _MOST = 0.05, 1.6  # normalised error


def draw_thesis(content: Mapping[str, Any]) -> bytes:
    """A PNG: for each object, and before and after refinement, how many touches have which normalised error."""
    from matplotlib.figure import Figure

    parts = content["parts"]
    figure = Figure(figsize=(4.2 * len(parts) + 0.4, 4.6), dpi=110, layout="constrained", facecolor="white")
    edges = np.arange(0, _MOST + _BIN, _BIN)
    for axes, (name, part) in zip(
        figure.subplots(1, len(parts), sharey=True, squeeze=False)[0], parts.items(), strict=True
    ):
        outcomes = part["outcomes"]
        random = np.array([o["random_mm"] for o in outcomes])
        error = np.array([o["error_mm"] for o in outcomes]) / random[:, None]
        for at, (row, colour) in enumerate(zip(_ROWS, _COLOURS, strict=True)):
            values = error[:, list(part["figures"]).index(row)]
            count, _ = np.histogram(np.minimum(values, _MOST - 1e-9), edges)
            share = 0.45 * count / count.max()
            axes.barh(edges[:-1], 2 * share, _BIN, at - share, align="edge", color=colour)
            axes.plot([at - 0.45, at + 0.45], [np.median(values)] * 2, color="k", lw=1.4, ls=(0, (2, 1)))
        axes.axhline(1, color="k", lw=1.0)
        sides = random.reshape(len(part["granularity_mm"]), -1)[:, 0]
        axes.axhline(float(np.mean(np.array(part["granularity_mm"]) / sides)), color="#CC0000", lw=1.0)
        axes.set_title(f"{name} ({len(outcomes)} touches)")
        axes.set_xticks(range(len(_ROWS)), list(_ROWS.values()), fontsize=8)
        axes.spines[["top", "right"]].set_visible(False)
        axes.set(xlim=(-0.6, len(_ROWS) - 0.4), ylim=(0, _MOST))
    first = figure.axes[0]
    first.set_ylabel("error over that of a random guess (ADD)")
    lines = {"median": ("k", (0, (2, 1))), "a random guess": ("k", "-"), "the grid's neighbours": ("#CC0000", "-")}
    handles = [first.plot([], [], color=colour, ls=style, label=label)[0] for label, (colour, style) in lines.items()]
    figure.legend(handles=handles, loc="outside upper center", ncols=len(handles), frameon=False)
    return png(figure)
