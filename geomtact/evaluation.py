"""How often a posterior's regions hold the truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike


@dataclass(frozen=True)
class Coverage:
    """Share of truths inside the region of ``nominal`` mass, with the interval (low, high) that its count allows."""

    nominal: float
    share: float
    low: float
    high: float


def coverage(levels: ArrayLike, nominal: Sequence[float], confidence: float = 0.95) -> list[Coverage]:
    """How often the truth lies in the highest-density region of each nominal mass.

    Parameters
    ----------
    levels : (n,) credible levels of the true poses, in [0, 1]
    nominal : masses in (0, 1)
    confidence : of the binomial intervals (Clopper and Pearson 1934)
    """
    levels = np.asarray(levels, float)
    return [
        Coverage(float(mass), *share_with_interval(int((levels <= mass).sum()), len(levels), confidence))
        for mass in nominal
    ]


def share_with_interval(hits: int, n: int, confidence: float = 0.95) -> list[float]:
    """The share of ``hits`` in ``n``, and its binomial interval (Clopper and Pearson 1934)."""
    from scipy.stats import binomtest

    interval = binomtest(hits, n).proportion_ci(confidence, "exact")
    return [hits / n, float(interval.low), float(interval.high)]
