"""``geomtact evaluate thesis``: the thesis's Table 1, on parts touched from a known side."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Annotated, Any

import typer

from geomtact.cli import study_file, study_options
from geomtact.cli.library import CacheDir
from geomtact.cli.localize import Effort
from geomtact.cli.prepare import Unit
from geomtact.cli.shell import print_table, progress_bar, tell
from geomtact.cli.simulate import NoiseName

SCHEMA = "geomtact/thesis-table/1"
_POSES = 50_000  # of a part that is touched from a known side


def judge_thesis_table(
    parts: study_options.ThesisParts = None,
    unit: Unit = None,
    sensor: study_options.SensorName = "gelslim",
    sides: Annotated[int, typer.Option("--sides", min=1, help="From how many sides each part is touched.")] = 5,
    touches: Annotated[int, typer.Option("--touches", min=1, help="How many touches from each side.")] = 40,
    noise: study_options.NoiseLevel = NoiseName.moderate,
    felt: study_options.Felt = study_options.FeltName.elastic,
    effort: study_options.EffortLevel = Effort.balanced,
    seed: study_options.Seed = 1,
    out: study_options.Out = None,
    cache_dir: CacheDir = None,
) -> None:
    """Judge one touch from a known side, as in the thesis's Table 1: the most probable pose, the best of ten, both refined.

    Prints median errors, absolute and normalised, and writes them and every outcome to --out.
    """
    from geomtact.evaluation import known_approach
    from geomtact.evaluation.scores import FELT
    from geomtact.inference.localizer import Localizer
    from geomtact.sensing.sensor import Sensor

    content, strength, gel = study_file.load(out, SCHEMA), study_options.noise_named(noise), Sensor.load(sensor)
    for mesh in study_options.meshes(parts, unit, gel):
        settings = {
            "object": mesh.name,
            "object_sha256": mesh.sha256,
            "sensor": gel.name,
            "sensor_sha256": gel.sha256,
            "poses": _POSES,
            "sides": sides,
            "touches": touches,
            "noise": {"name": noise.value, **asdict(strength)},
            "elastic": FELT[felt],
            "effort": effort.value,
            "seed": seed,
        }
        done = study_file.earlier(content["parts"].get(mesh.name), settings, known_approach.Outcome)
        done = done[: len(done) // touches * touches]  # a side that was not finished is touched anew

        def keep(done: list, name: str = mesh.name, settings: Mapping[str, Any] = settings) -> None:
            figures = known_approach.summarise(done)
            outcomes = [asdict(o) for o in done]
            study_file.keep(out, content, name, settings=settings, figures=figures, outcomes=outcomes)

        approaches = known_approach.draw_sides(mesh, gel, sides, seed)
        for side in range(len(done) // touches, sides):
            with progress_bar(f"preparing {mesh.name}, side {side + 1} of {sides}") as progress:
                localizer = Localizer.prepare(
                    mesh,
                    sensor=gel,
                    approach=approaches[side],
                    max_poses=_POSES,
                    cache_dir=cache_dir,
                    progress=progress,
                )
            judged = known_approach.judge_side(localizer, side, touches, seed, strength, effort.value, FELT[felt])
            done = study_file.collect(done, judged, len(done) + touches, f"touching {mesh.name}", lambda _: None)
            keep(done)
        keep(done)
        tell(f"{mesh.name}: done")
    _print(content["parts"])


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
