"""Colours of all figures, images brought to 0..1, and PNGs without metadata of the program that drew them."""

from __future__ import annotations

import io
from collections.abc import Iterable, Iterator
from itertools import cycle
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from geomtact.se3 import Array

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_T = TypeVar("_T")

# Okabe and Ito's, distinct for colour-blind readers
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
BARS, OBSERVED, SIMULATED, FIRST = COLOURS[0], COLOURS[1], COLOURS[5], "#000000"


def coloured(what: Iterable[_T]) -> Iterator[tuple[_T, str]]:
    """Each with a colour of its own; from the seventh on they come again."""
    return zip(what, cycle(COLOURS), strict=False)


def png(figure: Figure) -> bytes:
    """What a matplotlib ``figure`` shows."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    out = io.BytesIO()
    FigureCanvasAgg(figure).print_png(out, metadata={"Software": None})
    return out.getvalue()


def png_of(pixels: NDArray[np.uint8], **options: Any) -> bytes:
    """An image (H, W, 3) as PNG."""
    from PIL import Image

    out = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(pixels)).save(out, "PNG", **options)
    return out.getvalue()


def rgb(colour: str) -> Array:
    """RGB in 0..1 of a colour ``#rrggbb``."""
    return np.array([int(colour[k : k + 2], 16) for k in (1, 3, 5)]) / 255


def to_pixels(image: Any) -> NDArray[np.uint8]:
    """Any image as read, (H, W) or (H, W, 3), as RGB (H, W, 3)."""
    shown = np.round(255 * np.clip(displayable(image), 0, 1)).astype(np.uint8)
    return shown if shown.ndim == 3 else np.repeat(shown[..., None], 3, 2)


def displayable(image: Any) -> Array:
    """Any image as read, (H, W) or (H, W, 3), brought to 0..1."""
    shown = np.asarray(image)
    if shown.dtype == np.uint8:
        return shown / 255.0 if shown.max(initial=0) > 1 else shown.astype(float)
    shown = np.nan_to_num(shown.astype(float))
    low, high = min(shown.min(initial=0), 0.0), shown.max(initial=0)
    return (shown - low) / (high - low) if high > low else np.zeros(shown.shape)
