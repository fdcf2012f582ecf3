"""Examples to fit on, made one object at a time into files, so that a stopped run goes on."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TypeVar

from geomtact.files import write_whole
from geomtact.progress import Progress

_Example = TypeVar("_Example")


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
