"""Poses drawn from cells of the index: what a distribution over cells means between their centres."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geomtact.contact_space.index import Index
from geomtact.contact_space.space import ContactSpace
from geomtact.se3 import Array


def draw_within(
    index: Index, space: ContactSpace, ids: ArrayLike, rng: np.random.Generator, tries: int = 20
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Poses uniform over the part of each cell that touches, and over their images under the object's symmetry.

    A cell is tried again until a draw touches and falls into it: were the draw given up, cells that straddle the
    border of the contact pose space would come out too seldom.

    Parameters
    ----------
    ids : (n,) pose ids of ``index``

    Returns
    -------
    T_sensor_object : (n, 4, 4)
    penetration : (n,) [m]
    found : (n,) whether a draw succeeded; where none did, the pose is the cell's own
    """
    ids = np.asarray(ids)
    T = index.poses(ids)
    depth = np.asarray(index.resolution.penetrations)[ids // index.places]
    todo = np.arange(len(ids))
    for _ in range(tries):
        if not len(todo):
            break
        new, pressed = index.draw(ids[todo], rng)
        new, ok = space.settle(new, pressed)
        ok[ok] = space.admits(new[ok])
        ok[ok] = index.lookup(new[ok], pressed[ok]) == ids[todo][ok]
        T[todo[ok]], depth[todo[ok]] = new[ok], pressed[ok]
        todo = todo[~ok]
    found = np.ones(len(ids), bool)
    found[todo] = False
    return index.directions.any_image(T, rng), depth, found
