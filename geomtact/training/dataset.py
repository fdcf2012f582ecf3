"""What networks learn from, made once by several processes and kept in a folder: a stopped run goes on with what is missing."""

from __future__ import annotations

import os
import zipfile
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from geomtact.errors import MeshError
from geomtact.files import write_whole
from geomtact.geometry.mesh import Mesh
from geomtact.progress import Progress
from geomtact.sensing.sensor import Sensor
from geomtact.training.scenes import TrainingScene, make_scene

_FEWEST = 32  # touches of a scene
Make = Callable[[int], TrainingScene]
T = TypeVar("T")


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


def made_once(
    folder: Path,
    n: int,
    make: Callable[[int], Any],
    kind: Callable[..., T],
    doing: str,
    progress: Progress | None = None,
    processes: int = 2,
) -> list[T]:
    """What ``make`` makes of the numbers 0 to ``n`` - 1, in order; what ``folder`` holds already is read.

    ``make`` gives a dataclass of arrays, or None, which is left out; ``kind`` takes its fields and gives it back.
    """
    folder.mkdir(parents=True, exist_ok=True)
    paths, read = [folder / f"{i}.npz" for i in range(n)], partial(_read, kind=kind)
    todo = [i for i, path in enumerate(paths) if read(path) is None]
    done = n - len(todo)
    # processes, because much of the work holds the interpreter; spawned, because Embree and OpenMP do not survive a fork
    with ProcessPoolExecutor(processes, get_context("spawn"), _one_thread) as pool:
        futures = [pool.submit(_write, paths[i], make, i) for i in todo]
        try:
            for future in as_completed(futures):
                future.result()
                done += 1
                if progress:
                    progress(done / n, doing)
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    return [made for path in paths if (made := read(path)) is not None]


def _write(path: Path, make: Callable[[int], Any], i: int) -> None:
    made = make(i)
    if made is not None:
        write_whole(path, lambda temporary: np.savez(temporary, allow_pickle=False, **asdict(made)))


def _read(path: Path, kind: Callable[..., T]) -> T | None:
    try:
        with np.load(path, allow_pickle=False) as data:
            return kind(**{name: data[name] for name in data.files})
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile):
        return None


def _one_thread() -> None:
    import cv2

    os.environ["OMP_NUM_THREADS"] = "1"
    cv2.setNumThreads(1)
