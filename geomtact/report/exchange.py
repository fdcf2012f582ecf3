"""Poses in other tools' formats: TUM trajectories, BOP results, ROS messages as JSON, and a table for pandas."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import Rotation

from geomtact.errors import InputError
from geomtact.files import read_text, write_text
from geomtact.se3 import Array, check_transforms, quat_xyzw, transform

if TYPE_CHECKING:
    from geomtact.inference.modes import Mode
    from geomtact.inference.posterior import Posterior

BOP = ("scene_id", "im_id", "obj_id", "score", "R", "t", "time")
_NORM = 0.01  # by which a quaternion's norm may be off 1: three digits of each number leave 0.001


def to_tum(path: str | Path, times: Iterable[float], T: Any) -> None:
    """Write poses ``T`` (n, 4, 4) [m] at ``times`` (n,) [s] as lines of ``timestamp tx ty tz qx qy qz qw``."""
    lines = [tum_line(time, pose) for time, pose in zip(times, check_transforms(T).reshape(-1, 4, 4), strict=True)]
    write_text(Path(path), "".join(lines))


def tum_line(time: float, T: Array) -> str:
    """One pose (4, 4) [m] at ``time`` [s], with its line break."""
    return " ".join([f"{time:.6f}", *(f"{x:.9f}" for x in (*T[:3, 3], *quat_xyzw(T)))]) + "\n"


def from_tum(path: str | Path) -> tuple[Array, Array]:
    """Times (n,) [s] and poses (n, 4, 4) [m] of a TUM file; what follows # is left out.

    Raises
    ------
    InputError
        It cannot be read, or has a line of other than eight finite numbers, the last four a quaternion of norm 0.99 to 1.01.
    """
    rows = []
    for number, line in enumerate(_text(path).splitlines(), 1):
        words = line.split("#")[0].split()
        if not words:
            continue
        where = f"{path}: line {number}:"
        try:
            row = _numbers(words).reshape(8)
        except ValueError:
            raise InputError(f"{where} expected timestamp tx ty tz qx qy qz qw, eight numbers") from None
        if not np.isfinite(row).all():
            raise InputError(f"{where} expected finite numbers, got NaN or infinity; remove the line")
        norm = float(np.linalg.norm(row[4:]))
        if abs(norm - 1) > _NORM:
            raise InputError(
                f"{where} expected a quaternion qx qy qz qw of norm 1, got norm {norm:.4g}; check the columns"
            )
        rows.append(row)
    values = np.array(rows).reshape(-1, 8)
    R = Rotation.from_quat(values[:, 4:]).as_matrix() if rows else np.zeros((0, 3, 3))
    return values[:, 0], transform(R, values[:, 1:4])


def to_bop(path: str | Path, rows: Iterable[Mapping[str, Any]]) -> None:
    """Write results as the BOP benchmark reads them (bop.felk.cvut.cz/challenges).

    Each of ``rows`` has ``scene_id``, ``im_id``, ``obj_id``, ``score``, ``T`` (4, 4) [m], and ``time`` [s], -1 where it is
    left out; the file has R row by row and t in millimetres.
    """
    lines = [",".join(BOP)]
    for row in rows:
        T = check_transforms(row["T"])
        R, t = (" ".join(f"{x:.9g}" for x in values) for values in (T[:3, :3].ravel(), 1e3 * T[:3, 3]))
        head = [str(row[key]) for key in BOP[:3]]
        lines.append(",".join([*head, f"{row['score']:.9g}", R, t, f"{row.get('time', -1):g}"]))
    write_text(Path(path), "\n".join(lines) + "\n")


def from_bop(path: str | Path) -> list[dict[str, Any]]:
    """The rows of a BOP file, as :func:`to_bop` takes them.

    Raises
    ------
    InputError
    """
    found = csv.DictReader(_text(path).splitlines())
    if found.fieldnames is None or tuple(found.fieldnames) != BOP:
        raise InputError(f"{path}: expected the columns {','.join(BOP)}, got {','.join(found.fieldnames or ['none'])}")
    out = []
    for number, row in enumerate(found, 2):
        try:
            R, t = (_numbers(row[key].split()) for key in ("R", "t"))
            T = check_transforms(transform(R.reshape(3, 3), 1e-3 * t.reshape(3)), f"{path}: line {number}")
            ids = {key: int(_numbers([row[key]], int)[0]) for key in BOP[:3]}
            score, time = _numbers([row["score"], row["time"]]).tolist()
            if not np.isfinite([score, time]).all():
                raise InputError(f"{path}: line {number}: expected a finite score and time, got {score:g} and {time:g}")
            out.append(ids | {"score": score, "time": time, "T": T})
        except (TypeError, ValueError, AttributeError):
            raise InputError(f"{path}: line {number}: expected {','.join(BOP)} with nine and three numbers") from None
    return out


def to_ros(mode: Mode, frame_id: str, stamp: float = 0.0) -> dict[str, Any]:
    """A mode as geometry_msgs/PoseWithCovarianceStamped: metres, quaternion x, y, z, w, and the covariance (36,) row by row of
    (x, y, z, turns about the fixed axes x, y, z of ``frame_id``); ``stamp`` in seconds.

    A mode's own covariance is of a motion in the object's frame, turns first: T exp(xi^). At the object's origin the motion in
    the fixed frame is that turned by R.
    """
    R, zero = mode.T[:3, :3], np.zeros((3, 3))
    A = np.block([[zero, R], [R, zero]])
    x, y, z, w = quat_xyzw(mode.T).tolist()
    seconds = int(np.floor(stamp))
    return {
        "header": {"stamp": {"sec": seconds, "nanosec": round(1e9 * (stamp - seconds))}, "frame_id": frame_id},
        "pose": {
            "pose": {
                "position": dict(zip("xyz", mode.T[:3, 3].tolist(), strict=True)),
                "orientation": {"x": x, "y": y, "z": z, "w": w},
            },
            "covariance": (A @ mode.covariance @ A.T).ravel().tolist(),
        },
    }


def to_table(modes: Sequence[Mode], posterior: Posterior) -> dict[str, list[Any]]:
    """Modes as columns, for ``pandas.DataFrame``: lengths in millimetres, quaternions x, y, z, w, and the standard deviations of
    the object's origin [mm] and of its turn [degrees], each in its least certain direction."""
    T = np.array([mode.T for mode in modes]).reshape(-1, 4, 4)
    quat = np.array([quat_xyzw(each) for each in T]).reshape(-1, 4)
    std = np.sqrt([[np.linalg.eigvalsh(mode.covariance[k : k + 3, k : k + 3])[-1] for k in (3, 0)] for mode in modes])
    std = std.reshape(-1, 2) * [1e3, np.degrees(1)]
    columns: dict[str, list[Any]] = {"object": [posterior.mesh.name] * len(T), "frame": [posterior.frame] * len(T)}
    columns |= {"probability": [mode.probability for mode in modes]}
    numbers = np.concatenate([1e3 * T[:, :3, 3], quat, std], 1)
    names = ("x_mm", "y_mm", "z_mm", "qx", "qy", "qz", "qw", "shift_std_mm", "turn_std_deg")
    return columns | {name: numbers[:, k].tolist() for k, name in enumerate(names)}


def _numbers(words: Sequence[str], dtype: type = float) -> Array:
    """Written numbers (n,); ValueError of others, and of 1_0, which Python reads as 10."""
    if any("_" in word for word in words):
        raise ValueError
    return np.array([dtype(word) for word in words])


def _text(path: str | Path) -> str:
    try:
        return read_text(Path(path))
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; give one that exists") from None
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read as text ({error}); give a text file") from None
