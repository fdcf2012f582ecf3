"""Draw the moving picture of README.md, docs/images/three_touches.gif:

    python -m tools.make_film [--max-poses N] [--out FILE]

An elbow pipe is touched three times by a GelSlim, in simulation. Of 20 such triples, touched anywhere, it shows the one
whose information gain at the true pose is the tenth largest after three touches. About three minutes on two cores.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import cv2
import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from PIL import Image

from geomtact import GeomtactError, Localizer, Sensor, contact_mask
from geomtact.geometry.distance import PoseDistance
from geomtact.se3 import Array, apply, inverse, transform, unit
from geomtact.sensing.cast import Caster

FILM = Path(__file__).resolve().parents[1] / "docs" / "images" / "three_touches.gif"
OBJECT, SENSOR, SEED = "elbow_pipe", "gelslim", 1
TRIPLES, RANK, TOUCHES = 20, 10, 3
SAMPLES, PIXELS = 300, 400
FADE, FADE_MS, ARRIVE_MS, HOLD_MS, END_MS = 8, 80, 1200, 2800, 5000
CONTRAST, BLUR = 2.5, (5, 5)  # of the tactile images as shown; the camera's noise would fill the file
ORANGE, BLUE, GREY, INK = "#D55E00", "#0072B2", "#8A8F98", "#1B1F24"
STYLE = {"font.size": 10, "axes.titlesize": 10.5, "axes.spines.top": False, "axes.spines.right": False}
COUNTS = ("One touch", "Two touches", "Three touches")


@dataclass(frozen=True, eq=False)
class Triple:
    """Three tactile images (H, W, 3) of one object, and where the sensors were (3, 4, 4); the object is at the identity."""

    images: list[Array]
    T_world_sensor: Array


@dataclass(frozen=True)
class Step:
    """The posterior after some touches: samples (n, 4, 4), nats, the first mode's probability and error [mm]."""

    samples: Array
    gain: float
    probability: float
    error_mm: float


def simulate(folder: Path) -> tuple[list[Triple], Array]:
    """The triples and the image of the untouched gel, by the command line."""
    n = str(TRIPLES * TOUCHES)
    words = [
        "simulate",
        OBJECT,
        "--sensor",
        SENSOR,
        "--n",
        n,
        "--seed",
        str(SEED),
        "--tactile-image",
        "--noise",
        "moderate",
    ]
    subprocess.run([sys.executable, "-m", "geomtact", *words, "--out", str(folder)], check=True, stdout=sys.stderr)
    stems = [folder / f"{OBJECT}_{i + 1}" for i in range(TRIPLES * TOUCHES)]
    images = [np.asarray(Image.open(f"{stem}.png")) for stem in stems]
    T = np.array([json.loads(Path(f"{stem}.json").read_text("utf-8"))["T_sensor_object"] for stem in stems])
    some = [slice(i, i + TOUCHES) for i in range(0, len(stems), TOUCHES)]
    return [Triple(images[s], inverse(T)[s]) for s in some], np.asarray(Image.open(folder / "background.png"))


def posterior_after(localizer: Localizer, triple: Triple, background: Array, n: int):
    """The posterior of the first ``n`` touches."""
    images, T = triple.images[:n], triple.T_world_sensor[:n]
    return localizer.localize(images, "reading", [background] * n, T_world_sensor=T)


def choose(localizer: Localizer, triples: list[Triple], background: Array) -> int:
    """The triple of the median information gain after three touches."""
    gains = []
    for triple in triples:
        try:
            gains.append(float(posterior_after(localizer, triple, background, TOUCHES).log_density(np.eye(4))))
        except GeomtactError:  # an image without contact, or no pose that explains all three
            gains.append(-np.inf)
    chosen = int(np.argsort(gains)[::-1][RANK - 1])
    print(f"information gains {np.sort(gains).round(1).tolist()} nats; triple {chosen + 1} is shown")
    return chosen


def steps_of(localizer: Localizer, triple: Triple, background: Array) -> list[Step]:
    """The posterior after one touch, two, and three."""
    distance, out = PoseDistance(localizer.mesh), []
    for n in range(1, TOUCHES + 1):
        posterior = posterior_after(localizer, triple, background, n)
        mode = posterior.modes(1)[0]
        off = 1e3 * float(distance.mean(np.eye(4), mode.T[None])[0])
        out.append(Step(posterior.sample(SAMPLES, 0), -posterior.entropy_nats, mode.probability, off))
    return out


class Stage:
    """Draws the frames: tactile image, samples of the posterior seen from one side, and two curves."""

    def __init__(self, localizer: Localizer, triple: Triple, background: Array):
        self.mesh, self.sensor, self.triple = localizer.mesh, localizer.sensor, triple
        self.background = background
        self.outlines = [contact_mask(image, background, sensor=self.sensor) for image in triple.images]
        self.caster = Caster(self.mesh.vertices, self.mesh.faces)
        long = np.linalg.svd(self.mesh.surface_points(500) - self.mesh.centre, full_matrices=False)[2]
        across, away = unit(long[0]), unit(long[2] + 0.6 * long[1])
        R = np.stack([across, np.cross(away, across), away])
        self.view = transform(R, -R @ self.mesh.centre)
        self.half = 0.8 * self.mesh.diameter
        self.camera = Sensor("view", (PIXELS, PIXELS), (2 * self.half / PIXELS,) * 2, 0.0, 1.0)
        self.true = np.isfinite(self.caster.depths(self.camera, self.view[None])[0])

    def ghosts(self, poses: Array) -> Array:
        """Poses (n, 4, 4) as one picture (h, w, 4), the more opaque the more of them cover a pixel."""
        depths = self.caster.depths(self.camera, self.view @ poses)
        hit = np.isfinite(depths)
        y, x = np.gradient(np.where(hit, depths, np.nan), self.camera.pixel_pitch[0], axis=(1, 2))
        light = np.nan_to_num(1 / np.sqrt(1 + x**2 + y**2), nan=0.3)  # of a lamp at the viewer
        share = hit.mean(0)
        shade = (light * hit).sum(0) / np.maximum(hit.sum(0), 1)
        colour = (0.25 + 0.75 * shade)[..., None] * np.array(mpl.colors.to_rgb("#F0A35E"))
        return np.dstack([colour, share**0.6])

    def draw(self, touch: int, ghosts: Array, steps: list[Step], grown: float, title: str) -> Image.Image:
        """One frame; the curves end ``grown`` of the way from the step before to the last of ``steps``."""
        figure = Figure(figsize=(9, 3.8), dpi=100)
        canvas = FigureCanvasAgg(figure)
        figure.suptitle(title, fontsize=13, fontweight="bold", color=INK, y=0.97)
        self._tactile(figure.add_axes((0.07, 0.2, 0.25, 0.56)), touch)
        self._object(figure.add_axes((0.325, 0.03, 0.355, 0.8)), touch, ghosts)
        curves = figure.add_axes((0.735, 0.55, 0.245, 0.25)), figure.add_axes((0.735, 0.15, 0.245, 0.25))
        self._curves(curves, steps, grown)
        canvas.draw()
        return Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy())

    def _tactile(self, axes, touch: int) -> None:
        x, y = 1e3 * self.sensor.half_window
        change = cv2.blur(self.triple.images[touch].astype(float) - self.background, BLUR)
        axes.imshow(np.clip(0.5 + CONTRAST * change / 255, 0, 1), extent=(-x, x, y, -y))
        across, down = self.sensor.pixel_centres(self.outlines[touch].shape)
        axes.contour(1e3 * across, 1e3 * down, self.outlines[touch], [0.5], colors=INK, linewidths=1.6)
        axes.set(
            title=f"tactile image {touch + 1} and contact", ylabel="y [mm]", xticks=[-20, 0, 20], yticks=[-10, 0, 10]
        )
        axes.set_xlabel("x [mm]\nbackground removed")

    def _object(self, axes, touch: int, ghosts: Array) -> None:
        extent = 1e3 * self.half * np.array([-1, 1, 1, -1])
        axes.imshow(ghosts, extent=extent, zorder=1)
        axes.contour(self.true, [0.5], colors=BLUE, extent=extent, origin="upper", linewidths=1.4, zorder=3)
        corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * self.sensor.half_window
        window = np.column_stack([corners, np.zeros(4)])
        for k, T in enumerate(self.triple.T_world_sensor[: touch + 1]):
            colour = INK if k == touch else GREY
            place = 1e3 * apply(self.view @ T, window)[:, :2]
            axes.fill(*place.T, facecolor=colour, edgecolor=colour, alpha=0.35, lw=1.5, zorder=2)
            number = axes.annotate(str(k + 1), place.mean(0), ha="center", va="center", fontweight="bold", zorder=4)
            number.set(color="w", path_effects=[withStroke(linewidth=2.5, foreground=INK)])
        axes.set(xlim=extent[:2], ylim=extent[2:], xticks=[], yticks=[])
        axes.set_title("posterior samples")
        axes.text(0.5, 0.04, "blue: true pose; grey: sensor windows", ha="center", transform=axes.transAxes)
        for spine in axes.spines.values():
            spine.set_visible(False)

    def _curves(self, panels, steps: list[Step], grown: float) -> None:
        values = [(0.0, 0.0)] + [(step.gain, 100 * step.probability) for step in steps]
        values[-1] = tuple(np.array(values[-2]) + grown * (np.array(values[-1]) - values[-2]))
        number = [*range(len(steps)), len(steps) - 1 + grown]
        names, tops = ("information gain [nats]", "probability of mode 1 [%]"), (30, 110)
        for axes, heights, name, top in zip(panels, zip(*values, strict=True), names, tops, strict=True):
            axes.plot(number, heights, color=ORANGE, lw=2, marker="o", ms=5, clip_on=False)
            axes.set(xlim=(0, TOUCHES + 0.15), ylim=(0, top), xticks=range(TOUCHES + 1), title=name)
            axes.grid(axis="y", color="0.9")
        left = float(f"{np.exp(values[-1][0]):.2g}")  # as many nats are worth, to two digits
        panels[0].text(0.1, 26, f"1 pose in {left:,.0f} left", color=INK)
        panels[1].set_xlabel("touches")


def film(localizer: Localizer, triple: Triple, background: Array) -> tuple[list[Image.Image], list[int]]:
    """The frames, and how long each is shown [ms]."""
    stage, steps = Stage(localizer, triple, background), steps_of(localizer, triple, background)
    frames, durations, before = [], [], np.zeros((PIXELS, PIXELS, 4))
    name = f"{TOUCHES}: an {localizer.mesh.name.replace('_', ' ')} on a simulated sensor"
    for k, step in enumerate(steps):
        now = stage.ghosts(step.samples)
        held = f"{100 * step.probability:.{0 if step.probability > 0.01 else 1}f} %"
        title = f"{COUNTS[k]}: mode 1 holds {held}, {step.error_mm:.0f} mm from the true pose"
        print(f"{title}; {step.gain:.1f} nats")
        for i in range(FADE + 1):
            share = i / FADE
            shown = title if i == FADE else f"Touch {k + 1} of {name}"
            frames.append(stage.draw(k, (1 - share) * before + share * now, steps[: k + 1], share, shown))
            durations.append(ARRIVE_MS if i == 0 else FADE_MS)
        durations[-1] = HOLD_MS if k < TOUCHES - 1 else END_MS
        before = now
    return frames, durations


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--max-poses", type=int, default=300_000, help="of the grid")
    parser.add_argument("--out", type=Path, default=FILM)
    options = parser.parse_args()
    localizer = Localizer.prepare(OBJECT, sensor=SENSOR, max_poses=options.max_poses)
    with tempfile.TemporaryDirectory() as folder:
        triples, background = simulate(Path(folder))
    chosen = triples[choose(localizer, triples, background)]
    with mpl.rc_context(STYLE):
        frames, durations = film(localizer, chosen, background)
    first, *rest = [frame.quantize(256, dither=Image.Dither.NONE) for frame in frames]
    options.out.parent.mkdir(parents=True, exist_ok=True)
    first.save(options.out, save_all=True, append_images=rest, duration=durations, loop=0, optimize=True)
    seconds, megabytes = sum(durations) / 1e3, options.out.stat().st_size / 1e6
    print(f"{options.out}: {len(frames)} frames, {seconds:.0f} s, {megabytes:.1f} MB")


if __name__ == "__main__":
    main()
