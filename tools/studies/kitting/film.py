"""Kitting: a robot takes an object whose pose it does not know, touches it until it is sure, and places it in its fixture.

A jaw with a sensor in each finger grasps the object; a second one touches it where the expected gain is largest. The
fixture is a recess of the object's own shape, open to above, wider by a clearance on all sides. The object is placed
only if, of the poses that the posterior leaves, 95 % would go in. The robot is simulated. About ten seconds on two
cores, after the object's touches were simulated once (a minute); the picture and the animation go to out/kitting.
"""

import argparse
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from geomtact import GeomtactError, Localizer, Sensor
from geomtact.se3 import apply, inverse, transform, unit
from tools.studies.kitting.cell import SURE, draw_part, kit
from tools.studies.kitting.fixture import Fixture

OUT = Path("out/kitting")
BLUE, RED, GREEN = "#0072B2", "#D55E00", "#009E73"
PIXELS, CLOSING, PLACING = 120, 5, 10  # of the pictures; frames of a closing and of the placing

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--part", default="pin", help="a bundled object, or a mesh file with --unit")
parser.add_argument("--unit", help="of a mesh file: mm, cm, m or inch")
parser.add_argument("--clearance-mm", type=float, default=1.0)
parser.add_argument("--touches", type=int, default=4)
parser.add_argument("--max-poses", type=int, default=300_000, help="of the grid")
parser.add_argument("--seed", type=int, default=0)
options = parser.parse_args()
if options.touches < 1 or options.clearance_mm < 0:
    parser.error("expected --touches of 1 or more and a --clearance-mm of 0 or more")

try:
    localizer = Localizer.prepare(options.part, options.unit, sensor="gelslim", max_poses=options.max_poses)
except GeomtactError as refused:
    parser.error(str(refused))
space, mesh, rng = localizer.space, localizer.mesh, np.random.default_rng(options.seed)
fixture, clearance = Fixture(mesh), 1e-3 * options.clearance_mm
truth = draw_part(space, rng)  # only the simulated fingers know it, and the check at the end

steps = []  # where no pose agrees with all touches, the next one raises geomtact.errors.NoPoseAgreesError
for step in kit(localizer, fixture, truth, [clearance], rng, options.touches):
    steps.append(step)
    decision = step.decisions[0]
    known = f"{-step.posterior.entropy_nats:.1f} nats gained"
    print(f"touch {len(steps)}: {known}, it fits with {100 * decision.probability:.0f} %")
    if decision.sure:
        break
error = inverse(decision.T_world_part) @ truth  # where the object lies in the fixture's frame, were it placed
needed_mm = 1e3 * fixture.clearance_needed(error)[0]
if decision.sure:
    verdict = "placed right" if needed_mm <= options.clearance_mm else "placed wrong"
    print(f"{verdict}: it needs {needed_mm:.2f} mm of {options.clearance_mm:g} mm")
else:
    verdict = "not sure, not placed"
    print(f"{verdict} (it would have needed {needed_mm:.2f} mm)")

# all pictures are seen so that the object's long side lies across and the first jaw closes in the picture's plane
long = np.linalg.svd(mesh.surface_points(500) - mesh.centre, full_matrices=False)[2][0]
across = unit(truth[:3, :3] @ long)
away = unit(np.cross(across, [0.0, 0.1, 1.0]))
to_view = transform(np.stack([across, np.cross(away, across), away]), np.zeros(3))
to_view[:3, 3] = -apply(to_view @ truth, mesh.centre[None])[0]
half = 0.65 * mesh.diameter
camera = Sensor("view", (PIXELS, PIXELS), (2 * half / PIXELS,) * 2, 0.0, 1.0)
extent = 1e3 * half * np.array([-1, 1, 1, -1])
corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * localizer.sensor.half_window
window = np.column_stack([corners, np.zeros(4)])


def covered(T_world_part):
    """Share (h, w) of poses (n, 4, 4) at which the object lies on a pixel's line of sight."""
    return np.isfinite(space.caster.depths(camera, to_view @ T_world_part)).mean(0)


def draw(fingers, believed, probabilities, placed=None, title=""):
    """One picture (h, w, 3): the cell on the left, the decision and the fixture on the right; ``placed`` in the fixture."""
    figure = Figure(figsize=(8, 3.4), dpi=80, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    left, middle, right = figure.subplots(1, 3, width_ratios=(3, 1.3, 3))
    left.imshow(np.sqrt(believed), extent=extent, cmap="Greys", vmin=0, vmax=1.5)
    left.contour(covered(truth[None]), [0.5], colors=BLUE, extent=extent, origin="upper", linewidths=1)
    for T in fingers:
        left.fill(*1e3 * apply(to_view @ T, window)[:, :2].T, facecolor=RED, edgecolor=RED, alpha=0.5, lw=1.5)
    left.set_title("grey: believed, blue: true")
    colours = [GREEN if p >= SURE else "0.6" for p in probabilities]
    middle.bar(range(1, len(probabilities) + 1), probabilities, color=colours)
    middle.axhline(SURE, color="k", lw=0.8, ls="--")
    middle.set(xlim=(0.4, options.touches + 0.6), xticks=range(1, options.touches + 1), ylim=(0, 1))
    middle.set(title=f"P(fits), sure from {SURE:g}", xlabel="touches")
    recess = covered(truth[None])
    right.imshow(np.where(recess > 0, 0.25, 0.0), extent=extent, cmap="Greys", vmin=0, vmax=1)
    if placed is not None:
        colour = GREEN if verdict == "placed right" else RED
        right.contour(covered(truth @ placed[None]), [0.5], colors=colour, extent=extent, origin="upper")
    right.set_title(f"fixture, {options.clearance_mm:g} mm wider")
    for axes in (left, right):
        axes.set(xticks=[], yticks=[], xlim=extent[:2], ylim=extent[2:])
    figure.suptitle(title, fontsize=10)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


frames, durations, believed, before = [], [], np.zeros((PIXELS, PIXELS)), 0
for number, step in enumerate(steps, 1):
    fingers = step.felt.T_world_sensor[before:]
    before += len(fingers)
    odds = [s.decisions[0].probability for s in steps[:number]]
    for k in range(CLOSING):
        back = transform(np.eye(3), [0, 0, -0.3 * mesh.diameter * (1 - (k + 1) / CLOSING)])
        frames.append(draw(fingers @ back, believed, odds[:-1], title=f"touch {number}"))
        durations.append(120)
    poses = step.belief.T[rng.choice(len(step.belief.T), 100, p=step.belief.weight)]
    believed = covered(poses)
    frames.append(draw(fingers, believed, odds, title=f"touch {number}: it fits with {100 * odds[-1]:.0f} %"))
    durations.append(1500)
if decision.sure:
    for k in range(PLACING + 1):
        lifted = transform(np.eye(3), -0.6 * half * (1 - k / PLACING) * to_view[1, :3])
        above = inverse(truth) @ lifted @ truth @ error
        frames.append(draw([], believed, odds, above, title="placing"))
        durations.append(80)
frames[-1] = draw(fingers, believed, odds, error if decision.sure else None, verdict)
durations[-1] = 3000

OUT.mkdir(parents=True, exist_ok=True)
Image.fromarray(frames[-1]).save(OUT / f"{mesh.name}.png")
first, *rest = [Image.fromarray(frame).quantize(32) for frame in frames]
first.save(OUT / f"{mesh.name}.gif", save_all=True, append_images=rest, duration=durations, loop=0, optimize=True)
print(f"see {OUT / mesh.name}.png and .gif")
