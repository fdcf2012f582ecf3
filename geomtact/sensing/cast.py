"""Where an object touches a sensor at a pose, by ray casting (thesis 6.1.3).

A camera with the sensor's own optics looks through the gel; a pixel is in contact where the object comes nearer than
the membrane. Rays are cast in the object frame, so one Embree scene serves every pose.
"""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geomtact.geometry.mesh import outermost
from geomtact.se3 import Array, apply, inverse
from geomtact.sensing.contact import Contact
from geomtact.sensing.scene import MISSED, scene_of
from geomtact.sensing.sensor import Sensor
from geomtact.threads import thread_count

_RAYS_PER_CALL = 1 << 18
_OFF = 1e-6  # m from a surface, where a ray begins that must not meet it


class Caster:
    """Casts camera rays at one object.

    Parameters
    ----------
    vertices : (V, 3) object frame [m]
    faces : (F, 3) indices into vertices
    threads : how many batches of poses are cast at once (the GIL is released); by default ``threads.thread_count``

    Attributes
    ----------
    centre : (3,) of the object's bounding box, object frame [m]: the origin of what is in ``scene``
    scene : the object's triangles
    """

    def __init__(self, vertices: ArrayLike, faces: ArrayLike, threads: int | None = None):
        self.vertices, self.faces = np.asarray(vertices, float), np.asarray(faces)
        self.threads = thread_count() if threads is None else threads
        # Embree works in float32: rays start near the object's centre to keep 1e-8 m
        self.centre = 0.5 * (self.vertices.min(0) + self.vertices.max(0))
        self._radius = float(np.linalg.norm(self.vertices - self.centre, axis=1).max())
        self.scene = scene_of((self.vertices - self.centre).astype(np.float32)[self.faces])

    def __reduce__(self) -> tuple[Any, ...]:
        return Caster, (self.vertices, self.faces, self.threads)  # no scene can be pickled: it is made again

    def contact(self, sensor: Sensor, T_sensor_object: ArrayLike, shape: tuple[int, int] | None = None) -> Contact:
        """The contact at one pose ``T_sensor_object`` (4, 4): what the sensor would see, without noise.

        ``shape`` = (h, w) casts on a coarser grid over the same window; by default one ray per image pixel.
        """
        depth = self.depths(sensor, np.asarray(T_sensor_object, float)[None], shape)[0]
        mask = depth > 0
        return Contact(mask, np.where(mask, depth, 0).astype(np.float32))

    def depths(self, sensor: Sensor, T: ArrayLike, shape: tuple[int, int] | None = None) -> NDArray[np.float32]:
        """How far below the membrane the object lies along each camera ray: (n, h, w) [m] for poses ``T`` (n, 4, 4) of the object
        in the sensor's frame.

        Negative where the object stays above the membrane, -inf where the ray misses it.
        """
        x, y = sensor.pixel_centres(shape)
        rays = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
        return self.ray_depths(sensor, T, rays).reshape(-1, len(y), len(x))

    def ray_depths(self, sensor: Sensor, T: ArrayLike, rays: ArrayLike) -> NDArray[np.float32]:
        """As :meth:`depths`, for the camera rays that cross z = 0 at ``rays`` (m, 2) [m]: (n, m)."""
        T, rays = np.asarray(T, float).reshape(-1, 4, 4), np.asarray(rays, float)
        out = np.full((len(T), len(rays)), -np.inf, np.float32)
        per_call = max(1, _RAYS_PER_CALL // max(1, len(rays)))
        parts = [slice(i, i + per_call) for i in range(0, len(T), per_call)]

        def work(part: slice) -> None:
            out[part] = self._cast(sensor, T[part], rays)

        if len(parts) < 2:
            for part in parts:
                work(part)
        else:
            with ThreadPoolExecutor(self.threads) as pool:
                list(pool.map(work, parts))
        return out

    def faces_met(self, sensor: Sensor, T: ArrayLike, shape: tuple[int, int]) -> NDArray[np.int64]:
        """Which face the camera ray through each pixel (h, w) meets first at pose ``T`` (4, 4); -1 for none."""
        x, y = sensor.pixel_centres(shape)
        rays = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
        origin, direction, _ = self.rays(sensor, np.asarray(T, float)[None], rays)
        return self.scene.faces(origin, direction).reshape(len(y), len(x))

    def penetration(self, sensor: Sensor, T: ArrayLike) -> Array:
        """Depth of the object's deepest point inside the window (n,) [m]: > 0 below the membrane.

        Exact for the mesh's vertices and to a quarter of a percent of the window between them; +inf where the camera
        sits inside the object, -inf where nothing of the object is in the window.
        """
        T = np.asarray(T, float).reshape(-1, 4, 4)
        out = np.full(len(T), -np.inf)
        inner = np.stack(np.meshgrid(*sensor.pixel_centres((48, 64))), -1).reshape(-1, 2)
        rays = np.concatenate([inner, _border(sensor)])
        for part in _slices(len(T), 256):
            out[part] = self.ray_depths(sensor, T[part], rays).max(1)
            pose, p = self._below(T[part], -out[part])
            seen = (np.abs(sensor.project(p)) <= sensor.half_window).all(-1)
            if sensor.camera_distance:
                seen &= p[:, 2] > -sensor.camera_distance
            depth = -p[:, 2] - sensor.sag(p[:, 0], p[:, 1])
            np.maximum.at(out[part], pose[seen], depth[seen])
            out[part][self._camera_inside(sensor, T[part])] = np.inf
        return out

    def gaps(self, points: Array, directions: Array) -> Array:
        """How far (n,) [m] it is from ``points`` (n, 3) of the surface along unit ``directions`` (n, 3) to the surface again;
        +inf where it is not met."""
        rows = (points - self.centre + _OFF * directions, directions)
        far = self.scene.distances(*(np.ascontiguousarray(each, np.float32) for each in rows))
        return np.where(far > MISSED, np.inf, far.astype(float))

    def lowest_outside(self, sensor: Sensor, T: ArrayLike, below: float = 0.0) -> Array:
        """Lowest z (n,) [m] of the object's vertices outside the window, in the sensor frame; +inf if none is
        lower than ``below`` [m]."""
        T = np.asarray(T, float).reshape(-1, 4, 4)
        out = np.full(len(T), np.inf)
        # most poses are known to have none by the few vertices of the hull
        low = np.flatnonzero(((T[:, 2, :3] @ self._corners.T).min(1) + T[:, 2, 3]) < below)
        for rows in np.split(low, range(256, len(low), 256)):
            pose, p = self._below(T[rows], np.full(len(rows), below))
            outside = (np.abs(sensor.project(p)) > sensor.half_window).any(-1)
            np.minimum.at(out, rows[pose[outside]], p[outside, 2])
        return out

    @cached_property
    def _corners(self) -> Array:
        return outermost(self.vertices)

    def _below(self, T: Array, z: Array) -> tuple[NDArray[np.int64], Array]:
        """Vertices that lie below ``z`` (n,) [m] at poses ``T``: which pose (m,), and where (m, 3) in the sensor frame."""
        heights = T[:, 2, :3] @ self.vertices.T + T[:, 2, 3, None]
        pose, vertex = np.nonzero(heights < z[:, None])
        R = T[pose, :2, :3]
        xy = np.einsum("mij,mj->mi", R, self.vertices[vertex]) + T[pose, :2, 3]
        return pose, np.column_stack([xy, heights[pose, vertex]])

    def _cast(self, sensor: Sensor, T: Array, rays: Array) -> NDArray[np.float32]:
        origin, direction, below = self.rays(sensor, T, rays)
        t = self.scene.distances(origin, direction).reshape(len(T), len(rays))
        depth = t.astype(float)
        depth *= -(sensor.camera_distance or 1.0)
        depth += below[:, None]
        if sensor.membrane_radius:
            # a camera's rays spread: where they are when they have come so far
            scale = 1 - depth / sensor.camera_distance if sensor.camera_distance else 1.0
            with np.errstate(over="ignore", invalid="ignore"):
                depth -= sensor.sag(scale * rays[:, 0], scale * rays[:, 1])
        depth[t > MISSED] = -np.inf
        return depth.astype(np.float32)

    def rays(self, sensor: Sensor, T: Array, rays: Array) -> tuple[NDArray[np.float32], NDArray[np.float32], Array]:
        """Origins and directions (n m, 3) of rays in Embree's frame, and how far below the membrane's plane they start (n,) [m].

        A direction is so long that it nears that plane by the camera's distance, or by 1 m where there is no camera.
        """
        R = T[:, :3, :3]
        direction: Array | NDArray[np.float32]
        if sensor.camera_distance:
            below = np.full(len(T), sensor.camera_distance)
            direction = _combined(R, rays, sensor.camera_distance)
        else:
            # far enough below for every pose that reaches the membrane at all
            below = np.linalg.norm(apply(T, self.centre[None])[:, 0], axis=-1) + 2 * self._radius
            direction = R[:, 2, None]
        middle = np.einsum("ni,nij->nj", below[:, None] * [0.0, 0.0, -1.0] - T[:, :3, 3], R) - self.centre
        origin = middle[:, None] if sensor.camera_distance else middle[:, None] + _combined(R, rays, 0.0)
        return _of_every_ray(origin, len(rays)), _of_every_ray(direction, len(rays)), below

    def _camera_inside(self, sensor: Sensor, T: Array) -> NDArray[np.bool_]:
        if not sensor.camera_distance:
            return np.zeros(len(T), bool)
        camera = apply(inverse(T), np.array([[0.0, 0.0, -sensor.camera_distance]]))[:, 0] - self.centre
        # an odd direction, so that no ray runs along a face of a machined object
        direction = np.broadcast_to(np.array([0.41, 0.33, 0.85], np.float32), camera.shape)
        hit = self.scene.hits(camera.astype(np.float32), np.ascontiguousarray(direction))
        return np.asarray(((hit.normal * direction).sum(1) > 0) & (hit.face >= 0))


def _of_every_ray(x: Array | NDArray[np.float32], rays: int) -> NDArray[np.float32]:
    """``x`` (n, rays or 1, 3) as (n rays, 3), in single precision."""
    x = x.astype(np.float32, copy=False)
    return (np.repeat(x, rays, 1) if x.shape[1] == 1 else x).reshape(-1, 3)


def _combined(R: Array, rays: Array, z: float) -> NDArray[np.float32]:
    """Vectors (x, y, z) of the sensor, x and y of ``rays`` (m, 2), in the object frame (n, m, 3), for rotations ``R`` (n, 3, 3).

    In single precision, as Embree has it, and one component after the other: loops over three numbers each are slower.
    """
    R, (x, y) = R.astype(np.float32), rays.T.astype(np.float32)
    out = np.empty((len(R), len(x), 3), np.float32)
    for i in range(3):
        part = R[:, 0, i, None] * x
        part += R[:, 1, i, None] * y
        part += np.float32(z) * R[:, 2, i, None]
        out[..., i] = part
    return out


def _border(sensor: Sensor) -> Array:
    """Points (m, 2) along the window's border, a pixel apart, just inside."""
    half = sensor.half_window * (1 - 1e-6)
    n = max(sensor.image_size_px)
    s = np.linspace(-1, 1, n)
    one = np.ones(n)
    square = [np.stack(p, 1) for p in ((s, one), (s, -one), (one, s), (-one, s))]
    return np.concatenate(square) * half


def _slices(n: int, size: int) -> Iterator[slice]:
    for i in range(0, n, size):
        yield slice(i, i + size)
