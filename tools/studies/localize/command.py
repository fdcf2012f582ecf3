"""The study ``localize``: posteriors of one touch, against its true pose."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from geomtact.cli.options import CacheDir, Effort, MaxPoses, Seed, Unit
from geomtact.cli.shell import print_table, to_stderr
from geomtact.cli.simulate import NoiseName
from tools.studies.common import study_file, study_options

if TYPE_CHECKING:
    from tools.studies.common.study import Felt

SCHEMA = "geomtact/study/3"


def judge_localize(
    parts: study_options.Parts,
    unit: Unit = None,
    sensor: study_options.SensorName = "gelslim",
    touches: study_options.Touches = 200,
    noise: study_options.NoiseLevel = NoiseName.moderate,
    effort: study_options.EffortLevel = Effort.balanced,
    seed: Seed = 1,
    max_poses: MaxPoses = None,
    out: study_options.Out = None,
    plot: study_options.Plot = None,
    cache_dir: CacheDir = None,
) -> None:
    """Judge posteriors: their gain, coverage and pose errors for each object.

    Half of the touches are by a rigid threshold, half by an elastic gel. Prints the figures apart and together, and
    writes them and every outcome to --out.
    """
    study_file.plot(judge(parts, unit, sensor, touches, noise, effort, seed, max_poses, out, cache_dir), plot)


def judge(
    parts: list[str],
    unit: str | None,
    sensor: str,
    touches: int,
    noise: str,
    effort: str,
    seed: int,
    max_poses: int | None = None,
    out: Path | None = None,
    cache_dir: Path | None = None,
    felt: Felt | None = None,
    solver: str = "geomtact",
) -> dict[str, Any]:
    """Localize ``touches`` touches of each object, print the figures and write them to ``out``.

    ``felt`` as in ``study.make_touches``; ``solver`` names it in the file.
    """
    from geomtact.evaluation import describe
    from tools.studies.common import study
    from tools.studies.localize import study as proper

    content, strength = study_file.load(out, SCHEMA), study_options.noise_named(noise)
    all_figures: dict[tuple[str, str], dict[str, Any]] = {}
    for localizer in study_options.localizers(parts, unit, sensor, cache_dir, max_poses):
        settings = describe(localizer) | {
            "touches": touches,
            "noise": {"name": str(noise), **asdict(strength)},
            "effort": str(effort),
            "seed": seed,
            "elastic_solver": solver,
        }
        name = localizer.mesh.name
        outcomes = study_file.earlier(content["parts"].get(name), settings, proper.Judged)

        def keep(outcomes: list, name: str = name, settings: Mapping[str, Any] = settings, **figures: Any) -> None:
            flat = [asdict(o) for o in outcomes]
            study_file.keep(out, content, name, settings=settings, **figures, outcomes=flat)

        if len(outcomes) < touches:
            made = study.make_touches(localizer.space, touches, seed, strength, felt)
            more = proper.judge(localizer, made, effort, seed, len(outcomes))
            study_file.collect(outcomes, more, touches, f"localizing {name}", keep)
        random_mm = study.expected_random_add(localizer)
        figures = proper.summarise(outcomes, random_mm)
        keep(outcomes, random_add_mm=random_mm, figures=figures)
        all_figures |= {(name, group): values for group, values in figures.items()}
        to_stderr(f"{name}: done")
    _print(all_figures)
    return content


def _print(figures: dict[tuple[str, str], dict[str, Any]]) -> None:
    headings = ("part", "touches", "n", "gain [nats]", "claimed", "MSSD [mm]", "of 10", "ADD [mm]", "of 10", "P(first)")
    rows = []
    for names, f in figures.items():
        error = "" if f["gain_standard_error"] is None else f" ± {f['gain_standard_error']:.2f}"
        lengths = [f"{f[f'{name}_median']:.1f}" for name in ("mssd_mm", "mssd10_mm", "add_mm", "add10_mm")]
        gain = [str(f["n"]), f"{f['gain_mean']:.2f}{error}", f"{f['claimed_mean']:.2f}"]
        rest = [f"{f['probability_median']:.3f}", f"{100 * f['wrong']:.0f} %", f"{f['ms_median']:.0f}"]
        rows.append([*names, *gain, *lengths, *rest])
    typer.echo("Mean gain with its standard error, and medians")
    print_table([*headings, "wrong", "ms"], rows, {*headings[2:], "wrong", "ms"})
    rows = []
    for names, f in figures.items():
        rows.append([*names, *study_file.inside(f)])
    typer.echo("Percentage of truths inside the region of each mass, with 95 % intervals")
    masses = study_file.masses()
    print_table(["part", "touches", *masses], rows, masses)
