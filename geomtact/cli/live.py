"""Localize a live source image by image, each on its own: always the newest one."""

from __future__ import annotations

import time
from collections.abc import Generator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from geomtact.cli.frames import Frame, camera_frames, newest_in
from geomtact.cli.request import Request
from geomtact.cli.shell import to_stderr
from geomtact.errors import InputError, UsageError

if TYPE_CHECKING:
    from geomtact.localizer import Localizer


def follow(request: Request, images: Sequence[Path], camera: str | None) -> bool:
    """Localize the newest image of a camera, or of the folder in ``images``, again and again; whether any showed contact."""
    # a missing camera is reported before minutes go into an index
    frames = newest_in(images[0]) if camera is None else camera_frames(camera, request.mounted())
    options = {"kind": request.kind, "prior": request.prior, "effort": request.effort, "seed": request.seed}
    return localize_live(request.open(), frames, request.values["background"], options)


def check_live(images: list[Path], camera: str | None, watch: bool, unsuited: list[str]) -> None:
    """Refuse what does not go with --camera or --watch.

    Raises
    ------
    UsageError, InputError
    """
    if camera is not None and (images or watch):
        raise UsageError("--camera replaces images and --watch; give one of them")
    if watch and len(images) != 1:
        raise UsageError(f"--watch: expected one folder, got {len(images)}")
    if watch and not images[0].is_dir():
        raise InputError(f"--watch {images[0]}: expected the folder that receives images; give it")
    if unsuited:
        raise UsageError(
            f"{unsuited[0]} excludes --camera and --watch, which print a JSON line per image; leave it out"
        )


def localize_live(
    localizer: Localizer, frames: Generator[Frame, None, None], background: Any, options: dict[str, Any]
) -> bool:
    """Print a JSON line for each of the ``frames``, until there are no more or Ctrl-C; whether any showed contact.

    Without a ``background``, the first tactile image without contact serves as that of the following ones. An image that
    cannot be read brings a warning and is skipped, unless it is the first.
    """
    from geomtact.report.result import frame_line, to_line

    touched = False
    try:
        for n, frame in enumerate(frames, 1):
            began = time.perf_counter()
            try:
                posterior = localizer.localize(frame.image, background=background, **options)
            except InputError as error:
                if n == 1:
                    raise
                to_stderr(f"warning: image {n} skipped: {error}")
                continue
            touched |= posterior.contact
            if background is None and not posterior.contact and posterior.provenance.views[0].kind == "reading":
                background = frame.image
            line = frame_line(n, posterior)
            own = {
                "image": frame.image if isinstance(frame.image, str) else None,
                "time": frame.time,
                "skipped": frame.skipped,
            }
            typer.echo(to_line(line | own | {"ms": 1e3 * (time.perf_counter() - began)}))
    except KeyboardInterrupt:
        to_stderr("stopped")
    finally:
        frames.close()
    return touched
