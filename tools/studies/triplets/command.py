"""``python -m tools.studies triplets``: three touches of household objects on a DIGIT that others simulated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from geomtact.cli.options import CacheDir, Effort, MaxPoses, Seed
from geomtact.cli.shell import print_table, progress_bar, to_stderr
from tools.studies.common import study_file, study_options

SCHEMA = "geomtact/triplets/1"


def judge_triplets(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="That of the data, hsp_digit_sim_ycb.")],
    effort: study_options.EffortLevel = Effort.balanced,
    seed: Seed = 1,
    max_poses: MaxPoses = None,
    out: study_options.Out = None,
    cache_dir: CacheDir = None,
) -> None:
    """Judge triplets: one, two and three touches of household objects on a DIGIT that others simulated.

    Prints position errors, gain and coverage for each number of touches, and writes them and every outcome to --out.
    """
    from geomtact.evaluation import describe
    from geomtact.json_values import plain
    from tools.studies.triplets import study as triplets

    content = study_file.load(out, SCHEMA)
    read = triplets.read_triplets(folder, seed)
    prepared = study_options.localizers(list(read), "m", triplets.SENSOR, cache_dir, max_poses)
    for (mesh, some), localizer in zip(read.items(), prepared, strict=True):
        settings = describe(localizer) | {"effort": effort.value, "seed": seed}
        done = study_file.earlier(content["parts"].get(mesh.stem), settings, triplets.Outcome)
        each = 1 + 3 * len(triplets.SHOWN)
        with progress_bar(f"localizing {mesh.stem}") as progress:
            for more in triplets.judge(localizer, some, effort, seed, first=len(done) // each):
                done += more
                progress(len(done) / (each * len(some)), "")
                study_file.keep(out, content, mesh.stem, settings=settings, outcomes=[asdict(o) for o in done])
        to_stderr(f"{mesh.stem}: done")
    judged = [o for part in content["parts"].values() for o in study_file.outcomes(part, triplets.Outcome)]
    content["figures"] = plain(triplets.summarise(judged))
    study_file.save(out, content)
    _print(content["figures"])


def _print(figures: Sequence[dict[str, Any]]) -> None:
    headings = ("shown", "touches", "n", "centre [mm]", "mean", "ADD-S [mm]", "compatible", "gain [nats]", "claimed")
    rows, regions = [], []
    for f in figures:
        name = [f["shown"], str(f["touches"])]
        lengths = [
            _quartiles(f["position_mm_quartiles"]),
            f"{f['position_mm_mean']:.0f}",
            _quartiles(f["add_s_mm_quartiles"]),
        ]
        told = [f"{100 * f['compatible']:.0f} %", *(_quartiles(f[f"{key}_quartiles"]) for key in ("gain", "claimed"))]
        rows.append([*name, str(f["n"]), *lengths, *told])
        shares = [f"{100 * f[key]:.0f} %" for key in ("ruled_out", "warned")]
        regions.append([*name, *study_file.inside(f), *shares, f"{f['ms_quartiles'][1]:.0f}"])
    typer.echo("Medians with quartiles; triplets in which the first mode touches all three sensors")
    print_table(headings, rows, headings[1:])
    typer.echo("Percentage of truths inside the region of each mass, true poses ruled out, warnings of a sensor")
    said = ["touches", *study_file.masses(), "ruled out", "warned", "ms"]
    print_table(["shown", *said], regions, said)


def _quartiles(values: Sequence[float | None]) -> str:
    low, middle, high = ("inf" if value is None else f"{value:.1f}" for value in values)
    return f"{middle} ({low} to {high})"
