"""Several parts, each by a process of its own or by the machines of a Ray cluster."""

from __future__ import annotations

import contextlib
import functools
import inspect
import os
import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from geomtact.cli import study_file
from geomtact.cli.parts import units_of
from geomtact.cli.shell import tell

Jobs = Annotated[
    int | None,
    typer.Option(min=1, help="How many parts are worked on at a time, each by one core.", show_default=False),
]
Ray = Annotated[
    str | None,
    typer.Option(metavar="ADDRESS", help="Work on the machines of a Ray cluster; auto for the one this belongs to."),
]
Command = Callable[..., None]


def do_all(
    work: Command,
    tasks: Sequence[tuple[Any, ...]],
    names: Sequence[str],
    done: str,
    jobs: int | None = None,
    ray: str | None = None,
) -> None:
    """Do ``tasks`` as ``geomtact.batch.run_all`` does, and tell by its name of each that is ``done``, or why it is not.

    Raises
    ------
    InputError
        Some are not; the others are.
    """
    from geomtact.batch import run_all
    from geomtact.errors import InputError, UsageError

    if jobs is not None and ray is not None:
        raise UsageError("--jobs is for this machine, a Ray cluster has its own number of cores; leave out one of them")
    wrong = []
    together = run_all(work, tasks, min(jobs or os.cpu_count() or 1, len(tasks)), ray)
    for count, (number, error) in enumerate(together, 1):
        told = done if error is None else f"not {done}: {' '.join(str(error).split())}"
        tell(f"[{count} of {len(tasks)}] {names[number]}: {told}")
        if error is not None:
            wrong.append(names[number])
    if wrong:
        raise InputError(
            f"{len(wrong)} of {len(tasks)} parts are not {done}, for the reasons above: {', '.join(wrong)}"
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


def thesis_parts(options: Mapping[str, Any]) -> dict[str, Any]:
    """The options of a study, with the parts that are meant where none is named."""
    from geomtact.evaluation.study import THESIS_PARTS

    return {**options, "parts": options["parts"] or list(THESIS_PARTS)}


def by_part(judge: Command, meant: Callable[[Mapping[str, Any]], dict[str, Any]] = thesis_parts) -> Command:
    """The study ``judge``, which takes ``parts`` and ``out``, with the options --jobs and --ray.

    Of each part a task makes a file of its own by the same options, with the parts that are ``meant`` by them; what the files
    hold goes into ``--out``, from where the study goes on as one that was stopped after its last part.
    """

    @functools.wraps(judge)
    def run(jobs: int | None = None, ray: str | None = None, **options: Any) -> None:
        if jobs is not None or ray is not None:
            _judge_apart(judge, meant(options), jobs, ray)
        judge(**options)

    parameters = dict(inspect.signature(judge, eval_str=True).parameters)
    for name, kind in (("jobs", Jobs), ("ray", Ray)):
        parameters[name] = inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=kind)
    # by these typer finds the options
    run.__signature__ = inspect.Signature(list(parameters.values()))  # type: ignore[attr-defined]
    run.__annotations__ = {name: parameter.annotation for name, parameter in parameters.items()}
    return run


def _judge_apart(judge: Command, options: Mapping[str, Any], jobs: int | None, ray: str | None) -> None:
    """Put what each part's task finds into ``out``.

    Raises
    ------
    UsageError
        There is no ``out``.
    InputError
        Some parts cannot be judged; what was found of the others is in ``out``.
    """
    from geomtact.contact_space.store import default_cache_dir
    from geomtact.errors import UsageError

    out: Path | None = options["out"]
    if out is None:
        raise UsageError("--jobs and --ray need --out, the file in which what is found of the parts comes together")
    schema, parts = judge.__globals__["SCHEMA"], [str(part) for part in options["parts"]]
    names = [Path(part).stem for part in parts]
    if twice := next((name for name in names if names.count(name) > 1), None):
        raise UsageError(f"two parts are named {twice!r}, and a study keeps what it finds by name; rename one's file")
    content = study_file.load(out, schema)
    before = dict(content["parts"])
    folder = out.absolute().with_name(f"{out.stem}.parts")
    folder.mkdir(parents=True, exist_ok=True)
    files = [folder / f"{name}.json" for name in names]
    for file in files:
        if before and not file.exists():
            shutil.copyfile(out, file)
    same = dict(options) | {name: None for name in options if name.startswith("plot")}
    same["sensor"] = everywhere(options["sensor"])
    if "cache_dir" in options:  # a study of what preparing costs has none
        same["cache_dir"] = (options["cache_dir"] or default_cache_dir()).absolute()
    tasks = []
    for (name, unit), file in zip(parts_of_tasks(parts, options["unit"]), files, strict=True):
        tasks.append((judge, same | {"parts": [name], "unit": unit, "out": file}))
    try:
        do_all(quietly, tasks, parts, "judged", jobs, ray)
    finally:
        for file in files:  # in the order of the parts, whichever was done first
            found = study_file.load(file, schema)["parts"]
            content["parts"] |= {name: entry for name, entry in found.items() if entry != before.get(name)}
        study_file.save(out, content)
    for file in files:
        file.unlink(missing_ok=True)
    with contextlib.suppress(OSError):  # what else lies there is not ours
        folder.rmdir()
