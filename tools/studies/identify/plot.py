"""A picture of how often the right object is identified, and an unknown one detected, drawn from the study's JSON alone."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from geomtact.report.canvas import coloured, png

_LINES = {
    "right": "the right object is the most probable",
    "foreign": "an unknown object is detected",
    "alarmed": "false alarm: it is among them",
}


def draw_identification(content: Mapping[str, Any]) -> bytes:
    """A PNG: shares of scenes against the number of touches, and the confusion of objects after the last."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 4.6), dpi=110, layout="constrained", facecolor="white")
    left, right = figure.subplots(1, 2)
    figures = content["figures"]
    touches = [f["touches"] for f in figures]
    for (key, label), colour in coloured(_LINES.items()):
        share, low, high = 100 * np.array([f[key] for f in figures]).T
        left.errorbar(touches, share, [share - low, high - share], fmt="o-", capsize=3, color=colour, label=label)
    left.axhline(100 / len(content["parts"]), color="0.5", ls=":", lw=1, label="chance")
    left.set(xticks=touches, ylim=(0, 102), xlabel="touches", ylabel="scenes [%]", title="Object identification")
    left.spines[["top", "right"]].set_visible(False)
    left.legend(frameon=False, fontsize=8, loc="upper left")

    names = list(content["parts"])
    taken = np.zeros((len(names), len(names)))
    for row, name in enumerate(names):
        for some in content["parts"][name]["outcomes"]:
            logs = [some[-1]["log_probability"][other] for other in names]
            taken[row, int(np.argmax([-np.inf if each is None else each for each in logs]))] += 1
    taken /= np.maximum(taken.sum(1, keepdims=True), 1)
    right.imshow(taken, cmap="Blues", vmin=0, vmax=1)
    for (row, column), share in np.ndenumerate(taken):
        if share > 0:
            colour = "white" if share > 0.5 else "black"
            right.text(column, row, f"{100 * share:.0f}", ha="center", va="center", color=colour, fontsize=8)
    right.set_xticks(range(len(names)), names, rotation=35, ha="right")
    right.set_yticks(range(len(names)), names)
    right.set(xlabel="identified as", ylabel="touched", title=f"After {touches[-1]} touches [% of scenes]")
    return png(figure)
