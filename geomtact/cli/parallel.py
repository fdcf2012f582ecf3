"""Options --jobs and --ray: several objects in parallel, in processes or on the machines of a Ray cluster."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any

import typer

from geomtact.cli.parts import units_of
from geomtact.cli.shell import to_stderr

Jobs = Annotated[
    int | None,
    typer.Option(min=1, help="Number of objects processed in parallel, one core each.", show_default=False),
]
Ray = Annotated[
    str | None,
    typer.Option(metavar="ADDRESS", help="Run on the Ray cluster at this address; auto: this machine's cluster."),
]
Command = Callable[..., None]


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
    from geomtact.errors import InputError, UsageError

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


def parts_of_tasks(parts: Sequence[str], unit: str | None) -> list[tuple[str, str | None]]:
    """Each part's name or file, and the unit that it is loaded with, wherever its task is done."""
    from geomtact.geometry.catalogue import catalogue

    names = [part if part in catalogue() else everywhere(part) for part in parts]
    return list(zip(names, units_of(parts, unit), strict=True))


def quietly(command: Command, options: Mapping[str, Any]) -> None:
    """Do a command without a word: a task of :func:`do_all`."""
    from contextlib import redirect_stderr, redirect_stdout

    with open(os.devnull, "w", encoding="utf-8") as nowhere, redirect_stdout(nowhere), redirect_stderr(nowhere):
        command(**options)
