"""``python -m tools.studies next-touch``: touches chosen for their expected information gain against random ones."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any

import typer

from geomtact.cli.options import CacheDir, Seed, Unit
from geomtact.cli.shell import print_table
from geomtact.cli.simulate import NoiseName
from tools.studies.common import study_file, study_options

if TYPE_CHECKING:
    from geomtact.geometry.approach import Approach
    from geomtact.geometry.mesh import Mesh

SCHEMA = "geomtact/next-touch-study/1"
_POSES = 50_000  # of an object that lies on a known contact face


def judge_next_touch(
    parts: study_options.ThesisParts = None,
    unit: Unit = None,
    sensor: study_options.SensorName = "gelslim",
    runs: Annotated[
        int, typer.Option("--touches", min=1, help="How many times each object is touched until sure, by each policy.")
    ] = 100,
    noise: study_options.NoiseLevel = NoiseName.moderate,
    seed: Seed = 1,
    out: study_options.Out = None,
    plot: study_options.Plot = None,
    cache_dir: CacheDir = None,
) -> None:
    """Judge the next touch: how many touches it takes to be sure, chosen for their expected gain or at random.

    Prints their numbers and pose errors, and writes them and every run to --out.
    """
    from geomtact.evaluation import describe
    from tools.studies.kitting.fixture import upwards
    from tools.studies.next_touch import study as next_touch_study

    def lying(mesh: Mesh) -> Approach:
        return [(upwards(mesh), 0.0)]

    content, strength = study_file.load(out, SCHEMA), study_options.noise_named(noise)
    for localizer in study_options.localizers(parts, unit, sensor, cache_dir, _POSES, lying):
        settings = describe(localizer) | {
            "runs": runs,
            "noise": {"name": noise.value, **asdict(strength)},
            "seed": seed,
            "sure": next_touch_study.SURE,
            "most": next_touch_study.MOST,
        }
        more = partial(next_touch_study.touch_until_sure, localizer, runs, seed, strength)
        study_file.judged(
            out, content, settings, runs, "touching", more, next_touch_study.Run, next_touch_study.summarise
        )
    _print(content["parts"])
    study_file.plot(content, plot)


def _print(parts: Mapping[str, Any]) -> None:
    headings = ["part", "chosen", "runs", "touches", "sure", "sure and wrong", "MSSD [mm]", "best / random"]
    rows = []
    for name, part in parts.items():
        figures = part["figures"]
        for policy in ("best", "random"):
            f = figures[policy]
            wrong = "" if f["wrong"] is None else f"{100 * f['wrong']:.0f} %"
            ratio = "{:.2f} ({:.2f} to {:.2f})".format(*figures["ratio"]) if policy == "best" else ""
            numbers = [str(f["n"]), f"{f['touches_mean']:.2f}", f"{100 * f['sure']:.0f} %", wrong]
            rows.append([name, policy, *numbers, study_file.length(f["mssd_mm_median"]), ratio])
    typer.echo(
        "Touches after the first until one mode holds 95 %, 10 at most, and the ratio of their means with its 95 % interval"
    )
    print_table(headings, rows, headings[2:])
