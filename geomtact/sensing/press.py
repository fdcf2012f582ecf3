"""Presses of a ball: where in a tactile image its imprint lies, and why some tactile images show none."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geomtact.se3 import Array
from geomtact.sensing.change import as_unit_rgb, colour_change, same_size
from geomtact.sensing.flicker import without_flicker
from geomtact.sensing.local_shape import contact_of, does_bulge
from geomtact.sensing.sensor import Sensor

SAME = "it is the same image as one before"
_ROUND = 0.05  # of the radius that half of an outline may stray from its circle
_SEEN = 0.4  # share of the circle that has to be seen


@dataclass(frozen=True, eq=False)
class Press:
    """One press of the ball.

    Attributes
    ----------
    name : of its image
    change, changed : (H, W, 3) of colour from the background, and (H, W) where that exceeds the noise
    mask : (H, W) its imprint
    centre : (column, row) of the imprint's circle [px]
    radius : and its radius along x [px]
    """

    name: str
    change: Array
    changed: NDArray[np.bool_]
    mask: NDArray[np.bool_]
    centre: Array
    radius: float


def find_presses(
    images: Sequence[Any], reference: Array, pitch: tuple[float, float] | None, sensor: Sensor | None = None
) -> tuple[list[Press], dict[str, str]]:
    """Those of the images of a ``sensor`` that show a ball, and why the others do not."""
    found, left_out = [], {}
    seen: list[Array] = []
    stretch = 1.0 if pitch is None else pitch[1] / pitch[0]
    for number, source in enumerate(images, 1):
        name, image = named_image(source, f"press {number}", sensor)
        same_size(image, reference, name, "background")
        if any(np.array_equal(image, other) for other in seen):
            left_out[name] = SAME
            continue
        seen.append(image)
        image = without_flicker(image, reference).image
        change, changed = colour_change(image, reference)
        finer = np.array([1.0, stretch]) / min(1.0, stretch)
        mask = contact_of(image, reference, "auto", finer, does_bulge(sensor)).mask
        if not mask.any():
            left_out[name] = "no contact was found"
            continue
        circle = _circle(mask, stretch)
        if isinstance(circle, str):
            left_out[name] = circle
        else:
            found.append(Press(name, change, changed, mask, *circle))
    return found, left_out


def _circle(mask: NDArray[np.bool_], stretch: float) -> tuple[Array, float] | str:
    """Centre (column, row) and radius along x of the circle that the outline of a mask is, or what is wrong with it. Rows are
    ``stretch`` times as far apart as columns."""
    import cv2

    h, w = mask.shape
    contours = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]
    points = max(contours, key=len)[:, 0].astype(float)
    # where the image's border cuts the contact there is no outline
    points = points[(points > 1).all(1) & (points[:, 0] < w - 2) & (points[:, 1] < h - 2)]
    if len(points) < 20:
        return "hardly any of its outline lies within the image"
    points[:, 1] *= stretch
    weight = np.ones(len(points))
    for _ in range(10):
        A = np.column_stack([2 * points, np.ones(len(points))])
        solved = np.linalg.lstsq(A * weight[:, None], (points**2).sum(1) * weight, rcond=None)[0]
        radius = float(np.sqrt(max(solved[2] + solved[:2] @ solved[:2], 0.0)))
        off = np.linalg.norm(points - solved[:2], axis=1) - radius
        weight = 1 / (1 + (off / (0.02 * radius + 1e-9)) ** 2)
    if np.median(np.abs(off)) > _ROUND * radius:
        return "its outline is no circle"
    if len(np.unique(np.arctan2(*(points - solved[:2]).T) // (np.pi / 18))) < _SEEN * 36:
        return "less than two fifths of its circle are seen"
    return np.array([solved[0], solved[1] / stretch]), radius + 0.5  # a contour runs through the middles of its pixels


def named_image(source: Any, role: str, sensor: Sensor | None = None) -> tuple[str, Array]:
    """The name of an image, and it (H, W, 3) as 0..1, turned as the ``sensor`` is mounted."""
    image = as_unit_rgb(source, role)
    return str(source) if isinstance(source, str | Path) else role, image if sensor is None else sensor.upright(image)
