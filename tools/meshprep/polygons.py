"""The polygons of a file measured as they are, without the triangles that stand for them: the proof rests on this alone."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from meshprep.surface import Array, Faces, Surface
from numpy.typing import NDArray

from geomtact.geometry.polygons import Polygons

_AT_ONCE = 2_000_000  # corners that are looked at together
_POINTS_AT_ONCE = 1000
_EXACT = 1e-7  # of a surface's size: a distance below which no nearer polygon is looked for
NO_AREA = 1e-12  # of the square of a surface's size: area below which nothing can be touched


def points_on(polygons: Polygons, n: int) -> Array:
    """All corners but the tips of spikes, and about ``n`` points spread evenly over the faces (m, 3)."""
    corners = polygons.vertices[polygons.corners]
    normals, middle = _planes(polygons)
    u, v, w = _axes(normals)
    low, high = (f.reduceat(corners, polygons.starts) for f in (np.minimum, np.maximum))
    face = np.arange(len(normals))
    sides = (high - low)[face, u], (high - low)[face, v]
    area = np.linalg.norm(polygons.area_vectors, axis=1)
    upright = np.maximum(
        np.abs(normals[face, w]), 0.5
    )  # of the largest of three components at least 0.57, or it has no plane
    count = np.ceil(n * sides[0] * sides[1] / upright / area.sum()).astype(np.int64)
    face = np.repeat(face, count)
    rng = np.random.default_rng(0)
    points = low[face] + rng.random((len(face), 3)) * (high - low)[face]
    row, (u, v, w) = np.arange(len(face)), (axis[face] for axis in (u, v, w))
    off = points - middle[face]
    slope = normals[face[:, None], np.stack([u, v], 1)] * off[row[:, None], np.stack([u, v], 1)]
    points[row, w] = middle[face][row, w] - slope.sum(1) / np.where(normals[face, w] == 0, 1, normals[face, w])
    blunt = _without_spikes(polygons)
    return np.concatenate([blunt.vertices[blunt.corners], points[_measure(polygons, face, points)[0]]])


def _without_spikes(polygons: Polygons) -> Polygons:
    """Without the corners from which a side runs back along the one before, as there is no area between the two."""
    least = NO_AREA * np.square(np.ptp(polygons.vertices[polygons.corners], axis=0)).sum()
    while True:
        before = np.arange(-1, len(polygons.corners) - 1)
        before[polygons.starts] = polygons.starts + polygons.sizes - 1
        along = polygons.vertices[polygons.next_corner] - polygons.vertices[polygons.corners]
        flat = 0.5 * np.linalg.norm(np.cross(along[before], along), axis=1) <= least
        spike = flat & ((np.einsum("ij,ij->i", along[before], along) < 0) | ~along.any(1))
        if not spike.any():
            return polygons
        sizes = np.bincount(polygons.face_of_corner[~spike], minlength=len(polygons.sizes))
        polygons = replace(polygons, corners=polygons.corners[~spike], sizes=sizes).without_repeats()


def distance(surface: Surface, points: Array) -> Array:
    """Distance (n,) of ``points`` (n, 3) from the polygons of which ``surface`` was made, whatever its triangles cover."""
    import open3d as o3d

    assert surface.polygons is not None and surface.owner is not None
    scene, (middle, scale) = surface.scene
    nearest = scene.compute_closest_points(o3d.core.Tensor(((points - middle) / scale).astype(np.float32)))
    face = surface.owner[nearest["primitive_ids"].numpy().astype(np.int64)]
    # of long thin faces Open3D names a wrong one; the distance from any bounds that from the nearest
    bound = _distance_from(surface.polygons, face, points)
    far = np.flatnonzero(bound > _EXACT * surface.size)
    bound[far] = _least(surface.polygons, points[far], bound[far])
    return bound


def _least(polygons: Polygons, points: Array, bound: Array) -> Array:
    """Distance (n,) of ``points`` (n, 3) from the polygons, of which one is as near as ``bound`` (n,): from all within that."""
    from scipy.spatial import cKDTree

    corners = polygons.vertices[polygons.corners]
    low, high = (f.reduceat(corners, polygons.starts) for f in (np.minimum, np.maximum))
    middle, radius = 0.5 * (low + high), 0.5 * np.linalg.norm(high - low, axis=1)
    _, octave = np.frexp(radius)
    for size in np.unique(octave)[::-1]:
        alike = np.flatnonzero(octave == size)
        tree, reach = cKDTree(middle[alike]), radius[alike].max()
        for first in range(0, len(points), _POINTS_AT_ONCE):
            some = slice(first, first + _POINTS_AT_ONCE)
            near = tree.query_ball_point(points[some], bound[some] + reach)
            point = first + np.repeat(np.arange(len(near)), [len(each) for each in near])
            face = alike[np.concatenate([*near, []]).astype(np.int64)]
            outside = np.maximum(np.maximum(low[face] - points[point], points[point] - high[face]), 0)
            within = np.linalg.norm(outside, axis=1) < bound[point]
            point, face = point[within], face[within]
            np.minimum.at(bound, point, _distance_from(polygons, face, points[point]))
    return bound


def _distance_from(polygons: Polygons, face: Faces, points: Array) -> Array:
    """Distance (n,) of points (n, 3), each from one face (n,)."""
    inside, height, beside = _measure(polygons, face, points)
    return np.where(inside, np.minimum(height, beside), beside)


def _measure(polygons: Polygons, face: Faces, points: Array) -> tuple[NDArray[np.bool_], Array, Array]:
    """Of points (n, 3), each against one face (n,): whether it is inside the outline, its height over the plane, and its distance
    from the outline."""
    normals, middle = _planes(polygons)
    height = np.einsum("ij,ij->i", points - middle[face], normals[face])
    inside, beside = np.zeros(len(points), bool), np.zeros(len(points))
    axes = np.stack(_axes(normals), axis=1)
    for some in _portions(polygons.sizes[face]):
        mine = face[some]
        sizes = polygons.sizes[mine]
        begins = np.cumsum(sizes) - sizes
        which = np.repeat(np.arange(len(mine)), sizes)
        corner = np.arange(len(which)) - begins[which] + polygons.starts[mine][which]
        a, b = polygons.vertices[polygons.corners[corner]], polygons.vertices[polygons.next_corner[corner]]
        along, arm = b - a, points[some][which] - a
        square = np.einsum("ij,ij->i", along, along)
        share = np.clip(np.einsum("ij,ij->i", arm, along) / np.where(square > 0, square, 1), 0, 1)
        beside[some] = np.minimum.reduceat(np.linalg.norm(arm - share[:, None] * along, axis=1), begins)
        # sides that a ray in the plane crosses: an odd number from inside, where sides coincide too
        flat = (points[some] - height[some, None] * normals[mine])[which]
        (au, av), (bu, bv), (pu, pv) = (np.take_along_axis(x, axes[mine][which][:, :2], axis=1).T for x in (a, b, flat))
        level = np.where(bv == av, 1, bv - av)
        crossed = ((av > pv) != (bv > pv)) & (pu < au + (bu - au) * (pv - av) / level)
        inside[some] = np.add.reduceat(crossed.astype(np.int64), begins) % 2 == 1
    return inside, np.abs(height), beside


def _planes(polygons: Polygons) -> tuple[Array, Array]:
    """Unit normals and middles of the corners (P, 3), (P, 3); a face without area has no normal."""
    length = np.linalg.norm(polygons.area_vectors, axis=1, keepdims=True)
    middle = np.add.reduceat(polygons.vertices[polygons.corners], polygons.starts) / polygons.sizes[:, None]
    return polygons.area_vectors / np.where(length > 0, length, 1), middle


def _axes(normals: Array) -> tuple[Faces, Faces, Faces]:
    """Of each normal (n, 3) the two axes to which it is least inclined, and the third."""
    w = np.abs(normals).argmax(1)
    return (w + 1) % 3, (w + 2) % 3, w


def _portions(sizes: Faces) -> Iterator[slice]:
    """Slices of what has so many corners each, of few enough together."""
    total, first = np.cumsum(sizes), 0
    while first < len(sizes):
        before = total[first - 1] if first else 0
        last = max(int(np.searchsorted(total, before + _AT_ONCE)), first + 1)
        yield slice(first, last)
        first = last
