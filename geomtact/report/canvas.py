"""Colours of all figures, and a PNG without metadata of the program that drew it."""

from __future__ import annotations

import io
from collections.abc import Iterable, Iterator
from itertools import cycle
from typing import Any, TypeVar

_T = TypeVar("_T")

COLOURS = (
    "#0072B2",
    "#D55E00",
    "#009E73",
    "#CC79A7",
    "#E69F00",
    "#56B4E9",
)  # Okabe and Ito: distinct for colour-blind readers


def coloured(what: Iterable[_T]) -> Iterator[tuple[_T, str]]:
    """Each with a colour of its own; from the seventh on they come again."""
    return zip(what, cycle(COLOURS), strict=False)


def png(canvas: Any) -> bytes:
    """What a matplotlib ``canvas`` shows."""
    out = io.BytesIO()
    canvas.print_png(out, metadata={"Software": None})
    return out.getvalue()
