"""Draw the pictures of docs/ and README.md.

    python tools/make_docs_figures.py [NAME ...]

Without names all are drawn into docs/images: frames, approach, one_map, augmentations. ``augmentations`` needs the extra
``train``.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Arc, Circle, Polygon, Rectangle

from geomtact import Sensor, load_mesh
from geomtact.contact_space.heightmap import NOTHING, HeightMap, Window
from geomtact.contact_space.index import unpack
from geomtact.sensing.cast import Caster

ROOT = Path(__file__).resolve().parents[1]
IMAGES = ROOT / "docs" / "images"

# Okabe and Ito's colours, as in the report.
ORANGE, BLUE, GREEN, GREY, INK = "#D55E00", "#0072B2", "#009E73", "#8A8F98", "#1B1F24"
STYLE = {"font.size": 9, "axes.titlesize": 10, "axes.spines.top": False, "axes.spines.right": False}


def frames() -> Figure:
    """The sensor frame from the side and as the camera sees it."""
    figure = Figure(figsize=(10.5, 4.7), layout="constrained")
    side, seen = figure.subplots(1, 2, width_ratios=[1.3, 1])
    _side_view(side)
    _camera_view(seen)
    return figure


def _side_view(axes: Axes) -> None:
    """A cut through the sensor at y = 0, the object above: z points up in the picture, millimetres."""
    half, distance, deep, housing = 10.0, 20.0, 2.5, 5.0
    axes.set(xlim=(-20, 34), ylim=(-22.5, 13), aspect="equal", title="From the side (a cut at y = 0)")
    axes.axis("off")
    axes.add_patch(Rectangle((-half, -3.4), 2 * half, 3.4, color="#E8F1F8", lw=0))
    for side in (-1, 1):
        axes.add_patch(Rectangle((side * 14.5 - 3.5, -housing - 4), 7, 4, color="#D5D8DC", lw=0))
        axes.plot([0, side * half * 1.35], [-distance, 0.35 * distance], color=GREY, lw=0.8, ls="--")
        axes.text(side * 14.5, -housing - 2, "housing", ha="center", va="center", fontsize=8)
    axes.add_patch(Circle((-2.0, 7.0 - deep), 7.0, facecolor="#C9CED6", edgecolor=INK, lw=1.2, zorder=1))
    axes.text(-2.0, 7.5, "object", ha="center", va="center")
    axes.plot([-half, half], [0, 0], color=BLUE, lw=2.2, zorder=3)
    touch = np.sqrt(7.0**2 - (7.0 - deep) ** 2)
    axes.plot([-2 - touch, -2 + touch], [0, 0], color=ORANGE, lw=4, zorder=4, solid_capstyle="butt")
    axes.text(-half - 0.6, 0.2, "membrane,\nz = 0", color=BLUE, ha="right", va="center", fontsize=8)
    axes.text(-2.0, -6.2, "contact", color=ORANGE, ha="center", va="center", fontsize=8)
    axes.plot([-2.0, -2.0], [-5.3, -0.3], color=ORANGE, lw=0.7, zorder=4)
    axes.text(15.8, 8.4, "camera rays\nbound the window", color=GREY, fontsize=8, va="center", ha="center")
    # the camera
    axes.add_patch(Polygon([(-1.6, -22), (1.6, -22), (0.6, -20), (-0.6, -20)], color=INK))
    axes.text(2.4, -20.8, "camera centre (0, 0, −camera_distance)", va="center", fontsize=8)
    axes.plot([0], [0], marker="o", ms=5, color=INK, zorder=6)
    axes.annotate(
        "origin", (0, 0), (0.8, 2.3), fontsize=8, va="center", arrowprops={"arrowstyle": "-", "lw": 0.6}, zorder=6
    )
    axes.plot([-2, 8.5], [-deep, -deep], color=INK, lw=0.6, ls=":", zorder=2)
    _measure(axes, (6.0, 0.0), (6.0, -deep), "", (0, 0))
    axes.annotate(
        "penetration", (6.0, -1.6), (5.2, -11.5), fontsize=8, ha="center", arrowprops={"arrowstyle": "-", "lw": 0.6}
    )
    axes.plot([half, 20], [0, 0], color=BLUE, lw=0.6, ls=":")
    _measure(axes, (18.9, 0), (18.9, -housing), "housing_depth", (19.4, -2.5))
    _arrow(axes, (23, 2.5), (23, 11), INK, "+z, out towards\nthe object", (23.8, 10.3), "left")
    _arrow(axes, (23, 2.5), (29, 2.5), INK, "+x", (30.4, 2.5), "center")
    axes.text(23.6, 4.1, "+y away from you", fontsize=8, va="center")


def _camera_view(axes: Axes) -> None:
    """The image of the GelSight Mini with its pixel counts and axes."""
    sensor = Sensor.load("gelsight-mini")
    x, y = 1e3 * sensor.half_window
    width, height = sensor.image_size_px
    axes.set(xlim=(-x - 1, x + 2), ylim=(y + 1, -y - 2), aspect="equal", title="As the camera sees it (gelsight-mini)")
    axes.axis("off")
    axes.add_patch(Rectangle((-x, -y), 2 * x, 2 * y, facecolor="#F4F6F8", edgecolor=BLUE, lw=1.5))
    axes.add_patch(Circle((5.2, 3.5), 2.0, color=ORANGE, lw=0))
    axes.text(5.2, 6.3, "contact: non-zero", color=ORANGE, ha="center", va="center", fontsize=8)
    _arrow(axes, (0, 0), (7.5, 0), INK, "+x along columns", (3.8, -0.8), "center")
    _arrow(axes, (0, 0), (0, 5.6), INK, "+y along rows,\ndownwards", (-0.6, 4.0), "right")
    axes.plot([0], [0], marker="o", ms=9, mfc="white", mec=INK, zorder=6)
    axes.plot([0], [0], marker="x", ms=5, color=INK, zorder=6)
    axes.text(-0.9, -0.7, "+z away from you,\ntowards the object", ha="right", va="bottom", fontsize=8)
    axes.plot([-x + 0.3], [-y + 0.3], marker="s", ms=4, color=INK)
    axes.text(-x + 0.8, -y + 1.0, "pixel of row 0, column 0", fontsize=8, va="center")
    pitch = [f"{1e3 * p:.4f} mm" for p in sensor.pixel_pitch]
    axes.text(0, -y - 0.5, f"{width} px × {pitch[0]} = {2 * x:.1f} mm", ha="center", va="bottom", fontsize=8)
    axes.text(x + 0.5, 0, f"{height} px × {pitch[1]} = {2 * y:.1f} mm", rotation=270, va="center", fontsize=8)


def approach() -> Figure:
    """The approach direction and its half angle, and the transform between the two frames."""
    figure = Figure(figsize=(10.5, 3.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    left.set(xlim=(-8, 8), ylim=(-6.4, 5.2), aspect="equal", title="Approach: from the object towards the sensor")
    left.axis("off")
    body = np.array([(-5, -0.3), (5, -0.3), (5, 2.5), (1, 2.5), (1, 4.2), (-5, 4.2)])
    left.add_patch(Polygon(body, facecolor="#C9CED6", edgecolor=INK, lw=1.2))
    left.text(-2.8, 3.3, "object", ha="center")
    _arrow(left, (-4, 0.6), (-2.4, 0.6), GREEN, "x", (-2.0, 0.6), "center")
    _arrow(left, (-4, 0.6), (-4, 2.2), GREEN, "z", (-4, 2.6), "center")
    left.text(-1.6, 0.9, "object frame:\nthe mesh file's own", color=GREEN, fontsize=8, va="center")
    _arrow(left, (2.8, -0.3), (2.8, -3.6), ORANGE, "approach (0, 0, −1)\nin the object frame", (4.7, -2.4), "left")
    for angle in (-22, 22):
        tip = 2.8 + 3.6 * np.sin(np.radians(angle)), -0.3 - 3.6 * np.cos(np.radians(angle))
        left.plot([2.8, tip[0]], [-0.3, tip[1]], color=ORANGE, lw=0.8, ls="--")
    left.add_patch(Arc((2.8, -0.3), 4.2, 4.2, theta1=248, theta2=270, color=ORANGE, lw=0.9))
    left.text(1.1, -2.2, "half\nangle", color=ORANGE, fontsize=8, ha="right")
    left.add_patch(Rectangle((-1.0, -5.4), 7.6, 0.5, color=BLUE, lw=0))
    left.text(2.8, -5.9, "sensor", ha="center", color=BLUE, va="center")

    right.set(xlim=(0, 10), ylim=(0, 6), title="T_a_b takes b-coordinates into a")
    right.axis("off")
    boxes = {"world": (1.2, 3.6), "sensor": (5.0, 3.6), "object": (8.8, 3.6)}
    for name, (x, y) in boxes.items():
        right.text(x, y, name, ha="center", va="center", bbox={"boxstyle": "round,pad=0.5", "fc": "#F4F6F8", "ec": INK})
    for a, b, up in (("sensor", "object", 0.0), ("world", "sensor", 0.0)):
        start, end = boxes[b][0] - 0.95, boxes[a][0] + 0.95
        right.annotate("", (end, 3.6 + up), (start, 3.6 + up), arrowprops={"arrowstyle": "->", "color": INK})
        right.text((start + end) / 2, 3.9, f"T_{a}_{b}", ha="center", family="monospace", fontsize=8)
    right.annotate(
        "", (1.2, 3.0), (8.8, 3.0), arrowprops={"arrowstyle": "->", "color": INK, "connectionstyle": "arc3,rad=-0.22"}
    )
    right.text(
        5, 1.55, "T_world_object = T_world_sensor @ T_sensor_object", ha="center", family="monospace", fontsize=8
    )
    right.text(5, 5.2, "p_sensor = T_sensor_object @ p_object", ha="center", family="monospace", fontsize=9)
    return figure


def one_map() -> Figure:
    """One height map of the pin and the contacts cut from it, by the code that builds the index."""
    mesh, sensor = load_mesh("pin"), Sensor.load("gelslim")
    a = np.array([1.0, 0.0, 0.0])
    reach = float(np.linalg.norm(mesh.vertices - mesh.centre, axis=1).max())
    pixel, depth, shape = 0.35e-3, 0.75e-3, (48, 64)
    caster = Caster(mesh.vertices, mesh.faces)
    there = HeightMap.cast(caster, a, mesh.centre, reach, 2.1 * float(np.hypot(*sensor.half_window)), pixel)
    window = Window(sensor, shape, (depth,))
    # how far the map is turned, and where on the map the window's centre is
    cuts = [(0.0, (0.0, 42e-3)), (np.radians(55), (4e-3, 16e-3)), (np.radians(-30), (6e-3, -36e-3))]

    figure = Figure(figsize=(10.5, 3.4), layout="constrained")
    grid = figure.subplots(1, 4, width_ratios=[1.25, 1, 1, 1])
    heights = np.where(there.heights > NOTHING / 2, 1e3 * there.heights, np.nan)
    extent = 1e3 * pixel * len(heights) / 2
    shown = grid[0].imshow(heights, extent=(-extent, extent, extent, -extent), cmap="cividis")
    grid[0].set(title="One height map: the pin from its side", xlabel="[mm]", xlim=(-75, 75), ylim=(75, -75))
    figure.colorbar(shown, ax=grid[0], label="towards the sensor [mm]", shrink=0.8, location="left")
    x, y = 1e3 * sensor.half_window
    border = np.array([[-x, -y], [x, -y], [x, y], [-x, y], [-x, -y]])
    for k, (turn, centre) in enumerate(cuts):
        colour = (ORANGE, BLUE, GREEN)[k]
        c, s = np.cos(turn), np.sin(turn)
        back = np.array([[c, s], [-s, c]])  # from the turned map to the map itself
        placed = border @ back.T + 1e3 * np.array(centre)
        grid[0].plot(*placed.T, color=colour, lw=1.4)
        mask = window.masks(there, turn, np.array([centre]) @ back)[0].reshape(shape)
        axes = grid[k + 1]
        axes.imshow(np.where(mask[..., None], mpl.colors.to_rgb(colour), 1.0), extent=(-x, x, y, -y))
        axes.set(title=f"turned {np.degrees(turn):.0f}°, {1e3 * depth:.2f} mm deep", xlabel="x [mm]")
        for spine in axes.spines.values():
            spine.set(visible=True, color=colour)
    grid[1].set_ylabel("y [mm], downwards")
    return figure


def augmentations() -> Figure:
    """Five touches of a procedural part: stored, rigid, elastic, and each noise that training adds to them."""
    import torch

    from geomtact.training.augment import AUGMENTATIONS
    from geomtact.training.scenes import KEY_SHAPE, TOUCH_SHAPE, make_scene
    from tools.training.procedural import random_object

    scene = make_scene(random_object(11, 0.06), Sensor.load("gelslim"), 600_000, np.random.default_rng(5))
    touches, soft = unpack(scene.touches, TOUCH_SHAPE), np.flatnonzero(scene.elastic)
    elastic = touches[soft]
    # middling contacts, as different as five of them can be
    some = np.argsort(elastic.sum((1, 2)))[(np.linspace(0.5, 0.97, 5) * len(elastic)).astype(int)]
    masks = torch.from_numpy(elastic[some]).float()[:, None]
    columns = [
        ("stored, of the cell", unpack(scene.stored[scene.true[soft[some]]], KEY_SHAPE)),
        ("touch, rigid", touches[soft[some] - 1]),
        ("touch, elastic", elastic[some]),
    ]
    for i, a in enumerate(AUGMENTATIONS):
        # several draws, of which the one that changes most is shown: some noises come in few touches only
        drawn = [a.apply(masks, scene.pixel, torch.Generator().manual_seed(100 * i + k)) for k in range(12)]
        changed = torch.stack([(d != masks).flatten(1).sum(1) for d in drawn])
        best = changed.argmax(0)
        columns.append((a.name, torch.stack([drawn[k][j, 0] for j, k in enumerate(best.tolist())]).numpy()))
    figure = Figure(figsize=(12, 5.2), layout="constrained")
    axes = figure.subplots(5, len(columns))
    for c, (title, images) in enumerate(columns):
        for r in range(5):
            axes[r, c].imshow(images[r], cmap="gray", vmin=0, vmax=1, interpolation="nearest", extent=(0, 4, 3, 0))
            axes[r, c].set(xticks=[], yticks=[])
        axes[0, c].set_title(title, fontsize=9)
    return figure


def _arrow(axes: Axes, start: tuple, end: tuple, colour: str, text: str, at: tuple, align: str) -> None:
    axes.annotate("", end, start, arrowprops={"arrowstyle": "-|>", "color": colour, "lw": 1.4}, zorder=5)
    axes.text(*at, text, color=colour, ha=align, va="center", fontsize=8)


def _measure(axes: Axes, start: tuple, end: tuple, text: str, at: tuple) -> None:
    axes.annotate("", end, start, arrowprops={"arrowstyle": "<->", "color": INK, "lw": 0.9, "shrinkA": 0, "shrinkB": 0})
    axes.text(*at, text, fontsize=8, va="center")


PICTURES: dict[str, Callable[[], Figure]] = {
    "frames": frames,
    "approach": approach,
    "one_map": one_map,
    "augmentations": augmentations,
}


def main() -> None:
    unknown = [name for name in sys.argv[1:] if name not in PICTURES]
    if unknown:
        sys.exit(f"no picture named {', '.join(unknown)}; known: {', '.join(PICTURES)}")
    IMAGES.mkdir(parents=True, exist_ok=True)
    for name in sys.argv[1:] or PICTURES:
        with mpl.rc_context(STYLE):
            PICTURES[name]().savefig(IMAGES / f"{name}.png", dpi=110, facecolor="white", metadata={"Software": None})
        print(IMAGES / f"{name}.png")


if __name__ == "__main__":
    main()
