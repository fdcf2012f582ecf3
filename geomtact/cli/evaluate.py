"""``geomtact evaluate``: how good the answers are, on touches whose true pose is known."""

from __future__ import annotations

import functools
from dataclasses import asdict
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from geomtact.cli import study_file
from geomtact.cli.library import CacheDir
from geomtact.cli.localize import Effort
from geomtact.cli.prepare import Unit
from geomtact.cli.shell import print_table, progress_bar, tell
from geomtact.cli.simulate import NoiseName

if TYPE_CHECKING:
    from geomtact.evaluation.study import Felt
    from geomtact.sensing.noise import Noise

SCHEMA = "geomtact/study/2"
_SCORES_ONLY, _PICTURED = "Only for scores", "Only for scores, registration and touches"


class What(StrEnum):
    samples = "samples"
    localize = "localize"
    scores = "scores"
    registration = "registration"
    touches = "touches"


class FeltName(StrEnum):
    elastic = "elastic"
    rigid = "rigid"
    both = "both"


def evaluate(
    what: Annotated[
        What,
        typer.Argument(
            help="samples: what touches are judged on; localize: the posteriors from them; scores: all scores side by side; "
            "registration: from how far off refining finds home; touches: what several sensors at once add."
        ),
    ],
    parts: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="OBJECT...",
            help="Parts or mesh files; for scores and touches the thesis's four by default, for registration those and bare "
            "shapes.",
        ),
    ] = None,
    unit: Unit = None,
    sensor: Annotated[str, typer.Option(help="Name (see 'geomtact sensors') or TOML file.")] = "gelslim",
    touches: Annotated[int, typer.Option(min=1, help="How many touches of each part, or scenes of five.")] = 200,
    noise: Annotated[NoiseName, typer.Option(help="How strongly the masks are spoilt.")] = NoiseName.moderate,
    effort: Annotated[Effort, typer.Option(help="How much to compute.")] = Effort.balanced,
    seed: Annotated[int, typer.Option(min=0, help="Seed of all randomness.")] = 1,
    out: Annotated[
        Path | None, typer.Option(help="JSON file for all figures; a study that it holds in part is resumed.")
    ] = None,
    scores: Annotated[
        list[str] | None,
        typer.Option(
            metavar="SCORE...",
            help="Scores to judge, by name or weights file; fast, balanced or exact is the default score at that effort.",
            rich_help_panel=_SCORES_ONLY,
        ),
    ] = None,
    felt: Annotated[
        FeltName | None,
        typer.Option(
            help="What the gel is; elastic by default for scores, both for registration and touches.",
            show_default=False,
            rich_help_panel=_PICTURED,
        ),
    ] = None,
    max_poses: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="About how many poses; 1.2 million by default.",
            show_default=False,
            rich_help_panel=_SCORES_ONLY,
        ),
    ] = None,
    plot: Annotated[Path | None, typer.Option(help="PNG that shows the figures.", rich_help_panel=_PICTURED)] = None,
    cache_dir: CacheDir = None,
) -> None:
    """Judge posteriors on simulated touches with known poses: gain, coverage and pose errors for each part.

    For localize, half of the touches are felt by a rigid threshold, half by an elastic gel, and figures are given
    apart and together. For scores, every score is judged on the same touches, with what it costs.
    """
    from geomtact.errors import UsageError

    pictured = (What.scores, What.registration, What.touches)
    options: dict[str, tuple[Any, tuple[What, ...]]] = {
        "--scores": (scores, (What.scores,)),
        "--max-poses": (max_poses, (What.scores,)),
    }
    options |= {"--felt": (felt, pictured), "--plot": (plot, pictured)}
    for option, (value, studies) in options.items():
        if value and what not in studies:
            others = " and ".join(f"'evaluate {study}'" for study in studies)
            raise UsageError(f"{option} goes with {others}, not with 'evaluate {what}'; leave it out")
    if what is What.scores:
        from geomtact.cli.evaluate_scores import Options, judge_scores, sort_words
        from geomtact.contact_space.resolution import MAX_POSES
        from geomtact.sensing.sensor import Sensor

        chosen, names = sort_words(parts or [], scores or [])
        settings = Options(
            sensor=Sensor.load(sensor),
            touches=touches,
            noise_name=str(noise),
            noise=_noise(noise),
            felt=str(felt or FeltName.elastic),
            effort=str(effort),
            seed=seed,
            max_poses=max_poses or MAX_POSES,
        )
        judge_scores(chosen, unit, names, settings, out, plot, cache_dir)
        return
    if what is What.registration:
        from geomtact.cli.evaluate_registration import judge_registration
        from geomtact.evaluation.scores import FELT, THESIS_PARTS
        from geomtact.evaluation.shapes import SHAPES

        elastic = FELT[str(felt or FeltName.both)]
        names = parts or [*THESIS_PARTS, *SHAPES]
        judge_registration(names, unit, sensor, touches, str(noise), _noise(noise), elastic, seed, out, plot)
        return
    if what is What.touches:
        from geomtact.cli.evaluate_touches import judge_touches
        from geomtact.evaluation.scores import FELT, THESIS_PARTS

        elastic = FELT[str(felt or FeltName.both)]
        names = parts or list(THESIS_PARTS)
        judge_touches(
            names, unit, sensor, touches, str(noise), _noise(noise), elastic, str(effort), seed, out, plot, cache_dir
        )
        return
    if not parts:
        raise UsageError(f"evaluate {what}: no OBJECT given; name a part (see 'geomtact objects') or a mesh file")
    if what is What.samples:
        print_touches(parts, unit, sensor, touches, noise, seed)
    else:
        judge(parts, unit, sensor, touches, noise, effort, seed, out, cache_dir)


def judge(
    parts: list[str],
    unit: str | None,
    sensor: str,
    touches: int,
    noise: str,
    effort: str,
    seed: int,
    out: Path | None = None,
    cache_dir: Path | None = None,
    felt: Felt | None = None,
    solver: str = "geomtact",
) -> dict[str, Any]:
    """Localize ``touches`` touches of each part, print the figures and write them to ``out``.

    ``felt`` as in ``study.make_touches``; ``solver`` names it in the file.
    """
    from geomtact.evaluation import study
    from geomtact.inference.localizer import Localizer

    content = study_file.load(out, SCHEMA)
    all_figures: dict[tuple[str, str], dict[str, Any]] = {}
    for part in parts:
        with progress_bar(f"preparing {part}") as progress:
            localizer = Localizer.prepare(part, unit=unit, sensor=sensor, cache_dir=cache_dir, progress=progress)
        settings = study.describe(localizer) | {
            "touches": touches,
            "noise": {"name": str(noise), **asdict(_noise(noise))},
            "effort": str(effort),
            "seed": seed,
            "elastic_solver": solver,
        }
        name = localizer.mesh.name
        outcomes = study_file.earlier(content["parts"].get(name), settings, study.Outcome)
        keep = functools.partial(_keep, out, content, name, settings)
        if len(outcomes) < touches:
            todo = study.make_touches(localizer, touches, seed, _noise(noise), felt)[len(outcomes) :]
            more = study.localize_touches(localizer, todo, effort, seed)
            study_file.collect(outcomes, more, touches, f"localizing {name}", keep)
        random_mm = study.expected_random_add(localizer)
        figures = study.summarise(outcomes, random_mm)
        keep(outcomes, {"random_add_mm": random_mm, "figures": figures})
        all_figures |= {(name, group): values for group, values in figures.items()}
        tell(f"{name}: done")
    _print(all_figures)
    return content


def _keep(
    out: Path | None, content: dict[str, Any], part: str, settings: dict, outcomes: list, extra: dict | None = None
) -> None:
    from geomtact.report.result import plain

    content["parts"][part] = plain({"settings": settings, **(extra or {}), "outcomes": [asdict(o) for o in outcomes]})
    study_file.save(out, content)


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


def print_touches(parts: list[str], unit: str | None, sensor: str, n: int, noise: str, seed: int) -> None:
    """Print what the touches of each part are like: depth, area, and how many run over the window's border."""
    from types import SimpleNamespace

    import numpy as np

    from geomtact.contact_space.space import ContactSpace
    from geomtact.evaluation.study import make_touches
    from geomtact.geometry.mesh import load_mesh
    from geomtact.sensing.sensor import Sensor

    pressed = Sensor.load(sensor)
    pixel_mm2 = 1e6 * float(np.prod(pressed.pixel_pitch))
    rows = []
    for part in parts:
        mesh = load_mesh(part, unit, sensor=pressed)
        touches = make_touches(SimpleNamespace(space=ContactSpace(mesh, pressed)), n, seed, _noise(noise))
        for name, elastic in (("geometric", False), ("elastic", True)):
            some = [t for t in touches if t.elastic == elastic]
            if not some:
                continue
            areas = np.quantile([t.mask.sum() * pixel_mm2 for t in some], (0.1, 0.5, 0.9))
            border = np.mean([np.pad(t.mask[1:-1, 1:-1], 1).sum() < t.mask.sum() for t in some])
            depth = np.median([1e3 * t.penetration for t in some])
            row = [f"{depth:.2f}", *(f"{a:.1f}" for a in areas), f"{100 * border:.0f} %"]
            rows.append([mesh.name, name, str(len(some)), *row])
    headings = ("part", "touches", "n", "depth [mm]", "area [mm2]: 10 %", "50 %", "90 %", "over the border")
    print_table(headings, rows, headings[2:])


def _noise(name: str) -> Noise:
    from geomtact.sensing import noise

    return {"none": noise.CLEAN, "moderate": noise.MODERATE, "heavy": noise.HEAVY}[name]
