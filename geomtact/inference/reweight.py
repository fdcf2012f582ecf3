"""Cells of a posterior weighed again by what is found at single poses in them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geomtact.inference.distribution import row_log_density, rows_of
from geomtact.inference.posterior import Posterior


def reweight_cells(
    posterior: Posterior,
    cells: NDArray[np.int64],
    log_likelihood: ArrayLike,
    kept_share: float = 0.0,
    others_factor: float = 1.0,
    image_power: float = 1.0,
    log_prior: NDArray[np.floating] | None = None,
) -> Posterior:
    """``posterior`` with the mass of ``cells`` shared out among these again.

    Each gets mass in proportion to what the images gave it before, to the power ``image_power``, times
    exp(``log_likelihood``). A cell without likelihood keeps its mass; one that the posterior does not hold gets none.

    Parameters
    ----------
    cells : (n,) pose ids
    log_likelihood : (n,) up to a constant; of a cell that is named twice the largest counts
    kept_share : share of the cells' mass that stays as it was
    others_factor : factor on the mass of all other cells, before normalising
    image_power : power of what the images gave each before
    log_prior : (M,) log mass of every cell of the index before the images; the uniform's by default
    """
    row, held_here = rows_of(posterior, cells)
    row, which = np.unique(row[held_here], return_inverse=True)
    likeliest = np.full(len(row), -np.inf)
    np.maximum.at(likeliest, which, np.asarray(log_likelihood, float)[held_here])
    row, likeliest = row[likeliest > -np.inf], likeliest[likeliest > -np.inf]
    log_mass = posterior.cell_log_prob[row].astype(float)
    gain, at = row_log_density(posterior, row), posterior.cells[row]
    with np.errstate(invalid="ignore"):
        if log_prior is not None:
            gain = gain - (log_prior[at] - posterior.index.log_weight[at])
        new = log_mass + likeliest - (1 - image_power) * np.where(log_mass > -np.inf, gain, 0.0)
    if not np.isfinite(new).any():
        return posterior
    held = np.logaddexp.reduce(log_mass)
    new += held - np.logaddexp.reduce(new)
    log_total = np.log(others_factor + (1 - others_factor) * np.exp(held))
    with np.errstate(divide="ignore"):
        log_prob = posterior.cell_log_prob + posterior.cell_log_prob.dtype.type(np.log(others_factor) - log_total)
        log_prob[row] = np.logaddexp(new + np.log1p(-kept_share), log_mass + np.log(kept_share)) - log_total
    return replace(posterior, cell_log_prob=log_prob)
