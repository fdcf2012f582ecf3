"""Scenes to learn from, made once and kept: of procedural parts for the shared encoder, of one part to fine-tune it."""

from __future__ import annotations

import zipfile
from collections.abc import Callable, Iterator
from dataclasses import asdict
from functools import partial
from pathlib import Path

import numpy as np

from geomtact.errors import MeshError
from geomtact.files import write_whole
from geomtact.geometry.mesh import Mesh
from geomtact.progress import Progress
from geomtact.sensing.sensor import Sensor
from geomtact.training.numbered import write_all
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
    write_all(
        folder,
        n,
        partial(_write, make=make),
        lambda path: _read(path) is not None,
        "simulating scenes",
        progress,
        processes,
    )
    return [scene for scene in _all(folder, n) if len(scene.true) >= _FEWEST]


def _all(folder: Path, n: int) -> Iterator[Scene]:
    for i in range(n):
        scene = _read(folder / f"{i}.npz")
        if scene is not None:
            yield scene


def _write(path: Path, i: int, make: Make) -> None:
    try:
        scene = make(i)
    except MeshError:  # nothing of this part touches this sensor
        return
    write_whole(path, lambda temporary: np.savez(temporary, allow_pickle=False, **asdict(scene)))


def _read(path: Path) -> Scene | None:
    try:
        with np.load(path, allow_pickle=False) as data:
            arrays = {name: data[name] for name in data.files}
        return Scene(**arrays | {"pixel": float(arrays["pixel"])})
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile):
        return None
