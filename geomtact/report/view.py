"""A picture of the object on the sensor's window, by casting parallel rays from beside the sensor."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geomtact.geometry.mesh import Mesh
from geomtact.se3 import Array, apply
from geomtact.sensing.scene import scene_of
from geomtact.sensing.sensor import Sensor

_PART, _WINDOW, _BACKGROUND = np.array([0.72, 0.75, 0.80]), np.array([0.0, 0.45, 0.70]), np.array([1.0, 1.0, 1.0])
_WINDOW_OPACITY = 0.35
_SHOWN = 4  # diagonals of the window around it, within which the object is shown
# The viewer stands beyond the image's top edge, so x points right and z up, a little to the left of the middle.
_TOWARDS_VIEWER = np.array([-0.45, -0.75, 0.5])


@dataclass(frozen=True)
class PartView:
    """A picture and how to draw upon it.

    Attributes
    ----------
    image : (n, n, 3) RGB in 0..1
    extent : (left, right, bottom, top) [mm]
    axes : (2, 3) maps points of the sensor frame [mm] to the picture's (right, up) [mm]
    """

    image: NDArray[np.float64]
    extent: tuple[float, float, float, float]
    axes: Array

    def place(self, points_mm: Array) -> Array:
        """Where points (n, 3) of the sensor frame [mm] are in the picture (n, 2) [mm]."""
        return np.asarray(points_mm, float) @ self.axes.T


class Painter:
    """Draws one object at several poses; its ray caster is built once."""

    def __init__(self, mesh: Mesh, sensor: Sensor, pixels: int = 300):
        self.mesh, self.sensor, self.pixels = mesh, sensor, pixels
        self._centre = 0.5 * (mesh.vertices.min(0) + mesh.vertices.max(0))
        self._scene = scene_of((mesh.vertices - self._centre).astype(np.float32)[mesh.faces])

    def paint(self, T_sensor_object: Array) -> PartView:
        """The object at ``T_sensor_object`` (4, 4), with the sensor's window; far ends of a very long object are cut off."""
        back = _TOWARDS_VIEWER / np.linalg.norm(_TOWARDS_VIEWER)
        right = np.cross([0.0, 0.0, 1.0], back)
        right /= np.linalg.norm(right)
        plane = np.stack([right, np.cross(back, right)])
        window = 2 * float(np.hypot(*self.sensor.half_window))
        placed = apply(T_sensor_object, self.mesh.vertices)
        distance = np.linalg.norm(placed, axis=1)
        near, far = placed[distance < _SHOWN * window], 2 * float(distance.max()) + window
        corners = np.concatenate([near, self.sensor.corners]) @ plane.T
        middle = 0.5 * (corners.min(0) + corners.max(0))
        half = 0.53 * float(np.ptp(corners, axis=0).max())
        steps = (np.arange(self.pixels) + 0.5) / self.pixels * 2 - 1
        u, v = np.meshgrid(middle[0] + half * steps, middle[1] - half * steps)
        image = self._shade(T_sensor_object, u.ravel(), v.ravel(), plane, back, far)
        extent = tuple(1e3 * np.array([middle[0] - half, middle[0] + half, middle[1] - half, middle[1] + half]))
        return PartView(image.reshape(self.pixels, self.pixels, 3), extent, plane)

    def _shade(self, T: Array, u: Array, v: Array, plane: Array, back: Array, far: float) -> Array:
        start = u[:, None] * plane[0] + v[:, None] * plane[1] + far * back
        R = T[:3, :3]
        origin = ((start - T[:3, 3]) @ R - self._centre).astype(np.float32)
        direction = np.broadcast_to((-back @ R).astype(np.float32), origin.shape)
        hit = self._scene.hits(origin, np.ascontiguousarray(direction))
        found = hit.face >= 0
        normal = self.mesh.normals[np.where(found, hit.face, 0)] @ R.T
        light = 0.35 + 0.5 * np.abs(normal @ back) + 0.15 * np.clip(normal[:, 2], 0, 1)
        image = np.where(found[:, None], light[:, None] * _PART, _BACKGROUND)
        # the window: where the ray meets the plane z = 0
        t = start[:, 2] / back[2]
        on_window = (np.abs((start - t[:, None] * back)[:, :2]) <= self.sensor.half_window).all(1)
        in_front = on_window & (t < hit.t)
        behind = on_window & ~in_front
        image[in_front] += _WINDOW_OPACITY * (_WINDOW - image[in_front])
        image[behind] += 0.25 * _WINDOW_OPACITY * (_WINDOW - image[behind])
        return np.clip(image, 0, 1)
