"""``python -m tools.studies thesis``: the thesis's Table 1, on objects touched from a known contact face."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from geomtact.cli.options import CacheDir, Effort, Seed, Unit
from geomtact.cli.shell import print_table, progress_bar, to_stderr
from geomtact.cli.simulate import NoiseName
from tools.studies.common import study_file, study_options

if TYPE_CHECKING:
    from geomtact.geometry.mesh import Mesh
    from geomtact.sensing.noise import Noise
    from geomtact.sensing.sensor import Sensor

SCHEMA = "geomtact/thesis-table/2"
_POSES = 50_000  # of an object that is touched from a known contact face


def judge_thesis_table(
    parts: study_options.ThesisParts = None,
    unit: Unit = None,
    sensor: study_options.SensorName = "gelslim",
    sides: Annotated[int, typer.Option("--sides", min=1, help="From how many sides each object is touched.")] = 5,
    touches: Annotated[int, typer.Option("--touches", min=1, help="How many touches from each side.")] = 40,
    noise: study_options.NoiseLevel = NoiseName.moderate,
    felt: study_options.Felt = study_options.FeltName.elastic,
    effort: study_options.EffortLevel = Effort.exact,
    ambiguity: Annotated[
        int,
        typer.Option("--ambiguity", min=0, help="For how many of them to seek all poses that show the same contact."),
    ] = 0,
    seed: Seed = 1,
    out: study_options.Out = None,
    plot: study_options.Plot = None,
    cache_dir: CacheDir = None,
) -> None:
    """Judge one touch from a known contact face, as in the thesis's Table 1: the most probable pose, refined, and the
    best of ten.

    Prints median errors, absolute and normalised, and writes them and every outcome to --out; with --ambiguity also what the
    first touches from each side leave open, whoever reads them.
    """
    from geomtact.contact_space.store import FORMAT
    from geomtact.contact_space.touches import GEL_KINDS
    from geomtact.evaluation import identity
    from geomtact.sensing.sensor import Sensor

    content, gel, strength = study_file.load(out, SCHEMA), Sensor.load(sensor), study_options.noise_named(noise)
    for mesh in study_options.meshes(parts, unit, gel):
        settings = identity(mesh, gel) | {
            "index_format": FORMAT,
            "max_poses": _POSES,
            "sides": sides,
            "touches": touches,
            "noise": {"name": noise.value, **asdict(strength)},
            "elastic": GEL_KINDS[felt],
            "effort": effort.value,
            "seed": seed,
        }
        _judge_part(mesh, gel, strength, settings, ambiguity, content, out, cache_dir)
        to_stderr(f"{mesh.name}: done")
    _print(content["parts"])
    study_file.plot(content, plot)


def _judge_part(
    mesh: Mesh,
    gel: Sensor,
    noise: Noise,
    settings: Mapping[str, Any],
    ambiguity: int,
    content: dict[str, Any],
    out: Path | None,
    cache_dir: Path | None,
) -> None:
    """Judge what ``content`` does not hold yet of an object; a side that was not finished is touched anew."""
    from geomtact.localizer import Localizer
    from tools.studies.thesis import ambiguity as open_set
    from tools.studies.thesis import known_approach

    sides, touches, seed, elastic = (settings[key] for key in ("sides", "touches", "seed", "elastic"))
    done = study_file.earlier(content["parts"].get(mesh.name), dict(settings), known_approach.Outcome)
    done = done[: len(done) // touches * touches]
    before = content["parts"][mesh.name] if done else {}
    grain = before.get("granularity_mm", [])
    first = min(ambiguity, touches) or before.get("ambiguity", {"settings": {"touches": 0}})["settings"]["touches"]
    found = study_file.earlier(before.get("ambiguity"), open_set.settings(first), open_set.Ambiguity)
    found = found[: len(found) // first * first] if first else []

    def keep() -> None:
        entry = {"granularity_mm": grain, "figures": known_approach.summarise(done), "outcomes": _plain(done)}
        if found:
            figures = open_set.summarise(found, done, touches)
            entry["ambiguity"] = {"settings": open_set.settings(first), "figures": figures, "outcomes": _plain(found)}
        study_file.keep(out, content, mesh.name, settings=settings, **entry)

    approaches = known_approach.draw_sides(mesh, gel, sides, seed)
    for side in range(min(len(grain), len(done) // touches, len(found) // first if first else sides), sides):
        with progress_bar(f"preparing {mesh.name}, side {side + 1} of {sides}") as progress:
            localizer = Localizer.prepare(
                mesh,
                sensor=gel,
                approach=approaches[side],
                max_poses=_POSES,
                cache_dir=cache_dir,
                progress=progress,
            )
        if side >= len(grain):
            grain.append(known_approach.granularity(localizer))
        if side >= len(done) // touches:
            judged = known_approach.judge_side(localizer, side, touches, seed, noise, settings["effort"], elastic)
            study_file.collect(done, judged, len(done) + touches, f"touching {mesh.name}", lambda _: None)
        if first and side >= len(found) // first:
            others = open_set.judge_side(localizer, side, touches, first, seed, noise, settings["effort"], elastic)
            study_file.collect(found, others, len(found) + first, f"what else {mesh.name} may be", lambda _: None)
        keep()
    keep()


def _plain(outcomes: Iterable[Any]) -> list[dict[str, Any]]:
    return [asdict(outcome) for outcome in outcomes]


def _print(parts: Mapping[str, Any]) -> None:
    rows = []
    for name, part in parts.items():
        for row, f in part["figures"].items():
            low, middle, high = f["error_mm_quartiles"]
            moved = [f"{100 * f[key]:.0f} %" if key in f else "" for key in ("nearer", "farther")]
            n, before, after = f.get("near", (0, None, None))
            moved.append(f"{before:.1f} to {after:.1f} ({n})" if n else "")
            error = [f"{middle:.1f} ({low:.1f} to {high:.1f})", f"{f['normalised_median']:.2f}"]
            rows.append([name, row, str(f["n"]), *error, *moved])
    headings = ("part", "pose", "touches", "ADD [mm]", "normalised", "nearer", "farther", "of those near")
    typer.echo(
        "Median error with quartiles; nearer, farther: than before refinement; of those near: from 10 mm off at most"
    )
    print_table(headings, rows, headings[2:])
    rows = []
    for name, part in parts.items():
        if "ambiguity" not in part:
            continue
        figures = part["ambiguity"]["figures"]
        left = [f"{figures['median'][key]:.1f}" for key in ("span_mm", "random_mm", "least_mm")]
        left += [f"{100 * figures['mean'][key]:.0f} %" for key in ("precision", "recall")]
        for kind, table in figures["table"].items():
            ours = [f"{table[row]['error_mm_quartiles'][1]:.1f}" for row in ("best", "answer", "answer10")]
            rows.append([name, kind, str(table["best"]["n"]), *(left if kind == "all" else [""] * len(left)), *ours])
    if rows:
        typer.echo(
            "The ambiguity of a touch, and the errors on touches that leave much and little: medians. "
            "Precision: mean share of the posterior at poses that show the same contact; "
            "recall: mean share of these in its 90 % region"
        )
        numbers = [
            "touches",
            "span [mm]",
            "a guess",
            "the best guess",
            "precision",
            "recall",
            "best",
            "answer",
            "answer10",
        ]
        print_table(["part", "kind", *numbers], rows, numbers)
