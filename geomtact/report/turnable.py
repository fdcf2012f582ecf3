"""Content of the page's 3D view: the object at each mode, the sensors' windows, and the probable places of the contact."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import ArrayLike

from geomtact.geometry.mesh import coarser
from geomtact.inference.distribution import row_poses
from geomtact.report.sensor_image import SensorImage
from geomtact.se3 import Array, apply, inverse
from geomtact.sensing.sensor import Sensor

if TYPE_CHECKING:
    from geomtact.inference.modes import Mode
    from geomtact.inference.posterior import Posterior

_FACES = 20_000  # that are drawn; finer meshes are made coarser
_POINTS, _POSES, _SHAPE = 4000, 200, (24, 32)  # of the surface, of the posterior, and rays of each
_NEAR = 0.02  # of the object's diameter, over which a touch spreads


def turnable(posterior: Posterior, modes: Sequence[Mode], shown: Sequence[SensorImage]) -> dict[str, Any]:
    """The content of the view, ready for JSON: arrays as base64 of little-endian numbers, lengths in millimetres, all but the
    object's own points in the first sensor's frame."""
    T_sensor_frame = inverse(posterior.T_frame_sensor)
    T = np.array([_mm(T_sensor_frame @ mode.T) for mode in modes])
    mesh = coarser(posterior.mesh, _FACES)
    vertices = 1e3 * mesh.vertices
    points, weights = touched(posterior)
    windows, outlines = [], []
    for one in shown:
        T_first = _mm(T_sensor_frame @ one.T_frame_sensor)
        windows.append(apply(T_first, 1e3 * one.sensor.corners))
        outlines += [apply(T_first, 1e3 * line) for line in outlines_of(one.observation.contact.mask, one.sensor)]
    # a sensor without contact may be far away
    near = [window for window, one in zip(windows, shown, strict=True) if one.observation.contact.mask.any()]
    seen = np.concatenate([*near, apply(T[0], vertices)])
    middle = 0.5 * (seen.min(0) + seen.max(0))
    reach = float(np.linalg.norm(seen - middle, axis=1).max())
    return {
        "vertices": _packed(vertices, np.float32),
        "faces": _packed(mesh.faces, np.uint32),
        "points": _packed(points, np.float32),
        "weights": _packed(weights, np.float32),
        "modes": T.round(6).tolist(),
        "windows": [window.round(3).tolist() for window in windows],
        "outlines": [line.round(3).tolist() for line in outlines],
        "middle": middle.round(3).tolist(),
        "radius": round(1.05 * reach, 3),
        "reach": round(reach, 3),
    }


def touched(posterior: Posterior, seed: int = 0) -> tuple[Array, Array]:
    """Points (n, 3) of the object's surface [mm] and how likely each lies in the first sensor's contact (n,), relative to the
    likeliest."""
    from scipy.spatial import cKDTree

    mesh, sensor, rng = posterior.mesh, posterior.sensor, np.random.default_rng(seed)
    p = np.exp(np.asarray(posterior.log_prob, float))
    rows = rng.choice(len(p), _POSES, p=p / p.sum())
    T = inverse(posterior.T_frame_sensor) @ row_poses(posterior, rows)
    depth = posterior.space.caster.depths(sensor, T, _SHAPE)
    x, y = sensor.pixel_centres(_SHAPE)
    points = mesh.surface_points(_POINTS, seed=seed)
    tree, weight = cKDTree(points), np.zeros(_POINTS)
    for pose, below in zip(T, depth, strict=True):
        row, column = np.nonzero(below > 0)
        if len(row):
            met = apply(inverse(pose), np.column_stack([x[column], y[row], -below[row, column]]))
            near = tree.query_ball_point(met, _NEAR * mesh.diameter)
            weight[np.unique(np.concatenate(near).astype(int))] += 1
    return 1e3 * points, weight / max(weight.max(), 1)


def outlines_of(mask: ArrayLike, sensor: Sensor) -> list[Array]:
    """The borders (n, 3) of a contact (H, W), on the plane z = 0 of the sensor frame [m]."""
    x, y = sensor.pixel_centres(np.shape(mask))  # type: ignore[arg-type]
    found, _ = cv2.findContours(np.asarray(mask, np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    lines = [line[:, 0] for line in found if len(line) > 2]
    return [np.column_stack([x[line[:, 0]], y[line[:, 1]], np.zeros(len(line))]) for line in lines]


def _mm(T: Array) -> Array:
    out = np.array(T, float)
    out[:3, 3] *= 1e3
    return out


def _packed(array: ArrayLike, kind: type[np.generic]) -> str:
    return base64.b64encode(np.ascontiguousarray(array, np.dtype(kind).newbyteorder("<")).tobytes()).decode("ascii")
