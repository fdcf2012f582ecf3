"""Sums and means of probabilities given by their natural logarithms."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray


def normalised(log_mass: NDArray[np.floating]) -> NDArray[np.floating]:
    """``log_mass`` (N,) less the log of its sum, in its own precision: a log density is given up to a constant, however large."""
    top = log_mass.max()
    out: NDArray[np.floating] = log_mass - (top + np.log(np.exp(log_mass - top).sum(dtype=np.float64)))
    return out


def log_mean_exp(x: NDArray[np.floating]) -> NDArray[np.floating]:
    """Log of the mean (n,) over the columns of exp(``x``) (n, K), in its own precision."""
    top = x.max(1)
    return top + np.log(np.exp(x - top[:, None]).mean(1))


def log_mean_of_counted(log_density: ArrayLike, counts: NDArray[np.bool_] | None = None) -> NDArray[np.float64]:
    """Log of the mean density (n,) over the rows of ``log_density`` (m, n), or over those that ``counts`` (m, n); -inf without
    any, NaN where one is NaN."""
    log_density = np.asarray(log_density, float)
    counts = np.ones(log_density.shape, bool) if counts is None else counts
    with np.errstate(invalid="ignore"):  # the caller reports NaN
        total = np.logaddexp.reduce(np.where(counts, log_density, -np.inf), 0)
    return np.asarray(total - np.log(np.maximum(counts.sum(0), 1)))
