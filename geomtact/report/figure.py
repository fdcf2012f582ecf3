"""``report.png`` by matplotlib: the touch, the first modes and the distribution of each coordinate."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from geomtact.report.canvas import BARS, FIRST, OBSERVED, SIMULATED, displayable, png_of, rgb
from geomtact.report.marginals import Samples, marginals
from geomtact.report.sensor_image import SensorImage
from geomtact.report.summary import ModeSummary, caution, facts, percent
from geomtact.report.view import Painter, PartView
from geomtact.se3 import Array, inverse
from geomtact.sensing.contact import Contact
from geomtact.sensing.sensor import Sensor

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import SubFigure

    from geomtact.inference.modes import Mode
    from geomtact.inference.posterior import Posterior

DPI, WIDTH = 100, 14.0
# Heights in inches; those of the touch and of the modes, without the object, a row for each sensor
_BANDS = {"touch": 3.9, "modes": 2.9, "marginals": 2.9}
_COLUMNS = 5


@dataclass(frozen=True)
class Picture:
    """The whole report as one PNG, and its bands by name as PNGs of their own."""

    whole: bytes
    bands: dict[str, bytes]


def draw(
    posterior: Posterior, modes: Sequence[Mode], summaries: Sequence[ModeSummary], shown: Sequence[SensorImage]
) -> Picture:
    """Draw the report.

    Parameters
    ----------
    posterior : what was found
    modes, summaries : the modes to show, at most five, and their plain numbers
    shown : each sensor's image
    """
    import matplotlib as mpl
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    modes, summaries = modes[:_COLUMNS], summaries[:_COLUMNS]
    names = list(_BANDS) if modes else ["touch"]
    views = _views(posterior, modes) if modes else []
    part = WIDTH / _COLUMNS * max((_tallness(view) for view in views), default=0.0)
    rows = {"touch": len(shown), "modes": len(shown)}
    heights = [_BANDS[name] * rows.get(name, 1) + (part if name == "modes" else 0.0) for name in names]
    style: Any = {"font.size": 9, "axes.titlesize": 10, "axes.spines.top": False, "axes.spines.right": False}
    with mpl.rc_context(style):
        figure = Figure(figsize=(WIDTH, sum(heights)), dpi=DPI, layout="constrained", facecolor="white")
        canvas = FigureCanvasAgg(figure)
        bands = dict(
            zip(names, figure.subfigures(len(names), 1, squeeze=False, height_ratios=heights)[:, 0], strict=True)
        )
        words = _touch(bands["touch"], posterior, summaries, shown)
        if modes:
            _modes(bands["modes"], posterior, modes, views, part, shown)
            draw_marginals(bands["marginals"], marginals(posterior, np.asarray(modes[0].T)))
        canvas.draw()
        words_start = int(words.get_window_extent().x0)
        pixels = np.asarray(canvas.buffer_rgba())[..., :3].copy()
    edges = np.round(np.cumsum([0.0, *heights]) * DPI).astype(int)
    cut = {name: pixels[edges[k] : edges[k + 1]] for k, name in enumerate(names)}
    # the page has its own text and table instead of the words beside the touch
    cut["touch"] = cut["touch"][:, :words_start]
    return Picture(png_of(pixels), {name: png_of(band) for name, band in cut.items()})


def _touch(
    band: SubFigure, posterior: Posterior, summaries: Sequence[ModeSummary], shown: Sequence[SensorImage]
) -> Axes:
    """The images, the contacts and a summary in words, whose axes are returned."""
    grid = band.add_gridspec(len(shown), 3)
    for row, one in enumerate(shown):
        contact, of = one.observation.contact, f", {one.name}" if one.name else ""
        _in_window(band.add_subplot(grid[row, 0]), one.sensor, displayable(one.observation.image), f"The image{of}")
        axes = band.add_subplot(grid[row, 1])
        outline(axes, one.sensor, contact, OBSERVED)
        kind = one.observation.kind
        how = f"read as {'depth map' if kind == 'height' else kind}"
        if kind == "reading":
            how = f"{one.observation.method} method" + " with depths" * (contact.height is not None)
        area_mm2 = 1e6 * contact.mask.sum() * one.sensor.pixel_area(contact.mask.shape)
        title = f"The contact{of} ({area_mm2:.1f} mm², {how})"
        _in_window(axes, one.sensor, np.where(contact.mask, 0.75, 0.97), title)
    words = band.add_subplot(grid[:, 2])
    words.axis("off")
    lines = [part for line in _words(posterior, summaries) for part in (textwrap.wrap(line, 64) or [""])]
    words.text(0.02, 1, "\n".join(lines[: 20 * len(shown)]), va="top", fontsize=9, linespacing=1.5)
    return words


def _modes(
    band: SubFigure,
    posterior: Posterior,
    modes: Sequence[Mode],
    views: Sequence[PartView],
    part: float,
    shown: Sequence[SensorImage],
) -> None:
    """The contacts simulated at each mode, a row for each sensor, and below them the object, ``part`` inches high."""
    grid = band.subplots(len(shown) + 1, _COLUMNS, height_ratios=[_BANDS["modes"]] * len(shown) + [part])
    for axes in grid[:, len(modes) :].ravel():
        axes.axis("off")
    for column, (mode, view) in enumerate(zip(modes, views, strict=True)):
        for axes, one in zip(grid[:, column], shown, strict=False):
            contact = one.at(mode.T)
            there = np.ones((*contact.mask.shape, 3))
            there[contact.mask] = rgb(SIMULATED)
            title = f"mode {column + 1}: {percent(mode.probability)}"
            _in_window(axes, one.sensor, there, f"{title}, {one.name}" if one.name else title, small=True)
            outline(axes, one.sensor, one.observation.contact, OBSERVED)
        below = grid[-1, column]
        below.imshow(view.image, extent=view.extent)
        below.set_ylim(_filled(view))
        below.axis("off")
        _draw_frame(below, posterior.sensor, view.place)
        below.set_title(_over(posterior, shown))
    above = grid[0, 0]
    above.plot([], [], color=OBSERVED, label="observed outline")
    above.fill_between([], [], color=SIMULATED, label="contact simulated there")
    band.legend(*above.get_legend_handles_labels(), loc="outside upper right", ncols=2, frameon=False)


def _over(posterior: Posterior, shown: Sequence[SensorImage]) -> str:
    """The one of several sensors over which the object is drawn."""
    name = next((one.name for one in shown if one.observation is posterior.observation), "")
    return f"over {name}" if name else ""


def draw_marginals(band: SubFigure, all_samples: Sequence[Samples]) -> None:
    """Draw the distribution of each coordinate; a ball has neither turn nor tilt."""
    from matplotlib.ticker import MultipleLocator

    grid = band.subplots(1, 5)
    for axes, samples in zip(grid, all_samples, strict=False):
        mass, edges = samples.histogram()
        axes.stairs(100 * mass, edges, fill=True, color=BARS)
        axes.axvline(samples.mark, color=FIRST, lw=1.2, ls="--", label="mode 1")
        axes.set_xlabel(samples.label)
        axes.set_ylim(bottom=0)
        axes.set_xlim(max(edges[0], samples.least), min(edges[-1], samples.most))
        if samples.most == 180 and np.ptp(axes.get_xlim()) > 150:
            axes.xaxis.set_major_locator(MultipleLocator(90))
        axes.ticklabel_format(useOffset=False)
    empty = grid[len(all_samples) :]
    for axes in empty:
        axes.axis("off")
    for axes in empty[:1]:
        axes.text(0.5, 0.5, "a ball has\nno turn", ha="center", va="center", transform=axes.transAxes)
    grid[0].set_ylabel("probability [%]")
    band.legend(*grid[0].get_legend_handles_labels(), loc="outside upper right", frameon=False)


def _views(posterior: Posterior, modes: Sequence[Mode]) -> list[PartView]:
    """The object at each mode."""
    painter = Painter(posterior.mesh, posterior.sensor)
    return [painter.paint(inverse(posterior.T_frame_sensor) @ mode.T) for mode in modes]


def _filled(view: PartView) -> tuple[float, float]:
    """Bottom and top [mm] of what a picture shows, with a little air."""
    _, _, bottom, top = view.extent
    height = (top - bottom) / len(view.image)
    rows = np.flatnonzero((view.image < 1).any((1, 2)))  # the window at least is always there
    return top - (rows[-1] + 12) * height, top - (rows[0] - 12) * height


def _tallness(view: PartView) -> float:
    """Height of what a picture shows over the picture's width."""
    low, high = _filled(view)
    return (high - low) / (view.extent[1] - view.extent[0])


def outline(axes: Axes, sensor: Sensor, contact: Contact, colour: str) -> None:
    """Draw the border of a contact in millimetres on the membrane."""
    if contact.mask.any():
        x, y = sensor.pixel_centres(contact.mask.shape)  # type: ignore[arg-type]
        axes.contour(1e3 * x, 1e3 * y, np.asarray(contact.mask, float), [0.5], colors=colour, linewidths=1.4)


def _in_window(axes: Axes, sensor: Sensor, image: Array, title: str, small: bool = False) -> None:
    """Show ``image`` over the window in millimetres: x to the right, y downwards as in the image."""
    x, y = 1e3 * sensor.half_window
    axes.imshow(image, extent=(-x, x, y, -y), cmap="gray", vmin=0, vmax=1, interpolation="nearest")
    axes.set_title(title)
    axes.set_xlabel("x [mm]")
    if not small or axes.get_subplotspec().is_first_col():  # type: ignore[union-attr]
        axes.set_ylabel("y [mm], downwards")
    for spine in axes.spines.values():
        spine.set_visible(True)


def _draw_frame(axes: Axes, sensor: Sensor, place: Callable[[Array], Array]) -> None:
    """The window's border and the sensor's x and y axes, over the picture of the object."""
    x, y = 1e3 * sensor.half_window
    corners = 1e3 * sensor.corners
    axes.plot(*place(np.concatenate([corners, corners[:1]])).T, color=BARS, lw=0.8)
    for name, tip in (("x", (x, 0, 0)), ("y", (0, y, 0))):
        start, end = place(np.array([[0, 0, 0], tip]))
        axes.annotate("", end, start, arrowprops={"arrowstyle": "->", "color": BARS, "lw": 1.0})
        right, up = start + 1.12 * (end - start)
        axes.text(right, up, name, color=BARS, ha="center", va="center")


def _words(posterior: Posterior, summaries: Sequence[ModeSummary]) -> list[str]:
    lines = [f"WARNING: {text}" for text in posterior.warnings]
    lines += [f"{posterior.mesh.name} on {posterior.sensor.name}", *facts(posterior), ""]
    for s in summaries[:1]:
        lines += caution(summaries) or [f"Mode 1 holds {percent(s.probability)}."]
        lines += [
            "Object's centre at mode 1: "
            + ", ".join(f"{a} = {v:.2f}" for a, v in zip("xyz", s.centre_mm + 0.0, strict=True))
            + " mm",
            f"Within the mode: standard deviation {s.centre_sd_mm:.2f} mm and {s.rotation_sd_deg:.1f}°.",
            "Observable directions:",
            s.in_words(),
        ]
    return lines
