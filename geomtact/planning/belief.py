"""What planning needs of a posterior, and poses drawn from it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from geomtact.contact_space.draw import draw_within
from geomtact.contact_space.index import Index
from geomtact.contact_space.space import ContactSpace
from geomtact.errors import InputError
from geomtact.se3 import Array, exp


class Belief(Protocol):
    """A posterior, which is made in a later stage."""

    @property
    def contact(self) -> bool: ...
    @property
    def index(self) -> Index: ...
    @property
    def cells(self) -> NDArray[np.int64]: ...
    @property
    def log_prob(self) -> NDArray[np.floating]: ...
    @property
    def runs(self) -> NDArray[np.int64] | None: ...
    @property
    def refined(self) -> Mapping[int, Any]: ...
    @property
    def T_frame_sensor(self) -> Array: ...
    @property
    def space(self) -> ContactSpace: ...
    def modes(self, k: int = 5) -> list[Any]: ...


def draw_cells(posterior: Belief, n: int, rng: np.random.Generator, within: int = 1) -> Array:
    """Poses (d, n, 4, 4) of the object: ``n`` cells drawn from the posterior, and d = ``within`` poses in each.

    Poses lie anywhere within a cell, but where registration has looked they scatter about what it found: two such cells can be
    told apart by less than the grid's step.
    """
    p = np.exp(np.asarray(posterior.log_prob, float))
    row = rng.choice(len(p), n, p=p / p.sum())
    runs = np.ones(n, np.int64) if posterior.runs is None else posterior.runs[row]
    cells = posterior.index.within_runs(posterior.cells[row], runs, rng.random(n))
    T = draw_within(posterior.index, posterior.space, np.tile(cells, within), rng)[0].reshape(-1, n, 4, 4)
    for i in np.flatnonzero(np.isin(cells, list(posterior.refined))):
        found = posterior.refined[int(cells[i])]
        T[:, i] = found.T @ exp(rng.multivariate_normal(np.zeros(6), found.covariance, within))
    return posterior.T_frame_sensor @ T


def check_contact(posterior: Belief) -> None:
    """Only a posterior of a touch can be planned on."""
    if not posterior.contact:
        raise InputError(
            "next touch: the posterior is of an image without contact; localize a touch of the object first"
        )
