"""Whether a part goes into a fixture: a recess of its own shape, wider by a clearance on all sides."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from geomtact.geometry.mesh import Mesh
from geomtact.se3 import Array, apply

_FEW, _HOPELESS = 200, 6e-3  # points that are asked first, and the clearance [m] beyond which no others are


@dataclass(frozen=True, eq=False)
class Fixture:
    """A recess of the shape of ``mesh``, in the frame of ``mesh``, before it is widened; ``n`` points judge what fits."""

    mesh: Mesh
    n: int = 5000  # a hole of 4 mm in a part of 120 mm shall not slip between the points

    @cached_property
    def points(self) -> Array:
        """Points all over the surface, and corners of its hull, which reach farthest out (m, 3) [m]; in no order."""
        from scipy.spatial import ConvexHull

        corners = self.mesh.vertices[ConvexHull(self.mesh.vertices).vertices]
        points, rng = self.mesh.surface_points(self.n), np.random.default_rng(0)
        return rng.permutation(np.concatenate([points, rng.permutation(corners)[: self.n // 5]]))

    @cached_property
    def _scene(self) -> Any:
        import open3d as o3d

        scene = o3d.t.geometry.RaycastingScene()
        corners = (self.mesh.vertices - self.mesh.centre).astype(np.float32)
        scene.add_triangles(
            o3d.core.Tensor.from_numpy(corners), o3d.core.Tensor.from_numpy(self.mesh.faces.astype(np.uint32))
        )
        return scene

    def clearance_needed(self, T_fixture_part: ArrayLike) -> Array:
        """How far (n,) [m] the part at ``T_fixture_part`` (n, 4, 4) reaches out of the recess before it is widened.

        The largest signed distance of the part's surface from the nominal one; where that is hopelessly large, of a few of its
        points. Images under the part's symmetry need the same, without its being known.
        """
        T = np.asarray(T_fixture_part, float).reshape(-1, 4, 4)
        out = self._farthest(T, self.points[:_FEW])
        near = out <= _HOPELESS
        out[near] = self._farthest(T[near], self.points)
        return out

    def _farthest(self, T: Array, points: Array) -> Array:
        """The largest signed distance (n,) [m] of ``points`` (m, 3), moved by ``T`` (n, 4, 4), from the nominal surface."""
        moved = (apply(T, points) - self.mesh.centre).astype(np.float32)
        return np.array([self._scene.compute_signed_distance(p).numpy().max() for p in moved], float)
