"""An object's surface in metres, in the frame of its own file."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from geomtact.errors import MeshError
from geomtact.geometry.symmetry import Symmetry, find_symmetry
from geomtact.se3 import Array


@dataclass(frozen=True, eq=False)
class Mesh:
    """A closed triangle mesh. Lengths are metres, in the object frame (the file's own coordinates).

    Attributes
    ----------
    vertices : (V, 3) float64 [m]
    faces : (F, 3) int32, wound so that normals point outwards
    name : catalogue name or the file's stem
    unit : unit of the file it came from
    path : the file, if any
    symmetry : the object's rotation symmetry; None means not looked for yet (see :meth:`with_symmetry`)
    warnings : what was assumed in reading the file, one line each; they come with every posterior
    """

    vertices: Array
    faces: NDArray[np.int32]
    name: str
    unit: str
    path: Path | None = None
    symmetry: Symmetry | None = None
    warnings: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        vertices = np.array(self.vertices, dtype="<f8", order="C")
        faces = np.array(self.faces, dtype="<i4", order="C")
        if vertices.ndim != 2 or vertices.shape[1] != 3 or faces.ndim != 2 or faces.shape[1] != 3:
            raise MeshError(f"mesh {self.name!r}: expected (V, 3) and (F, 3), got {vertices.shape} and {faces.shape}")
        vertices.flags.writeable = faces.flags.writeable = False
        object.__setattr__(self, "vertices", vertices)
        object.__setattr__(self, "faces", faces)

    def __repr__(self) -> str:
        return f"Mesh({self.name}, {len(self.faces):,} faces, read in {self.unit})"

    @cached_property
    def sha256(self) -> str:
        """Hash of the vertices in metres (little endian float64) and of the faces; not of name, path or unit."""
        digest = hashlib.sha256(repr((self.vertices.shape, self.faces.shape)).encode())
        digest.update(self.vertices.tobytes())
        digest.update(self.faces.tobytes())
        return digest.hexdigest()

    @cached_property
    def diameter(self) -> float:
        """Largest distance between two points of the mesh [m]."""
        return _largest_distance(outermost(self.vertices))

    @cached_property
    def centre(self) -> Array:
        """(3,) [m]: where rotations of the object are best centred: the symmetry's centre, else the bounding box's."""
        if self.symmetry is not None and self.symmetry.kind != "none":
            return self.symmetry.centre
        return 0.5 * (self.vertices.min(0) + self.vertices.max(0))

    @cached_property
    def radius_rms(self) -> float:
        """Area-weighted root mean square distance of the surface from :attr:`centre` [m]."""
        corners = self.vertices[self.faces] - self.centre
        # The mean of |p|^2 over a triangle is (|a|^2 + |b|^2 + |c|^2 + |a+b+c|^2) / 12.
        mean_square = ((corners**2).sum((1, 2)) + (corners.sum(1) ** 2).sum(1)) / 12
        return float(np.sqrt(np.average(mean_square, weights=self.areas)))

    @cached_property
    def reach(self) -> float:
        """Largest distance of the surface from :attr:`centre` [m]."""
        return float(np.linalg.norm(self.vertices - self.centre, axis=1).max())

    @cached_property
    def areas(self) -> Array:
        """(F,) area of each face [m^2]."""
        return 0.5 * np.linalg.norm(self._crosses, axis=1)

    @cached_property
    def normals(self) -> Array:
        """(F, 3) outward unit normal of each face (zero for a face without area)."""
        length = np.linalg.norm(self._crosses, axis=1, keepdims=True)
        return self._crosses / np.where(length > 0, length, 1.0)

    @cached_property
    def _crosses(self) -> Array:
        a, b, c = np.moveaxis(self.vertices[self.faces], 1, 0)
        return np.cross(b - a, c - a)

    def sample_surface(self, n: int, seed: int = 0) -> tuple[Array, Array]:
        """``n`` points uniform over the surface (n, 3) [m], and the outward unit normals there (n, 3)."""
        rng = np.random.default_rng(seed)
        face = rng.choice(len(self.faces), size=n, p=self.areas / self.areas.sum())
        u, v = rng.random((2, n, 1))
        fold = u + v > 1
        u, v = np.where(fold, 1 - u, u), np.where(fold, 1 - v, v)
        a, b, c = np.moveaxis(self.vertices[self.faces[face]], 1, 0)
        return a + u * (b - a) + v * (c - a), self.normals[face]

    def surface_points(self, n: int, seed: int = 0) -> Array:
        """``n`` points uniform over the surface (n, 3) [m]: those of :meth:`sample_surface`."""
        return self.sample_surface(n, seed)[0]

    def with_symmetry(self, tolerance: float = 5e-5) -> Mesh:
        """This mesh with its symmetry found (``tolerance`` in metres), or itself if it was found already."""
        if self.symmetry is not None:
            return self
        return replace(self, symmetry=find_symmetry(self.vertices, self.faces, tolerance))


def coarser(mesh: Mesh, faces: int) -> Mesh:
    """The mesh with ``faces`` faces at most, by quadric decimation; itself where it has no more."""
    if len(mesh.faces) <= faces:
        return mesh
    import open3d as o3d

    vertices, triangles = (
        o3d.utility.Vector3dVector(mesh.vertices.copy()),
        o3d.utility.Vector3iVector(mesh.faces.copy()),
    )
    some = o3d.geometry.TriangleMesh(vertices, triangles).simplify_quadric_decimation(faces)
    return replace(mesh, vertices=np.asarray(some.vertices), faces=np.asarray(some.triangles))


def outermost(points: Array) -> Array:
    """Those of ``points`` (n, 3) that are corners of their convex hull (m, 3): none of the others reaches farther out."""
    from scipy.spatial import ConvexHull

    return points[ConvexHull(points).vertices]


def _largest_distance(points: Array) -> float:
    """Largest distance between two of ``points`` (n, 3)."""
    radius = np.linalg.norm(points - 0.5 * (points.min(0) + points.max(0)), axis=1)
    far, best = points[radius.argmax()], 0.0
    for _ in range(4):  # a few sweeps to the farthest point come close to the answer
        distance = np.linalg.norm(points - far, axis=1)
        far, best = points[distance.argmax()], max(best, float(distance.max()))
    # Only a point whose distance to the centre and the largest such one sum to more can do better.
    for p in points[radius + radius.max() > best * (1 + 1e-9)]:
        best = max(best, float(np.linalg.norm(points - p, axis=1).max()))
    return best
