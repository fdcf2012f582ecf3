"""Cells of a posterior weighed again by what is found at single poses in them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geomtact.inference.distribution import rows_of
from geomtact.inference.posterior import Posterior


def reweight_cells(posterior: Posterior, cells: NDArray[np.int64], log_likelihood: ArrayLike) -> Posterior:
    """``posterior`` with the mass of ``cells`` (n,) shared out among these again.

    Each gets mass in proportion to what it had times exp(``log_likelihood``) (n,). A cell without likelihood keeps its mass; one
    that the posterior does not hold gets none.
    """
    row, held_here = rows_of(posterior, cells)
    likely = np.where(held_here, np.asarray(log_likelihood, float), -np.inf)
    row, likely = row[likely > -np.inf], likely[likely > -np.inf]
    log_mass = posterior.cell_log_prob[row].astype(float)
    new = log_mass + likely
    if not np.isfinite(new).any():
        return posterior
    log_prob = posterior.cell_log_prob.copy()
    log_prob[row] = new + np.logaddexp.reduce(log_mass) - np.logaddexp.reduce(new)
    return replace(posterior, cell_log_prob=log_prob)
