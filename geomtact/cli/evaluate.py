"""``geomtact evaluate``: how good the answers are, on touches whose true pose is known.

Here are the studies ``samples`` and ``localize``; each of the others has a module of its own.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from geomtact.cli import study_file, study_options
from geomtact.cli.apart import by_part
from geomtact.cli.evaluate_choices import judge_choices
from geomtact.cli.evaluate_identify import judge_identification
from geomtact.cli.evaluate_kitting import judge_kitting
from geomtact.cli.evaluate_next_touch import judge_next_touch
from geomtact.cli.evaluate_plot import plot_study
from geomtact.cli.evaluate_readings import judge_readings
from geomtact.cli.evaluate_registration import judge_registration, parts_meant
from geomtact.cli.evaluate_scores import judge_scores, words_meant
from geomtact.cli.evaluate_stability import judge_stability
from geomtact.cli.evaluate_thesis import judge_thesis_table
from geomtact.cli.evaluate_touches import judge_touches
from geomtact.cli.evaluate_track import judge_track
from geomtact.cli.evaluate_triplets import judge_triplets
from geomtact.cli.options import CacheDir, Effort, MaxPoses, Seed, Unit
from geomtact.cli.shell import one_line_errors, print_table, tell
from geomtact.cli.simulate import NoiseName

if TYPE_CHECKING:
    from geomtact.evaluation.study import Felt

SCHEMA = "geomtact/study/3"
Touches = Annotated[int, typer.Option("--touches", min=1, help="How many touches of each part.")]


def judge_samples(
    parts: study_options.Parts,
    unit: Unit = None,
    sensor: study_options.SensorName = "gelslim",
    touches: Touches = 200,
    noise: study_options.NoiseLevel = NoiseName.moderate,
    seed: Seed = 1,
) -> None:
    """Describe the touches that posteriors are judged on: how deep, how large, how many run over the window's border.

    Prints a table, half of the touches felt by a rigid threshold and half by an elastic gel, and writes nothing.
    """
    import numpy as np

    from geomtact.contact_space.space import ContactSpace
    from geomtact.evaluation.study import make_touches
    from geomtact.evaluation.worlds import cut_off
    from geomtact.sensing.sensor import Sensor

    pressed, strength = Sensor.load(sensor), study_options.noise_named(noise)
    pixel_mm2 = 1e6 * float(np.prod(pressed.pixel_pitch))
    rows = []
    for mesh in study_options.meshes(parts, unit, pressed):
        made = make_touches(ContactSpace(mesh, pressed), touches, seed, strength)
        for name, elastic in (("geometric", False), ("elastic", True)):
            some = [t for t in made if t.elastic == elastic]
            if not some:
                continue
            areas = np.quantile([t.mask.sum() * pixel_mm2 for t in some], (0.1, 0.5, 0.9))
            border = np.mean([cut_off(t.mask) > 0 for t in some])
            depth = np.median([1e3 * t.penetration for t in some])
            row = [f"{depth:.2f}", *(f"{a:.1f}" for a in areas), f"{100 * border:.0f} %"]
            rows.append([mesh.name, name, str(len(some)), *row])
    headings = ("part", "touches", "n", "depth [mm]", "area [mm2]: 10 %", "50 %", "90 %", "over the border")
    print_table(headings, rows, headings[2:])


def judge_localize(
    parts: study_options.Parts,
    unit: Unit = None,
    sensor: study_options.SensorName = "gelslim",
    touches: Touches = 200,
    noise: study_options.NoiseLevel = NoiseName.moderate,
    effort: study_options.EffortLevel = Effort.balanced,
    seed: Seed = 1,
    max_poses: MaxPoses = None,
    out: study_options.Out = None,
    plot: study_options.Plot = None,
    cache_dir: CacheDir = None,
) -> None:
    """Judge posteriors: their gain, coverage and pose errors for each part.

    Half of the touches are felt by a rigid threshold, half by an elastic gel. Prints the figures apart and together, and
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
    """Localize ``touches`` touches of each part, print the figures and write them to ``out``.

    ``felt`` as in ``study.make_touches``; ``solver`` names it in the file.
    """
    from geomtact.evaluation import proper, study

    content, strength = study_file.load(out, SCHEMA), study_options.noise_named(noise)
    all_figures: dict[tuple[str, str], dict[str, Any]] = {}
    for localizer in study_options.localizers(parts, unit, sensor, cache_dir, max_poses):
        settings = study.describe(localizer) | {
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
        tell(f"{name}: done")
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


evaluate = typer.Typer(no_args_is_help=True, help="Judge the answers on touches with known poses: one study a command.")
evaluate.command("samples")(one_line_errors(judge_samples))
evaluate.command("localize")(one_line_errors(by_part(judge_localize)))
evaluate.command("scores")(one_line_errors(by_part(judge_scores, words_meant)))
evaluate.command("registration")(one_line_errors(by_part(judge_registration, parts_meant)))
evaluate.command("thesis")(one_line_errors(by_part(judge_thesis_table)))
evaluate.command("touches")(one_line_errors(by_part(judge_touches)))
evaluate.command("readings")(one_line_errors(judge_readings))
evaluate.command("triplets")(one_line_errors(judge_triplets))
evaluate.command("identify")(one_line_errors(judge_identification))
evaluate.command("track")(one_line_errors(by_part(judge_track)))
evaluate.command("next-touch")(one_line_errors(by_part(judge_next_touch)))
evaluate.command("kitting")(one_line_errors(by_part(judge_kitting)))
evaluate.command("stability")(one_line_errors(by_part(judge_stability)))
evaluate.command("choices")(one_line_errors(by_part(judge_choices)))
evaluate.command("plot")(one_line_errors(plot_study))
