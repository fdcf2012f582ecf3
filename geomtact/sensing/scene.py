"""Rays against one mesh: by Embree where embreex is installed, else by Open3D, which casts the same more slowly."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

Rays = NDArray[np.float32]
MISSED = 1e30  # beyond which a distance is none


@dataclass(frozen=True)
class Hits:
    """What m rays meet first.

    Attributes
    ----------
    t : (m,) how far, in lengths of the ray's direction; inf for nothing
    face : (m,) -1 for nothing
    normal : (m, 3) of the face, not normalised, by its corners' order
    """

    t: NDArray[np.float32]
    face: NDArray[np.int64]
    normal: NDArray[np.float32]


class RayScene(Protocol):
    """Rays (m, 3) from ``origin`` along ``direction``, single precision, which may be cast by several threads at once.

    A distance is beyond ``MISSED``, and a face -1, where nothing is met.
    """

    def distances(self, origin: Rays, direction: Rays) -> NDArray[np.float32]: ...
    def faces(self, origin: Rays, direction: Rays) -> NDArray[np.int64]: ...
    def hits(self, origin: Rays, direction: Rays) -> Hits: ...


def scene_of(corners: ArrayLike) -> RayScene:
    """A scene of triangles, their corners (f, 3, 3)."""
    triangles = np.ascontiguousarray(corners, np.float32)
    try:
        return _Embree(triangles)
    except ModuleNotFoundError:  # there are no wheels of embreex for 64-bit Arm
        return _Open3D(triangles)


class _Embree:
    def __init__(self, corners: NDArray[np.float32]):
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        self._scene = EmbreeScene()
        TriangleMesh(self._scene, corners)

    def distances(self, origin: Rays, direction: Rays) -> NDArray[np.float32]:
        return np.asarray(self._scene.run(origin, direction, query="DISTANCE"))

    def faces(self, origin: Rays, direction: Rays) -> NDArray[np.int64]:
        return np.asarray(self._scene.run(origin, direction, query="INTERSECT"), np.int64)

    def hits(self, origin: Rays, direction: Rays) -> Hits:
        hit = self._scene.run(origin, direction, output=True)
        face = np.asarray(hit["primID"], np.int64)
        return Hits(np.where(face < 0, np.inf, hit["tfar"]).astype(np.float32), face, hit["Ng"])


class _Open3D:
    def __init__(self, corners: NDArray[np.float32]):
        import open3d as o3d

        self._scene, self._corners = o3d.t.geometry.RaycastingScene(), corners
        faces = np.arange(3 * len(corners), dtype=np.uint32).reshape(-1, 3)
        self._tensor = o3d.core.Tensor.from_numpy
        self._scene.add_triangles(self._tensor(corners.reshape(-1, 3)), self._tensor(faces))

    def distances(self, origin: Rays, direction: Rays) -> NDArray[np.float32]:
        return np.asarray(self._cast(origin, direction)["t_hit"].numpy())

    def faces(self, origin: Rays, direction: Rays) -> NDArray[np.int64]:
        # what is missed is the largest number there is
        return self._cast(origin, direction)["primitive_ids"].numpy().astype(np.int32).astype(np.int64)

    def hits(self, origin: Rays, direction: Rays) -> Hits:
        found = self._cast(origin, direction)
        face = found["primitive_ids"].numpy().astype(np.int32).astype(np.int64)
        a, b, c = np.moveaxis(self._corners[np.maximum(face, 0)], 1, 0)
        return Hits(found["t_hit"].numpy(), face, np.cross(b - a, c - a))

    def _cast(self, origin: Rays, direction: Rays) -> dict[str, Any]:
        return self._scene.cast_rays(self._tensor(np.concatenate([origin, direction], 1)))
