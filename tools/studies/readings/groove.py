"""A scanned groove localized by its heights: the direction along it must stay open."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from geomtact.errors import InputError
from geomtact.geometry.mesh import Mesh
from geomtact.localizer import Localizer
from geomtact.se3 import inverse
from geomtact.sensing.sensor import Sensor

MM = 1e-3


@dataclass(frozen=True)
class Groove:
    """One mode of the groove scan's middle, localized by its heights on the plate that was scanned.

    Attributes
    ----------
    probability : of the mode
    across_mm, along_mm, deep_mm : how far it is off across the groove, along it, and in height
    turn_deg, tilt_deg : about the normal, and of it
    told : how many directions are observable
    told_along : the largest component along the groove of an observable direction, by unit vectors
    """

    probability: float
    across_mm: float
    along_mm: float
    deep_mm: float
    turn_deg: float
    tilt_deg: float
    told: int
    told_along: float


def localize_groove(folder: Path, cache_dir: Any = None, modes: int = 5) -> tuple[float, list[Groove]]:
    """The log density at the true pose, and the observable directions of the leading modes, of a window of the scan:
    6.6 mm by 4.9 mm, of heights without noise, on a plate whose grooves go on beyond it."""
    height, pitch = read_scan(folder / "gelsight_groove_scan" / "heightmap.tmd")
    h, w = height.shape
    sensor = Sensor("groove scan", (240, 180), pitch, 0.0, 1 * MM, height_noise=0.02 * MM)
    rows, columns = slice(167, 347), slice(173, 413)  # the middle groove
    # the plate faces the sensor: rows of the contact run against those of the scan
    seen = height[rows, columns][::-1]
    seen = (seen - seen.min() + 0.15 * MM).astype(np.float32)
    approach = [(np.array([0.0, 0.0, 1.0]), 0.1)]
    localizer = Localizer.prepare(
        _plate(height, pitch), sensor=sensor, approach=approach, max_poses=400_000, cache_dir=cache_dir
    )
    posterior = localizer.localize(seen, "height")
    true = np.diag([1.0, -1.0, -1.0, 1.0])
    true[0, 3] = ((w - columns.start - columns.stop) / 2) * pitch[0]
    true[1, 3] = ((rows.start + rows.stop - h) / 2) * pitch[1]
    true[2, 3] = localizer.space.caster.depths(sensor, true[None]).max() - seen.max()
    out = []
    for mode in posterior.modes(modes):
        off = mode.T @ inverse(true)
        along = np.abs(mode.observable[:, 4]) if len(mode.observable) else np.zeros(1)
        x, y, z = (mode.T[:3, 3] - true[:3, 3]) / MM
        turn, tilt = np.arctan2(off[1, 0], off[0, 0]), np.arccos(np.clip(off[2, 2], -1, 1))
        out.append(
            Groove(
                mode.probability, x, y, z, np.degrees(turn), np.degrees(tilt), len(mode.observable), float(along.max())
            )
        )
    return float(posterior.log_density(true)), out


def read_scan(path: Path) -> tuple[Any, tuple[float, float]]:
    """Heights (H, W) [m] and the pitch along x and y [m] of a TrueMap file, version 2.

    Raises
    ------
    InputError
        It is none.
    """
    data = path.read_bytes()
    try:
        start = data.index(b"\0", 32) + 1
        columns, rows = (int(n) for n in np.frombuffer(data, "<u4", 2, start))
        length = np.frombuffer(data, "<f4", 2, start + 8) * MM
        height = np.frombuffer(data, "<f4", rows * columns, start + 24).reshape(rows, columns) * MM
    except ValueError as error:
        raise InputError(f"{path}: expected a TrueMap file as its makers wrote it ({error})") from None
    return height.astype(float), (float(length[0]) / columns, float(length[1]) / rows)


def _plate(height: Any, pitch: tuple[float, float]) -> Mesh:
    """A plate with the relief ``height`` (H, W) [m] on its upper side, x along columns, y along rows."""
    import trimesh

    every, thick = 6, 3 * MM
    top = height[::every, ::every]
    h, w = top.shape
    # a pixel is where its middle is, the origin the middle of the whole scan
    H, W = height.shape
    x, y = np.meshgrid((np.arange(w) * every + 0.5 - W / 2) * pitch[0], (np.arange(h) * every + 0.5 - H / 2) * pitch[1])
    vertices = np.concatenate([np.stack([x, y, z], -1).reshape(-1, 3) for z in (top, np.full_like(top, -thick))])
    at, n = np.arange(h * w).reshape(h, w), h * w
    a, b, c, d = (part.ravel() for part in (at[:-1, :-1], at[:-1, 1:], at[1:, 1:], at[1:, :-1]))
    upper = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    ring = np.concatenate([at[0, :-1], at[:-1, -1], at[-1, :0:-1], at[:0:-1, 0]])
    beside = np.roll(ring, -1)
    wall = np.concatenate([np.stack([ring, ring + n, beside], 1), np.stack([beside, ring + n, beside + n], 1)])
    plate = trimesh.Trimesh(vertices, np.concatenate([upper, upper[:, ::-1] + n, wall]))
    return Mesh(plate.vertices, plate.faces, "grooved plate", "m")
