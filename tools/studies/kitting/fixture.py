"""Whether an object goes into a fixture: a recess of its own shape that is open to above, wider by a clearance on all sides."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import trimesh
from numpy.typing import ArrayLike

from geomtact.geometry.approach import facing
from geomtact.geometry.mesh import Mesh, outermost
from geomtact.se3 import Array, apply

_FEW, _HOPELESS = 200, 6e-3  # points that are asked first, and the clearance [m] beyond which no others are
_AT_ONCE = 64  # points, the farthest out first, for which the way down is looked for
_AS_LOW, _RAYS = 0.005, 128  # of the diameter by which resting poses may differ in height; rays to a side
_STEP = 0.2e-3  # m of that way, at least, between two distances: what is told is too large by half of that at most


def upwards(mesh: Mesh) -> Array:
    """The direction (3,) that points up, in the object's frame, where the object rests with its centre of mass lowest.

    Of directions in which it rests about as low, as a round object may, the one in which its holes are least open to below.
    """
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces)
    poses, _ = trimesh.poses.compute_stable_poses(solid)
    heights = poses[:, 2, :3] @ solid.center_mass + poses[:, 2, 3]
    low = poses[heights <= heights.min() + _AS_LOW * mesh.diameter, 2, :3]
    scene = _scene(mesh)
    return np.asarray(low[np.argmax([_swept(scene, mesh.reach, up) for up in low])], float)


def _swept(scene: Any, reach: float, up: Array) -> float:
    """The volume that the object, which reaches so far [m] from the origin, sweeps on its way along ``up`` (3,), up to a constant
    and in units of its own."""
    s = np.linspace(-reach, reach, _RAYS)
    x, y, up = facing(-up)
    start = (s[:, None, None] * x + s[:, None] * y).reshape(-1, 3) - 2 * reach * up
    rays = np.concatenate([start, np.broadcast_to(up, start.shape)], 1).astype(np.float32)
    return float(np.maximum(4 * reach - scene.cast_rays(rays)["t_hit"].numpy(), 0).sum())


def _scene(mesh: Mesh) -> Any:
    """The object about its centre, for distances and rays."""
    import open3d as o3d

    scene = o3d.t.geometry.RaycastingScene()
    corners = (mesh.vertices - mesh.centre).astype(np.float32)
    scene.add_triangles(o3d.core.Tensor.from_numpy(corners), o3d.core.Tensor.from_numpy(mesh.faces.astype(np.uint32)))
    return scene


@dataclass(frozen=True, eq=False)
class Fixture:
    """A recess into which ``mesh`` is lowered, in the frame of ``mesh``, before it is widened; ``n`` points judge what fits.

    Its volume is what the object sweeps on its way up: where the object has a hole from side to side, nothing stands in it.

    Attributes
    ----------
    up : (3,) out of the recess; by default as the object rests lowest
    """

    mesh: Mesh
    n: int = 5000  # a hole of 4 mm in a part of 120 mm shall not slip between the points
    up: Array | None = None

    @cached_property
    def points(self) -> Array:
        """Points all over the surface, and corners of its hull, which reach farthest out (m, 3) [m]; in no order."""
        points, rng = self.mesh.surface_points(self.n), np.random.default_rng(0)
        return rng.permutation(np.concatenate([points, rng.permutation(outermost(self.mesh.vertices))[: self.n // 5]]))

    def clearance_needed(self, T_fixture_part: ArrayLike) -> Array:
        """How far (n,) [m] the object at ``T_fixture_part`` (n, 4, 4) reaches out of the recess before it is widened.

        The largest distance of the object's surface from what it sweeps on its way up, 0 where all of it lies inside; where that
        is hopelessly large, of a few of its points. Images under the object's symmetry need the same, without its being known.
        """
        T = np.asarray(T_fixture_part, float).reshape(-1, 4, 4)
        out = np.array([self._farthest(apply(each, self.points[:_FEW])) for each in T])
        for i in np.flatnonzero(out <= _HOPELESS):
            out[i] = self._farthest(apply(T[i], self.points), out[i])
        return out

    def _farthest(self, points: Array, least: float = 0.0) -> float:
        """The largest distance [m] of ``points`` (m, 3) from the swept volume, or ``least`` where that is larger."""
        # no point is farther from the swept volume than from the object
        distance = self._distance(points)
        order = np.argsort(-distance)
        for i in range(0, len(order), _AT_ONCE):
            some = order[i : i + _AT_ONCE]
            some = some[distance[some] > least]
            if not len(some):
                break
            least = max(least, float(self._from_swept(points[some], distance[some], least).max()))
        return least

    def _from_swept(self, points: Array, distance: Array, enough: float) -> Array:
        """Distance (m,) [m] from the swept volume of ``points`` (m, 3) that lie ``distance`` (m,) from the object; of
        those nearer than ``enough``, only that they are.

        |p - (q + t up)| = |(p - t up) - q|: the least distance of the object from the way that leads down from p.
        """
        best, gone = distance.copy(), np.zeros(len(points))
        height = (points - self._lowest) @ self._up
        todo = np.arange(len(points))
        while len(todo):
            gone[todo] += np.maximum(distance[todo] - best[todo], _STEP)  # nothing nearer lies between
            distance[todo] = self._distance(points[todo] - gone[todo, None] * self._up)
            best[todo] = np.minimum(best[todo], distance[todo])
            todo = todo[(best[todo] > enough) & (gone[todo] < height[todo])]
        return np.maximum(best, 0)

    def _distance(self, points: Array) -> Array:
        """Signed distance (m,) [m] of ``points`` (m, 3) from the object, negative inside."""
        return np.asarray(
            self._scene.compute_signed_distance((points - self.mesh.centre).astype(np.float32)).numpy(), float
        )

    @cached_property
    def _up(self) -> Array:
        up = upwards(self.mesh) if self.up is None else np.asarray(self.up, float)
        return np.asarray(up / np.linalg.norm(up))

    @cached_property
    def _lowest(self) -> Array:
        """The object's lowest vertex (3,)."""
        return np.asarray(self.mesh.vertices[(self.mesh.vertices @ self._up).argmin()])

    @cached_property
    def _scene(self) -> Any:
        return _scene(self.mesh)
