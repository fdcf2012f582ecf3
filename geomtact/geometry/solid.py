"""Whether a surface is a solid: closed, with its outside outside, and not folded back onto itself in one plane."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from geomtact.errors import MeshError
from geomtact.geometry.polygons import edge_table, edges_of
from geomtact.se3 import Array

_NO_VOLUME = 1e-12  # of the cube of a body's size: more than rounding leaves of a sheet, less than any needle has
# Points of a body that are tried, and how far within it they lie, of its size: single precision is 1e-7 of that
_PROBES, _WITHIN = 9, 1e-5
# By how much corners may lie beside a common plane: of the size the last of six digits, as text is written with, and of the
# farthest coordinate a few times what single precision rounds away
_OF_SIZE, _OF_REACH = 1e-5, 2.5e-7
# Sine of the angle between folded faces: no blade is that sharp, and where boolean operations leave slivers of some
# micrometres, their wedges are from 0.005 on
_ANGLE = 1e-3


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
    _, way, start, uses = edge_table(faces)
    bare = int((uses % 2 == 1).sum())
    if bare:
        raise MeshError(
            f"{path}: not watertight, {bare} of {len(uses)} edges are open; "
            "close the surface with tools/prep_mesh.py or a mesh editor"
        )
    turned = int((np.add.reduceat(way, start) != 0).sum())
    if turned:
        raise MeshError(
            f"{path}: neighbouring faces disagree about the outside at {turned} of {len(uses)} edges; "
            "make them agree in a mesh editor and export it again"
        )
    edges = edges_of(faces)
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


def folded_faces(vertices: Array, faces: NDArray[np.integer]) -> NDArray[np.intp]:
    """The faces (n,) that are folded over their neighbours in one plane: of each two coplanar pieces of surface that lie on the
    same side of a shared edge and look opposite ways, the one with less area.

    Edges of more than two faces are where bodies touch: nothing is a fold there. Faces without width are looked across.

    Parameters
    ----------
    vertices : (V, 3)
    faces : (F, 3) indices into vertices, wound alike
    """
    corners = vertices[faces]
    crosses = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    double = np.linalg.norm(crosses, axis=1)
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(1)
    rounding = max(_OF_SIZE * float(np.ptp(vertices, axis=0).max()), _OF_REACH * float(np.abs(vertices).max()))
    has_width = double > longest * max(rounding, 1e-300)
    normals = crosses / np.where(double > 0, double, 1)[:, None]
    one, two = _neighbours(faces, has_width)

    def coplanar(sign: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Neighbours that lie in one plane, their normals alike (1) or opposite (-1)."""
        found = np.linalg.norm(normals[one] - sign * normals[two], axis=1) < _ANGLE
        a, b = one[found], two[found]
        # each in the plane of the other: the larger one's corners decide
        apart = [
            np.abs(np.einsum("ikj,ij->ik", corners[there] - corners[here][:, :1], normals[here])).max(1)
            for here, there in ((a, b), (b, a))
        ]
        flat = np.maximum(*apart) <= rounding
        return a[flat], b[flat]

    folded, onto = coplanar(-1)
    if not len(folded):
        return folded
    joined = coplanar(1)
    graph = coo_array((np.ones(len(joined[0])), joined), shape=(len(faces),) * 2)
    _, piece = connected_components(graph, directed=False)
    area = np.bincount(piece, double)
    a, b = piece[folded], piece[onto]
    return np.flatnonzero(np.isin(piece, np.where(area[a] < area[b], a, b)))


def _neighbours(faces: NDArray[np.integer], has_width: NDArray[np.bool_]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Pairs (n,), (n,) of faces with width that share an edge of two faces, or that both meet a face without width there."""
    n = len(faces)
    owner, _, start, uses = edge_table(faces)
    pairs = start[uses == 2]
    one, two = owner[pairs], owner[pairs + 1]
    both = has_width[one] & has_width[two]
    # slivers that meet are one, and whatever meets them is paired
    thin = ~has_width[one] | ~has_width[two]
    slivers = ~has_width[one] & ~has_width[two]
    _, piece = connected_components(
        coo_array((np.ones(slivers.sum()), (one[slivers], two[slivers])), shape=(n, n)), directed=False
    )
    met = np.concatenate(
        [np.stack([one, two], 1)[thin & has_width[one]], np.stack([two, one], 1)[thin & has_width[two]]]
    )
    met = np.stack([met[:, 0], piece[met[:, 1]]], axis=1)
    met = met[np.argsort(met[:, 1], kind="stable")]
    across = [(one[both], two[both])]
    for step in range(1, int(np.bincount(met[:, 1]).max(initial=1))):
        same = met[step:, 1] == met[:-step, 1]
        across.append((met[:-step, 0][same], met[step:, 0][same]))
    return np.concatenate([a for a, _ in across]), np.concatenate([b for _, b in across])


def place_mm(corners: Array) -> str:
    """The middle of corners (..., 3) in millimetres."""
    return ", ".join(f"{1e3 * x:.4g}" for x in corners.reshape(-1, 3).mean(0))
