"""Scenes to learn from, made once and kept: of procedural parts for the shared encoder, of one part to fine-tune it."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from geomtact.errors import MeshError
from geomtact.geometry.mesh import Mesh
from geomtact.progress import Progress
from geomtact.sensing.sensor import Sensor
from geomtact.training.numbered import made_once
from geomtact.training.parts import random_part
from geomtact.training.scenes import Scene, make_scene

SENSORS = ("gelslim", "gelslim", "gelslim", "gelsight-mini", "digit")  # one after the other
SIZES = (0.5, 3.5)  # longest side of a part, in long sides of the window
POSES = (1e5, 1.5e6)  # that the grid is chosen for
_FEWEST = 32  # touches of a scene
Make = Callable[[int], Scene]


def shared_scenes(
    folder: Path, n: int, seed: int = 0, progress: Progress | None = None, processes: int = 2
) -> list[Scene]:
    """Scenes of ``n`` procedural parts, in order; those that ``folder`` holds already are read.

    Scenes in which hardly anything touches are left out, so that there may be a few less.
    """
    return _scenes(folder, n, partial(_procedural, seed=seed), progress, processes)


def part_scenes(
    folder: Path,
    mesh: Mesh,
    sensor: Sensor,
    max_poses: int,
    n: int,
    seed: int = 0,
    progress: Progress | None = None,
    processes: int = 2,
) -> list[Scene]:
    """``n`` scenes of one part on one sensor, each with directions of its own."""
    make = partial(_own, mesh=mesh, sensor=sensor, max_poses=max_poses, seed=seed)
    return _scenes(folder, n, make, progress, processes)


def _procedural(i: int, seed: int) -> Scene:
    rng = np.random.default_rng([seed, i])
    sensor = Sensor.load(SENSORS[i % len(SENSORS)])
    size = 2 * sensor.half_window.max() * np.exp(rng.uniform(*np.log(SIZES)))
    part = random_part(int(rng.integers(1 << 31)), float(size))
    return make_scene(part, sensor, int(np.exp(rng.uniform(*np.log(POSES)))), rng)


def _own(i: int, mesh: Mesh, sensor: Sensor, max_poses: int, seed: int) -> Scene:
    return make_scene(mesh, sensor, max_poses, np.random.default_rng([seed, i]))


def _scenes(folder: Path, n: int, make: Make, progress: Progress | None, processes: int) -> list[Scene]:
    found = made_once(folder, n, partial(_touched, make=make), _scene, "simulating scenes", progress, processes)
    return [scene for scene in found if len(scene.true) >= _FEWEST]


def _touched(i: int, make: Make) -> Scene | None:
    try:
        return make(i)
    except MeshError:  # nothing of this part touches this sensor
        return None


def _scene(**arrays: Any) -> Scene:
    return Scene(**arrays | {"pixel": float(arrays["pixel"])})
