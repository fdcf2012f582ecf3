"""A contact as registration sees it: its outline on the membrane, points inside and outside it, and depths where measured.

Along the outline the object's surface crosses the membrane, so the outline is a curve on the surface. An elastic gel sinks
around the object: its outline lies a little above the surface. That offset along z equals a smaller penetration, so the
outline cannot separate the two. Its expected size is given (``sink``); its uncertainty (``sink_std``) limits what the outline
constrains of z. Membrane inside the outline lies within the object, membrane outside of it does not. Where depths are
measured, the gel lies on the object's surface all over the contact, and nowhere in the object.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from geomtact.registration.protocol import Problem
from geomtact.registration.surface import Surface
from geomtact.se3 import Array, apply, inverse, unit
from geomtact.sensing.contact import Contact, SoftMask
from geomtact.sensing.sensor import Sensor

# All constants are hand-set.
SINK, SINK_STD = 0.2e-3, 0.35e-3  # depth that a gel, rigid or elastic, sinks around the object: mean and std [m]
_FEWEST = 4  # least number of points on a contour; shorter ones are specks
FLAT = 0.05  # sine of the slope below which a surface does not cross the membrane
_STEEP = 1.0  # slope of the gel above which a wall is near
_MARGIN = 2  # margin around missing depths that is not used [px]
_CLEAR = 0.5e-3  # least distance from the outline of a point inside or outside of it [m]
_AROUND = 4e-3  # largest distance from the contact of a point outside of it [m]


def make_problem(
    mask: ArrayLike,
    sensor: Sensor,
    height: ArrayLike | None = None,
    *,
    max_points: int = 60,
    outline_noise: float = 0.2e-3,
    height_noise: float | None = None,
    correlation: float = 2e-3,
    sink: float = SINK,
    sink_std: float = SINK_STD,
) -> Problem:
    """One contact, in the sensor's frame.

    Parameters
    ----------
    mask : (H, W) bool, on any grid over the sensor's window; or the probability of contact at each pixel, by which its outline
        is the less sure the more slowly that falls
    sensor : whose membrane the contact lies on
    height : (H, W) how deep the gel is pressed in [m], NaN where it is not measured. The contact is then where it is more than
        half of the deepest, and ``sink`` is not used
    max_points : of the outline, of the depths, and of what lies inside and outside, at most
    outline_noise : how far the outline of a real mask strays, standard deviation along its normal [m]
    height_noise : standard deviation of depths [m]; the sensor's by default
    correlation : over what length both stray the same way [m]: to 1/e in a Gaussian field, as ``Noise.correlation``
    sink : how far below the membrane the object's surface lies at the outline [m]: 0 for a rigid gel, about 0.55 of the deepest
        for an elastic one
    sink_std : standard deviation of ``sink`` [m]; the default spans both gels
    """
    shown = np.asarray(mask)
    contact: NDArray[np.bool_] = shown if shown.dtype == bool else shown > 0.5
    pitch_xy = 2 * sensor.half_window / contact.shape[::-1]
    pitch = float(np.sqrt(pitch_xy.prod()))
    outline_noise, height_noise = (
        float(np.hypot(outline_noise, 0.3 * pitch)),
        float(np.hypot(height_noise or sensor.height_noise, 0.1 * pitch)),
    )

    def lifted(uv: Array, depth: ArrayLike = 0.0) -> Array:
        return sensor.lift((uv + 0.5) * pitch_xy - sensor.half_window, depth)

    if height is None:
        uv, outward, unsure, spacing = _outline(shown, pitch_xy, max_points)
        noise = np.maximum(outline_noise, unsure)
        met = _on_outline(lifted(uv), outward, sink, noise, spacing / (np.sqrt(np.pi) * correlation), sensor)
        inside, outside = (lifted(uv) for uv in _inside_and_outside(contact, pitch_xy, max_points))
        # what the gel may have sunk to lies neither inside nor outside
        inside, outside = inside + sink * _down(inside, sensor), outside + (sink + sink_std) * _down(outside, sensor)
    else:
        sink_std = 0.0
        depth, measured, clear = _depths(height)
        lying = Contact(contact, depth.astype(np.float32))
        half, deep = lying.sure_depth, lying.sure
        uv, outward, _, spacing = _outline(deep, pitch_xy, max_points)
        # of an elastic gel, what is not pressed in half as deep as the deepest may hang free of the object, far beside it
        # even: only where the gel drops off steeply a wall is near
        steep = _at(clear & (np.hypot(*np.gradient(depth, *pitch_xy[::-1])) > _STEEP), uv)
        rim = _on_outline(
            lifted(uv[steep]), outward[steep], half, outline_noise, spacing / (np.sqrt(np.pi) * correlation), sensor
        )
        uv, apart = _spaced(deep & measured, pitch_xy, max_points)
        gel = lifted(uv, _at(depth, uv))
        met = _joined(rim, _on_gel(gel, height_noise, (apart / correlation) ** 2 / np.pi, sensor))
        uv = _inside_and_outside(contact, pitch_xy, max_points)[1]
        uv = uv[_at(clear, uv)]
        inside, outside = np.zeros((0, 3)), lifted(uv, _at(depth, uv) + height_noise)
    points = met["points"]
    centre = points.mean(0) if len(points) else np.zeros(3)
    length = float(np.sqrt(((points - centre) ** 2).sum(1).mean())) if len(points) else 0.0
    return Problem(
        **met,
        contact=np.zeros(len(points), np.int64),
        around=np.concatenate([inside, outside]),
        side=np.repeat([1, -1], [len(inside), len(outside)]),
        outwards=np.array([0.0, 0.0, 1.0]),
        centre=centre,
        length=max(length, pitch),
        pitch=pitch,
        sink_std=max(sink_std, 1e-9),
    )


def _on_outline(
    rim: Array, outward: Array, sink: float, noise: float | Array, weight: float, sensor: Sensor
) -> dict[str, Array]:
    """Fields of a ``Problem`` for points (n, 3) of an outline on the membrane, its normals (n, 2) in the image's plane, and its
    noise [m], one or (n,)."""
    down = _down(rim, sensor)
    facing = np.concatenate([outward, np.zeros((len(outward), 1))], 1)
    return {
        "points": rim + sink * down,
        "facing": facing,
        "across": unit(np.cross(down, facing)),
        "sinking": down,
        "noise": np.full(len(rim), noise),
        "weight": np.full(len(rim), min(1.0, weight)),
    }


def _on_gel(gel: Array, noise: float, weight: float, sensor: Sensor) -> dict[str, Array]:
    """Fields of a ``Problem`` for points (n, 3) of a gel of measured depth that lie on the object."""
    return {
        "points": gel,
        "facing": unit(_down(gel, sensor)),
        "across": np.zeros_like(gel),
        "sinking": np.zeros_like(gel),
        "noise": np.full(len(gel), noise),
        "weight": np.full(len(gel), min(1.0, weight)),
    }


def _joined(*parts: dict[str, Array]) -> dict[str, Array]:
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def _depths(height: ArrayLike) -> tuple[Array, NDArray[np.bool_], NDArray[np.bool_]]:
    """Depths (H, W) without single outliers, 0 where missing; where (H, W) they are measured; and where all around too."""
    height = np.asarray(height, np.float32)
    missing = ~np.isfinite(height)
    depth = cv2.medianBlur(np.where(missing, 0, height).astype(np.float32), 3).astype(float)
    size = 2 * _MARGIN + 1
    return depth, ~missing, cv2.dilate(missing.astype(np.uint8), np.ones((size, size), np.uint8)) == 0


def _at(values: NDArray, uv: Array) -> NDArray:
    """Of an image (H, W), at the pixels (n,) nearest to (column, row) ``uv`` (n, 2)."""
    column, row = np.rint(uv).astype(int).T
    return values[row, column]


def _down(points: Array, sensor: Sensor) -> Array:
    """Towards the camera (n, 3), per metre along z, from points (n, 3)."""
    if not sensor.camera_distance:
        return np.tile([0.0, 0.0, -1.0], (len(points), 1))
    camera = np.array([0.0, 0.0, -sensor.camera_distance])
    return -(points - camera) / (points - camera)[:, 2:]


def near_surface(surface: Surface, problem: Problem, T: Array, reach: float) -> tuple[Array, Array]:
    """Points (s, 3) and normals (s, 3) of the surface, in the problem's frame at ``T``, within ``reach`` [m] of what was
    observed, as far as they may have made a single contact: not parallel to its membrane."""
    if len(problem.points) < _FEWEST:
        return np.zeros((0, 3)), np.zeros((0, 3))
    around = float(np.linalg.norm(problem.points - problem.centre, axis=1).max()) + reach
    centre = apply(inverse(T), problem.centre[None])[0]
    index = np.array(surface.tree.query_ball_point(centre, around, return_sorted=False), dtype=np.intp)
    if problem.contacts == 1:
        # few of these points lie close to the membrane: heights first
        up = problem.outwards
        z, met = surface.points[index] @ (T[:3, :3].T @ up) + T[:3, 3] @ up, problem.points @ up
        index = index[(z > met.min() - reach) & (z < met.max() + reach)]
        if problem.across.any(1).all():
            index = index[np.abs(surface.normals[index] @ (T[:3, :3].T @ up)) < np.sqrt(1 - FLAT**2)]
    return apply(T, surface.points[index]), surface.normals[index] @ T[:3, :3].T


def _inside_and_outside(mask: NDArray[np.bool_], pitch_xy: Array, most: int) -> tuple[Array, Array]:
    """Pixels (m, 2), (l, 2) as (column, row) that are clearly in contact, and clearly not but close to it."""
    if not mask.any():
        return np.zeros((0, 2)), np.zeros((0, 2))
    # no finer than needed: distances take time
    step = max(1, int(_CLEAR / 2 / pitch_xy.max()))
    image, clear = mask[::step, ::step].astype(np.uint8), _CLEAR / (step * float(np.sqrt(pitch_xy.prod())))
    inside = cv2.distanceTransform(image, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) > clear
    off = cv2.distanceTransform(1 - image, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    outside = (off > clear) & (off < clear * _AROUND / _CLEAR)
    some = (_spaced(where, step * pitch_xy, most // 2)[0] for where in (inside, outside))
    return step * next(some), step * next(some)


def _spaced(where: NDArray[np.bool_], pitch_xy: Array, most: int) -> tuple[Array, float]:
    """At most ``most`` pixels (m, 2) as (column, row) spread evenly over those of ``where`` (h, w), and how far apart [m]."""
    area = float(where.sum() * pitch_xy.prod())
    apart = np.maximum(1, np.ceil(np.sqrt(area / max(most, 1)) / pitch_xy)).astype(int)
    some = np.zeros_like(where)
    some[apart[1] // 2 :: apart[1], apart[0] // 2 :: apart[0]] = True
    rows, cols = np.nonzero(where & some)
    return np.stack([cols, rows], 1)[:most].astype(float), float(np.sqrt((apart * pitch_xy).prod()))


def _outline(shown: SoftMask, pitch_xy: Array, max_points: int) -> tuple[Array, Array, Array, float]:
    """Subpixel outline (n, 2) in (column, row), its outward unit normals (n, 2) in metric axes, how unsure it is along them by
    the probabilities that are ``shown`` (n,) [m], and its spacing [m].

    Where the border of the image cuts the contact there is no outline.
    """
    from scipy.ndimage import gaussian_filter, map_coordinates
    from skimage.measure import find_contours

    none = np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0), float(pitch_xy.mean())
    mask = shown > 0.5
    rows, cols = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    if not len(rows) or min(mask.shape) < 2:
        return none
    # the neighbourhood of the contact is enough; at the image's border it ends there, so that no outline follows it
    top, left = max(rows[0] - 4, 0), max(cols[0] - 4, 0)
    smooth = shown[top : rows[-1] + 5, left : cols[-1] + 5].astype(np.float32)
    if shown.dtype == bool:  # a blur of one pixel takes the stairs out of the outline
        smooth = gaussian_filter(smooth, 1.0, mode="nearest", truncate=3.0)
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
    rc, outward, steep = rc[good], outward[good] / steep[good, None], steep[good]
    # where an outline that errs by s may be, the probability falls by 1 / (s sqrt(2 pi)) a metre
    unsure = np.zeros(len(rc)) if shown.dtype == bool else 1 / (np.sqrt(2 * np.pi) * steep)
    return (rc + [top, left])[:, ::-1], outward, unsure, float(spacing)
