"""Trains the shared encoder from nothing, on simulated touches of procedural objects."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np

from geomtact.progress import Progress
from geomtact.scoring.encoder import ARCHITECTURE
from geomtact.sensing.sensor import Sensor
from geomtact.training.card import write_encoder
from geomtact.training.dataset import make_scenes
from geomtact.training.scenes import TrainingScene, make_scene
from geomtact.training.state import claim, read_weights, sha256_of
from geomtact.training.train import Settings, train
from tools.training.procedural import random_object

SENSORS = ("gelslim", "gelslim", "gelslim", "gelsight-mini", "digit")  # one after the other
SIZES = (0.5, 3.5)  # longest side of an object, in long sides of the window
POSES = (1e5, 1.5e6)  # numbers of grid poses that the grid is chosen for


def train_encoder(
    out: Path, work: Path, n: int, settings: Settings, start: Path | None = None, progress: Progress | None = None
) -> float:
    """Train on scenes of ``n`` procedural objects and write ``out``, its card and its curves; the gain [nats] on unseen scenes.

    ``work`` keeps the scenes and the state; ``start`` names weights to begin with.
    """
    sizes = {"width": settings.width, "dimension": settings.dimension, "seed": settings.seed}
    claim(work, {"architecture": ARCHITECTURE} | sizes | {"start": sha256_of(start)})
    made = make_scenes(work / "scenes", n, partial(procedural_scene, seed=settings.seed), progress)
    data = {"parts": "procedural", "sensors": SENSORS, "sizes": SIZES, "poses": POSES}
    if start is not None:
        data["start"] = start.name
    weights = None if start is None else read_weights(start)
    network, curve = train(made, settings, work, progress, start=weights)
    write_encoder(out, network, curve, settings, made, data)
    return curve.validation[-1]


def procedural_scene(i: int, seed: int) -> TrainingScene:
    """Scene number ``i``: an object, a size and a number of grid poses drawn for it, on a sensor in turn."""
    rng = np.random.default_rng([seed, i])
    sensor = Sensor.load(SENSORS[i % len(SENSORS)])
    size = 2 * sensor.half_window.max() * np.exp(rng.uniform(*np.log(SIZES)))
    mesh = random_object(int(rng.integers(1 << 31)), float(size))
    return make_scene(mesh, sensor, int(np.exp(rng.uniform(*np.log(POSES)))), rng)
