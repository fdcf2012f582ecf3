"""One picture of the pose distribution, the touches of most expected information gain and the contacts of the best."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from geomtact.planning.actions import Touch
from geomtact.planning.draws import draw_places
from geomtact.planning.next_touch import Action, ambiguity
from geomtact.report.canvas import COLOURS, FIRST, SIMULATED, png, rgb
from geomtact.se3 import Array, apply, inverse, transform
from geomtact.sensing.sensor import Sensor

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from geomtact.inference.posterior import Posterior

_COLOURS = (COLOURS[1], COLOURS[0], COLOURS[2])
_OTHERS = "#999999"
_POSES, _SHOWN, _BARS = 48, 5, 12
_PIXELS = 160
_ARROW = 0.03  # m
# R_view_world of cameras whose rows run downwards, and the axes that point right and up in their pictures
_VIEWS = (
    ("seen along -z", "x", "y", np.diag([1.0, -1.0, -1.0])),
    ("seen along +y", "x", "z", np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])),
)


def draw_next_touch(posterior: Posterior, ranked: Sequence[Action], seed: int = 0) -> bytes:
    """PNG of the ranked actions.

    Parameters
    ----------
    posterior : from which the actions were ranked
    ranked : the best first, as ``next_touch`` gives them
    seed : of the poses that are shown
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure

    poses = draw_places(posterior, _POSES, np.random.default_rng(seed))[0]
    best = ranked[: len(_COLOURS)]
    with mpl.rc_context({"font.size": 9, "axes.titlesize": 10}):
        figure = Figure(figsize=(14, 8.6), dpi=100, layout="constrained", facecolor="white")
        upper, lower = figure.subfigures(2, 1, squeeze=False, height_ratios=[5.6, 3.0])[:, 0]
        above, front, bars = upper.subplots(1, 3)
        for axes, view in zip((above, front), _VIEWS, strict=True):
            _region(axes, posterior, poses, best, *view)
        upper.legend(*front.get_legend_handles_labels(), loc="outside lower left", ncols=5, frameon=False)
        _bars(bars, ranked)
        if isinstance(ranked[0].of, Touch):
            _shown(lower.subplots(1, _SHOWN), posterior, ranked[0].of, poses)
            lower.suptitle(
                f"Contacts of touch {ranked[0].number}, the best, with the object at {_SHOWN} of these poses: it "
                "distinguishes poses whose contacts differ",
                fontsize=10,
            )
        note = ambiguity(ranked)
        title = f"{posterior.mesh.name} on {posterior.sensor.name}, {posterior.frame} frame: where to touch next"
        title += " (dark: the object is probably there)"
        figure.suptitle(title if note is None else f"{title}\n{note}", fontsize=11)
        return png(figure)


def _region(
    axes: Axes, posterior: Posterior, poses: Array, best: Sequence[Action], name: str, right: str, up: str, R: Array
) -> None:
    """The share of ``poses`` at which the object covers a line of sight, the first sensor, and the ``best`` actions."""
    ends = np.concatenate([_path(posterior, action, poses) for action in best])
    outline = apply(poses, posterior.mesh.surface_points(128)).reshape(-1, 3)
    # of all sensors that touched, each taken to have the first one's window
    placed = np.stack([view.T_frame_sensor for view in posterior.provenance.views] or [posterior.T_frame_sensor])
    windows = apply(placed, posterior.sensor.corners)
    corners = np.concatenate([outline, *windows, ends]) @ R.T
    low, high = corners.min(0)[:2], corners.max(0)[:2]
    middle, half = 0.5 * (low + high), 0.55 * float((high - low).max())
    covered = _covered(posterior, poses, R, middle, half)
    x, y = middle[0], -middle[1]
    extent = tuple(1e3 * np.array([x - half, x + half, y - half, y + half]))
    # the root, so that what is unlikely is seen too
    axes.imshow(np.sqrt(covered), extent=extent, cmap="Greys", vmin=0, vmax=1.3)
    for k, window in enumerate(windows):
        label = None if k else "window of a sensor that touched"
        axes.fill(*_seen(window, R), facecolor="none", edgecolor=FIRST, lw=1.5, label=label)
    for action, colour in zip(best, _COLOURS, strict=False):
        start, end = _seen(_path(posterior, action, poses), R).T
        kind = "touch" if isinstance(action.of, Touch) else "probe"
        label = f"{kind} {action.number}, where it stops"
        if isinstance(action.of, Touch):
            there = transform(action.T_world_sensor[:3, :3], _path(posterior, action, poses)[1])
            axes.fill(*_seen(apply(there, posterior.sensor.corners), R), color=colour, alpha=0.45, lw=1.5, label=label)
        arrow = {"arrowstyle": "-|>", "color": colour, "lw": 1.6, "shrinkA": 0, "shrinkB": 0}
        axes.annotate("", end, start, arrowprops=arrow)
        axes.text(
            start[0],
            start[1],
            f" {action.number} ",
            color=colour,
            weight="bold",
            ha="center",
            va="center",
            bbox={"boxstyle": "circle,pad=0.15", "fc": "white", "ec": colour},
        )
    axes.set(title=f"Distribution of the object, {name}", xlabel=f"{right} [mm]", ylabel=f"{up} [mm]")


def _covered(posterior: Posterior, poses: Array, R: Array, middle: Array, half: float) -> Array:
    """Share (n, n) of ``poses`` (m, 4, 4) at which the object lies on the line of sight through each pixel."""
    # a camera without perspective is a sensor to the caster
    camera = Sensor("view", (_PIXELS, _PIXELS), (2 * half / _PIXELS,) * 2, 0.0, 1.0)
    T = transform(R, -np.append(middle, 0.0)) @ poses
    return np.isfinite(posterior.space.caster.depths(camera, T)).mean(0)


def _path(posterior: Posterior, action: Action, poses: Array) -> Array:
    """Where an action comes from and where, in the median over ``poses``, it ends (2, 3)."""
    T = action.T_world_sensor
    if isinstance(action.of, Touch):
        stopped = action.of.reached(posterior.space, poses, 0.5 * posterior.sensor.max_penetration)
        end = np.median(stopped[:, :3, 3], axis=0)
        return np.stack([end - _ARROW * T[:3, 2], end])
    return np.stack([T[:3, 3] - _ARROW * T[:3, 2], T[:3, 3]])


def _bars(axes: Axes, ranked: Sequence[Action]) -> None:
    """Expected information gain of the best actions and of the last."""
    exact = [action for action in ranked if not action.roughly]
    some = exact if len(exact) <= _BARS else [*exact[: _BARS - 1], exact[-1]]
    place = np.arange(len(some))
    colours = [*_COLOURS, *[_OTHERS] * len(some)][: len(some)]
    axes.barh(place, [a.expected_nats for a in some], color=colours)
    names = [f"{'touch' if isinstance(a.of, Touch) else 'probe'} {a.number}" for a in some]
    axes.set_yticks(place, names)
    axes.invert_yaxis()
    for at, action in enumerate(some):
        cost = "" if action.cost == 1 else f", cost {action.cost:g}"
        text = f" {action.expected_nats:.2f}, contact with {100 * action.contact:.0f} %{cost}"
        axes.text(action.expected_nats, at, text, va="center", fontsize=8)
    axes.set_xlim(0, 1.7 * max(0.1, *(a.expected_nats for a in some)))
    axes.spines[["top", "right"]].set_visible(False)
    title = "Expected information gain"
    if len(some) < len(ranked):
        title = f"The best of {len(ranked)} actions,\nand the last of those evaluated at all poses"
    axes.set(title=title, xlabel="expected gain [nats]; 0.7 halves the possible poses")


def _shown(grid: NDArray, posterior: Posterior, touch: Touch, poses: Array) -> None:
    """The contacts of a touch at the first of ``poses``, and how far the sensor went."""
    x, y = 1e3 * posterior.sensor.half_window
    pressed = 0.5 * posterior.sensor.max_penetration
    stopped = touch.reached(posterior.space, poses[: len(grid)], pressed)
    for axes, there, pose in zip(grid, stopped, poses, strict=False):
        mask = posterior.space.caster.contact(posterior.sensor, inverse(there) @ pose).mask
        shown = np.ones((*mask.shape, 3))
        shown[mask] = rgb(SIMULATED)
        axes.imshow(shown, extent=(-x, x, y, -y), interpolation="nearest")
        went = 1e3 * float((there[:3, 3] - touch.T_world_sensor[:3, 3]) @ touch.T_world_sensor[:3, 2])
        axes.set(title=f"stops after {went:.1f} mm" if mask.any() else "no contact", xlabel="x [mm]")
    grid[0].set_ylabel("y [mm], downwards")


def _seen(points: Array, R: Array) -> Array:
    """Points (n, 3) [m] in a picture: right and up (2, n) [mm]."""
    return 1e3 * (points @ R.T)[:, :2].T * [[1.0], [-1.0]]
