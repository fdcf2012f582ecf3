"""A jaw with a sensor in each finger: where it grasps an object, and where its fingers stop."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geomtact.contact_space.space import ContactSpace
from geomtact.errors import InputError
from geomtact.geometry.approach import facing
from geomtact.geometry.mesh import Mesh
from geomtact.se3 import Array, apply, exp, inverse, transform

_MOST_OPEN = 80e-3  # largest distance between the fingers [m]; hand-set
_POINTS = 400  # points of the surface among which a grasp is chosen; hand-set
_SLIP = np.radians(15)  # largest angle [rad] between a surface and a finger's plane at which a grasp holds; hand-set
OPPOSITE = np.diag([1.0, -1.0, -1.0, 1.0])


def closed_on(
    space: ContactSpace, T_world_object: Array, T_world_sensor: Array, pressed: ArrayLike
) -> tuple[Array, NDArray[np.bool_]]:
    """Where sensors stop (n, 4, 4) that come along their own z from clear of an object, and which of them meet it (n,).

    Parameters
    ----------
    T_world_sensor : (n, 4, 4), anywhere along the lines on which they come
    pressed : how deep the object presses into each [m]
    """
    T = inverse(T_world_sensor) @ T_world_object
    T[:, 2, 3] -= apply(T, space.mesh.vertices)[..., 2].min(1)  # the whole object before the sensor
    T, touches = space.settle(T, pressed)
    return T_world_object @ inverse(T), touches


def close_jaw(
    space: ContactSpace, T_world_object: Array, T_world_jaw: Array, pressed: ArrayLike
) -> tuple[Array, NDArray[np.bool_]]:
    """Where two opposed sensors stop that close along the jaw's z axis.

    Parameters
    ----------
    T_world_jaw : (4, 4) origin anywhere on the axis; the first finger looks along +z, the second along -z
    pressed : (2,) how deep the object presses into each [m]

    Returns
    -------
    T_world_sensor : (2, 4, 4)
    touches : (2,) bool, whether each finger meets the object
    """
    return closed_on(space, T_world_object, T_world_jaw @ np.stack([np.eye(4), OPPOSITE]), pressed)


def first_grasp(mesh: Mesh, rng: np.random.Generator) -> Array:
    """A jaw's pose (4, 4) in the object's frame in which it might hold: two points of the surface that face away from each other
    along the jaw's axis. Drawn from all such pairs, turned about the axis in any way."""
    points, normals = mesh.sample_surface(_POINTS, seed=int(rng.integers(2**31)))
    apart = points[:, None] - points
    width = np.linalg.norm(apart, axis=-1)
    along = apart / np.maximum(width, 1e-9)[..., None]
    away = np.einsum("ijk,ik->ij", along, normals)
    holds = (np.minimum(away, away.T) >= np.cos(_SLIP)) & (width <= _MOST_OPEN)
    if not holds.any():
        raise InputError(
            f"{mesh.name}: no place to grasp between fingers that open {1e3 * _MOST_OPEN:.0f} mm; take another object"
        )
    i, j = rng.choice(np.argwhere(holds))
    turn = exp([0, 0, rng.uniform(0, 2 * np.pi), 0, 0, 0])
    return transform(facing(along[i, j]).T, 0.5 * (points[i] + points[j])) @ turn
