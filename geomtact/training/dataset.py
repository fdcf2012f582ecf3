"""Scenes to learn from, made once and kept."""

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
from geomtact.training.scenes import TrainingScene, make_scene

_FEWEST = 32  # touches of a scene
Make = Callable[[int], TrainingScene]


def make_scenes(
    folder: Path, n: int, make: Make, progress: Progress | None = None, processes: int = 2
) -> list[TrainingScene]:
    """What ``make`` makes of the numbers 0 to ``n`` - 1, in order; those that ``folder`` holds already are read.

    Scenes in which hardly anything touches are left out, so that there may be a few less.
    """
    found = made_once(folder, n, partial(_touched, make=make), _scene, "simulating scenes", progress, processes)
    return [scene for scene in found if len(scene.true) >= _FEWEST]


def object_scenes(
    folder: Path,
    mesh: Mesh,
    sensor: Sensor,
    max_poses: int,
    n: int,
    seed: int = 0,
    progress: Progress | None = None,
    processes: int = 2,
) -> list[TrainingScene]:
    """``n`` scenes of one object on one sensor, each with directions of its own, for :func:`make_scenes`' folder."""
    make = partial(_object_scene, mesh=mesh, sensor=sensor, max_poses=max_poses, seed=seed)
    return make_scenes(folder, n, make, progress, processes)


def _object_scene(i: int, mesh: Mesh, sensor: Sensor, max_poses: int, seed: int) -> TrainingScene:
    return make_scene(mesh, sensor, max_poses, np.random.default_rng([seed, i]))


def _touched(i: int, make: Make) -> TrainingScene | None:
    try:
        return make(i)
    except MeshError:  # this object never touches this sensor
        return None


def _scene(**arrays: Any) -> TrainingScene:
    return TrainingScene(**arrays | {"pixel": float(arrays["pixel"])})
