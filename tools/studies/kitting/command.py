"""``python -m tools.studies kitting``: objects grasped, localized and placed in a fixture, in simulation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from functools import partial
from typing import Annotated, Any

import typer

from geomtact.cli.options import CacheDir, Seed, Unit
from geomtact.cli.shell import print_table
from geomtact.cli.simulate import NoiseName
from tools.studies.common import study_file, study_options

SCHEMA = "geomtact/kitting/1"


def judge_kitting(
    parts: study_options.ThesisParts = None,
    unit: Unit = None,
    sensor: study_options.SensorName = "gelslim",
    runs: Annotated[int, typer.Option("--touches", min=1, help="How many of each object to place.")] = 200,
    noise: study_options.NoiseLevel = NoiseName.moderate,
    seed: Seed = 1,
    out: study_options.Out = None,
    plot: study_options.Plot = None,
    cache_dir: CacheDir = None,
) -> None:
    """Judge kitting: how many objects, grasped anyhow and localized, are placed right in a fixture, placed wrong and refused.

    Prints them for each clearance and number of touches, and writes them and every run to --out.
    """
    from geomtact.contact_space.touches import penetrations
    from geomtact.evaluation import describe
    from tools.studies.kitting import cell as kitting
    from tools.studies.kitting import study as kitting_study

    content, strength = study_file.load(out, SCHEMA), study_options.noise_named(noise)
    for localizer in study_options.localizers(parts, unit, sensor, cache_dir):
        settings = describe(localizer) | {
            "noise": {"name": noise.value, **asdict(strength)},
            "penetration_mm": [1e3 * depth for depth in penetrations(localizer.space)],
            "sure": kitting.SURE,
            "clearances_mm": [1e3 * clearance for clearance in kitting_study.CLEARANCES],
            "goal_mm": 1e3 * kitting_study.GOAL,
            "thorough": kitting_study.THOROUGH,
            "touches": kitting_study.TOUCHES,
            "seed": seed,
        }
        more = partial(kitting_study.run_cell, localizer, runs, seed, strength)
        study_file.judged(out, content, settings, runs, "kitting", more, kitting_study.Outcome, kitting_study.summarise)
    _print(content["parts"])
    study_file.plot(content, plot)


def _print(parts: Mapping[str, Any]) -> None:
    rows = []
    for name, part in parts.items():
        for f in part["figures"]:
            low, high = (100 * share for share in f["interval"])
            right = f"{f['right']} ({low:.0f}-{high:.0f} %)"
            counts = [str(f[key]) for key in ("wrong", "refused")]
            rows.append([name, f"{f['clearance_mm']:g}", str(f["touches"]), str(f["n"]), right, *counts])
    headings = ("part", "clearance [mm]", "touches", "n", "placed right", "placed wrong", "refused")
    typer.echo("Objects placed right, with the 95 % interval of their share, placed wrong, and refused")
    print_table(headings, rows, headings[1:])
