"""Examples to fit on: the objects that are touched, one at a time into files, so that a stopped run goes on."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np

from geomtact.files import write_whole
from geomtact.geometry.mesh import Mesh
from geomtact.progress import Progress
from geomtact.sensing.sensor import Sensor
from tools.training.procedural import random_object

_Example = TypeVar("_Example")

SENSORS = ("gelslim", "gelsight-mini", "gelslim", "digit")  # one after the other


def drawn_object(i: int, sizes: tuple[float, float], rng: np.random.Generator) -> tuple[Sensor, Mesh]:
    """The sensor of example ``i`` and an object for it; its longest side is drawn from ``sizes``, in long sides of the window."""
    sensor = Sensor.load(SENSORS[i % len(SENSORS)])
    size = 2 * sensor.half_window.max() * np.exp(rng.uniform(*np.log(sizes)))
    return sensor, random_object(int(rng.integers(1 << 31)), float(size))


def resumed(
    paths: Sequence[Path],
    make: Callable[[int], Iterable[_Example]],
    save: Callable[[Path, Sequence[_Example]], None],
    load: Callable[[Path], Sequence[_Example]],
    progress: Progress | None = None,
) -> list[_Example]:
    """What ``make`` gives for each object, in files of ``paths``: those that are there already are only read."""
    found: list[_Example] = []
    for i, path in enumerate(paths):
        path.parent.mkdir(parents=True, exist_ok=True)
        if not path.exists():
            made = list(make(i))
            write_whole(path, lambda temporary, made=made: save(temporary, made))  # type: ignore[misc]
        found += load(path)
        if progress:
            progress((i + 1) / len(paths), "exploring touches")
    return found
