"""The patches of a contact: where an object touches at several places."""

from __future__ import annotations

import cv2
import numpy as np

from geomtact.sensing.contact import Shown

_LEAST = 0.3e-6  # m^2 that a patch has to have to count


def patches(mask: Shown, pixel_area: float, most: int | None = None) -> list[Shown]:
    """``mask`` (h, w), of pixels of ``pixel_area`` [m^2], with one of its patches of 0.3 mm^2 or more alone; the largest first,
    ``most`` of them.

    ``mask`` is bool, or the probability of contact at each pixel; a patch is where that exceeds a half.
    """
    _, labels, stats, _ = cv2.connectedComponentsWithStats((mask > 0.5).astype(np.uint8), connectivity=8)
    area = stats[1:, cv2.CC_STAT_AREA] * pixel_area
    largest = np.argsort(-area, kind="stable")[: np.count_nonzero(area >= _LEAST)]
    return [np.where(labels == i + 1, mask, mask.dtype.type(0)) for i in largest[:most]]
