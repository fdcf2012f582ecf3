"""``python -m tools.studies track``: the filter against independent frames and against the thesis's own."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Annotated, Any

import typer

from geomtact.cli.options import CacheDir, Effort, Seed, Unit
from geomtact.cli.shell import print_table, to_stderr
from geomtact.cli.simulate import NoiseName
from tools.studies.common import study_file, study_options

SCHEMA = "geomtact/track/2"


def judge_track(
    parts: study_options.ThesisParts = None,
    unit: Unit = None,
    sensor: study_options.SensorName = "gelslim",
    trajectories: Annotated[int, typer.Option("--touches", min=1, help="How many trajectories of each object.")] = 200,
    noise: study_options.NoiseLevel = NoiseName.moderate,
    effort: study_options.EffortLevel = Effort.balanced,
    seed: Seed = 1,
    out: study_options.Out = None,
    plot: study_options.Plot = None,
    cache_dir: CacheDir = None,
) -> None:
    """Judge tracking: the filter over a sequence against independent frames and against the thesis's own filter.

    Prints gain, coverage and how often each loses the object, and writes them and every trajectory to --out.
    """
    from geomtact.evaluation import describe
    from geomtact.json_values import plain
    from tools.studies.track import study as track_study

    content, strength = study_file.load(out, SCHEMA), study_options.noise_named(noise)
    for localizer in study_options.localizers(parts, unit, sensor, cache_dir):
        settings = describe(localizer) | {
            "trajectories": trajectories,
            "frames": track_study.FRAMES,
            "filter": track_study.settings(),
            "noise": {"name": noise.value, **asdict(strength)},
            "effort": effort.value,
            "seed": seed,
        }
        name = localizer.mesh.name
        found = content["parts"].get(name)
        done = study_file.earlier(found, settings, track_study.Followed)
        timing = found["step_ms"] if found is not None and done else None

        def keep(outcomes: list, name: str = name, settings: Mapping = settings, timing: Any = None) -> None:
            rows = [_rounded(asdict(o)) for o in outcomes]
            study_file.keep(out, content, name, settings=settings, step_ms=timing, outcomes=rows)

        if len(done) < trajectories:
            more = track_study.follow(localizer, trajectories, seed, track_study.FRAMES, strength, effort, len(done))
            study_file.collect(done, more, trajectories, f"following {name}", keep)
        keep(done, timing=timing or track_study.time_steps(localizer, seed, track_study.FRAMES, strength, effort))
        to_stderr(f"{name}: done")
    everything = [o for part in content["parts"].values() for o in study_file.outcomes(part, track_study.Followed)]
    content["figures"] = plain(track_study.summarise(everything))
    study_file.save(out, content)
    _print(content)
    study_file.plot(content, plot)


def _rounded(value: Any) -> Any:
    """Numbers to four digits: thousands of frames in a file of some hundred kilobytes."""
    if isinstance(value, dict):
        return {key: _rounded(each) for key, each in value.items()}
    if isinstance(value, list):
        return [_rounded(each) for each in value]
    return float(f"{value:.4g}") if isinstance(value, float) else value


def _print(content: Mapping[str, Any]) -> None:
    import numpy as np

    from tools.studies.track.plot import LABELS

    figures = content["figures"]
    typer.echo(f"{figures['n']} trajectories, {figures['stretches']} of which begin without features")
    headings = ("method", "gain [nats]", "more than frames", "better", "claimed", "lost")
    rows, regions = [], []
    for method, title in LABELS.items():
        f = figures[method]
        more = "{:+.2f} ({:+.2f} to {:+.2f})".format(*f["more"]) if method != "frames" else ""
        better = f"{100 * f['better']:.0f} %" if method != "frames" else ""
        rows.append([title, f"{f['gain_mean']:.2f}", more, better, f"{f['claimed_mean']:.2f}", str(f["lost"])])
        regions.append([title, *study_file.inside(f)])
    print_table(headings, rows, headings[1:])
    typer.echo("Percentage of truths inside the region of each mass")
    print_table(["method", *study_file.masses()], regions, study_file.masses())
    steps = [ms for part in content["parts"].values() for ms in part["step_ms"] or []]
    typer.echo(
        f"A step of the filter: {np.median(steps):.0f} ms in the median, {np.quantile(steps, 0.9):.0f} ms at 90 %"
    )
