"""Whether a surface is a solid: closed, and with its outside outside."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from geomtact.errors import MeshError
from geomtact.geometry.polygons import edges_of
from geomtact.se3 import Array

_NO_VOLUME = 1e-12  # of the cube of a body's size: more than rounding leaves of a sheet, less than any needle has
# Points of a body that are tried, and how far within it they lie, of its size: single precision is 1e-7 of that
_PROBES, _WITHIN = 9, 1e-5


def check_solid(vertices: Array, faces: NDArray[np.int32], path: Path) -> None:
    """Check that every edge is walked as often one way as the other, and that the surface's outside is outside.

    This allows bodies that touch along an edge, which casts of rays do not mind.

    Parameters
    ----------
    vertices : (V, 3) [m]
    faces : (F, 3) indices into vertices
    path : the file to name

    Raises
    ------
    MeshError
        Not closed, wound in two ways, inside out, or a body of it without volume.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    edges = edges_of(faces).astype(np.int64)
    _, index, uses = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True, return_counts=True)
    excess = np.bincount(index.reshape(-1), np.where(edges[:, 0] < edges[:, 1], 1, -1))
    bare = int((uses % 2 == 1).sum())
    if bare:
        raise MeshError(
            f"{path}: not watertight, {bare} of {len(uses)} edges are open; "
            "close the surface with tools/prep_mesh.py or a mesh editor"
        )
    turned = int((excess != 0).sum())
    if turned:
        raise MeshError(
            f"{path}: neighbouring faces disagree about the outside at {turned} of {len(uses)} edges; "
            "make them agree in a mesh editor and export it again"
        )
    join = coo_array((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(len(vertices),) * 2)
    count, body_of_vertex = connected_components(join, directed=False)
    body = body_of_vertex[faces[:, 0]]
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    np.minimum.at(low, body_of_vertex, vertices)
    np.maximum.at(high, body_of_vertex, vertices)
    sizes = np.linalg.norm(high - low, axis=1)
    a, b, c = np.moveaxis(vertices[faces] - low[body][:, None], 1, 0)
    volume = np.bincount(body, np.einsum("ij,ij->i", a, np.cross(b, c)) / 6, minlength=count)
    for k in np.flatnonzero(np.abs(volume) <= _NO_VOLUME * sizes**3):
        raise MeshError(
            f"{path}: a body about ({place_mm(vertices[faces[body == k]])}) mm encloses no volume, as a sheet without thickness; "
            "remove it, or give it a thickness, in a mesh editor"
        )
    # An inverted body is a cavity if it lies in an upright one; otherwise it is inside out.
    for k in np.flatnonzero(volume < 0):
        around = np.flatnonzero((volume > 0) & (low <= low[k]).all(1) & (high >= high[k]).all(1))
        inside = _inside(vertices[faces[body == k]], sizes[k], [vertices[faces[body == j]] for j in around])
        if not inside.any():
            raise MeshError(
                f"{path}: the surface is inside out (its faces look inwards); flip its faces in a mesh editor and export it again"
            )
        if not inside.all():
            raise MeshError(
                f"{path}: a body about ({place_mm(vertices[faces[body == k]])}) mm, whose faces look inwards, passes through "
                "another; subtract it in CAD and export the object again"
            )
    if volume.sum() < 1e-6 * sizes.max() ** 3:
        raise MeshError(f"{path}: the surface encloses no volume; give a solid object")


def _inside(corners: Array, size: float, bodies: list[Array]) -> NDArray[np.bool_]:
    """Whether points (n,) just within an inverted body of triangles ``corners`` (F, 3, 3) lie in one of the upright ``bodies``.

    The points are within the inverted body, because a cavity may touch what it lies in.
    """
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1)
    wide = np.flatnonzero(length > 0)
    some = wide[np.linspace(0, len(wide) - 1, min(len(wide), _PROBES)).astype(int)]
    points = corners[some].mean(1) + _WITHIN * size * normals[some] / length[some, None]
    return np.array([any(_winding_number(body, point) > 0.5 for body in bodies) for point in points])


def _winding_number(corners: Array, point: Array) -> float:
    """How often closed triangles (F, 3, 3) go round a point (3,), by their solid angles (van Oosterom and Strackee 1983)."""
    a, b, c = np.moveaxis(corners - point, 1, 0)
    la, lb, lc = (np.linalg.norm(x, axis=1) for x in (a, b, c))
    ab, bc, ca = (np.einsum("ij,ij->i", x, y) for x, y in ((a, b), (b, c), (c, a)))
    volume = np.einsum("ij,ij->i", a, np.cross(b, c))
    return float(np.arctan2(volume, la * lb * lc + ab * lc + bc * la + ca * lb).sum() / (2 * np.pi))


def place_mm(corners: Array) -> str:
    """The middle of corners (..., 3) in millimetres."""
    return ", ".join(f"{1e3 * x:.4g}" for x in corners.reshape(-1, 3).mean(0))
