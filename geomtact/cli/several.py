"""Several objects: names with commas between them, or a folder of mesh files; in parallel by --jobs and --ray."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from geomtact.cli.shell import to_stderr
from geomtact.errors import InputError, UsageError

Jobs = Annotated[
    int | None,
    typer.Option(min=1, help="Number of objects processed in parallel, one core each.", show_default=False),
]
Ray = Annotated[
    str | None,
    typer.Option(metavar="ADDRESS", help="Run on the Ray cluster at this address; auto: this machine's cluster."),
]
Command = Callable[..., None]


def objects_of(object_name: str | None) -> list[str | None]:
    """The objects that ``--object`` names, each as it would be named alone; bundled ones of a folder by their names.

    Raises
    ------
    InputError
        A folder without meshes, or an object named twice.
    """
    from geomtact.geometry.catalogue import catalogue
    from geomtact.geometry.mesh_file import FORMATS

    if object_name is None or object_name in catalogue():
        return [object_name]
    if not object_name.strip():
        raise InputError("--object: expected an object's name or a mesh file, got an empty text; check your variables")
    folder = Path(object_name)
    if not folder.is_dir():
        names = [name.strip() for name in object_name.split(",")] if not folder.exists() else [object_name]
        if len(set(names)) < len(names) or "" in names:
            raise InputError(f"--object {object_name}: expected each object once, separated by commas")
        return list(names)
    bundled = {entry.file.resolve(): name for name, entry in catalogue().items()}
    files = sorted(p for p in folder.iterdir() if p.suffix.lower() in FORMATS and not p.name.startswith("."))
    if not files:
        raise InputError(f"--object {folder}: no mesh in this folder; expected {', '.join(FORMATS)}")
    return [bundled.get(path.resolve(), str(path)) for path in files]


def units_of(objects: Sequence[str | Path | None], unit: str | None) -> list[str | None]:
    """The unit to load each object with: of several, ``unit`` is for those that state none; None means the object's own.

    If every object states its own, ``unit`` goes to all, so that one which contradicts it is refused as it would be alone.
    """
    from geomtact.geometry.mesh_file import states_unit

    own = [each is not None and states_unit(each) for each in objects]
    return [None if stated and not all(own) else unit for stated in own]


def do_all(
    work: Command,
    tasks: Sequence[tuple[object, ...]],
    names: Sequence[str],
    done: str,
    jobs: int | None = None,
    ray: str | None = None,
) -> None:
    """Do ``tasks`` as ``geomtact.batch.run_all`` does, and print the name of each that is ``done``, or why it is not.

    Raises
    ------
    InputError
        Some failed; the others are done.
    """
    from geomtact.batch import run_all

    if jobs is not None and ray is not None:
        raise UsageError("--jobs is for this machine and --ray for a cluster; give one of them")
    wrong = []
    together = run_all(work, tasks, min(jobs or os.cpu_count() or 1, len(tasks)), ray)
    for count, (number, error) in enumerate(together, 1):
        outcome = done if error is None else f"not {done}: {' '.join(str(error).split())}"
        to_stderr(f"[{count} of {len(tasks)}] {names[number]}: {outcome}")
        if error is not None:
            wrong.append(names[number])
    if wrong:
        raise InputError(
            f"{len(wrong)} of {len(tasks)} objects are not {done}, for the reasons above: {', '.join(wrong)}"
        )


def everywhere(name: str) -> str:
    """A name, or the file of that name, in whatever folder a task is done."""
    return os.path.abspath(name) if os.path.isfile(name) else name


def objects_with_units(objects: Sequence[str], unit: str | None) -> list[tuple[str, str | None]]:
    """Each object's name or file, and the unit that it is loaded with, wherever its task is done."""
    from geomtact.geometry.catalogue import catalogue

    names = [each if each in catalogue() else everywhere(each) for each in objects]
    return list(zip(names, units_of(objects, unit), strict=True))


def quietly(command: Command, options: Mapping[str, Any]) -> None:
    """Do a command without a word: a task of :func:`do_all`."""
    from contextlib import redirect_stderr, redirect_stdout

    with open(os.devnull, "w", encoding="utf-8") as nowhere, redirect_stdout(nowhere), redirect_stderr(nowhere):
        command(**options)
