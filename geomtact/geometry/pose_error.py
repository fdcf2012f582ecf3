"""How wrong an estimate is: the field's pose errors, and how often a posterior's regions hold the truth.

ADD and ADD-S: Hinterstoisser et al., ACCV 2012. MSSD: Hodan et al., BOP challenge, ECCVW 2020. The normalised ADD is the
thesis's (7.2): in units of what two random poses of the contact pose space differ by.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from geomtact.geometry.distance import PoseDistance
from geomtact.geometry.mesh import Mesh, outermost
from geomtact.se3 import Array, apply


def add(T_true: ArrayLike, T: ArrayLike, points: ArrayLike) -> Array:
    """ADD (m,) [m]: mean distance of corresponding points (n, 3) of the object at ``T_true`` (4, 4) and ``T`` (m, 4, 4).

    Symmetry is not taken into account; ``PoseDistance.mean`` is ADD modulo the object's symmetry.
    """
    return np.linalg.norm(apply(_poses(T), points) - apply(T_true, points), axis=-1).mean(-1)


def add_s(T_true: ArrayLike, T: ArrayLike, points: ArrayLike) -> Array:
    """ADD-S (m,) [m]: mean distance from each point (n, 3) at ``T_true`` (4, 4) to the nearest point at ``T`` (m, 4, 4)."""
    from scipy.spatial import cKDTree

    here = apply(T_true, points)
    return np.array([cKDTree(there).query(here)[0].mean() for there in apply(_poses(T), points)])


def mssd(T_true: ArrayLike, T: ArrayLike, mesh: Mesh) -> Array:
    """MSSD (m,) [m]: largest distance of corresponding surface points of ``mesh`` at ``T_true`` (4, 4) and ``T`` (m, 4, 4).

    Over a finite symmetry group it is the least over the group; over a continuous one it is taken at the image that is
    nearest in mean square. A point's distance is convex in the point, so the hull's vertices hold the largest.
    """
    symmetry = mesh.symmetry
    if symmetry is not None and symmetry.kind == "discrete":
        images = _poses(T)[:, None] @ symmetry.elements
    else:
        images = PoseDistance(mesh).aligned(T_true, _poses(T))[:, None]
    corners = outermost(mesh.vertices)
    here = apply(T_true, corners)
    return np.array([np.linalg.norm(apply(some, corners) - here, axis=-1).max(-1).min() for some in images])


def _poses(T: ArrayLike) -> Array:
    return np.asarray(T, float).reshape(-1, 4, 4)
