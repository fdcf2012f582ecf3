"""The rim of a contact, lifted to the membrane, and the part of the object's surface that may have made it.

Along the rim the object's surface crosses the membrane, so the rim is a curve on the surface. An elastic gel sinks
around the object: its rim lies a little above the surface. That offset along z looks exactly like a smaller
penetration, so the rim cannot tell the two apart: its expected size is given (``sink``), and what is not known of it
(``sink_std``) is taken off what the rim tells about z.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geomtact.registration.protocol import Problem, Surface
from geomtact.se3 import Array, apply, inverse
from geomtact.sensing.sensor import Sensor

_FEWEST = 4  # rim points on a contour; shorter ones are specks
_FLAT = 0.05  # sine of the slope under which a surface does not cross the membrane


def make_problem(
    mask: ArrayLike,
    sensor: Sensor,
    *,
    max_points: int = 120,
    outline_noise: float = 0.15e-3,
    correlation: float = 2e-3,
    sink: float = 0.0,
    sink_std: float = 0.3e-3,
) -> Problem:
    """The rim of a contact as points of the membrane.

    Parameters
    ----------
    mask : (H, W) bool, on any grid over the sensor's window
    sensor : whose membrane the contact lies on
    max_points : of the rim
    outline_noise : how far the outline of a real mask strays, standard deviation along its normal [m]
    correlation : over what length it strays the same way [m]
    sink : how far below the membrane the object's surface lies at the rim [m]: 0 for a rigid gel
    sink_std : and how much more or less it may be [m]
    """
    mask = np.asarray(mask, bool)
    pitch_xy = 2 * sensor.half_window / mask.shape[::-1]
    pitch = float(np.sqrt(pitch_xy.prod()))
    pixels, outward, spacing = _outline(mask, pitch_xy, max_points)

    def lifted(uv: Array) -> Array:
        return sensor.lift((uv + 0.5) * pitch_xy - sensor.half_window)

    rim = lifted(pixels)
    rays = rim + [0.0, 0.0, sensor.camera_distance] if sensor.camera_distance else np.zeros_like(rim) + [0.0, 0.0, 1.0]
    rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    rim = rim - sink / rays[:, 2:] * rays
    centre = rim.mean(0) if len(rim) else np.zeros(3)
    length = float(np.sqrt(((rim - centre) ** 2).sum(1).mean())) if len(rim) else 0.0
    return Problem(
        rim=rim,
        outward=np.concatenate([outward, np.zeros((len(outward), 1))], 1),
        rays=rays,
        centre=centre,
        length=max(length, pitch),
        spacing=spacing,
        pitch=pitch,
        noise=float(np.hypot(outline_noise, 0.3 * pitch)),
        correlation=correlation,
        sink_std=max(sink_std, 1e-9),
    )


def near_surface(surface: Surface, problem: Problem, T: Array, reach: float) -> tuple[Array, Array]:
    """Points (s, 3) and normals (s, 3), sensor frame at ``T``, of the surface that may have made the rim.

    It lies within ``reach`` [m] of the rim and is not parallel to the membrane, or it would not cross it.
    """
    if len(problem.rim) < _FEWEST:
        return np.zeros((0, 3)), np.zeros((0, 3))
    around = float(np.linalg.norm(problem.rim - problem.centre, axis=1).max()) + reach
    centre = apply(inverse(T), problem.centre[None])[0]
    index = np.array(surface.tree.query_ball_point(centre, around, return_sorted=False), dtype=np.intp)
    # few of these points lie close to the membrane: heights first
    z = surface.points[index] @ T[2, :3] + T[2, 3]
    index = index[(z > problem.rim[:, 2].min() - reach) & (z < problem.rim[:, 2].max() + reach)]
    index = index[np.abs(surface.normals[index] @ T[2, :3]) < np.sqrt(1 - _FLAT**2)]
    return apply(T, surface.points[index]), surface.normals[index] @ T[:3, :3].T


def _outline(mask: NDArray[np.bool_], pitch_xy: Array, max_points: int) -> tuple[Array, Array, float]:
    """Subpixel outline (n, 2) in (column, row), its outward unit normals (n, 2) in metric axes, and its spacing [m].

    Where the border of the image cuts the contact there is no outline.
    """
    from scipy.ndimage import gaussian_filter, map_coordinates
    from skimage.measure import find_contours

    none = np.zeros((0, 2)), np.zeros((0, 2)), float(pitch_xy.mean())
    rows, cols = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    if not len(rows) or min(mask.shape) < 2:
        return none
    # the neighbourhood of the contact is enough; at the image's border it ends there, so that no outline follows it
    top, left = max(rows[0] - 4, 0), max(cols[0] - 4, 0)
    part = mask[top : rows[-1] + 5, left : cols[-1] + 5].astype(np.float32)
    # a blur of one pixel takes the stairs out of the outline
    smooth = gaussian_filter(part, 1.0, mode="nearest", truncate=3.0)
    contours = [c for c in find_contours(smooth, 0.5) if len(c) > _FEWEST]
    if not contours:
        return none
    metric = pitch_xy[::-1]
    arcs = [np.concatenate([[0], np.linalg.norm(np.diff(c * metric, axis=0), axis=1).cumsum()]) for c in contours]
    total = sum(arc[-1] for arc in arcs)
    spacing = max(total / max_points, float(pitch_xy.mean()))
    chosen = []
    for contour, arc in zip(contours, arcs, strict=True):
        # a speck of dirt has an outline too, but a short one
        if arc[-1] < 0.1 * total:
            continue
        at = (np.arange(max(1, round(arc[-1] / spacing))) + 0.5) / max(1, round(arc[-1] / spacing)) * arc[-1]
        chosen.append(np.stack([np.interp(at, arc, contour[:, i]) for i in (0, 1)], 1))
    if not chosen:
        return none
    rc = np.concatenate(chosen)
    slope = [map_coordinates(g, rc.T, order=1, mode="nearest") for g in np.gradient(smooth)]
    outward = -np.stack([slope[1] / pitch_xy[0], slope[0] / pitch_xy[1]], 1)
    steep = np.linalg.norm(outward, axis=1)
    good = steep > 1e-9
    rc, outward = rc[good], outward[good] / steep[good, None]
    return (rc + [top, left])[:, ::-1], outward, float(spacing)
