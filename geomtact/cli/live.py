"""Localize a live source image by image, each on its own: always the newest one."""

from __future__ import annotations

import time
from collections.abc import Generator
from typing import TYPE_CHECKING, Any

import typer

from geomtact.cli.frames import Frame
from geomtact.cli.lines import line_of, to_line
from geomtact.cli.shell import tell
from geomtact.errors import InputError

if TYPE_CHECKING:
    from geomtact.inference.localizer import Localizer


def localize_live(
    localizer: Localizer, frames: Generator[Frame, None, None], background: Any, options: dict[str, Any]
) -> bool:
    """Print a JSON line for each of the ``frames``, until there are no more or Ctrl-C; whether any showed contact.

    Without a ``background``, the first tactile image without contact serves as that of the following ones. An image that
    cannot be read brings a warning and is skipped, unless it is the first.
    """
    touched = False
    try:
        for n, frame in enumerate(frames, 1):
            began = time.perf_counter()
            try:
                posterior = localizer.localize(frame.image, background=background, **options)
            except InputError as error:
                if n == 1:
                    raise
                tell(f"warning: image {n} skipped: {error}")
                continue
            touched |= posterior.contact
            if background is None and not posterior.contact and posterior.observation.kind == "reading":
                background = frame.image
            line = line_of(n, posterior)
            own = {
                "image": frame.image if isinstance(frame.image, str) else None,
                "time": frame.time,
                "skipped": frame.skipped,
            }
            typer.echo(to_line(line | own | {"ms": 1e3 * (time.perf_counter() - began)}))
    except KeyboardInterrupt:
        tell("stopped")
    finally:
        frames.close()
    return touched
