"""A picture of whether posteriors are calibrated, drawn from the study's JSON alone."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from geomtact.report.canvas import coloured, png

_BAND = 1.63  # of a Kolmogorov band that holds 99 % of curves, in 1 / sqrt(n)


def draw_answers(content: Mapping[str, Any]) -> bytes:
    """A PNG: how many truths lie in the region of each mass, and in what is nearer to a pose drawn at random; and how often a
    right mode is among the first ones; a line for each object."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 4.2), dpi=110, layout="constrained", facecolor="white")
    regions, nearer, found = figure.subplots(1, 3)
    for (name, part), colour in coloured(content["parts"].items()):
        for axes, field in ((regions, "level"), (nearer, "tarp")):
            levels = np.sort([outcome[field] for outcome in part["outcomes"]])
            axes.step([0, *levels, 1], np.linspace(0, 1, len(levels) + 2), where="post", color=colour, label=name)
        recall = part["figures"]["all"]["recall"]
        shares = np.array(list(recall.values())).T  # with their intervals
        found.plot([int(k) for k in recall], shares[0], "o-", color=colour)
        found.fill_between([int(k) for k in recall], *shares[1:], color=colour, alpha=0.15, lw=0)
    n = min(len(part["outcomes"]) for part in content["parts"].values())
    for axes, title in (
        (regions, "in the posterior's region of that mass"),
        (nearer, "nearer to a random pose than so much of it"),
    ):
        mass = np.array([0.0, 1.0])
        axes.fill_between(mass, mass - _BAND / np.sqrt(n), mass + _BAND / np.sqrt(n), color="0.9", lw=0)
        axes.plot(mass, mass, color="0.5", lw=1)
        axes.set(xlim=(0, 1), ylim=(0, 1), xlabel="mass of the posterior", ylabel="share of true poses")
        axes.set_title(title, fontsize=10)
        axes.set_aspect("equal")
    found.set(xscale="log", xlabel="first modes", ylabel="share of touches")
    found.set_title("a right mode among the first ones", fontsize=10)
    found.set_ylim(bottom=0)
    found.set_xticks([1, 2, 5, 10], ["1", "2", "5", "10"], minor=False)
    found.set_xticks([], minor=True)
    for axes in (regions, nearer, found):
        axes.spines[["top", "right"]].set_visible(False)
    regions.legend(frameon=False, fontsize=8, loc="lower right")
    return png(figure)
