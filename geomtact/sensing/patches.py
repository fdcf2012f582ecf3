"""The patches of a contact: where an object touches at several places."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from geomtact.sensing.contact import SoftMask

_LEAST = 0.3e-6  # m^2 that a patch has to have to count


def patches(mask: SoftMask, pixel_area: float, most: int | None = None) -> list[SoftMask]:
    """``mask`` (h, w), of pixels of ``pixel_area`` [m^2], with one of its patches of 0.3 mm^2 or more alone; the largest first,
    ``most`` of them.

    ``mask`` is bool, or the probability of contact at each pixel; a patch is where that exceeds a half.
    """
    labels, count = labelled(mask > 0.5)
    area = count[1:] * pixel_area
    largest = np.argsort(-area, kind="stable")[: np.count_nonzero(area >= _LEAST)]
    return [np.where(labels == i + 1, mask, mask.dtype.type(0)) for i in largest[:most]]


def labelled(mask: NDArray[np.bool_]) -> tuple[NDArray[Any], NDArray[Any]]:
    """The patch that each pixel of ``mask`` (h, w) belongs to, from 1, 0 beside them (h, w); and how many pixels each has."""
    # labels of 16 bits take a third of the time, where no more patches fit into the mask
    fit = np.prod([(side + 1) // 2 for side in mask.shape])
    kind = cv2.CV_16U if fit < (1 << 16) - 1 else cv2.CV_32S
    _, labels, stats, _ = cv2.connectedComponentsWithStatsWithAlgorithm(
        mask.astype(np.uint8), 8, kind, cv2.CCL_SPAGHETTI
    )
    return np.asarray(labels), stats[:, cv2.CC_STAT_AREA]
