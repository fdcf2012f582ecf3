"""A sheet of tactile images: the contact that was found on each, beside the circle that was drawn by hand."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from geomtact.report.canvas import COLOURS, png

_COLUMNS = 10


def draw_sheet(
    sets: Mapping[str, Sequence[tuple[Any, NDArray[np.bool_], Sequence[float]]]], factor: Mapping[str, float]
) -> bytes:
    """A PNG of all tactile images by set, each (image (H, W, 3), contact (H, W), circle (column, row, radius) [px]);
    the circle is divided by the set's ``factor``."""
    from matplotlib.figure import Figure

    rows = {name: -(-len(some) // _COLUMNS) for name, some in sets.items()}
    tall = {name: some[0][0].shape[0] / some[0][0].shape[1] for name, some in sets.items()}
    height = sum(rows[name] * tall[name] for name in sets)
    figure = Figure((13, 13 * height / _COLUMNS + 0.5 * len(sets)), layout="constrained")
    bands = np.ravel(
        figure.subfigures(len(sets), 1, squeeze=False, height_ratios=[rows[n] * tall[n] + 0.35 for n in sets])
    )
    for band, (name, some) in zip(bands, sets.items(), strict=True):
        band.suptitle(
            f"{name}: contact found (orange), circle drawn by hand, divided by {factor[name]:.2f} (white)",
            fontsize=10,
        )
        grid = band.subplots(rows[name], _COLUMNS, squeeze=False).ravel()
        for axes in grid:
            axes.set_axis_off()
        for axes, (image, mask, (x, y, radius)) in zip(grid, some, strict=False):
            axes.imshow(image)
            around = np.linspace(0, 2 * np.pi, 60)
            r = radius / factor[name]
            axes.plot(x + r * np.cos(around), y + r * np.sin(around), color="white", linewidth=0.8)
            contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
            for contour in contours:
                axes.plot(*np.vstack([contour[:, 0], contour[:1, 0]]).T, color=COLOURS[1], linewidth=1.0)
            axes.set(xlim=(-0.5, image.shape[1] - 0.5), ylim=(image.shape[0] - 0.5, -0.5))
    return png(figure)
