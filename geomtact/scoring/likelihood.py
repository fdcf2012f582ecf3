"""How likely the observed pixels are, given how far the object lies below the membrane at each of them.

A pixel is in contact when the object reaches below the membrane there by more than a threshold. It is 0 for a rigid contact, a
share of the penetration for an elastic gel, which dips beside what presses (Hertz: half of it under a ball). The softness is
the width of the boundary. Threshold and softness are unknown for a touch and marginalised over. Neighbouring pixels are
correlated, so that each counts for less than one observation.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from geomtact.contact_space.index import Index
from geomtact.log_mass import log_mean_exp
from geomtact.scoring.overlap import overlaps, to_grid
from geomtact.sensing.contact import SoftMask
from geomtact.sensing.moments import cleaned

# All constants are hand-set; the thresholds span a rigid contact and Hertz's half under a ball.
THRESHOLDS = (0.0, 0.25, 0.5)  # least depth of a pixel in contact, as a share of the penetration; equally likely
SOFTNESS = (0.1e-3, 0.4e-3)  # width of the boundary between contact and none, in depth [m]; equally likely
_CORRELATED = 4e-6  # area within which pixels count as one observation [m^2]
_OUTLIERS = 0.02  # share of pixels that are outliers, such as dust and glare


@dataclass(frozen=True)
class PixelLikelihood:
    """Log likelihood of the observed pixels from the stored contacts at all penetrations.

    The contacts of a place at its P penetrations are contour lines of the object's surface there: they give the height at
    every pixel to within a penetration bin. So the likelihood of all poses takes P counts of common pixels a place.

    The stored masks and their areas: 98 bytes per pose at 32 x 24 pixels, 386 at 64 x 48; a count of bits a word, and for
    every penetration 12 multiplications and exponentials to compare.
    """

    name: str = "likelihood"

    def score(self, index: Index, mask: SoftMask) -> NDArray[np.float32]:
        """Log likelihood (P, n) of ``mask`` (h, w) at every pose."""
        seen = to_grid(cleaned(mask, index.sensor), index.resolution.mask_shape)
        depths = np.asarray(index.resolution.penetrations)
        P, bin_size = len(depths), depths[0] * 2
        # between two contours the surface lies in the middle; beyond the last ones it lies a bin away
        below = depths[:, None] - np.arange(P + 1) * bin_size  # by the pose's penetration and the pixel's contour
        in_contact = np.diff(overlaps(index.bits, seen).astype(np.float32), axis=0, prepend=0, append=seen.sum())
        area = np.diff(index.area.astype(np.float32), axis=0, prepend=0, append=seen.size)
        counts = np.concatenate([in_contact, np.maximum(area - in_contact, 0)]).T  # (n, 2 (P + 1))
        weight = _independent(index.sensor.pixel_area(seen.shape))
        out = np.zeros(index.area.shape, np.float32)
        for p, d in enumerate(depths):
            yes = np.stack([_contact_probability(below[p] - t * d, s) for t, s in product(THRESHOLDS, SOFTNESS)], 1)
            logs = weight * np.concatenate([np.log(yes), np.log1p(-yes)]).astype(np.float32)  # (2 (P + 1), K)
            out[p] = log_mean_exp(counts @ logs)
        return out


def _contact_probability(below: NDArray[np.floating], softness: float) -> NDArray[np.floating]:
    """Probability that a pixel is in contact where the object is ``below`` [m] under the threshold."""
    out: NDArray[np.floating] = _OUTLIERS / 2 + (1 - _OUTLIERS) / (1 + np.exp(np.clip(-below / softness, -30, 30)))
    return out


def _independent(area: float) -> float:
    """Share of one observation that a pixel of ``area`` [m^2] counts for."""
    return min(1.0, area / _CORRELATED)
