"""``geomtact track``: an object tracked through a sequence of images, one JSON line per image."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from geomtact.cli import options
from geomtact.cli.frames import Frame, all_frames, listed
from geomtact.cli.request import Request
from geomtact.cli.shell import NO_CONTACT, check_file, note_overwritten, to_stderr
from geomtact.errors import InputError, UsageError
from geomtact.files import write_text

if TYPE_CHECKING:
    from geomtact.cli.frames import Image, Unread
    from geomtact.inference.posterior import Posterior
    from geomtact.localizer import Localizer
    from geomtact.sensing.image_file import ImageFile


def track(
    source: options.Source,
    object_name: options.ObjectName = None,
    unit: options.Unit = None,
    sensor: options.SensorName = None,
    kind: options.KindName = options.Kind.auto.value,
    background: options.Background = None,
    prior: Annotated[
        Path | None, typer.Option(help="Prior of the first image: a posterior.npz, or its folder.")
    ] = None,
    effort: options.EffortName = None,
    scorer: options.ScorerName = None,
    motion_mm: options.MotionMm = options.MOTION_MM,
    max_cells: Annotated[
        int | None, typer.Option(min=1, help="Largest number of grid cells kept from image to image. Fewer are faster.")
    ] = None,
    follow: options.Follow = False,
    skip_broken: options.SkipBroken = False,
    rotate: options.Rotate = None,
    mirror: options.Mirror = None,
    tum: Annotated[
        Path | None, typer.Option(help="Write the first modes as a TUM trajectory: timestamp tx ty tz qx qy qz qw.")
    ] = None,
    report: Annotated[Path | None, typer.Option(help="Write an HTML file that plays the sequence.")] = None,
    fps: Annotated[float, typer.Option(min=1e-6, help="Images per second, for the timestamps of a folder.")] = 1.0,
    seed: options.Seed = 0,
    max_poses: options.MaxPoses = None,
    cache_dir: options.CacheDir = None,
) -> None:
    """Track an object through a sequence of images: print one JSON line per image.

    Options that you leave out come from the nearest geomtact.toml (this folder or above), then from the first image's
    metadata.

    Exit status: 0 done, 2 usage error, 3 bad input, 4 no contact in any image.
    """
    check_file(tum, "--tum")
    check_file(report, "--report")
    localizer, posteriors = open_track(
        source,
        follow,
        skip_broken,
        motion_mm,
        {"object": object_name, "unit": unit, "sensor": sensor, "background": background, "effort": effort},
        max_cells=max_cells,
        kind=kind,
        prior=prior,
        scorer=scorer,
        seed=seed,
        max_poses=max_poses,
        cache_dir=cache_dir,
        mounting=options.Mounting(rotate, mirror),
    )

    from geomtact.report.exchange import tum_line
    from geomtact.report.result import frame_line, to_line

    note_overwritten([tum, report])
    lines: list[str] = []
    shown: list[dict[str, Any]] = []
    touched = whole = False
    try:
        for n, (at, posterior) in enumerate(posteriors, 1):
            line = frame_line(n, posterior) | {"surprise_nats": posterior.diagnostics.surprise_nats}
            touched |= posterior.contact
            typer.echo(to_line(line))
            if line["T"] is not None:
                lines.append(tum_line(n / fps if at is None else at, line["T"]))
            if report is not None:
                from geomtact.report.sequence_page import sequence_frame

                shown.append(sequence_frame(posterior, line, localizer.simulate))
        whole = True
    except KeyboardInterrupt:
        to_stderr("stopped")
    finally:  # the results before a frame that cannot be read are kept
        if tum is not None and (lines or whole):
            write_text(tum, "".join(lines))
        if report is not None and shown:
            from geomtact.report.sequence_page import sequence_page

            write_text(report, sequence_page(localizer.mesh.name, localizer.sensor.name, shown))
    exit_untouched(touched)


def exit_untouched(touched: bool) -> None:
    """Exit with the status of no contact, unless any image was ``touched``."""
    if not touched:
        to_stderr("no contact found in any image; give --background, or the kind of the images by --kind")
        raise typer.Exit(NO_CONTACT)


def open_track(
    source: str,
    follow: bool,
    skip_broken: bool,
    motion_mm: float,
    given: Mapping[str, str | Path | None],
    max_cells: int | None = None,
    **asked: Any,
) -> tuple[Localizer, Iterator[tuple[float | None, Posterior]]]:
    """The localizer, and each frame's time, if the source has one, and posterior.

    Parameters as of :func:`track`; ``given`` and what else is ``asked`` as of :meth:`Request.of`.
    """
    from geomtact.sensing.reading import read_observation

    if follow and not Path(source).is_dir():
        raise UsageError(f"--follow: expected a folder to watch, got {source}")
    first, metadata = _first_image(source)
    request = Request.of(given, metadata, **asked)
    sensor, background = request.mounted(), request.values["background"]

    def read(image: Unread) -> Image:
        if first is not None and not follow:  # an image that is still being written is read in its turn
            image = first
        if sensor is None or skip_broken:
            return image  # opening the index reports a missing sensor; broken images are skipped in their turn
        return read_observation(image, sensor, request.kind, background)

    frames = all_frames(source, follow, sensor, read, masks=request.kind == options.Kind.mask.value)
    localizer = request.open()

    from geomtact.inference.motion import UniformBall

    times: deque[float | None] = deque()
    posteriors = localizer.track(
        _images(frames, times),
        kind=request.kind,
        background=background,
        prior=request.prior,
        effort=request.effort,
        seed=request.seed,
        motion=UniformBall(1e-3 * motion_mm),
        most=max_cells,
        on_error="skip" if skip_broken else "raise",
    )
    return localizer, ((times.popleft(), posterior) for posterior in posteriors)


def _first_image(source: str) -> tuple[ImageFile | None, dict[str, Any]]:
    """The first image of a folder, if it can be read, and its metadata."""
    from geomtact.sensing.image_file import ImageFile

    images = listed(Path(source)) if Path(source).is_dir() else []
    if not images:
        return None, {}
    try:
        first = ImageFile.read(images[0])
        return first, first.metadata
    except InputError:
        return None, {}  # reported with its number when its turn comes


def _images(frames: Iterator[Frame], times: deque[float | None]) -> Iterator[Image]:
    """The images alone; their times are put into ``times``."""
    for frame in frames:
        times.append(frame.time)
        yield frame.image
