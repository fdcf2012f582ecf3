"""What one touch tells: where the object presses, and how deep where that is known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Contact:
    """A contact on the sensor's image grid.

    Attributes
    ----------
    mask : (H, W) bool, True where the object touches (the thesis's local shape)
    height : (H, W) float32, depth of the indentation [m], 0 outside the contact; None where only the mask is known
    """

    mask: NDArray[np.bool_]
    height: NDArray[np.float32] | None = None
