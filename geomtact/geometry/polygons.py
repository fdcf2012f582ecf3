"""The polygons of a mesh file, and the triangles that cover them: each is cut up in its own plane and keeps its corners."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from geomtact.errors import MeshError
from geomtact.se3 import Array

Indices = NDArray[np.int64]

# Of a polygon's extent: by which its corners lie beside where they are meant, in files that hold seven digits
_ROUNDING = 1e-6


@dataclass(frozen=True, eq=False)
class Polygons:
    """The faces of a file as it holds them. Lengths are in the file's unit, coordinates the file's own.

    Attributes
    ----------
    vertices : (V, 3)
    corners : (C,) indices into vertices, those of the first face, then those of the second, ...
    sizes : (P,) number of corners of each face
    warnings : what was assumed in reading, one line each
    """

    vertices: Array
    corners: Indices
    sizes: Indices
    warnings: tuple[str, ...] = ()

    @classmethod
    def of(cls, vertices: Array, faces: Sequence[Sequence[int]] | Indices, warnings: tuple[str, ...] = ()) -> Polygons:
        """Polygons of faces given one by one, or as an array (P, n)."""
        sizes = np.fromiter((len(face) for face in faces), np.int64, len(faces))
        corners = np.fromiter((corner for face in faces for corner in face), np.int64, int(sizes.sum()))
        return cls(np.asarray(vertices, float).reshape(-1, 3), corners, sizes, warnings)

    @cached_property
    def starts(self) -> Indices:
        """(P,) where each face begins in ``corners``."""
        return np.cumsum(self.sizes) - self.sizes

    @cached_property
    def face_of_corner(self) -> Indices:
        """(C,)"""
        return np.repeat(np.arange(len(self.sizes)), self.sizes)

    @cached_property
    def next_corner(self) -> Indices:
        """(C,) vertex that follows each corner around its face."""
        follows = np.arange(1, len(self.corners) + 1)
        follows[self.starts + self.sizes - 1] = self.starts
        return np.asarray(self.corners[follows])

    @cached_property
    def area_vectors(self) -> Array:
        """(P, 3) normals of the area's length, of which every triangulation has the same sum (Newell)."""
        origin = self.vertices[self.corners[self.starts]][self.face_of_corner]
        crosses = np.cross(self.vertices[self.corners] - origin, self.vertices[self.next_corner] - origin)
        return 0.5 * np.add.reduceat(crosses, self.starts) if len(crosses) else np.zeros((0, 3))

    def without_repeats(self) -> Polygons:
        """Without corners that repeat the one before, and then without faces of fewer than three corners."""
        if not len(self.sizes):
            return self
        some = self if self.sizes.all() else replace(self, sizes=self.sizes[self.sizes > 0])
        kept = some.corners != some.next_corner
        sizes = np.bincount(some.face_of_corner[kept], minlength=len(some.sizes))
        face = np.repeat(sizes > 2, sizes)
        return replace(self, corners=some.corners[kept][face], sizes=sizes[sizes > 2])

    def thickness(self) -> Array:
        """(P,) how far the corners of each face reach across its plane: 0 where it is flat.

        Of four corners it is the distance between the two surfaces that they may mean, one for each diagonal.
        """
        if (self.sizes == 3).all():
            return np.zeros(len(self.sizes))
        length = np.linalg.norm(self.area_vectors, axis=1, keepdims=True)
        normals = self.area_vectors / np.where(length > 0, length, 1)
        origin = self.vertices[self.corners[self.starts]][self.face_of_corner]
        heights = np.einsum("ij,ij->i", self.vertices[self.corners] - origin, normals[self.face_of_corner])
        return np.asarray(np.maximum.reduceat(heights, self.starts) - np.minimum.reduceat(heights, self.starts))

    def triangles(self) -> tuple[Indices, Indices]:
        """Triangles (F, 3) that cover every face once, and the face (F,) of each; no corner is left out, so that nothing opens.

        A fan from the first or second corner where that covers the face; else ears are cut off the face as it lies in its plane.
        Of a face that is not flat the plane is the one across its mean normal.

        Raises
        ------
        MeshError
            A face crosses itself.
        """
        if (self.sizes == 3).all():
            return self.corners.reshape(-1, 3), np.arange(len(self.sizes))
        faces, owners = [np.zeros((0, 3), np.int64)], [np.zeros(0, np.int64)]
        for n in np.unique(self.sizes).tolist():
            mine = np.flatnonzero(self.sizes == n)
            rings = self.corners[self.starts[mine][:, None] + np.arange(n)]
            for first in (0, 1):
                turned = np.roll(rings, -first, axis=1)
                covers = _fan_covers(self.vertices[turned], self.area_vectors[mine])
                faces.append(_fan(turned[covers]))
                owners.append(np.repeat(mine[covers], n - 2))
                rings, mine = rings[~covers], mine[~covers]
            faces += [self._cut_up(ring, face) for ring, face in zip(rings, mine.tolist(), strict=True)]
            owners.append(np.repeat(mine, n - 2))
        owner = np.concatenate(owners)
        order = np.argsort(owner, kind="stable")
        return np.concatenate(faces)[order], owner[order]

    def _cut_up(self, ring: Indices, face: int) -> Indices:
        """Triangles (n - 2, 3) of one face, of corners ``ring`` (n,)."""
        points = self.vertices[ring] - self.vertices[ring].mean(0)
        extent, width, _ = np.linalg.svd(points, compute_uv=False)[:3]
        if width <= _ROUNDING * extent:  # all on a line: without area, but its neighbours meet there
            return _fan(ring[None])
        from manifold3d import triangulate

        normal = self.area_vectors[face]
        area = float(np.linalg.norm(normal))
        rounding = _ROUNDING * extent**2
        if area > rounding:
            across = np.linalg.svd(normal[None])[2]
            flat = points @ (across[[1, 2]] if np.linalg.det(across) * (across[0] @ normal) > 0 else across[[2, 1]]).T
            cut = np.asarray(triangulate([flat]), np.int64)
            (a, b, c) = np.moveaxis(flat[cut], 1, 0)
            areas = 0.5 * _cross2(b - a, c - a)
            if len(cut) == len(ring) - 2 and areas.min() >= -rounding and areas.sum() <= area + rounding:
                return np.asarray(ring[cut])
        where = ", ".join(f"{x:.4g}" for x in self.vertices[ring].mean(0))
        raise MeshError(
            f"face {face + 1}, of {len(ring)} corners about ({where}), crosses itself, so what it covers is not certain; "
            "cut it into triangles in the program that made it"
        )


def edges_of(faces: NDArray[np.integer]) -> NDArray[np.integer]:
    """The edges (3 F, 2) of triangles (F, 3), as they go round them: all first ones, all second ones, all third ones."""
    return np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])


def edge_table(
    faces: NDArray[np.integer],
) -> tuple[NDArray[np.intp], NDArray[np.int64], NDArray[np.intp], NDArray[np.intp]]:
    """The edges of triangles (F, 3), gathered by the two corners that they join.

    Returns
    -------
    face : (3 F,) that has the edge
    way : (3 F,) 1 where it goes from the lower to the higher corner, else -1
    start : (E,) where each group of edges of the same corners begins
    uses : (E,) how many there are in each
    """
    edges = edges_of(faces)
    ends = np.sort(edges, axis=1)
    order = np.lexsort(ends.T)
    ends, way = ends[order], np.where(edges[:, 0] < edges[:, 1], 1, -1)[order]
    start = np.flatnonzero(np.concatenate([[True], (ends[1:] != ends[:-1]).any(1)]))
    return order % len(faces), way, start, np.diff(np.append(start, len(ends)))


def _fan(rings: Indices) -> Indices:
    """Triangles (m (n - 2), 3) of faces ``rings`` (m, n), all from their first corners."""
    n = rings.shape[1]
    first = np.repeat(rings[:, :1], n - 2, axis=1)
    return np.stack([first, rings[:, 1:-1], rings[:, 2:]], axis=-1).reshape(-1, 3)


def _fan_covers(points: Array, area_vectors: Array) -> NDArray[np.bool_]:
    """Of which faces (m, n, 3) a fan from the first corner covers each place once (m,): all its triangles are wound as the face,
    with a share of its area that rounding does not make, and they go less than once around that corner."""
    area = np.linalg.norm(area_vectors, axis=1, keepdims=True)
    arms = points[:, 1:] - points[:, :1]
    normals = area_vectors / np.where(area > 0, area, 1)
    across = np.einsum("mij,mj->mi", np.cross(arms[:, :-1], arms[:, 1:]), normals)
    along = np.einsum("mij,mij->mi", arms[:, :-1], arms[:, 1:])
    turn = np.arctan2(across, along).sum(1)
    return np.asarray((across > 2 * _ROUNDING * area).all(1) & (turn < 2 * np.pi - _ROUNDING))


def _cross2(a: Array, b: Array) -> Array:
    return np.asarray(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
