"""``python -m tools.studies identify``: which of several objects is touched, and is it one of them at all."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import partial
from typing import Annotated, Any

import typer

from geomtact.cli.options import CacheDir, Effort, MaxPoses, Seed, Unit
from geomtact.cli.shell import print_table
from geomtact.cli.simulate import NoiseName
from tools.studies.common import study_file, study_options

SCHEMA = "geomtact/identification/1"


def judge_identification(
    parts: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="OBJECT...", help="Objects or mesh files; all bundled ones by default.", show_default=False
        ),
    ] = None,
    unit: Unit = None,
    sensor: study_options.SensorName = "gelslim",
    scenes: Annotated[
        int, typer.Option("--scenes", min=1, help="How many of each object, of one to three touches.")
    ] = 20,
    noise: study_options.NoiseLevel = NoiseName.moderate,
    effort: study_options.EffortLevel = Effort.balanced,
    seed: Seed = 1,
    max_poses: MaxPoses = None,
    out: study_options.Out = None,
    plot: study_options.Plot = None,
    cache_dir: CacheDir = None,
) -> None:
    """Judge which object it is: touches of each of several objects, localized on all of them, and on all but the right one.

    Prints how often the right object is the most probable, how often an object that is not among them is called unknown, and how
    often one that is; and writes them and every probability to --out.
    """
    from geomtact.evaluation import describe
    from geomtact.geometry.catalogue import catalogue
    from tools.studies.identify import study as identification

    content, strength = study_file.load(out, SCHEMA), study_options.noise_named(noise)
    everyone = list(study_options.localizers(parts or list(catalogue()), unit, sensor, cache_dir, max_poses))
    for own in everyone:
        settings = describe(own) | {
            "among": {each.mesh.name: each.mesh.sha256 for each in everyone},
            "scenes": scenes,
            "noise": {"name": noise.value, **asdict(strength)},
            "effort": effort.value,
            "seed": seed,
        }
        more = partial(identification.identify_scenes, own, everyone, scenes, seed, strength, effort)
        study_file.judged(out, content, settings, scenes, "identifying", more)
    told = {name: study_file.outcomes(part, identification.Told) for name, part in content["parts"].items()}
    content["figures"] = identification.summarise(told)
    study_file.save(out, content)
    _print(content["figures"])
    study_file.plot(content, plot)


def _print(figures: Sequence[Mapping[str, Any]]) -> None:
    def percent(three: Sequence[float]) -> str:
        return "{:.0f} ({:.0f}-{:.0f}) %".format(*(100 * share for share in three))

    headings = [
        "touches",
        "scenes",
        "right",
        "given",
        "log P(right)",
        "sure and wrong",
        "unknown detected",
        "false alarms",
    ]
    rows = [
        [
            str(f["touches"]),
            str(f["n"]),
            percent(f["right"]),
            f"{100 * f['claimed']:.0f} %",
            f"{f['log_probability_mean']:.2f}",
            f"{100 * f['sure_and_wrong']:.0f} %",
            percent(f["foreign"]),
            percent(f["alarmed"]),
        ]
        for f in figures
    ]
    typer.echo("Shares of scenes, with 95 % intervals; log P(right) is a mean; sure is more than 95 %")
    print_table(headings, rows, headings)
