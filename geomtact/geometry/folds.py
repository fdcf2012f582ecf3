"""Faces that are folded back onto their neighbours in one plane, as a fan makes of a polygon that is not convex."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geomtact.geometry.polygons import edges_of
from geomtact.se3 import Array

# By how much corners may lie beside a common plane: of the size the last of six digits, as text is written with, and of the
# farthest coordinate a few times what single precision rounds away
_OF_SIZE, _OF_REACH = 1e-5, 2.5e-7
# Sine of the angle between folded faces: no blade is that sharp, and where boolean operations leave slivers of some
# micrometres, their wedges are from 0.005 on
_ANGLE = 1e-3


def folded_faces(vertices: Array, faces: NDArray[np.integer]) -> NDArray[np.intp]:
    """The faces (n,) that are folded over their neighbours in one plane: of each two coplanar pieces of surface that lie on the
    same side of a shared edge and look opposite ways, the one with less area.

    Edges of more than two faces are where bodies touch: nothing is a fold there. Faces without width are looked across.

    Parameters
    ----------
    vertices : (V, 3)
    faces : (F, 3) indices into vertices, wound alike
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

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
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    n = len(faces)
    edges = np.sort(edges_of(faces), axis=1)
    order = np.lexsort(edges.T)
    edges, owner = edges[order], order % n
    first = np.concatenate([[True], (edges[1:] != edges[:-1]).any(1)])
    start = np.flatnonzero(first)
    pairs = start[np.diff(np.append(start, len(edges))) == 2]
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
