"""Where the sensors stand that show an object at the same time, and whether they can stand there together."""

from __future__ import annotations

from itertools import combinations
from typing import Any

import numpy as np

from geomtact.contact_space.carry import RigStd
from geomtact.errors import InputError, UsageError
from geomtact.se3 import Array, adjoint, check_transforms, inverse

_HALL = 30.0  # m from the origin from which a translation is taken to be in millimetres
_ROOM = 10.0  # m between two sensors from which translations are taken to be in millimetres


def views_of(image: Any, T_world_sensor: Any) -> tuple[list[Any], str, Array]:
    """The images, the posterior's frame, and the sensors' poses (n, 4, 4) in it."""
    images = list(image) if isinstance(image, list | tuple) else [image]
    n = len(images)
    if not n:
        raise UsageError("localize: expected an image, got an empty list")
    if T_world_sensor is None:
        if n > 1:
            raise UsageError(f"localize: {n} images need T_world_sensor, the pose (4, 4) of each sensor in the world")
        return images, "sensor", np.eye(4)[None]
    T = check_transforms(T_world_sensor, "T_world_sensor")
    if T.shape not in ([(4, 4), (1, 4, 4)] if n == 1 else [(n, 4, 4)]):
        raise UsageError(f"T_world_sensor: expected one pose for each of {n} images, ({n}, 4, 4), got shape {T.shape}")
    T = T.reshape(n, 4, 4)
    check_rig(T)
    return images, "world", T


def rig_covariance(T: Array, T_frame_sensor: Array, rig: RigStd) -> Array:
    """What a ``rig`` known so well adds to the covariance (6, 6) of an object's pose ``T`` (4, 4) that several sensors tell.

    An error eta of the pose of a sensor at ``T_frame_sensor`` (n, 4, 4) turns and shifts the object that it tells by
    xi = adjoint(T^-1 T_sensor) eta, with xi = (rx, ry, rz, tx, ty, tz) in T exp(xi^). The mean over the sensors, in full: what
    all of them tell is nearer than that, what one alone tells is not.
    """
    eta = np.diag([rig.rotation**2] * 3 + [rig.translation**2] * 3)
    carried = adjoint(inverse(T) @ T_frame_sensor)
    return np.asarray((carried @ eta @ carried.swapaxes(-1, -2)).mean(0))


def check_rig(T_world_sensor: Array, name: str = "T_world_sensor") -> None:
    """Whether sensors at ``T_world_sensor`` (n, 4, 4) can stand together; ``name`` is theirs in messages.

    Raises
    ------
    InputError
        Two are farther apart than a room is long, or at the same pose; or one is farther from the origin than a hall is long.
    """
    T = T_world_sensor
    far = np.linalg.norm(T[:, :3, 3], axis=1)
    if far.max() > _HALL:
        raise InputError(
            f"{name}: sensor {int(far.argmax()) + 1} is {far.max():.3g} m from the origin; give translations in metres, in a "
            "frame of the same hall"
        )
    for i, j in combinations(range(len(T)), 2):
        apart = float(np.linalg.norm(T[i, :3, 3] - T[j, :3, 3]))
        if apart > _ROOM:
            raise InputError(
                f"{name}: sensors {i + 1} and {j + 1} are {apart:.3g} m apart; give translations in metres"
            )
        if np.abs(T[i] - T[j]).max() < 1e-6:
            raise InputError(
                f"{name}: sensors {i + 1} and {j + 1} are at the same pose; give each sensor its own, or follow "
                "one sensor over time with track"
            )
