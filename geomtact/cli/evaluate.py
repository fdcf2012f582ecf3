"""``geomtact evaluate``: how well an object will be localized, on simulated touches of it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from geomtact.cli.options import CacheDir, Effort, EffortName, MaxPoses, Objects, Seed, SensorName, Unit, check_name
from geomtact.cli.project import required, resolve
from geomtact.cli.request import Request
from geomtact.cli.several import Jobs, Ray, do_all, everywhere, objects_with_units, quietly
from geomtact.cli.shell import check_folder, print_table, progress_bar, to_stderr
from geomtact.errors import InputError, UsageError

if TYPE_CHECKING:
    from geomtact.evaluation import Outcome

SCHEMA = "geomtact/evaluation/1"
_SAVE_EVERY = 10  # touches


def evaluate(
    objects: Objects = None,
    unit: Unit = None,
    sensor: SensorName = None,
    touches: Annotated[
        int, typer.Option("--touches", min=1, help="Number of localizations by each number of sensors.")
    ] = 50,
    sensors: Annotated[
        str, typer.Option("--sensors", metavar="N,N,...", help="Numbers of sensors that touch the object at once.")
    ] = "1,2,3,5",
    effort: EffortName = None,
    seed: Seed = 1,
    max_poses: MaxPoses = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", help="Folder for OBJECT.json and OBJECT.png. A stopped evaluation continues from there."),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the JSON to standard output, and no table.")] = False,
    cache_dir: CacheDir = None,
    jobs: Jobs = None,
    ray: Ray = None,
) -> None:
    """Evaluate how well your object will be localized, on simulated touches of its mesh at known poses.

    Prints information gain, pose error, empirical coverage and time by number of sensors. Rigid and elastic contacts alternate,
    with moderate noise. Several objects are evaluated in parallel, one on each core.
    """
    from geomtact.contact_space.store import default_cache_dir
    from geomtact.json_values import read_json, to_text

    given = {"object": objects[0] if objects else None, "unit": unit, "sensor": sensor, "effort": effort}
    values, sources = resolve(given)
    first, sensor_named = required(values, "OBJECT")
    objects = objects or [first]
    effort = values["effort"] or Effort.balanced.value
    check_name("effort", effort, Effort, sources.get("effort"))
    check_folder(out)
    options: dict[str, Any] = {
        "sensor": everywhere(sensor_named),
        "sensors": _numbers(sensors),
        "touches": touches,
        "effort": effort,
        "seed": seed,
        "max_poses": max_poses,
        "cache_dir": (cache_dir or default_cache_dir()).absolute(),
        "out": out and out.absolute(),
    }
    Request(values, sources).announce()
    named: list[dict[str, Any]] = [
        {"name": name, "unit": own} for name, own in objects_with_units(objects, values["unit"])
    ]
    if len(named) == 1 and jobs is None and ray is None:
        contents = [evaluate_object(**named[0], **options)]
    else:
        if out is None:
            raise UsageError("several objects, --jobs and --ray need --out, the folder for their results")
        files = [_file(out, name) for name in objects]
        if twice := next((file.stem for file in files if files.count(file) > 1), None):
            raise UsageError(f"two objects are named {twice!r}, and results are kept by name; rename one's file")
        tasks = [(evaluate_object, each | options) for each in named]
        do_all(quietly, tasks, objects, "evaluated", jobs, ray)
        contents = [read_json(file) for file in files]
    if as_json:
        typer.echo(to_text(contents[0]) if len(contents) == 1 else "[" + ",\n".join(map(to_text, contents)) + "]")
        return
    for content in contents:
        _print(content)
    if out is not None:
        typer.echo(f"written: {', '.join(str(_file(out, name).with_suffix('.*')) for name in objects)}")


def _numbers(sensors: str) -> list[int]:
    """Numbers of sensors, ascending, that the command line names.

    Raises
    ------
    UsageError
    """
    words = [word.strip() for word in sensors.split(",")]
    if not all(word.isdecimal() and int(word) > 0 for word in words):
        raise UsageError(
            f"--sensors: expected whole numbers above 0 with commas between them, such as 1,2,3,5, got {sensors!r}"
        )
    return sorted({int(word) for word in words})


def _file(out: Path, name: str) -> Path:
    return out / f"{Path(name).stem}.json"


def evaluate_object(
    name: str,
    unit: str | None,
    sensor: str,
    sensors: Sequence[int],
    touches: int,
    effort: str,
    seed: int,
    max_poses: int | None,
    cache_dir: Path,
    out: Path | None,
) -> dict[str, Any]:
    """Evaluate one object from where its file in ``out`` ends; returns what the file then holds.

    Raises
    ------
    InputError
        The file is no evaluation, or one with other settings.
    """
    from dataclasses import asdict

    from geomtact import evaluation
    from geomtact.contact_space.touches import penetrations
    from geomtact.files import write_bytes, write_text
    from geomtact.geometry.distance import mode_radius
    from geomtact.json_values import plain, to_text
    from geomtact.report.evaluation_plot import draw_evaluation
    from geomtact.sensing.noise import MODERATE
    from geomtact.versions import versions

    values = {"object": name, "unit": unit, "sensor": sensor}
    localizer = Request(values, {}, max_poses=max_poses, cache_dir=cache_dir).open()
    mesh = localizer.mesh
    for warning in mesh.warnings:
        to_stderr(f"warning: {warning}")
    settings = evaluation.describe(localizer) | {
        "touches": touches,
        "sensors": sensors,
        "noise": {"name": "moderate", **asdict(MODERATE)},
        "penetration_mm": [1e3 * depth for depth in penetrations(localizer.space)],
        "effort": effort,
        "seed": seed,
    }
    path = None if out is None else _file(out, name)
    content: dict[str, Any] = {
        "schema": SCHEMA,
        "object": {"name": mesh.name, "sha256": mesh.sha256, "unit": mesh.unit},
        "sensor": localizer.sensor.name,
        "mode_radius_mm": 1e3 * mode_radius(mesh),
        "settings": plain(settings),
    }
    rows = _earlier(path, content["settings"])

    def keep() -> None:
        content["figures"] = plain([asdict(each) for each in evaluation.accuracy(rows)])
        content["outcomes"] = plain([[asdict(outcome) for outcome in row] for row in rows])
        content["versions"] = versions()
        if path is not None:
            path.parent.mkdir(parents=True, exist_ok=True)
            write_text(path, to_text(content))

    with progress_bar(f"evaluating {mesh.name}") as progress:
        try:
            for row in evaluation.evaluate(localizer, sensors, touches, effort, seed, len(rows)):
                rows.append(row)
                progress(len(rows) / touches, "")
                if len(rows) % _SAVE_EVERY == 0:
                    keep()
        finally:
            keep()
    if path is not None:
        title = f"{mesh.name} on {localizer.sensor.name}"
        write_bytes(
            path.with_suffix(".png"), draw_evaluation(evaluation.accuracy(rows), title, content["mode_radius_mm"])
        )
    return content


def _earlier(path: Path | None, settings: Mapping[str, Any]) -> list[list[Outcome]]:
    """The outcomes that an earlier run with the same settings left in a file."""
    from geomtact.evaluation import changed
    from geomtact.json_values import read_json

    if path is None or not path.exists():
        return []
    try:
        held = read_json(path)
        if held["schema"] != SCHEMA:
            raise ValueError("another schema")
        before, rows = dict(held["settings"]), _outcomes(held)
    except (ValueError, KeyError, TypeError):
        raise InputError(f"{path}: expected a file of the schema {SCHEMA}; give another folder with --out") from None
    if other := changed(before, settings):
        raise InputError(
            f"{path}: holds an evaluation with other settings ({', '.join(other)}); give another folder with --out, or the same "
            "settings to continue it"
        )
    return rows


def _outcomes(content: Mapping[str, Any]) -> list[list[Outcome]]:
    """Outcomes as written; null stands for the log of no probability, or for the error where there is no mode."""
    from geomtact.evaluation import Outcome

    def number(key: str, value: Any) -> Any:
        return value if value is not None else -math.inf if key == "information_gain_nats" else math.inf

    return [
        [Outcome(**{key: number(key, value) for key, value in each.items()}) for each in row]
        for row in content["outcomes"]
    ]


def _print(content: Mapping[str, Any]) -> None:
    from geomtact.evaluation import LEVELS, accuracy
    from geomtact.report.evaluation_plot import finding

    figures, rows, regions = accuracy(_outcomes(content)), [], []
    for f in figures:
        gain = "-" if f.information_gain_nats is None else f"{f.information_gain_nats:.2f}"
        gain += "" if f.standard_error_nats is None else f" ± {f.standard_error_nats:.2f}"
        errors = (f.error_mm_median, f.error_mm_90_percent, f.best_of_5_error_mm_median)
        inside = f"{100 * f.within_mode_radius[0]:.0f} %"
        rows.append([str(f.sensors), gain, *(f"{mm:.1f}" for mm in errors), inside, f"{f.ms_median:.0f}"])
        shares = [f"{100 * c.share:.0f} % ({100 * c.low:.0f}-{100 * c.high:.0f})" for c in f.coverage]
        regions.append([str(f.sensors), *shares, f"{100 * f.excluded:.0f} %"])
    n, radius = figures[0].n, content["mode_radius_mm"]
    typer.echo(f"{content['object']['name']} on {content['sensor']}: {n} simulated touches by each number of sensors")
    typer.echo(f"{finding(figures)}.")
    headings = ["sensors", "information gain [nats]", "MSSD [mm]: median", "90 %", "best of 5"]
    headings += [f"within {radius:.1f} mm", "time [ms]"]
    print_table(headings, rows, headings)
    for line in (
        "MSSD: largest error of a surface point at the most probable mode, modulo symmetry.",
        f"best of 5: median of the least MSSD of the five most probable modes. within {radius:.1f} mm: share of true poses "
        "within the first mode.",
        "nats: log density at the true pose relative to the uniform distribution over all touching poses.",
        "HPD: the most probable poses that together hold the stated probability.",
    ):
        typer.echo(line)
    typer.echo("Empirical coverage of HPD credible levels, with 95 % intervals; and true poses without probability")
    headings = ["sensors", *(f"{100 * level:.0f} %" for level in LEVELS), "excluded"]
    print_table(headings, regions, headings)
