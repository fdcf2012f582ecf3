"""``python -m tools.studies readings``: real tactile images, from the image to the contact, the height and the pose."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from geomtact.cli.options import CacheDir
from geomtact.cli.shell import print_table, progress_bar, to_stderr
from tools.studies.common import study_file, study_options

SCHEMA = "geomtact/readings/1"


def judge_readings(
    folder: Annotated[
        Path, typer.Argument(metavar="FOLDER", help="That of the data, with the tactile images of several sensors.")
    ],
    circles: Annotated[
        Path | None,
        typer.Option(
            help="CSV of circles drawn by eye on the GelSight Mini's presses; without it no ball is localized."
        ),
    ] = None,
    out: study_options.Out = None,
    sheet: Annotated[
        Path | None, typer.Option(help="PNG of every tactile image with the contact that was found.")
    ] = None,
    cache_dir: CacheDir = None,
) -> None:
    """Judge real tactile images: contacts against circles drawn by hand, a calibration by the ball it did not see, balls and a
    grooved plate localized by heights.

    Prints a table of each, and writes them and every outcome to --out.
    """
    from geomtact.sensing.sensor import CONTACT_METHODS
    from tools.studies.readings import groove
    from tools.studies.readings import study as readings

    content = study_file.load(out, SCHEMA)
    sets, methods = readings.imprints(folder), readings.methods()
    if circles is not None:
        sets["gelslam"] = readings.imprints_by_eye(folder, circles)
    default = CONTACT_METHODS[0]
    for name, some in sets.items():
        found = {method: readings.find(some, method, find) for method, find in methods.items()}
        study_file.keep(
            out,
            content,
            name,
            settings={"set": name, "n": len(some), "default": default},
            figures={method: readings.summarise_contacts(each) for method, each in found.items()},
            outcomes=[asdict(o) for each in found.values() for o in each],
        )
    _print_contacts({name: content["parts"][name]["figures"] for name in sets})
    if sheet is not None:
        _draw(sheet, sets, methods[default], {name: content["parts"][name]["figures"][default] for name in sets})

    for camera, base in readings.cameras().items():
        by_ball = readings.calibrations(folder, base)
        _measure_balls(by_ball, camera, out, content)
        if circles is not None:
            sensors = {ball: each.sensor for ball, each in by_ball.items()}
            _judge_balls(folder, circles, sensors, camera, out, content, cache_dir)
    with progress_bar("localizing a groove"):
        density, modes = groove.localize_groove(folder, cache_dir)
    figures = {"log_density_at_truth": density, "modes": [asdict(m) for m in modes]}
    study_file.keep(out, content, "groove", settings={"height_noise_mm": 0.02}, figures=figures, outcomes=[])
    headings = ("probability", "across [mm]", "along", "height", "turn [deg]", "tilt", "told", "of it along")
    typer.echo(f"The groove's leading modes; {density:.1f} nats at the true pose")
    print_table(headings, [_mode(m) for m in modes], headings)


def _measure_balls(found: Any, camera: str, out: Path | None, content: dict[str, Any]) -> None:
    """Diameters by the calibrations ``found``, by their ball, of a sensor with a ``camera``."""
    from tools.studies.readings import study as readings

    measured = readings.measure_balls(found)
    noise = {f"{used:.3f}": 1e3 * each.sensor.height_noise for used, each in found.items()}
    settings = {"sensor": "gelsight-mini", "camera": camera}
    study_file.keep(out, content, f"calibration, {camera}", settings=settings, figures=measured, outcomes=[noise])
    rows = [
        [f"{m['used_mm']:.3f}", f"{m['ball_mm']:.3f}", f"{m['told_mm']:.2f}", f"{100 * m['off']:+.1f} %"]
        for m in measured
    ]
    typer.echo(f"Diameters [mm] measured by the colours, with the presses of one ball as calibration; {camera}")
    print_table(("calibrated with", "ball", "measured", "off"), rows, ("calibrated with", "ball", "measured", "off"))


def _judge_balls(
    folder: Path, circles: Path, sensors: Any, camera: str, out: Path | None, content: dict, cache_dir: Any
) -> None:
    import hashlib

    from tools.studies.readings import study as readings

    digest, part = hashlib.sha256(circles.read_bytes()).hexdigest(), f"balls, {camera}"
    settings = {"sensor": "gelsight-mini", "camera": camera, "circles_sha256": digest}
    done = study_file.earlier(content["parts"].get(part), settings, readings.Pressed)
    total = len(readings.circles_of(circles))

    def keep(outcomes: list) -> None:
        figures = readings.summarise_balls(outcomes)
        study_file.keep(out, content, part, settings=settings, figures=figures, outcomes=[asdict(o) for o in outcomes])

    if len(done) < total:
        more = readings.localize_balls(folder, circles, sensors, cache_dir, first=len(done))
        study_file.collect(done, more, total, "localizing balls", keep)
        keep(done)
    rows = [
        [
            f"{f['ball_mm']:.3f}",
            str(f["n"]),
            f"{100 * f['right']:.0f} %",
            f"{f['nats'][0]:.1f} ({f['nats'][1]:.1f} to {f['nats'][2]:.1f})",
            str(f["whole"]),
            f"{f['off_mm_median']:.2f}",
            f"{100 * f['within_0.3_mm']:.0f} %",
            f"{f['off_mm_largest']:.2f}",
        ]
        for f in content["parts"][part]["figures"]
    ]
    headings = ("ball", "n", "right ball", "nats", "whole", "off [mm]", "within 0.3", "largest")
    typer.echo(
        f"Balls localized by heights, calibrated with the other ball; off: where the whole contact is seen; {camera}"
    )
    print_table(headings, rows, headings)


def _print_contacts(figures: dict[str, dict[str, Any]]) -> None:
    headings = ("set", "method", "n", "imprint / contact", "IoU", "least", "centre", "ms")
    rows = [
        [
            name,
            method,
            str(f["n"]),
            " ".join(f"{factor:.2f}" for factor in f["factors"]),
            f"{f['iou_median']:.3f} ({f['iou_interval'][0]:.3f} to {f['iou_interval'][1]:.3f})",
            f"{f['iou_least']:.2f}",
            f"{f['centre_median']:.3f}",
            f"{f['ms_median']:.0f}",
        ]
        for name, each in figures.items()
        for method, f in each.items()
    ]
    typer.echo("Contacts against imprints drawn by hand; centre: off in image widths. Medians")
    print_table(headings, rows, headings[2:])


def _draw(path: Path, sets: Any, method: Any, figures: dict[str, dict[str, Any]]) -> None:
    from geomtact.files import write_bytes
    from tools.studies.readings.sheet import draw_sheet

    shown = {name: [(i.image, method(i.image, i.background), i.circle) for i in some] for name, some in sets.items()}
    factor = {name: sum(f["factors"]) / len(f["factors"]) for name, f in figures.items()}
    picture = draw_sheet(shown, factor)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_bytes(path, picture)
    to_stderr(f"sheet: {path}")


def _mode(m: Any) -> list[str]:
    lengths = [f"{value:.2f}" for value in (m.across_mm, m.along_mm, m.deep_mm)]
    return [
        f"{100 * m.probability:.1f} %",
        *lengths,
        f"{m.turn_deg:.1f}",
        f"{m.tilt_deg:.1f}",
        str(m.told),
        f"{m.told_along:.2f}",
    ]
