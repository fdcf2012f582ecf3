"""A triangle surface as a file holds it, in the file's own unit, and what can be counted on it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from geomtact.geometry.polygons import Polygons

Array = NDArray[np.float64]
Faces = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Surface:
    """Triangles, closed or not. Lengths are in the file's unit, coordinates the file's own.

    Attributes
    ----------
    vertices : (V, 3)
    faces : (F, 3) indices into vertices
    polygons : the faces of the file as it holds them, if they were read; with their own vertices
    owner : (F,) which of the polygons each face is of
    """

    vertices: Array
    faces: Faces
    polygons: Polygons | None = None
    owner: Faces | None = None

    @cached_property
    def corners(self) -> Array:
        """(F, 3, 3)"""
        return self.vertices[self.faces]

    @cached_property
    def crosses(self) -> Array:
        """(F, 3) normals of twice the area's length."""
        a, b, c = np.moveaxis(self.corners, 1, 0)
        return np.asarray(np.cross(b - a, c - a))

    @cached_property
    def areas(self) -> Array:
        return 0.5 * np.linalg.norm(self.crosses, axis=1)

    @cached_property
    def bounds(self) -> tuple[Array, Array]:
        """Least and largest coordinates (3,), (3,) of the vertices that faces use."""
        used = self.vertices[np.unique(self.faces)]
        return used.min(0), used.max(0)

    @property
    def size(self) -> float:
        """Diagonal of the bounding box."""
        low, high = self.bounds
        return float(np.linalg.norm(high - low))

    @property
    def middle(self) -> Array:
        low, high = self.bounds
        return np.asarray(0.5 * (high + low))

    @cached_property
    def half_edges(self) -> tuple[Faces, NDArray[np.int64], NDArray[np.int64]]:
        """Every face's three edges (3 F, 2) as walked, the number (3 F,) of the undirected edge of each, and how many half-edges
        each of those has."""
        edges = np.concatenate([self.faces[:, [0, 1]], self.faces[:, [1, 2]], self.faces[:, [2, 0]]])
        _, number, uses = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True, return_counts=True)
        return edges, number.ravel(), uses

    @cached_property
    def open_edges(self) -> int:
        """Edges of one face, or of another odd number."""
        return int((self.half_edges[2] % 2 == 1).sum())

    @cached_property
    def open_half_edges(self) -> NDArray[np.int64]:
        """Which of the half-edges (m,) run along open edges."""
        _, number, uses = self.half_edges
        return np.flatnonzero(uses[number] % 2 == 1)

    @cached_property
    def crowded_edges(self) -> int:
        """Edges of more than two faces."""
        return int((self.half_edges[2] > 2).sum())

    @cached_property
    def _walked(self) -> NDArray[np.float64]:
        """How much oftener each edge is walked one way than the other."""
        edges, number, _ = self.half_edges
        return np.bincount(number, np.where(edges[:, 0] < edges[:, 1], 1, -1))

    @property
    def torn_edges(self) -> int:
        """Edges that are not walked as often one way as the other."""
        return int((self._walked != 0).sum())

    @property
    def coherent(self) -> bool:
        """Whether no two faces walk an edge that they share the same way."""
        return bool((np.abs(self._walked) <= self.half_edges[2] % 2).all())

    @cached_property
    def bodies(self) -> NDArray[np.int64]:
        """Which body (F,) each face belongs to, connected by edges."""
        return label_faces(self.faces)

    @cached_property
    def volumes(self) -> Array:
        """Signed volume of each body."""
        a, b, c = np.moveaxis(self.corners - self.middle, 1, 0)
        return np.bincount(self.bodies, np.einsum("ij,ij->i", a, np.cross(b, c)) / 6)

    @property
    def volume(self) -> float:
        return float(self.volumes.sum())

    @property
    def area(self) -> float:
        return float(self.areas.sum())

    @cached_property
    def contained(self) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Of a closed surface, which body (n, n) of the column contains that of the row, and which pass through each other."""
        n = len(self.volumes)
        contains, crosses = np.zeros((n, n), bool), np.zeros((n, n), bool)
        own = [np.unique(self.faces[self.bodies == k]) for k in range(n)]
        low, high = (np.array([f(self.vertices[some], axis=0) for some in own]) for f in (np.min, np.max))
        for j in range(n):
            near = (low < high[j]).all(1) & (high > low[j]).all(1)
            near[j] = False
            if not near.any():
                continue
            alone = self.with_faces(self.faces[self.bodies == j])
            for k in np.flatnonzero(near):
                some = self.vertices[own[k][:: max(1, len(own[k]) // 50)]]
                # a little towards the body's own middle, so that what touches is not taken to lie inside
                inside = alone.encloses(some + 1e-4 * (some.mean(0) - some))
                contains[k, j], crosses[k, j] = inside.all(), inside.any() and not inside.all()
        return contains, crosses | crosses.T

    @cached_property
    def owners(self) -> NDArray[np.int64]:
        """Which body each body (n,) is part of: itself, or for a cavity the smallest that contains it."""
        owner = np.arange(len(self.volumes))
        for k in np.flatnonzero(self.volumes < 0):
            around = np.flatnonzero(self.contained[0][k] & (self.volumes > 0))
            if len(around):
                owner[k] = around[self.volumes[around].argmin()]
        return owner

    def encloses(self, points: Array) -> NDArray[np.bool_]:
        """Whether ``points`` (n, 3) lie inside, whichever direction the faces have."""
        scene, (middle, scale) = self.scene
        return scene.compute_occupancy(((points - middle) / scale).astype(np.float32), nsamples=3).numpy() > 0.5

    @cached_property
    def scene(self) -> tuple[Any, tuple[Array, float]]:
        """For rays, in single precision: the surface about its middle and in its size, and both."""
        import open3d as o3d

        scene = o3d.t.geometry.RaycastingScene()
        vertices = ((self.vertices - self.middle) / self.size).astype(np.float32)
        scene.add_triangles(o3d.core.Tensor(vertices), o3d.core.Tensor(self.faces.astype(np.uint32)))
        return scene, (self.middle, self.size)

    def with_faces(self, faces: Faces) -> Surface:
        """The same vertices with other faces."""
        return Surface(self.vertices, faces)

    def tidied(self) -> Surface:
        """Without vertices that no face uses."""
        kept, faces = np.unique(self.faces, return_inverse=True)
        return Surface(self.vertices[kept], faces.reshape(-1, 3))


def label_faces(faces: Faces) -> NDArray[np.int64]:
    """Number (F,) of the connected piece of each face, connected by vertices."""
    if not len(faces):
        return np.zeros(0, np.int64)
    pairs = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]]])
    n = int(faces.max()) + 1
    _, label = connected_components(
        coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), (n, n)), directed=False
    )
    return np.unique(label[faces[:, 0]], return_inverse=True)[1]
