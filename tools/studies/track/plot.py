"""A picture of what the filter adds to single frames, drawn from the study's JSON alone."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from geomtact.report.canvas import coloured, png

LABELS = {"filter": "the filter", "frames": "independent frames", "thesis": "the thesis's filter"}


def draw_track(content: Mapping[str, Any]) -> bytes:
    """A PNG: information frame by frame in the mean, and what the filter adds on each trajectory."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 4), dpi=110, layout="constrained", facecolor="white")
    left, right = figure.subplots(1, 2)
    least = content["figures"]["least_gain"]
    outcomes = [(name, o) for name, part in content["parts"].items() for o in part["outcomes"]]
    for (method, label), colour in coloured(LABELS.items()):
        mean = np.mean([_gain(o, method, least) for _, o in outcomes], axis=0)
        left.plot(np.arange(1, len(mean) + 1), mean, color=colour, label=label)
    left.axhline(0, color="0.4", lw=0.8)
    left.set_xlabel("frame")
    left.set_ylabel("information at the true pose [nats]")
    left.set_title(f"Mean of {len(outcomes)} trajectories")
    left.legend(frameon=False)
    more = [(float(np.mean(_gain(o, "filter", least) - _gain(o, "frames", least))), name) for name, o in outcomes]
    place = 0
    for name, colour in coloured(content["parts"]):
        own = sorted(value for value, part in more if part == name)
        right.bar(np.arange(place, place + len(own)), own, color=colour, label=name)
        place += len(own) + 1
    right.axhline(0, color="0.4", lw=0.8)
    right.set_xticks([])
    right.set_xlabel("trajectories, object by object")
    right.set_ylabel("filter less independent frames [nats]")
    right.set_title("Each trajectory, mean over its frames")
    right.legend(frameon=False, fontsize=8, loc="lower left")
    for axes in (left, right):
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(alpha=0.3, axis="y")
    return png(figure)


def _gain(outcome: Mapping[str, Any], method: str, least: float) -> np.ndarray:
    """Log densities (n,) at the truth; null stands for none, which counts as ``least``."""
    return np.array([least if gain is None else max(gain, least) for gain in outcome["gain"][method]])
