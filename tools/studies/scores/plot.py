"""The gain of scores against their cost: a picture of ``python -m tools.studies scores``, from its JSON alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from geomtact.report.canvas import png
from tools.studies.common.names import Named, write_names

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Okabe and Ito's colours without yellow, also distinct to the colour-blind; the shape distinguishes further scores
_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#000000", "#E69F00", "#56B4E9")
_SHAPES = ("o", "s", "^", "D", "v", "P", "X", "*")
_SIZE = (4.6, 3.6)  # of a panel, inches
_COLUMNS = 3


def draw_scores(content: Mapping[str, Any]) -> bytes:
    """PNG with a panel for each object and one for their mean: gain [nats] against the time of the score [ms, log].

    Parameters
    ----------
    content : of the JSON that ``python -m tools.studies scores --out`` writes
    """
    import matplotlib as mpl
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    panels = {name: part["scores"] for name, part in content["parts"].items()}
    if len(panels) > 1:
        panels[f"mean over {len(panels)} parts"] = content.get("overall", {})
    names = list(dict.fromkeys(name for entries in panels.values() for name in entries))
    rows, columns = -(-len(panels) // _COLUMNS), min(len(panels), _COLUMNS)
    settings = content["settings"]
    with mpl.rc_context({"font.size": 9, "axes.spines.top": False, "axes.spines.right": False}):
        figure = Figure(figsize=(columns * _SIZE[0], rows * _SIZE[1]), dpi=120, layout="constrained", facecolor="white")
        canvas = FigureCanvasAgg(figure)
        grid = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
        for axes in grid.flat[len(panels) :]:
            axes.remove()
        shown = list(zip(grid.flat, panels.items(), strict=False))
        points = [_points(axes, title, entries, names) for axes, (title, entries) in shown]
        what = f"{settings['touches']} touches a part on {settings['sensor']}"
        figure.suptitle(
            f"{what}, {settings['felt']}, {settings['noise']['name']} noise\nbars: standard error", fontsize=9
        )
        canvas.draw()
        figure.set_layout_engine("none")  # labels are placed between the points as these now lie
        for (axes, _), here in zip(shown, points, strict=True):
            write_names(axes, here)
        return png(figure)


def _points(axes: Axes, title: str, entries: Mapping[str, Any], names: Sequence[str]) -> list[Named]:
    """Draw each score that has been judged, and return what is to be labelled."""
    from matplotlib.ticker import LogLocator, NullFormatter

    out = []
    for name, entry in entries.items():
        if "figures" not in entry:
            continue
        f, k = entry["figures"]["all"], names.index(name)
        colour, shape = _COLOURS[k % len(_COLOURS)], _SHAPES[k % len(_SHAPES)]
        ms, gain, error = f["score_ms_median"], f["gain_mean"], f["gain_standard_error"]
        axes.errorbar(ms, gain, error, color=colour, marker=shape, ms=6, capsize=3, elinewidth=1)
        out.append(Named(name, colour, ms, gain, error or 0.0))
    axes.set_xscale("log")
    axes.set_title(title)
    axes.grid(alpha=0.3, lw=0.5)
    axes.tick_params(labelbottom=True, labelleft=True)
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.margins(0.2)
    axes.set_xlabel("score and posterior [ms per touch]")
    axes.set_ylabel("gain [nats]")
    return out
