"""A picture of the study ``adaptive``, from its JSON alone."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from geomtact.report.canvas import coloured, png

_TARGET = 4.0  # nats at 100,000 contacts that opening cells was to reach


def draw_adaptive(content: Mapping[str, Any]) -> bytes:
    """A PNG: information gain against contacts, by opening cells and by sampling, a colour for each object."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 4.2), dpi=110, layout="constrained", facecolor="white")
    opened, sampled = figure.subplots(1, 2, sharey=True)
    for (name, part), colour in coloured(content["parts"].items()):
        f = part["figures"]
        gains = [each[-1] for each in f["opened_gain"]]
        opened.plot(f["budgets"], gains, "o-", color=colour, ms=4, label=name)
        contacts = [each["contacts"] for each in f["sampled"]]
        sampled.plot(contacts, [each["gain"] for each in f["sampled"]], "o-", color=colour, label=name)
        sampled.plot(contacts, [each["expected_gain"] for each in f["sampled"]], "s:", color=colour, mfc="white")
    sampled.plot([], [], "s:", color="0.4", mfc="white", label="expected by the posterior")
    opened.set_title("Opening cells: 4 nats take 100,000 to 1,000,000 contacts", fontsize=10)
    sampled.set_title("Sampling the density: 8 to 9 nats", fontsize=10)
    opened.set_ylabel("information gain [nats]")
    for axes in (opened, sampled):
        axes.set_xscale("log")
        axes.set_xlim(8e2, 4e6)
        axes.set_xlabel("contacts evaluated for a touch")
        axes.axhline(_TARGET, color="0.6", lw=1, ls="--")
        axes.set_ylim(bottom=0)
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(alpha=0.3)
        axes.legend(frameon=False, fontsize=9)
    return png(figure)
