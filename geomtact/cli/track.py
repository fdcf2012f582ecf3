"""``geomtact track``: an object tracked through a sequence of images, one JSON line per image."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from geomtact.cli.frames import Frame, all_frames, listed
from geomtact.cli.lines import line_of, to_line
from geomtact.cli.options import (
    Background,
    CacheDir,
    Effort,
    EffortName,
    Kind,
    KindName,
    MaxPoses,
    Mirror,
    Mounting,
    Rotate,
    ScorerName,
    Seed,
    SensorName,
    Unit,
    check_name,
)
from geomtact.cli.prepare import open_localizer
from geomtact.cli.project import given_of, resolve
from geomtact.cli.shell import NO_CONTACT, check_file, posterior_file, tell
from geomtact.errors import InputError, UsageError
from geomtact.files import write_text

if TYPE_CHECKING:
    from geomtact.inference.localizer import Localizer
    from geomtact.inference.posterior import Posterior


Source = Annotated[
    str,
    typer.Argument(
        metavar="DIR|VIDEO|CAMERA|-",
        help="Folder of images, video, number of a camera, or - for paths on standard input.",
    ),
]
ObjectName = Annotated[str | None, typer.Option("--object", help="Object (see 'geomtact objects') or mesh file.")]
MotionMm = Annotated[
    float,
    typer.Option(min=0.001, max=1000, help="Largest motion between two frames: mean distance of the object's points."),
]
Follow = Annotated[bool, typer.Option("--follow", help="Wait for more images in the folder, until Ctrl-C.")]
SkipBroken = Annotated[bool, typer.Option("--skip-broken", help="Skip images that cannot be read.")]
MOTION_MM = 8.0  # the thesis's
UNTOUCHED = "no contact found in any image; give --background, or the kind of the images by --kind"


def track(
    source: Source,
    object_name: ObjectName = None,
    unit: Unit = None,
    sensor: SensorName = None,
    kind: KindName = Kind.auto.value,
    background: Background = None,
    prior: Annotated[
        Path | None, typer.Option(help="Prior of the first frame: a posterior.npz, or its folder.")
    ] = None,
    effort: EffortName = None,
    scorer: ScorerName = None,
    motion_mm: MotionMm = MOTION_MM,
    max_cells: Annotated[
        int | None, typer.Option(min=1, help="Largest number of grid cells kept between frames. Fewer are faster.")
    ] = None,
    follow: Follow = False,
    skip_broken: SkipBroken = False,
    rotate: Rotate = None,
    mirror: Mirror = None,
    tum: Annotated[
        Path | None, typer.Option(help="Write the first modes as a TUM trajectory: timestamp tx ty tz qx qy qz qw.")
    ] = None,
    report: Annotated[Path | None, typer.Option(help="Write an HTML file that plays the sequence.")] = None,
    fps: Annotated[float, typer.Option(min=1e-6, help="Images per second, for the timestamps of a folder.")] = 1.0,
    seed: Seed = 0,
    max_poses: MaxPoses = None,
    cache_dir: CacheDir = None,
) -> None:
    """Track an object through a sequence of images: print one JSON line per image.

    Options that you leave out come from the nearest geomtact.toml (this folder or above), then from the first image's
    metadata.

    Exit status: 0 done, 2 usage error, 3 bad input, 4 no contact in any image.
    """
    check_file(tum, "--tum")
    check_file(report, "--report")
    given = given_of(object_name, unit, sensor, background, effort)
    options: dict[str, Any] = {"kind": kind, "prior": prior, "max_cells": max_cells, "skip_broken": skip_broken}
    options["seed"] = seed
    options["mounting"] = Mounting(rotate, mirror)
    localizer, posteriors = open_track(source, given, follow, motion_mm, scorer, max_poses, cache_dir, **options)

    from geomtact.report.exchange import tum_line

    lines: list[str] = []
    shown: list[dict[str, Any]] = []
    touched = whole = False
    try:
        for n, (at, posterior) in enumerate(posteriors, 1):
            line = line_of(n, posterior) | {"surprise_nats": posterior.settings["surprise_nats"]}
            touched |= posterior.contact
            typer.echo(to_line(line))
            if line["T"] is not None:
                lines.append(tum_line(n / fps if at is None else at, line["T"]))
            if report is not None:
                from geomtact.report.sequence_page import sequence_frame

                shown.append(sequence_frame(posterior, line, localizer.simulate))
        whole = True
    except KeyboardInterrupt:
        tell("stopped")
    finally:  # the results before a frame that cannot be read are kept
        if tum is not None and (lines or whole):
            write_text(tum, "".join(lines))
        if report is not None and shown:
            from geomtact.report.sequence_page import sequence_page

            write_text(report, sequence_page(localizer.mesh.name, localizer.sensor.name, shown))
    if not touched:
        tell(UNTOUCHED)
        raise typer.Exit(NO_CONTACT)


def open_track(
    source: str,
    given: dict[str, str | None],
    follow: bool,
    motion_mm: float,
    scorer: str | None,
    max_poses: int | None,
    cache_dir: Path | None,
    *,
    kind: str,
    skip_broken: bool,
    seed: int,
    mounting: Mounting,
    prior: Path | None = None,
    max_cells: int | None = None,
) -> tuple[Localizer, Iterator[tuple[float | None, Posterior]]]:
    """The localizer, and each frame's time, if the source has one, and posterior; parameters as of :func:`track`."""
    from geomtact.sensing.reading import read_observation

    check_name("kind", kind, Kind)
    prior = prior and posterior_file(prior, "--prior")
    if follow and not Path(source).is_dir():
        raise UsageError(f"--follow: expected a folder to watch, got {source}")
    values, sources = resolve(given, _metadata(source))
    effort = values["effort"] or Effort.balanced.value
    check_name("effort", effort, Effort, sources.get("effort"))
    sensor = mounting.of(values["sensor"]) if values["sensor"] else None

    def check(image: Any) -> None:
        if sensor is not None and not skip_broken:
            read_observation(image, sensor, kind, values["background"])

    frames = all_frames(source, follow, sensor, check, masks=kind == Kind.mask.value)
    localizer = open_localizer(values, sources, scorer, cache_dir, max_poses, prior, mounting=mounting)

    from geomtact.inference.motion import UniformBall
    from geomtact.inference.sequence import track as followed

    options: dict[str, Any] = {"kind": kind, "background": values["background"], "prior": prior, "effort": effort}
    options |= {"motion": UniformBall(1e-3 * motion_mm), "most": max_cells}
    options["on_error"] = "skip" if skip_broken else "raise"
    times: deque[float | None] = deque()
    posteriors = followed(localizer, _images(frames, times), seed=seed, **options)
    return localizer, ((times.popleft(), posterior) for posterior in posteriors)


def _metadata(source: str) -> dict[str, Any]:
    """The metadata of the first image of a folder."""
    from geomtact.sensing.reading import read_metadata

    images = listed(Path(source)) if Path(source).is_dir() else []
    try:
        return read_metadata(images[0]) if images else {}
    except InputError:
        return {}  # reported with its number when its turn comes


def _images(frames: Iterator[Frame], times: deque[float | None]) -> Iterator[Any]:
    """The images alone; their times are put into ``times``."""
    for frame in frames:
        times.append(frame.time)
        yield frame.image
