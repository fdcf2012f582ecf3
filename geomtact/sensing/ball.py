"""The gel under a ball, as the sensor's camera sees it: how deep it is and how it slopes at each pixel, and the ball of a slope.

A pixel looks through ``xy`` at z = 0. A near camera sees what lies ``below`` that plane, at ``xy`` (1 - below / camera distance),
so that the deepest point of a press beside the window's middle is seen farther out than the middle of its imprint.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geomtact.se3 import Array
from geomtact.sensing.colour import terms
from geomtact.sensing.press import Press
from geomtact.sensing.sensor import Sensor

_STEPS = 20  # of a pixel's ray towards the ball, or of a diameter towards what it says of depths


@dataclass(frozen=True, eq=False)
class OnBall:
    """Pixels of a press that lie on the ball.

    Attributes
    ----------
    at : rows and columns (n,) each
    features : (n, ``TERMS``) of their changes of colour
    xy : (n, 2) of each pixel at z = 0 [m]
    middle : (3,) of the imprint, on the membrane at rest [m]
    imprint : its radius, where the ball meets the membrane at rest [m]
    sensor : that sees them
    """

    at: tuple[NDArray[np.int64], NDArray[np.int64]]
    features: Array
    xy: Array
    middle: Array
    imprint: float
    sensor: Sensor

    @classmethod
    def within(cls, press: Press, sensor: Sensor, share: float) -> OnBall:
        """Those that are within ``share`` of the imprint's radius from its middle."""
        off = from_middle(press, sensor)
        v, u = np.nonzero(np.linalg.norm(off, axis=-1) < share * press.radius * sensor.pixel_pitch[0])
        middle = sensor.lift(sensor.from_pixels(press.centre))
        return cls(
            (v, u),
            terms(press.change[v, u], u, v, press.mask.shape),
            sensor.from_pixels(np.stack([u, v], 1)),
            middle,
            press.radius * sensor.pixel_pitch[0] * (1 + middle[2] * _nearness(sensor)),
            sensor,
        )

    def centre(self, radius: float) -> Array:
        """Centre (3,) [m] of a ball of ``radius`` [m]: over the imprint's middle, along the membrane's normal there."""
        rim, bend = min(self.imprint, 0.99 * radius), self.sensor.membrane_radius
        above = float(np.sqrt(radius**2 - rim**2))
        if not bend:
            return np.array([*self.middle[:2], above])
        inner = np.array([0.0, 0.0, -bend])  # centre of the membrane's sphere
        return np.asarray(inner + (self.middle - inner) / bend * (np.sqrt(bend**2 - rim**2) + above))

    def height(self, radius: float) -> Array:
        """Depth (n,) [m] below the membrane at rest under a ball of ``radius`` [m] that meets it at the imprint."""
        seen, below = self._seen(radius)
        return np.asarray(below - self.sensor.sag(*seen.T))

    def slopes(self, radius: float) -> Array:
        """Slope (n, 2) of that depth along x and y, from pixel to pixel: metres of depth per metre at z = 0."""
        seen, below = self._seen(radius)
        off = seen - self.centre(radius)[:2]
        ball = -off / np.sqrt(radius**2 - np.minimum((off**2).sum(-1, keepdims=True), (0.99 * radius) ** 2))
        return self._as_seen(below, ball, ball - self._rest(seen))

    def diameter(self, slopes: Array) -> float:
        """Diameter [m] of the ball that the membrane slopes so (n, 2) under, from pixel to pixel; NaN where it does not dip."""
        seen, below = self.xy, np.zeros(len(self.xy))
        out = self._diameter(slopes, seen, below)
        if not self.sensor.camera_distance:
            return out
        for _ in range(_STEPS):  # how deep a pixel looks follows from the ball that it looks at
            if not 0.5 * out > 1.01 * np.linalg.norm(self.xy - self.middle[:2], axis=1).max():
                break
            out = self._diameter(slopes, *self._seen(0.5 * out))
        return out

    def _diameter(self, slopes: Array, seen: Array, below: Array) -> float:
        """As :meth:`diameter`, of pixels that look at ``seen`` (n, 2), so far ``below`` (n,) z = 0."""
        near, rest = _nearness(self.sensor), self._rest(seen)
        shrink = 1 - near * below[:, None]
        xy = self.xy
        ball = (slopes + shrink * rest) / (1 + near * _dot(xy, rest))  # of what lies below z = 0, from pixel to pixel
        along = _dot(xy, ball) / (shrink - near * _dot(xy, ball))
        return diameter_of(seen, ball * (1 + near * along) / shrink)

    def _seen(self, radius: float) -> tuple[Array, Array]:
        """Where (n, 2) each pixel's ray meets the ball, and how far below z = 0 (n,) [m]."""
        *centre, above = self.centre(radius)
        below = np.zeros(len(self.xy))
        for _ in range(_STEPS if self.sensor.camera_distance else 1):
            seen = self.xy * (1 - _nearness(self.sensor) * below[:, None])
            off2 = np.minimum(((seen - centre) ** 2).sum(1), (0.99 * radius) ** 2)
            below = np.sqrt(radius**2 - off2) - above
        return seen, below

    def _as_seen(self, below: Array, ball: Array, change: Array) -> Array:
        """``change`` (n, 2), of a depth per metre of the gel, per metre at z = 0, on a ``ball`` of such slopes (n, 2)."""
        near = _nearness(self.sensor)
        shrink = 1 - near * below[:, None]
        shown = shrink * ball / (1 + near * _dot(self.xy, ball))
        return np.asarray(shrink * change - near * shown * _dot(self.xy, change))

    def _rest(self, seen: Array) -> Array:
        """Slope (n, 2) of how far the membrane at rest lies below z = 0, at ``seen`` (n, 2)."""
        bend = self.sensor.membrane_radius
        if not bend:
            return np.zeros_like(seen)
        return np.asarray(seen / np.sqrt(bend**2 - (seen**2).sum(1, keepdims=True)))


def from_middle(press: Press, sensor: Sensor) -> Array:
    """Where each pixel (H, W, 2) lies from the imprint's middle [m], at z = 0."""
    row, column = np.mgrid[: press.mask.shape[0], : press.mask.shape[1]]
    return np.asarray(np.stack([column - press.centre[0], row - press.centre[1]], -1) * np.asarray(sensor.pixel_pitch))


def diameter_of(xy: Array, slope: Array) -> float:
    """Diameter [m] of the sphere that has depths of such ``slope`` (n, 2) at ``xy`` (n, 2) [m]; NaN where they do not dip."""
    sine = slope / np.sqrt(1 + (slope**2).sum(1))[:, None]  # -(xy - centre) / radius
    xy, sine = xy - xy.mean(0), sine - sine.mean(0)
    dips = -float((xy * sine).sum())
    return float(2 * (xy**2).sum() / dips) if dips > 0 else float("nan")


def _nearness(sensor: Sensor) -> float:
    """One over the camera's distance [1/m]; 0 of an orthographic one."""
    return 1 / sensor.camera_distance if sensor.camera_distance else 0.0


def _dot(a: ArrayLike, b: ArrayLike) -> Array:
    """(n, 1) of vectors (n, 2)."""
    return np.asarray((np.asarray(a) * np.asarray(b)).sum(-1, keepdims=True))
