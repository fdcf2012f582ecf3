"""Figures 8, 10, 14 and 15 of the thesis, of this project's own objects and touches: 8 shows where pixel distance fails, 10 what
normalised errors look like, 14 and 15 contacts added one by one.

    python -m tools.studies.thesis.figures [8] [10] [15] [--out FOLDER]

Without numbers all are drawn, 14 as the first column of 15. About three minutes on two cores, after the four objects' touches
were simulated once (a minute each); pictures and their figures (JSON) go to out/thesis.
"""

import argparse
import json
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from geomtact import Localizer, Sensor, load_mesh
from geomtact.contact_space.space import ContactSpace
from geomtact.contact_space.touches import each_touch
from geomtact.evaluation import simultaneous_touches
from geomtact.geometry.distance import PoseDistance
from geomtact.scoring.overlap import OVERLAPS, to_grid
from geomtact.se3 import apply, exp, inverse, transform, unit
from geomtact.sensing.cast import Caster
from geomtact.sensing.noise import MODERATE
from tools.studies.common.study import THESIS_PARTS, random_add
from tools.studies.thesis.known_approach import draw_sides
from tools.studies.touches.study import SENSORS

ORANGE, BLUE = "#D55E00", "#0072B2"
SENSOR = Sensor.load("gelslim")
X, Y = 1e3 * SENSOR.half_window
SEED, PIXELS = 1, 240
LARGE = 50  # pixels of a contact that is worth a look


def pixel_distance():
    """Figure 8: of touches of one side that lie within the window, the first at which the pixels' first pose is wrong and the
    network's right."""
    mesh = load_mesh("elbow_pipe", sensor=SENSOR)
    side = draw_sides(mesh, SENSOR, 1, 2)[0]
    localizer = Localizer.prepare(mesh, sensor=SENSOR, approach=side, scorer="encoder", max_poses=50_000)
    index, distance = localizer.index, PoseDistance(mesh)
    for number, touch in enumerate(each_touch(localizer.space, 60, 2, True, MODERATE), 1):
        seen = to_grid(touch.mask, index.resolution.mask_shape)
        differ = 1 - OVERLAPS["l1"].score(index, seen).reshape(-1)
        apart = -localizer.scorer.scorer.score(index, touch.mask).reshape(-1)
        first = [int(some.argmin()) for some in (differ, apart)]
        off = 1e3 * distance.mean(touch.T_sensor_object, index.poses(first))
        inside = seen.sum() >= LARGE and seen[1:-1, 1:-1].sum() == seen.sum()
        if inside and off[0] > 30 and off[1] < 10:
            chosen = number
            break
    figure = Figure(figsize=(10, 3.7), dpi=110, layout="constrained")
    panels = figure.subplots(1, 3)
    masks = index.masks(first)
    titles = ("what the pixels prefer", "the touch", "what the network prefers")
    for axes, mask, title in zip(panels, (masks[0], seen, masks[1]), titles, strict=True):
        contact(axes, mask, [0.35] * 3)
        outline(axes, seen)
        axes.set(title=title, xticks=[-20, 0, 20], yticks=[-10, 0, 10], xlabel="x [mm]")
    panels[0].set_ylabel("y [mm], downwards")
    panels[1].set_xlabel("x [mm]\norange: its outline, in all three")
    rows = []
    for axes, i, mm in zip(panels[::2], first, off, strict=True):
        rows.append({"differing": float(differ[i]), "network": float(apart[i]), "add_mm": float(mm)})
        told = f"{100 * differ[i]:.1f} % of pixels differ\n{apart[i]:.1f} apart by the network"
        axes.set_xlabel(f"x [mm]\n{told}\nthe part lies {mm:.0f} mm off")
    return figure, {"part": mesh.name, "touch": chosen, "pixels": rows[0], "network": rows[1]}


def pose_errors():
    """Figure 10: the damping pin at four normalised distances from one pose."""
    mesh = load_mesh("damping_pin", sensor=SENSOR)
    caster, distance = Caster(mesh.vertices, mesh.faces), PoseDistance(mesh)
    expected = random_add(distance, ContactSpace(mesh, SENSOR))
    half = 0.62 * mesh.diameter
    way = inverse(transform(np.eye(3), mesh.centre))
    T, move = lying(mesh) @ way, np.array([0.1, 0.45, 1.0, 0.012, 0.022, 0.0])
    figure, rows = Figure(figsize=(12, 2.6), dpi=110, layout="constrained"), []
    for axes, wanted in zip(figure.subplots(1, 4), (0.05, 0.10, 0.16, 0.32), strict=True):
        low, high = 0.0, 3.0
        for _ in range(40):
            middle = (low + high) / 2
            other = exp(middle * move) @ T
            low, high = (middle, high) if distance.mean(T, other[None])[0] < wanted * expected else (low, middle)
        mm = 1e3 * float(distance.mean(T, other[None])[0])
        rows.append({"normalised": wanted, "add_mm": mm})
        overlay(axes, caster, T, other, half)
        axes.set(title=f"{wanted:.2f} ({mm:.1f} mm)", ylim=(0.9e3 * half, -0.5e3 * half))
    return figure, {"part": mesh.name, "random_mm": 1e3 * expected, "shown": rows}


def contacts_added():
    """Figures 14 and 15: a scene of each object, localized from its first touch, its first two, and so on."""
    figure = Figure(figsize=(15, 2.25 * len(THESIS_PARTS)), dpi=90, layout="constrained")
    grid, told = figure.subplots(len(THESIS_PARTS), 8, width_ratios=[1, 1.1] * 4), {}
    for row, name in zip(grid, THESIS_PARTS, strict=True):
        localizer = Localizer.prepare(name, sensor=SENSOR)
        mesh, space, distance = localizer.mesh, localizer.space, PoseDistance(localizer.mesh)
        (scene,) = simultaneous_touches(localizer.space, 1, SENSORS, SEED)
        truth, told[name] = scene.T_world_object, []
        window = np.column_stack([np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * SENSOR.half_window, np.zeros(4)])
        view = lying(mesh) @ inverse(truth @ transform(np.eye(3), mesh.centre))
        half = 0.6 * mesh.diameter
        for k in range(4):
            images = [touch.mask for touch in scene.touches[: k + 1]]
            mode = localizer.localize(images, "mask", T_world_sensor=scene.T_world_sensor[: k + 1]).modes(1)[0]
            mm = 1e3 * float(distance.mean(truth, mode.T[None])[0])
            told[name].append({"touches": k + 1, "add_mm": mm, "probability": mode.probability})
            left, right = row[2 * k : 2 * k + 2]
            simulated = space.caster.contact(SENSOR, inverse(scene.T_world_sensor[k]) @ mode.T).mask
            contact(left, simulated, [0.34, 0.71, 0.91])
            outline(left, scene.touches[k].mask)
            left.set(xticks=[], yticks=[], title=f"touch {k + 1}")
            nearest = distance.aligned(truth, mode.T[None])[0]
            overlay(right, space.caster, view @ truth, view @ nearest, half)
            for T in scene.T_world_sensor[: k + 1]:
                right.fill(*1e3 * apply(view @ T, window)[:, :2].T, fc="none", ec=BLUE, lw=1.0)
            holds = f"{100 * mode.probability:.0f} %" if mode.probability >= 0.01 else "< 1 %"
            right.set_title(f"{mm:.1f} mm off, holds {holds}", fontsize=10)
        row[0].set_ylabel(name, fontsize=12)
    return figure, told


def contact(axes, mask, colour):
    """A contact (h, w) in ``colour`` over the window in millimetres, y downwards."""
    shown = np.full((*mask.shape, 3), 0.97)
    shown[mask] = colour
    axes.imshow(shown, extent=(-X, X, Y, -Y))


def outline(axes, mask):
    """The border of a contact (h, w)."""
    x, y = SENSOR.pixel_centres(mask.shape)
    axes.contour(1e3 * x, 1e3 * y, mask, [0.5], colors=ORANGE, linewidths=1.2)


def lying(mesh):
    """A rotation (4, 4) about the object's centre that lays its long side across a picture."""
    long = np.linalg.svd(mesh.surface_points(500) - mesh.centre, full_matrices=False)[2]
    across, away = unit(long[0]), unit(long[2] + 0.5 * long[1])
    return transform(np.stack([across, np.cross(away, across), away]), np.zeros(3))


def overlay(axes, caster, T, other, half):
    """The object at ``T``, shaded, and at ``other``, tinted orange, seen along z; the picture is 2 ``half`` [m] wide."""
    camera = Sensor("view", (PIXELS, PIXELS), (2 * half / PIXELS,) * 2, 0.0, 1.0)
    image = np.ones((PIXELS, PIXELS, 3))
    depths = caster.depths(camera, np.stack([T, other]))
    for depth, colour, opacity in zip(depths, ([0.62, 0.66, 0.72], [0.90, 0.45, 0.10]), (1.0, 0.55), strict=True):
        part = np.isfinite(depth)
        down, right = np.gradient(np.where(part, depth, 0.0), 2 * half / PIXELS)
        light = 0.45 + 0.55 / np.sqrt(1 + np.minimum(down**2 + right**2, 30))
        image[part] += opacity * (light[part, None] * colour * 1.25 - image[part])
    extent = 1e3 * half * np.array([-1, 1, 1, -1])
    axes.imshow(np.clip(image, 0, 1), extent=extent)
    axes.contour(np.isfinite(depths[1]), [0.5], colors=ORANGE, linewidths=1.0, extent=extent * [1, 1, -1, -1])
    axes.plot([-0.9e3 * half, -0.9e3 * half + 20], [0.8e3 * half] * 2, color="k", lw=2)
    axes.text(-0.9e3 * half, 0.76e3 * half, "20 mm", fontsize=7)
    axes.set(xticks=[], yticks=[], xlim=extent[:2], ylim=extent[2:])


FIGURES = {"8": (pixel_distance, "pixels"), "10": (pose_errors, "errors"), "15": (contacts_added, "contacts")}
parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("figures", nargs="*", choices=[[], *FIGURES], metavar="NUMBER")
parser.add_argument("--out", type=Path, default=Path("out/thesis"))
options = parser.parse_args()
options.out.mkdir(parents=True, exist_ok=True)
told = options.out / "thesis_figures.json"
shown = json.loads(told.read_text("utf-8")) if told.exists() else {}
for number in options.figures or FIGURES:
    draw, name = FIGURES[number]
    drawn, shown[number] = draw()
    drawn.savefig(options.out / f"thesis_{name}.png", facecolor="white")
    told.write_text(json.dumps(shown, indent=1) + "\n", "utf-8")
    print(f"figure {number}: see {options.out / f'thesis_{name}.png'}")
print(f"their figures: {told}")
