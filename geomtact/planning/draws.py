"""Poses drawn from a posterior: places that a touch could distinguish, and poses of each."""

from __future__ import annotations

import numpy as np

from geomtact.contact_space.draw import draw_within
from geomtact.errors import InputError
from geomtact.inference.posterior import Posterior
from geomtact.se3 import Array


def draw_places(posterior: Posterior, n: int, rng: np.random.Generator, within: int = 1) -> Array:
    """Poses (d, n, 4, 4) of the object: ``n`` places drawn from the posterior, and d = ``within`` poses in each.

    A place of a resolved posterior is one pose, d times. Of another it is a cell: its poses lie anywhere within.
    """
    if posterior.explored is not None:
        return np.tile(posterior.T_frame_sensor @ posterior.explored.draw(n, rng), (within, 1, 1, 1))
    p = np.exp(np.asarray(posterior.cell_log_prob, float))
    row = rng.choice(len(p), n, p=p / p.sum())
    cells = posterior.cells[row]
    T = draw_within(posterior.index, posterior.space, np.tile(cells, within), rng)[0].reshape(-1, n, 4, 4)
    return posterior.T_frame_sensor @ T


def check_contact(posterior: Posterior) -> None:
    """Only a posterior of a touch can be planned on."""
    if not posterior.contact:
        raise InputError(
            "next touch: the posterior is of an image without contact; localize a touch of the object first"
        )
