"""Registration by other libraries, on the same terms as ours: the rim of a contact against the object's surface near it.

Each gets the rim and the surface in millimetres, and the reach that ours has. A library that is not installed is left out.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib.util import find_spec
from typing import Any

import numpy as np

from geomtact.registration.contact_problem import near_surface
from geomtact.registration.observability import Spread
from geomtact.registration.surface import Surface
from geomtact.se3 import Array, inverse
from tools.studies.registration.study import End, Method, Seen

_MM = 1e3
_LOST = 10.0  # reaches from where it was, a contact is lost
# moves the rim (n, 3) onto points (m, 3) with normals (m, 3), within a reach, all in mm: (4, 4), None where it gives up
Align = Callable[[Array, Array, Array, float], Array | None]


def peers(surface: Surface, spread: Spread) -> dict[str, Method]:
    """Those methods whose libraries are installed, by name."""
    known: dict[str, tuple[str, Align]] = {
        "open3d point to plane": ("open3d", _open3d_plane),
        "open3d point to point": ("open3d", _open3d_point),
        "small_gicp point to plane": ("small_gicp", _small_gicp),
        "probreg point to point": ("probreg", _probreg_point),
        "probreg point to plane": ("probreg", _probreg_plane),
    }
    return {name: _method(align, surface, spread) for name, (package, align) in known.items() if find_spec(package)}


def _method(align: Align, surface: Surface, spread: Spread) -> Method:
    def refine(seen: Seen, start: Array) -> End:
        problem = seen.problem
        reach = 3 * spread.radius(problem.length) + 2 * problem.pitch
        points, normals = near_surface(surface, problem, start, reach)
        if len(points) < 6:
            return End(start, False)
        motion = align(_MM * problem.points, _MM * points, normals, _MM * reach)
        if motion is None or not np.isfinite(motion).all():
            return End(start, False)
        motion = np.array(motion, float)
        motion[:3, 3] /= _MM
        return End(inverse(motion) @ start, True)

    return refine


def _open3d_plane(rim: Array, points: Array, normals: Array, reach: float) -> Array | None:
    import open3d as o3d

    return _open3d(rim, points, normals, reach, o3d.pipelines.registration.TransformationEstimationPointToPlane())


def _open3d_point(rim: Array, points: Array, normals: Array, reach: float) -> Array | None:
    import open3d as o3d

    return _open3d(rim, points, normals, reach, o3d.pipelines.registration.TransformationEstimationPointToPoint())


def _open3d(rim: Array, points: Array, normals: Array, reach: float, estimation: object) -> Array | None:
    import open3d as o3d

    source, target = o3d.geometry.PointCloud(), o3d.geometry.PointCloud()
    source.points, target.points = (o3d.utility.Vector3dVector(p) for p in (rim, points))
    target.normals = o3d.utility.Vector3dVector(normals)
    result = o3d.pipelines.registration.registration_icp(source, target, reach, np.eye(4), estimation)
    return np.asarray(result.transformation) if result.fitness > 0 else None


def _small_gicp(rim: Array, points: Array, normals: Array, reach: float) -> Array | None:
    import small_gicp

    target, tree = small_gicp.preprocess_points(points, downsampling_resolution=1e-3, num_neighbors=10)
    source, _ = small_gicp.preprocess_points(rim, downsampling_resolution=1e-3, num_neighbors=10)
    result = small_gicp.align(
        target, source, tree, registration_type="PLANE_ICP", max_correspondence_distance=reach, max_iterations=30
    )
    return np.asarray(result.T_target_source) if result.num_inliers else None


def _probreg_point(rim: Array, points: Array, normals: Array, reach: float) -> Array | None:
    return _probreg(rim, points, None, "pt2pt", reach)


def _probreg_plane(rim: Array, points: Array, normals: Array, reach: float) -> Array | None:
    return _probreg(rim, points, normals, "pt2pl", reach)


def _probreg(rim: Array, points: Array, normals: Array | None, objective: str, reach: float) -> Array | None:
    from probreg import filterreg

    def stop_when_lost(motion: Any) -> None:
        # points far off, or nowhere, make its filter read memory that is not its own
        if not np.linalg.norm(motion.rot @ middle + motion.t - middle) < _LOST * reach:
            raise _Lost

    middle = rim.mean(0)
    try:
        result = filterreg.registration_filterreg(
            rim,
            points,
            normals,
            objective_type=objective,
            sigma2=(reach / 3) ** 2,
            update_sigma2=True,
            callbacks=[stop_when_lost],
        )
    except _Lost:
        return None
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = result.transformation.rot, result.transformation.t
    return motion


class _Lost(Exception):
    """A registration that runs off."""
