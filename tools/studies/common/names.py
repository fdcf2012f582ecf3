"""Names beside the points of a picture, where they cover nothing."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.transforms import Bbox


@dataclass(frozen=True)
class Named:
    """A point of a picture at (``x``, ``y``), with a bar of ``error`` up and down."""

    name: str
    colour: str
    x: float
    y: float
    error: float = 0.0


def write_names(axes: Axes, points: Sequence[Named], size: float | None = None) -> None:
    """Name each point, at the nearest place around it where the name covers no other name, no point and no bar."""
    marks = [(p.x, p.y + part * p.error) for p in points for part in np.linspace(-1, 1, 9)]
    marked = axes.transData.transform(marks) if marks else np.zeros((0, 2))
    inside = axes.get_window_extent()
    taken: list[Bbox] = []
    angles = np.radians([0, 180, 45, 315, 135, 225, 90, 270])
    for p in points:
        for far, angle in itertools.product((9, 16, 24, 34, 46), angles):
            right, up = np.cos(angle), np.sin(angle)
            text = axes.annotate(
                p.name,
                (p.x, p.y),
                (far * right, far * up),
                textcoords="offset points",
                color=p.colour,
                ha="center" if abs(right) < 0.1 else "left" if right > 0 else "right",
                va="center" if abs(up) < 0.1 else "bottom" if up > 0 else "top",
                fontsize=size,
            )
            box = text.get_window_extent()
            free = not box.count_overlaps(taken) and not box.padded(3).count_contains(marked)
            if free and inside.count_contains(box.corners()) == 4:
                break
            text.remove()
        else:  # too crowded: beside its point, over whatever is there
            text = axes.annotate(
                p.name, (p.x, p.y), (9, 0), textcoords="offset points", color=p.colour, va="center", fontsize=size
            )
        taken.append(text.get_window_extent())
