"""``geomtact evaluate touches``: what each more sensor adds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from geomtact.cli import study_file
from geomtact.cli.shell import print_table, progress_bar, tell

if TYPE_CHECKING:
    from geomtact.sensing.noise import Noise

SCHEMA = "geomtact/touches/1"


def judge_touches(
    parts: Sequence[str],
    unit: str | None,
    sensor: str,
    scenes: int,
    noise_name: str,
    noise: Noise,
    elastic: bool | None,
    effort: str,
    seed: int,
    out: Path | None = None,
    plot: Path | None = None,
    cache_dir: Path | None = None,
) -> dict[str, Any]:
    """Localize each part from one to five sensors at once, print the figures and write them to ``out``; ``plot`` is a PNG.

    ``elastic`` as in ``touches.random_touches``.
    """
    from geomtact.evaluation import multitouch, study
    from geomtact.inference.localizer import Localizer
    from geomtact.report.result import plain

    content = study_file.load(out, SCHEMA)
    for part in parts:
        with progress_bar(f"preparing {part}") as progress:
            localizer = Localizer.prepare(part, unit=unit, sensor=sensor, cache_dir=cache_dir, progress=progress)
        settings = study.describe(localizer) | {
            "scenes": scenes,
            "noise": {"name": noise_name, **asdict(noise)},
            "elastic": elastic,
            "effort": effort,
            "seed": seed,
        }
        name = localizer.mesh.name
        found = content["parts"].get(name)
        done = found["outcomes"] if found is not None and study_file.same(found, settings) else []

        def keep(outcomes: list, name: str = name, settings: Mapping[str, Any] = settings) -> None:
            flat = [multitouch.Fused(**_numbers(o)) for some in outcomes for o in some]
            figures = multitouch.summarise(flat)
            content["parts"][name] = plain({"settings": settings, "figures": figures, "outcomes": outcomes})
            study_file.save(out, content)

        if len(done) < scenes:
            made = multitouch.make_scenes(localizer, scenes, seed, noise, elastic)
            more = multitouch.fuse_scenes(localizer, made, effort, seed, first=len(done))
            done = study_file.collect(
                done, ([asdict(o) for o in some] for some in more), scenes, f"fusing {name}", keep
            )
        keep(done)
        tell(f"{name}: done")
    _print(content["parts"])
    if plot is not None:
        from geomtact.report.touches_plot import draw_touches

        study_file.draw(draw_touches(content), plot)
    return content


def _numbers(outcome: Mapping[str, Any]) -> dict[str, Any]:
    """An outcome as written, null standing for what JSON has no number for."""
    missing = {"gain": -float("inf")}
    return {key: missing.get(key, float("inf")) if value is None else value for key, value in outcome.items()}


def _print(parts: Mapping[str, Any]) -> None:
    headings = ("part", "sensors", "gain [nats]", "more", "claimed", "MSSD [mm]", "ADD-S [mm]", "ADD of 10", "P(first)")
    rows, regions = [], []
    for name, part in parts.items():
        for f in part["figures"]:
            more = "" if "more" not in f else "{:+.2f} ({:+.2f} to {:+.2f})".format(*f["more"])
            lengths = [f"{f[f'{key}_median']:.1f}" for key in ("mssd_mm", "add_s_mm", "add10_mm")]
            share = f"{f['probability_median']:.3f}"
            rows.append(
                [name, str(f["sensors"]), f"{f['gain_mean']:.2f}", more, f"{f['claimed_mean']:.2f}", *lengths, share]
            )
            told = [f"{100 * f[key]:.1f} %" for key in ("ruled_out", "warned")]
            regions.append([name, str(f["sensors"]), *study_file.inside(f), *told, f"{f['ms_median']:.0f}"])
    typer.echo("Mean gain, what one more sensor adds with its 95 % interval, and medians")
    print_table(headings, rows, headings[1:])
    typer.echo("Percentage of truths inside the region of each mass, true poses ruled out, sensors said to disagree")
    said = ["sensors", *study_file.masses(), "ruled out", "warned", "ms"]
    print_table(["part", *said], regions, said)
