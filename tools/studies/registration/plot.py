"""From how far off each method finds home: a picture of ``python -m tools.studies registration``, from its JSON alone."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from typing import Any

import numpy as np

from geomtact.report.canvas import COLOURS, png
from geomtact.se3 import Array
from tools.studies.registration.study import OWN

_NAMES = {
    "none": "start, not registered",
    "icp": "ICP (Open3D's, checked)",
    "filterreg": "FilterReg (geomtact)",
    "both": "FilterReg, then ICP",
    "thesis": "the thesis's FilterReg",
}
_OURS, _GREY = "filterreg", "0.55"
_STYLES = ("-", "--", "-.", ":")


def draw_registration(content: Mapping[str, Any]) -> bytes:
    """PNG with two panels: the share of starts from which each method finds the truth, against how far the start is turned
    [degrees] and shifted [mm], over all kinds of contact and the starts of the other panel's axis.

    Parameters
    ----------
    content : of the JSON that ``python -m tools.studies registration --out`` writes
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure

    settings = next(iter(content["parts"].values()))["settings"]
    with mpl.rc_context({"font.size": 9}):
        figure = Figure(figsize=(10, 4.2), dpi=110, layout="constrained", facecolor="white")
        axes = figure.subplots(1, 2, sharey=True)
        for each, key, words in zip(axes, ("turn_deg", "shift_mm"), ("turned [°]", "shifted [mm]"), strict=True):
            for i, (name, (at, shares)) in enumerate(_by(content, key).items()):
                ours = name == _OURS
                colour = COLOURS[0] if ours else COLOURS[1 + i % (len(COLOURS) - 1)]
                each.plot(
                    range(len(at)),
                    100 * shares,
                    "o-" if ours else _STYLES[i // len(COLOURS) % len(_STYLES)],
                    color=_GREY if name == "none" else colour,
                    lw=2.5 if ours else 1.2,
                    ms=4,
                    label=_NAMES.get(name, name),
                )
            each.set_xticks(range(len(at)), [f"{level:g}" for level in at])
            each.set_xlabel(f"start, {words}")
            each.grid(alpha=0.3)
            each.spines[["top", "right"]].set_visible(False)
        axes[0].set_ylabel(f"ends within {settings['success_mm']:g} mm [% of starts]")
        axes[0].set_ylim(0, 100)
        figure.suptitle(_found(content))
        figure.legend(*axes[0].get_legend_handles_labels(), loc="outside right center", frameon=False)
        return png(figure)


def _by(content: Mapping[str, Any], key: str) -> dict[str, tuple[list[float], Array]]:
    """For each method the levels of ``key``, and the mean success at each of all touches and starts."""
    cells = [cell for some in content["figures"]["success"].values() for cell in some]
    levels = sorted({cell[key] for cell in cells})
    weight = np.zeros(len(levels))
    found: dict[str, Array] = defaultdict(lambda: np.zeros(len(levels)))
    for cell in cells:
        k = levels.index(cell[key])
        weight[k] += cell["n"]
        for name in content["figures"]["methods"]:
            found[name][k] += cell["n"] * cell["rates"][name]
    return {name: (levels, shares / weight) for name, shares in found.items()}


def _found(content: Mapping[str, Any]) -> str:
    """What the picture shows, in words."""
    mean = {name: float(shares.mean()) for name, (_, shares) in _by(content, "turn_deg").items()}
    peers = {name: each for name, each in mean.items() if name not in OWN}
    if _OURS not in mean or not peers:
        return "Share of starts from which each method finds the true pose"
    best = max(peers, key=lambda name: peers[name])
    ours, theirs = (f"{100 * share:.0f} %" for share in (mean[_OURS], peers[best]))
    return f"FilterReg finds the true pose from {ours} of the starts, the best peer ({best}) from {theirs}"
