"""From how far off each method finds home: a picture of ``python -m tools.studies registration``, from its JSON alone."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from geomtact.report.canvas import png

_PANEL = (1.75, 1.6)  # inches


def draw_registration(content: Mapping[str, Any]) -> bytes:
    """PNG with a row for each contact class and a column for each method: the share of touches that end within reach of
    the truth, against how far the start is turned [degrees] and shifted [mm].

    Parameters
    ----------
    content : of the JSON that ``python -m tools.studies registration --out`` writes
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure

    kinds = {kind: cells for kind, cells in content["figures"]["success"].items() if cells}
    names = list(content["figures"]["methods"])
    settings = next(iter(content["parts"].values()))["settings"]
    with mpl.rc_context({"font.size": 8}):
        size = (_PANEL[0] * len(names) + 1.2, _PANEL[1] * len(kinds) + 0.9)
        figure = Figure(figsize=size, dpi=120, layout="constrained", facecolor="white")
        grid = figure.subplots(len(kinds), len(names), squeeze=False)  # a hundred axes that share take minutes
        for i, (kind, cells) in enumerate(kinds.items()):
            turns, shifts = (sorted({cell[key] for cell in cells}) for key in ("turn_deg", "shift_mm"))
            for axes, name in zip(grid[i], names, strict=True):
                share = np.full((len(turns), len(shifts)), np.nan)
                for cell in cells:
                    share[turns.index(cell["turn_deg"]), shifts.index(cell["shift_mm"])] = cell["rates"][name]
                axes.imshow(share, vmin=0, vmax=1, cmap="Blues", origin="lower", aspect="auto")
                for row, column in np.argwhere(np.isfinite(share)):
                    value = share[row, column]
                    colour = "white" if value > 0.55 else "black"
                    axes.text(column, row, f"{100 * value:.0f}", ha="center", va="center", fontsize=6.5, color=colour)
                axes.set(xticks=range(len(shifts)), xticklabels=[f"{s:g}" for s in shifts])
                axes.set(yticks=range(len(turns)), yticklabels=[f"{t:g}" for t in turns])
                axes.label_outer()
                if i == 0:
                    axes.set_title(name.replace(" point", "\npoint", 1), fontsize=8)
            n = np.median([cell["n"] for cell in cells])
            grid[i, 0].set_ylabel(f"{kind}, {n:.0f} touches\nturned [deg]")
        for axes in grid[-1]:
            axes.set_xlabel("shifted [mm]")
        within = f"within {settings['success_mm']:g} mm in observable directions"
        figure.suptitle(
            f"Share [%] of touches that end {within}: {', '.join(content['parts'])} on {settings['sensor']}, "
            f"{settings['noise']['name']} noise",
            fontsize=9,
        )
        return png(figure)
