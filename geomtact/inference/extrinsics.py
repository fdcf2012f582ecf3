"""Poses of several sensors relative to each other: whether they are plausible, and what their uncertainty adds."""

from __future__ import annotations

from itertools import combinations

import numpy as np

from geomtact.contact_space.cell_transfer import ExtrinsicsStd
from geomtact.errors import InputError
from geomtact.se3 import Array, adjoint, inverse

_LARGEST_DISTANCE = 30.0  # largest distance of a sensor from the origin [m]; hand-set, as millimetres exceed it
_LARGEST_SPACING = 10.0  # largest distance between two sensors [m]; hand-set, as millimetres exceed it


def extrinsics_covariance(T: Array, T_frame_sensor: Array, extrinsics_std: ExtrinsicsStd) -> Array:
    """What the sensors' uncertain poses add to the covariance (6, 6) of an object's pose ``T`` (4, 4) that they measure.

    An error eta of the pose of a sensor at ``T_frame_sensor`` (n, 4, 4) moves the object that it measures by
    xi = adjoint(T^-1 T_sensor) eta, with xi = (rx, ry, rz, tx, ty, tz) in T exp(xi^). The mean over the sensors is added in
    full: where all sensors measure a direction this is too much, where one alone does it is not.
    """
    eta = np.diag([extrinsics_std.rotation**2] * 3 + [extrinsics_std.translation**2] * 3)
    carried = adjoint(inverse(T) @ T_frame_sensor)
    return np.asarray((carried @ eta @ carried.swapaxes(-1, -2)).mean(0))


def check_sensor_poses(T_world_sensor: Array, name: str = "T_world_sensor") -> None:
    """Whether sensors at ``T_world_sensor`` (n, 4, 4) can stand together; ``name`` is theirs in messages.

    Raises
    ------
    InputError
        Two are farther apart than a room is long, or at the same pose; or one is farther from the origin than a hall is long.
    """
    T = T_world_sensor
    far = np.linalg.norm(T[:, :3, 3], axis=1)
    if far.max() > _LARGEST_DISTANCE:
        raise InputError(
            f"{name}: sensor {int(far.argmax()) + 1} is {far.max():.3g} m from the origin; give translations in metres, in a "
            "frame of the same hall"
        )
    for i, j in combinations(range(len(T)), 2):
        apart = float(np.linalg.norm(T[i, :3, 3] - T[j, :3, 3]))
        if apart > _LARGEST_SPACING:
            raise InputError(
                f"{name}: sensors {i + 1} and {j + 1} are {apart:.3g} m apart; give translations in metres"
            )
        if np.abs(T[i] - T[j]).max() < 1e-6:
            raise InputError(
                f"{name}: sensors {i + 1} and {j + 1} are at the same pose; give each sensor its own, or follow "
                "one sensor over time with track"
            )
