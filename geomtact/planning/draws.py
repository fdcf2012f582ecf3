"""Poses drawn from a posterior, within its cells."""

from __future__ import annotations

import numpy as np

from geomtact.contact_space.draw import draw_within
from geomtact.errors import InputError
from geomtact.inference.posterior import Posterior
from geomtact.se3 import Array, exp


def draw_cells(posterior: Posterior, n: int, rng: np.random.Generator, within: int = 1) -> Array:
    """Poses (d, n, 4, 4) of the object: ``n`` cells drawn from the posterior, and d = ``within`` poses in each.

    Poses lie anywhere within a cell, but around refined modes they scatter by their covariance: two such cells can differ by less
    than the grid's step.
    """
    p = np.exp(np.asarray(posterior.cell_log_prob, float))
    row = rng.choice(len(p), n, p=p / p.sum())
    cells = posterior.cells[row]
    T = draw_within(posterior.index, posterior.space, np.tile(cells, within), rng)[0].reshape(-1, n, 4, 4)
    for i in np.flatnonzero(np.isin(cells, list(posterior.refined))):
        found = posterior.refined[int(cells[i])]
        T[:, i] = found.T @ exp(rng.multivariate_normal(np.zeros(6), found.covariance, within))
    return posterior.T_frame_sensor @ T


def check_contact(posterior: Posterior) -> None:
    """Only a posterior of a touch can be planned on."""
    if not posterior.contact:
        raise InputError(
            "next touch: the posterior is of an image without contact; localize a touch of the object first"
        )
