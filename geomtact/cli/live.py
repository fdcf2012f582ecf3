"""One image after the other localized, each by itself, as they come: the newest whenever the one before is done."""

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
    """Print a line of JSON for each of the ``frames``, until there are no more or Ctrl-C; whether any showed contact.

    Without a ``background``, the first reading that shows none is that of those after it. An image that cannot be read is told,
    and passed over, but for the first.
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
                tell(f"warning: image {n} is passed over: {error}")
                continue
            touched |= posterior.contact
            if background is None and not posterior.contact and posterior.observation.kind == "reading":
                background = frame.image
            line = line_of(n, posterior)
            own = {
                "image": frame.image if isinstance(frame.image, str) else None,
                "time": frame.time,
                "passed_over": frame.passed_over,
            }
            typer.echo(to_line(line | own | {"ms": 1e3 * (time.perf_counter() - began)}))
    except KeyboardInterrupt:
        tell("stopped")
    finally:
        frames.close()
    return touched
