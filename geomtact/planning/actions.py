"""Actions that measure the pose: touch with the sensor, or probe with a thin finger; and their outcomes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geomtact.contact_space.space import ContactSpace
from geomtact.errors import UsageError
from geomtact.geometry.approach import facing
from geomtact.se3 import Array, check_pose, inverse, transform
from geomtact.sensing.moments import moments
from geomtact.sensing.sensor import Sensor

# Penetration at each pose of a cell, as a share of the largest: first of the touch that is evaluated, then of those that it is
# compared with, because the localizer does not know the penetration. Hand-set.
PRESSED = (0.5, 0.2, 0.4, 0.6, 0.8)
_SHAPE = (24, 32)  # pixels of the casts
_FARTHEST = 3.0  # largest travel of a sensor [m]: a larger number is probably in millimetres


@dataclass(frozen=True, eq=False)
class Touch:
    """The sensor comes along its own +z to ``T_world_sensor`` and goes on for up to ``travel``; it stops as soon as the object
    presses against it, and shows the contact and where it stopped.

    Without travel it is merely placed there. That its housing strikes first shows nothing.

    Attributes
    ----------
    T_world_sensor : (4, 4), in the posterior's frame
    travel : [m], at most 3
    cost : in any unit, the same for all actions
    """

    T_world_sensor: Array
    travel: float = 0.0
    cost: float = 1.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "T_world_sensor", check_pose(self.T_world_sensor, "T_world_sensor"))
        if not 0 <= self.travel <= _FARTHEST:
            raise UsageError(f"Touch: expected a travel of 0 to {_FARTHEST:g} m, got {self.travel:g}; give metres")
        _check_cost(self.cost)

    def reached(self, space: ContactSpace, T_world_object: ArrayLike, pressed: float) -> Array:
        """Where the sensor stops (n, 4, 4) in the world, with objects at ``T_world_object`` (n, 4, 4) that may press
        ``pressed`` [m] into the gel."""
        T = inverse(self.T_world_sensor) @ np.asarray(T_world_object, float).reshape(-1, 4, 4)
        advance, _ = _advance(space, T, self.travel, pressed)
        return self.T_world_sensor @ _along_z(advance)

    def shows(self, space: ContactSpace, T_world_object: Array) -> tuple[NDArray[np.bool_], Array]:
        """Whether it touches (d, n) and what it shows (d, n, 7) with the object at ``T_world_object`` (d, n, 4, 4).

        That is how far the sensor went and the contact's moments, lengths in half diagonals of the window.
        """
        d, n = T_world_object.shape[:2]
        T = inverse(self.T_world_sensor) @ T_world_object.reshape(-1, 4, 4)
        sensor = space.sensor
        pressed = sensor.max_penetration * np.repeat(PRESSED[:d], n)
        advance, below = _advance(space, T, self.travel, pressed)
        touches = below.max((1, 2)) > 0
        if sensor.housing_depth is not None and touches.any():
            stopped = _along_z(-advance[touches]) @ T[touches]
            touches[touches] = space.caster.lowest_outside(sensor, stopped) >= -sensor.housing_depth
        shown = np.zeros((d * n, 7))
        shown[touches, 0] = advance[touches] / np.hypot(*sensor.half_window)
        shown[touches, 1:] = moments(below[touches] > 0, sensor)
        return touches.reshape(d, n), shown.reshape(d, n, 7)


@dataclass(frozen=True, eq=False)
class Probe:
    """A thin finger comes along ``direction`` up to ``point`` and reports only whether it met the object on its way.

    Attributes
    ----------
    point : (3,) where its tip ends, in the posterior's frame [m]
    direction : (3,) in the posterior's frame, of any length
    cost : in any unit, the same for all actions
    """

    point: Array
    direction: Array
    cost: float = 1.0

    def __post_init__(self) -> None:
        for name in ("point", "direction"):
            value = np.asarray(getattr(self, name), float)
            if value.shape != (3,) or not np.isfinite(value).all():
                raise UsageError(f"Probe: expected a {name} of three finite numbers, got {getattr(self, name)}")
            object.__setattr__(self, name, value)
        if np.linalg.norm(self.direction) < 1e-12:
            raise UsageError("Probe: expected a direction, got one of no length")
        _check_cost(self.cost)

    @property
    def T_world_sensor(self) -> Array:
        """(4, 4): origin at the point, +z along the direction."""
        return transform(facing(-self.direction / np.linalg.norm(self.direction)).T, self.point)

    def shows(self, space: ContactSpace, T_world_object: Array) -> tuple[NDArray[np.bool_], Array]:
        """Whether it meets the object (d, n) at ``T_world_object`` (d, n, 4, 4), and nothing else (d, n, 0)."""
        T = inverse(self.T_world_sensor) @ T_world_object.reshape(-1, 4, 4)
        straight = replace(_straight(space.sensor), membrane_radius=0.0)
        touches = space.caster.ray_depths(straight, T, np.zeros((1, 2)))[:, 0] >= 0
        return touches.reshape(T_world_object.shape[:2]), np.zeros((*T_world_object.shape[:2], 0))


def _check_cost(cost: float) -> None:
    if not 0 < cost < np.inf:
        raise UsageError(f"cost: expected a number > 0, got {cost}")


def _advance(
    space: ContactSpace, T_sensor_object: Array, travel: float, pressed: ArrayLike
) -> tuple[Array, NDArray[np.floating]]:
    """How far (n,) [m] the sensor goes along z until the object at ``T_sensor_object`` (n, 4, 4) presses ``pressed`` [m] deep,
    at most ``travel``; and how deep the object then lies below the membrane (n, h, w) [m]. It stops short of where it starts
    if the object is in its way, but for one that is merely placed.

    By rays parallel to z, so that one cast serves all heights: the slant of a camera's rays moves the contacts of all poses
    alike.
    """
    sensor = _straight(space.sensor)
    below = space.caster.depths(sensor, T_sensor_object, sensor.along(_SHAPE))
    advance = np.minimum(np.asarray(pressed) - below.max((1, 2)), travel) if travel else np.zeros(len(below))
    return advance, below + advance[:, None, None].astype(np.float32)


def _straight(sensor: Sensor) -> Sensor:
    """``sensor`` seen by parallel rays."""
    return replace(sensor, camera_distance=0.0)


def _along_z(distance: Array) -> Array:
    """Shifts (n, 4, 4) by ``distance`` (n,) [m] along z."""
    return transform(np.eye(3), distance[:, None] * [0.0, 0.0, 1.0])
