"""``--sensor-poses``: where several sensors are, which they are, and how well that is known."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from geomtact.contact_space.carry import RigStd
from geomtact.errors import InputError, nearest_name
from geomtact.se3 import Array, check_transforms

_KEYS = ("T_world_sensor", "sensor", "std_mm", "std_deg")


@dataclass(frozen=True)
class SensorPoses:
    """The content of the file.

    Attributes
    ----------
    T_world_sensor : (n, 4, 4), one for each image
    sensor : n names or TOML files, where they are given
    rig : how well the poses are known
    """

    T_world_sensor: Array
    sensor: list[str] | None
    rig: RigStd


def read_sensor_poses(path: Path, images: int) -> SensorPoses:
    """Read the JSON file for so many images.

    Raises
    ------
    InputError, PoseError
        It cannot be read, lacks a key or has an unknown one, or its poses are not rigid or of another number.
    """
    try:
        content = json.loads(path.read_text("utf-8"))
    except FileNotFoundError:
        raise InputError(
            f'--sensor-poses {path}: no such file; write {{"T_world_sensor": [4x4 for each image]}}'
        ) from None
    except (OSError, ValueError) as error:
        raise InputError(f"--sensor-poses {path}: cannot be read as JSON ({error})") from None
    if not isinstance(content, dict) or "T_world_sensor" not in content:
        raise InputError(f'--sensor-poses {path}: expected {{"T_world_sensor": [4x4 for each image]}}')
    for key in content:
        if key not in _KEYS:
            raise InputError(f"--sensor-poses {path}: unknown key {key!r}{nearest_name(key, _KEYS)}")
    try:
        T = np.array(content["T_world_sensor"], float)
    except (ValueError, TypeError):
        T = np.zeros(0)
    if T.shape != (images, 4, 4):
        given = len(content["T_world_sensor"]) if isinstance(content["T_world_sensor"], list) else "none"
        raise InputError(f"--sensor-poses {path}: expected a 4x4 matrix for each of {images} images, got {given}")
    names = content.get("sensor")
    if names is not None and (not isinstance(names, list) or len(names) != images):
        raise InputError(f"--sensor-poses {path}: sensor must list {images} names or TOML files, one for each image")
    std = {key: content.get(key, 0.0) for key in ("std_mm", "std_deg")}
    for key, value in std.items():
        if isinstance(value, bool) or not isinstance(value, int | float) or not value >= 0:
            raise InputError(f"--sensor-poses {path}: {key} must be a number >= 0, got {value!r}")
    return SensorPoses(
        check_transforms(T, f"{path}: T_world_sensor"),
        None if names is None else [_beside(path, name) for name in names],
        RigStd(float(np.radians(std["std_deg"])), 1e-3 * std["std_mm"]),
    )


def _beside(path: Path, name: Any) -> str:
    """A sensor's TOML file named relative to ``path``, or a bundled sensor's name."""
    return str(path.parent / str(name)) if (path.parent / str(name)).is_file() else str(name)
