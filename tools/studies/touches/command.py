"""``python -m tools.studies touches``: what each more sensor adds."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict
from enum import StrEnum
from typing import TYPE_CHECKING, Annotated, Any

import typer

from geomtact.cli.options import CacheDir, Effort, Seed, Unit
from geomtact.cli.shell import print_table
from geomtact.cli.simulate import NoiseName
from tools.studies.common import study_file, study_options

if TYPE_CHECKING:
    from geomtact.localizer import Localizer

SCHEMA = "geomtact/touches/1"


class SceneName(StrEnum):
    """What holds the sensors."""

    anyhow = "anyhow"
    jaw = "jaw"
    loose_jaw = "loose-jaw"


def judge_touches(
    parts: study_options.ThesisParts = None,
    unit: Unit = None,
    sensor: study_options.SensorName = "gelslim",
    scenes: Annotated[
        int, typer.Option("--touches", min=1, help="How many scenes of five touches of each part.")
    ] = 200,
    noise: study_options.NoiseLevel = NoiseName.moderate,
    felt: study_options.Felt = study_options.FeltName.both,
    scene: Annotated[
        SceneName,
        typer.Option(
            help="Five sensors anyhow, or the two opposed fingers of a jaw that measures its opening to 0.1 mm; or of "
            "one that is known to 0.5 mm and 0.5 degrees."
        ),
    ] = SceneName.anyhow,
    effort: study_options.EffortLevel = Effort.balanced,
    seed: Seed = 1,
    out: study_options.Out = None,
    plot: study_options.Plot = None,
    cache_dir: CacheDir = None,
) -> None:
    """Judge several sensors: what each more adds to the posterior of a part that one to five touch at once.

    Prints gain, coverage and pose errors for each number of sensors, and writes them and every outcome to --out.
    """
    from geomtact.contact_space.touches import GEL_KINDS
    from geomtact.evaluation import describe, simultaneous_touches
    from tools.studies.touches import jaw
    from tools.studies.touches import study as sensors_study

    content, strength = study_file.load(out, SCHEMA), study_options.noise_named(noise)
    std = {SceneName.jaw: jaw.OPENING, SceneName.loose_jaw: jaw.LOOSE}.get(scene)
    for localizer in study_options.localizers(parts, unit, sensor, cache_dir):
        settings = describe(localizer) | {
            "scenes": scenes,
            "noise": {"name": noise.value, **asdict(strength)},
            "elastic": GEL_KINDS[felt],
            "scene": scene.value,
            "effort": effort.value,
            "seed": seed,
        }

        def more(first: int, localizer: Localizer = localizer) -> Iterator[Any]:
            space, elastic = localizer.space, GEL_KINDS[felt]
            made = (
                simultaneous_touches(space, scenes, sensors_study.SENSORS, seed, strength, elastic)
                if std is None
                else jaw.grasps(space, scenes, seed, strength, elastic, std)
            )
            return sensors_study.fuse_scenes(localizer, made, first, effort=effort, seed=seed, extrinsics_std=std)

        study_file.judged(
            out, content, settings, scenes, "fusing", more, sensors_study.FusedOutcome, sensors_study.summarise
        )
    _print(content["parts"])
    study_file.plot(content, plot)


def _print(parts: Mapping[str, Any]) -> None:
    headings = ("part", "sensors", "gain [nats]", "more", "claimed", "MSSD [mm]", "ADD-S [mm]", "ADD of 10", "P(first)")
    rows, regions = [], []
    for name, part in parts.items():
        for f in part["figures"]:
            more = "" if "more" not in f else "{:+.2f} ({:+.2f} to {:+.2f})".format(*f["more"])
            lengths = [study_file.length(f[f"{key}_median"]) for key in ("mssd_mm", "add_s_mm", "add10_mm")]
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
