"""Open3D's point-to-plane ICP for the rim of a contact, with checks of its own.

Open3D returns the start pose with rmse 0 when nothing corresponds, and moves freely in directions that the rim does not
constrain; so its result is checked by the rim's own measure, and kept only in observable directions.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from geomtact.registration.contact_problem import near_surface
from geomtact.registration.filterreg import ContactFilter
from geomtact.registration.fit import FEWEST
from geomtact.registration.observability import Spread
from geomtact.registration.protocol import Problem, Refinement
from geomtact.registration.surface import Surface
from geomtact.se3 import Array, check_transforms, inverse

_MAX_ITERATIONS = 20  # of Open3D at each distance; hand-set


@dataclass(frozen=True)
class Icp:
    """Refines poses of one object against the rim of a contact.

    Attributes
    ----------
    surface : the object's surface, points denser than the sensor's pixels
    spread : how far the start poses may be off
    """

    surface: Surface
    spread: Spread
    name: str = "icp"

    def refine(self, problem: Problem, T: Array) -> Refinement:
        """Refine the poses ``T`` (k, 4, 4) of the object in the problem's frame, one after the other."""
        start = check_transforms(T, "start pose").reshape(-1, 4, 4)
        with _one_thread():
            found = [self._register(problem, pose) for pose in start]
        met = np.array([pose is not None for pose in found], bool)
        ended = [first if pose is None else pose for first, pose in zip(start, found, strict=True)]
        sinks = np.zeros((len(start), problem.contacts))
        contact_filter = ContactFilter(problem, self.surface)
        return contact_filter.accept_or_revert(start, np.reshape(ended, (-1, 4, 4)), sinks, met, self.spread)

    def _register(self, problem: Problem, start: Array) -> Array | None:
        reach = 3 * self.spread.radius(problem.length) + 2 * problem.pitch
        points, normals = near_surface(self.surface, problem, start, reach)
        if len(points) < FEWEST:
            return None
        motion = _register(problem, points, normals, reach)
        # Open3D moves what was observed onto the surface; the object moves the other way
        return None if motion is None or not np.isfinite(motion).all() else inverse(motion) @ start


def _register(problem: Problem, points: Array, normals: Array, reach: float) -> Array | None:
    """(4, 4) that moves the rim onto the surface, first from afar, then close by; None where nothing corresponds."""
    import open3d as o3d

    registration = o3d.pipelines.registration
    rim, cloud = o3d.geometry.PointCloud(), o3d.geometry.PointCloud()
    # Open3D's tolerances are absolute, and about its origin, and made for metres of room: in units of a pixel about the
    # contact's centre they fit
    unit = problem.pitch
    anchors, axes = _anchors(problem, reach)
    rim.points = o3d.utility.Vector3dVector((np.concatenate([problem.points, anchors]) - problem.centre) / unit)
    cloud.points = o3d.utility.Vector3dVector((np.concatenate([points, anchors]) - problem.centre) / unit)
    cloud.normals = o3d.utility.Vector3dVector(np.concatenate([normals, axes]))
    motion, found = np.eye(4), False
    for within in (reach, 3 * problem.middle_noise + problem.pitch):
        result = registration.registration_icp(
            rim,
            cloud,
            within / unit,
            motion,
            registration.TransformationEstimationPointToPlane(registration.TukeyLoss(k=within / unit)),
            registration.ICPConvergenceCriteria(1e-4, 1e-4, _MAX_ITERATIONS),
        )
        if result.fitness == 0:
            break  # it diverged; Open3D reports that in no other way
        motion, found = np.array(result.transformation), True
    if not found:
        return None
    motion[:3, 3] = unit * motion[:3, 3] + problem.centre - motion[:3, :3] @ problem.centre
    return motion


@contextmanager
def _one_thread() -> Iterator[None]:
    """Open3D kept to one thread: several end their sums in another order each time, and with them the pose."""
    import open3d as o3d

    before = o3d.utility.get_max_threads()
    o3d.utility.set_max_threads(1)
    try:
        yield
    finally:
        o3d.utility.set_max_threads(before)


def _anchors(problem: Problem, reach: float) -> tuple[Array, Array]:
    """Points (9, 3) far from all surface and directions (9, 3) in which each is held where it is.

    A wall does not constrain motion along it; Open3D's normal equations are singular then, and its step is at random.
    Each anchor weighs as much as a rim point, which is little against the rim.
    """
    angle, up = 2 * np.pi / 9 * np.arange(9)[:, None], problem.outwards
    axes = np.linalg.svd(up[None])[2]  # the first along ``up``
    ring = (reach + problem.length) * (np.cos(angle) * axes[1] + np.sin(angle) * axes[2])
    return problem.centre + ring - 2 * reach * up, np.tile(axes, (3, 1))
