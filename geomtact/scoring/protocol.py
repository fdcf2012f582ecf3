"""How alike two contacts are: one protocol for every score (thesis 6.1.4)."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from geomtact.contact_space.index import Index
from geomtact.sensing.contact import SoftMask


class Scorer(Protocol):
    """Compares one observed contact with every stored one.

    A score is a similarity: higher is more alike, and nothing else is promised of its scale. The value of a score as
    evidence is measured, not assumed (``scoring.calibration``).
    """

    @property
    def name(self) -> str: ...

    def score(self, index: Index, mask: SoftMask) -> NDArray[np.float32]:
        """Similarity (P, n) of ``mask`` (h, w), over the whole window on any grid, to the mask of every pose of ``index``.

        ``mask`` is bool, or the probability of contact at each pixel.
        """
        ...
