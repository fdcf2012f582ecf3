"""``python -m tools.studies stability``: conditions made worse step by step, and whether failures are detected."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Annotated, Any

import typer

from geomtact.cli.options import CacheDir, Effort, MaxPoses, Seed, Unit
from geomtact.cli.shell import print_table, to_stderr
from tools.studies.common import study_file, study_options

SCHEMA = "geomtact/stability/2"
_ALIKE = ("sensor_sha256", "scorer", "touches", "effort", "seed")  # settings that objects taken together share
_NAMES = (
    "noise, specks, depth, pitch, size, surface, faces, threshold, halo, area, border, kind, shown, detail, rig_shift, "
    "rig_turn, jaw, slips, other_part"
)


def judge_stability(
    parts: study_options.ThesisParts = None,
    unit: Unit = None,
    sweep: Annotated[
        list[str] | None,
        typer.Option(
            "--sweep",
            help=f"What to make worse (see docs/robustness.md); may be repeated; all by default: {_NAMES}.",
        ),
    ] = None,
    sensor: study_options.SensorName = "gelslim",
    touches: Annotated[
        int,
        typer.Option(
            "--touches",
            min=1,
            help="How many of each object at each level that is promised to hold; a quarter at others.",
        ),
    ] = 200,
    effort: study_options.EffortLevel = Effort.balanced,
    seed: Seed = 1,
    max_poses: MaxPoses = None,
    out: study_options.Out = None,
    plot: study_options.Plot = None,
    cache_dir: CacheDir = None,
) -> None:
    """Judge stability: noise, wrong pixels, wrong meshes, small contacts and wrong sensor extrinsics, from easy to broken.

    Prints for each level the gain, how often the estimate is wrong, and how often that is undetected; writes all to --out.
    """
    from geomtact.errors import UsageError, nearest_name
    from geomtact.evaluation import describe
    from geomtact.json_values import plain
    from tools.studies.stability import study as stability

    names = sweep or list(stability.SWEEPS)
    for name in names:
        if name not in stability.SWEEPS:
            raise UsageError(f"no sweep named {name!r}{nearest_name(name, stability.SWEEPS)}")
    content = study_file.load(out, SCHEMA)
    for localizer in study_options.localizers(parts, unit, sensor, cache_dir, max_poses):
        settings = describe(localizer) | {"touches": touches, "effort": effort.value, "seed": seed}
        part = localizer.mesh.name
        found = content["parts"].get(part)
        sweeps = dict(found["sweeps"]) if study_file.begun(found, settings) else {}
        as_prepared: list = []
        for name in names:
            one = stability.SWEEPS[name]
            done = sweeps.setdefault(name, {"title": one.title, "inside": list(one.inside), "levels": []})["levels"]
            judged = {at["level"] for at in done}  # at a level that no touch fulfils there is nothing to keep
            for level in (level for level in one.levels if level not in judged):
                many = touches if level in one.inside else -(-touches // 4)
                todo = stability.swept(localizer, one, level, many, seed, effort, as_prepared)
                told = study_file.collect([], todo, many, f"{part}: {one.title} {level:g}", lambda _: None)
                if told:
                    figures = stability.summarise(told)
                    done.append({"level": level, "figures": figures, "answers": _columns(told)})
                content["parts"][part] = plain({"settings": settings, "sweeps": sweeps})
                content["together"] = plain(_together(list(content["parts"].values())))
                study_file.save(out, content)
        _print(part, {name: sweeps[name] for name in names})
    content["together"] = plain(_together(list(content["parts"].values())))
    study_file.save(out, content)
    if len(content["parts"]) > 1:
        _print("all objects", {name: content["together"][name] for name in names if name in content["together"]})
    study_file.plot(content, plot)


def _together(parts: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """The sweeps of all objects that were evaluated as the first one was, the estimates of each level pooled."""
    from tools.studies.stability import study as stability

    how = [{key: part["settings"][key] for key in _ALIKE} for part in parts]
    parts = [part for part, own in zip(parts, how, strict=True) if own == how[0]]
    out: dict[str, Any] = {}
    for name in dict.fromkeys(name for part in parts for name in part["sweeps"]):
        held = [part["sweeps"][name] for part in parts if name in part["sweeps"]]
        answers: dict[float, list] = {level: [] for level in stability.SWEEPS[name].levels}
        for at in (at for sweep in held for at in sweep["levels"]):
            answers.setdefault(at["level"], []).extend(_answers(at["answers"]))
        levels = [{"level": x, "figures": stability.summarise(some)} for x, some in answers.items() if some]
        out[name] = {"title": held[0]["title"], "inside": held[0]["inside"], "levels": levels}
    return out


def _columns(answers: Sequence[Any]) -> dict[str, list]:
    """Estimates as they are written, a list for each field."""
    rows = [asdict(each) for each in answers]
    return {key: [row[key] if isinstance(row[key], bool) else round(row[key], 4) for row in rows] for key in rows[0]}


def _answers(columns: Mapping[str, Sequence[Any]]) -> list[Any]:
    """The estimates that were written as ``columns``."""
    from tools.studies.common.answer import Answer

    rows = zip(*columns.values(), strict=True)
    return [Answer(**study_file.numbers(dict(zip(columns, row, strict=True)))) for row in rows]


def _print(part: str, sweeps: Mapping[str, Any]) -> None:
    rows = []
    for sweep in sweeps.values():
        for at in sweep["levels"]:
            f = at["figures"]
            mark = "" if at["level"] in sweep["inside"] else "*"
            shares = [study_file.percent(f[k]) for k in ("wrong", "warned", "silent", "alarmed")]
            nats = [study_file.figure(f[k]) for k in ("gain_mean", "claimed_mean")]
            told = [*nats, study_file.percent(f["ruled_out"])]
            rows.append([sweep["title"], f"{at['level']:g}{mark}", str(f["n"]), *told, *study_file.inside(f), *shares])
    numbers = ["level", "n", "gain [nats]", "claimed", "ruled out", "in 50 %", "in 90 %"]
    shares = ["wrong", "warned", "silent", "right but warned"]
    typer.echo(
        f"{part}: wrong, the first mode is more than 10 mm off (from one touch most are, and say so by holding little); silent, "
        "wrong, holding half or more, without a warning; * no longer promised to hold"
    )
    print_table(["condition", *numbers, *shares], rows, [*numbers, *shares])
    to_stderr(f"{part}: done")
