"""A study of several objects, each by a process of its own or by the machines of a Ray cluster."""

from __future__ import annotations

import contextlib
import functools
import inspect
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from geomtact.cli.several import Command, Jobs, Ray, do_all, everywhere, objects_with_units, quietly
from tools.studies.common import study_file


def thesis_parts(options: Mapping[str, Any]) -> dict[str, Any]:
    """The options of a study, with the objects that are meant where none is named."""
    from tools.studies.common.study import THESIS_PARTS

    return {**options, "parts": options["parts"] or list(THESIS_PARTS)}


def by_part(
    judge: Command, schema: str, meant: Callable[[Mapping[str, Any]], dict[str, Any]] = thesis_parts
) -> Command:
    """The study ``judge`` of a ``schema``, which takes ``parts`` and ``out``, with the options --jobs and --ray.

    Of each object a task makes a separate file by the same options, with the objects that are ``meant`` by them; what the files
    hold goes into ``--out``, from where the study goes on as one that was stopped after its last object.
    """

    @functools.wraps(judge)
    def run(jobs: int | None = None, ray: str | None = None, **options: Any) -> None:
        if jobs is not None or ray is not None:
            _judge_apart(judge, schema, meant(options), jobs, ray)
        judge(**options)

    parameters = dict(inspect.signature(judge, eval_str=True).parameters)
    for name, kind in (("jobs", Jobs), ("ray", Ray)):
        parameters[name] = inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=kind)
    # by these typer finds the options
    run.__signature__ = inspect.Signature(list(parameters.values()))  # type: ignore[attr-defined]
    run.__annotations__ = {name: parameter.annotation for name, parameter in parameters.items()}
    return run


def _judge_apart(judge: Command, schema: str, options: Mapping[str, Any], jobs: int | None, ray: str | None) -> None:
    """Put what each object's task finds into ``out``.

    Raises
    ------
    UsageError
        There is no ``out``.
    InputError
        Some objects cannot be evaluated; what was found of the others is in ``out``.
    """
    from geomtact.contact_space.store import default_cache_dir
    from geomtact.errors import UsageError

    out: Path | None = options["out"]
    if out is None:
        raise UsageError("--jobs and --ray need --out, the file in which what is found of the objects comes together")
    parts = [str(part) for part in options["parts"]]
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
    for (name, unit), file in zip(objects_with_units(parts, options["unit"]), files, strict=True):
        tasks.append((judge, same | {"parts": [name], "unit": unit, "out": file}))
    try:
        do_all(quietly, tasks, parts, "judged", jobs, ray)
    finally:
        for file in files:  # in the order of the objects, whichever was done first
            found = study_file.load(file, schema)["parts"]
            content["parts"] |= {name: entry for name, entry in found.items() if entry != before.get(name)}
        study_file.save(out, content)
    for file in files:
        file.unlink(missing_ok=True)
    with contextlib.suppress(OSError):  # what else lies there is not ours
        folder.rmdir()
