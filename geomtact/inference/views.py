"""The images of a call, each read once, and where their sensors stand."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from geomtact.errors import UsageError
from geomtact.inference.extrinsics import check_sensor_poses
from geomtact.se3 import Array, check_transforms
from geomtact.sensing.reading import Observation, read_observation
from geomtact.sensing.sensor import Sensor


@dataclass(frozen=True, eq=False)
class Placed:
    """One sensor's image, and where the sensor stands.

    Attributes
    ----------
    observation : the image and the contact in it
    T_frame_sensor : (4, 4) of the sensor in ``frame``
    frame : "sensor" or "world"
    read_ms : time that reading the image took
    """

    observation: Observation
    T_frame_sensor: Array
    frame: str
    read_ms: float


def read_views(image: Any, T_world_sensor: Any, sensors: Sequence[Sensor], kind: str, background: Any) -> list[Placed]:
    """The images of a call to ``localize``, which has the same parameters; one that is an Observation is read already.

    ``sensors`` are one for each image, or one for all.
    """
    images, frame, T = _poses_of(image, T_world_sensor)
    n = len(images)
    backgrounds = background if isinstance(background, list | tuple) else [background] * n
    if len(backgrounds) != n:
        raise UsageError(f"localize: expected one background, or {n}, got {len(backgrounds)}")
    sensors = list(sensors) * n if len(sensors) == 1 else sensors
    if len(sensors) != n:
        raise UsageError(f"localize: prepared for {len(sensors)} sensors, got {n} images; give one for each")
    out = []
    for each, sensor, empty, T_frame_sensor in zip(images, sensors, backgrounds, T, strict=True):
        began = time.perf_counter()
        observation = each if isinstance(each, Observation) else read_observation(each, sensor, kind, empty)
        out.append(Placed(observation, T_frame_sensor, frame, 1e3 * (time.perf_counter() - began)))
    return out


def _poses_of(image: Any, T_world_sensor: Any) -> tuple[list[Any], str, Array]:
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
    check_sensor_poses(T)
    return images, "world", T
