"""``--sensor-poses``: the sensor extrinsics, which sensors they are, and their uncertainty."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from geomtact.cli.project import is_bundled
from geomtact.contact_space.cell_transfer import ExtrinsicsStd
from geomtact.errors import InputError, nearest_name
from geomtact.inference.extrinsics import check_sensor_poses
from geomtact.json_values import is_number, read_json
from geomtact.se3 import Array, check_transforms

_KEYS = ("T_world_sensor", "sensor", "std_mm", "std_deg")


@dataclass(frozen=True)
class SensorPoses:
    """The content of the file.

    Attributes
    ----------
    T_world_sensor : (n, 4, 4), one for each image
    sensor : n names or TOML files, where they are given
    extrinsics_std : the uncertainty of the poses; None where the file does not state it
    """

    T_world_sensor: Array
    sensor: list[str] | None
    extrinsics_std: ExtrinsicsStd | None


def read_sensor_poses(path: Path, images: int) -> SensorPoses:
    """Read the JSON file for so many images.

    Raises
    ------
    InputError, PoseError
        It cannot be read, lacks a key or has an unknown one, or its poses are not rigid or of another number.
    """
    try:
        content = read_json(path)
    except FileNotFoundError:
        raise InputError(
            f'--sensor-poses {path}: no such file; write {{"T_world_sensor": [4x4 for each image]}}'
        ) from None
    except IsADirectoryError:
        raise InputError(f"--sensor-poses {path}: is a folder; give a JSON file") from None
    except (OSError, ValueError) as error:
        raise InputError(f"--sensor-poses {path}: cannot be read as JSON ({error}); correct the file") from None
    if not isinstance(content, dict) or "T_world_sensor" not in content:
        got = f"the keys {', '.join(content) or 'none'}" if isinstance(content, dict) else f"a {type(content).__name__}"
        raise InputError(f'--sensor-poses {path}: expected {{"T_world_sensor": [4x4 for each image]}}, got {got}')
    for key in content:
        if key not in _KEYS:
            raise InputError(f"--sensor-poses {path}: unknown key {key!r}{nearest_name(key, _KEYS)}")
    try:
        T = np.array(content["T_world_sensor"], float)
    except (ValueError, TypeError):  # matrices of several shapes, or no numbers
        T = np.zeros(0)
    if T.shape != (images, 4, 4):
        listed = content["T_world_sensor"]
        given = str(len(listed)) if isinstance(listed, list) else "none"
        if T.shape == (4, 4):
            given = "one 4x4; put it into a list"
        elif T.ndim == 3 and T.shape[1:] != (4, 4):
            given = "{} of {}x{}".format(*T.shape)
        elif T.ndim == 1 and listed:
            given += ", not all 4x4"
        expected = f"for each of {images} images" if images > 1 else "for the image"
        raise InputError(f"--sensor-poses {path}: T_world_sensor: expected a 4x4 matrix {expected}, got {given}")
    names = content.get("sensor")
    if names is not None and (not isinstance(names, list) or len(names) != images):
        got = str(len(names) if isinstance(names, list) else names)
        raise InputError(f"--sensor-poses {path}: sensor must list a name or TOML file for each of {images}, got {got}")
    std = {key: content[key] for key in ("std_mm", "std_deg") if key in content}
    for key, value in std.items():
        if not (is_number(value) and value >= 0):
            raise InputError(f"--sensor-poses {path}: {key} must be a finite number >= 0, got {value!r}")
    name = f"--sensor-poses {path}: T_world_sensor"
    T = check_transforms(T, name)
    check_sensor_poses(T, name)
    return SensorPoses(
        T,
        None if names is None else [_beside(path, name) for name in names],
        ExtrinsicsStd(float(np.radians(std.get("std_deg", 0.0))), 1e-3 * std.get("std_mm", 0.0)) if std else None,
    )


def _beside(path: Path, name: object) -> str:
    """A sensor's TOML file named relative to ``path``, or a bundled sensor's name."""
    name = str(name)
    return str(path.parent / name) if (path.parent / name).is_file() and not is_bundled("sensor", name) else name
