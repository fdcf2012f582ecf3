"""Pose errors that the field reports and geomtact itself does without: ADD and ADD-S (Hinterstoisser et al., ACCV 2012)."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

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


def _poses(T: ArrayLike) -> Array:
    return np.asarray(T, float).reshape(-1, 4, 4)
