"""The contact pose space itself, undiscretised (thesis 6.1.1): which poses touch, and poses drawn uniformly from it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geomtact.errors import MeshError
from geomtact.geometry.approach import NO_TILT, Approach, allowed, approach_of, check_approach, facing, in_cones
from geomtact.geometry.mesh import Mesh, outermost
from geomtact.se3 import Array, random_rotations, transform
from geomtact.sensing.cast import Caster
from geomtact.sensing.sensor import Sensor

# a pose settles to this, and so may press deeper than the gel allows, or not quite touch, by as much
_SETTLED = 1e-6  # m
_LOOKED_AT = 4096  # points of the surface, for what faces them
_STEEP = (0.0, 0.25, 0.7, 1.5, 4.0, 12.0)  # slopes along which the object's lowest part is bounded
# Poses cast at most: at any rate, and more for each that is asked for; and poses drawn for each of these
_FIRST, _MORE, _IDLE = 25_000, 20, 50


@dataclass(frozen=True)
class ContactSpace:
    """All poses at which the object's deepest point in the window lies 0 to ``max_penetration`` below the membrane,
    the housing is not entered, and the approach is allowed.

    Attributes
    ----------
    mesh, sensor
    approach : [(direction (3,) in the object frame, half angle [rad])], None for all
    """

    mesh: Mesh
    sensor: Sensor
    approach: Approach | None = None

    @cached_property
    def caster(self) -> Caster:
        return Caster(self.mesh.vertices, self.mesh.faces)

    @cached_property
    def _corners(self) -> Array:
        return outermost(self.mesh.vertices)

    @property
    def on_known_faces(self) -> bool:
        """Whether the approach leaves single directions, so that the object only turns and shifts on a face."""
        return self.cones is not None and max(half for _, half in self.cones) <= NO_TILT

    @cached_property
    def cones(self) -> list[tuple[Array, float]] | None:
        return check_approach(self.approach)

    @cached_property
    def hollow(self) -> float:
        """The share of the surface, of what may be approached, that faces another across a gap wider than the window: the sensor
        may fit in there, and no pose of it there is found by coming from outside (thesis 6.1.1, its footnote)."""
        points, normals = self.mesh.sample_surface(_LOOKED_AT)
        reached = allowed(normals, self.cones)
        gap = self.caster.gaps(points[reached], normals[reached])
        wide = np.isfinite(gap) & (gap > 2 * self.sensor.half_window.max())
        return float(wide.mean()) if len(gap) else 0.0

    def penetration(self, T: ArrayLike) -> Array:
        """Depth (n,) [m] of the deepest point in the window at ``T`` (n, 4, 4); NaN outside the contact pose space."""
        T = np.asarray(T, float).reshape(-1, 4, 4)
        depth = self.caster.penetration(self.sensor, T)
        inside = (depth >= -_SETTLED) & (depth <= self.sensor.max_penetration + _SETTLED)
        inside[inside] = self.admits(T[inside])
        return np.where(inside, np.clip(depth, 0, self.sensor.max_penetration), np.nan)

    def admits(self, T: ArrayLike) -> NDArray[np.bool_]:
        """Whether the approach and the sensor's housing allow the object at ``T`` (n, 4, 4), however deep it presses."""
        T = np.asarray(T, float).reshape(-1, 4, 4)
        allowed = self.approaches(T)
        if self.sensor.housing_depth is not None and allowed.any():
            lowest = self.caster.lowest_outside(self.sensor, T[allowed], -self.sensor.housing_depth - _SETTLED)
            allowed[allowed] = lowest == np.inf
        return allowed

    def settle(self, T: ArrayLike, depth: ArrayLike, steps: int = 30) -> tuple[Array, NDArray[np.bool_]]:
        """``T`` (n, 4, 4) moved along z until the deepest point in the window is ``depth`` (n,) [m] below the membrane.

        Returns the moved poses and whether each one touches so after at most ``steps`` casts.
        """
        T = np.array(T, float).reshape(-1, 4, 4)
        depth = np.broadcast_to(np.asarray(depth, float), len(T))
        ok = np.zeros(len(T), bool)
        too_high, too_low = np.full(len(T), np.inf), np.full(len(T), -np.inf)
        going = np.arange(len(T))
        for _ in range(steps):
            z = T[going, 2, 3]
            step = self.caster.penetration(self.sensor, T[going]) - depth[going]
            ok[going] = np.abs(step) < _SETTLED
            high = step < 0
            too_high[going[high]], too_low[going[~high]] = z[high], z[~high]
            # the camera sees a narrower window the deeper a point lies: a point at the edge leaves it as it is pressed in,
            # so the step is only trusted between a height that is too high and one that is too low
            with np.errstate(invalid="ignore"):
                middle = 0.5 * (too_high[going] + too_low[going])
            new = z + step
            trusted = (new < too_high[going]) & (new > too_low[going])
            new = np.where(trusted, new, middle)
            moving = np.isfinite(new) & ~ok[going] & (np.abs(new - z) > _SETTLED / 100)
            T[going[moving], 2, 3] = new[moving]
            going = going[moving]
            if not len(going):
                break
        return T, ok

    def sample(
        self, n: int, rng: np.random.Generator, depths: tuple[float, float] | None = None, batch: int = 128
    ) -> tuple[Array, Array]:
        """``n`` poses uniform over the contact pose space, by rejection: Haar times length along x and y times penetration,
        which is length along z wherever the deepest point stays in the window.

        Parameters
        ----------
        depths : penetration drawn uniformly from this range [m]; the whole of it by default

        Returns
        -------
        T_sensor_object : (n, 4, 4)
        penetration : (n,) [m]

        Raises
        ------
        MeshError
            Hardly any pose touches as the approach and the housing allow.
        """
        low, high = depths or (0.0, self.sensor.max_penetration)
        half = self.mesh.reach + self.sensor.half_window
        found: list[Array] = []
        pressed: list[Array] = []
        most, tried, drawn = _FIRST + _MORE * n, 0, 0
        while tried < most and drawn < _IDLE * most:
            R = self._rotations(batch, rng)
            depth = rng.uniform(low, high, batch)
            centre = np.zeros((batch, 3))
            centre[:, :2] = rng.uniform(-half, half, (batch, 2))
            # the object's lowest point is a first guess for where it meets the membrane
            centre[:, 2] = -(R[:, 2] @ (self.mesh.vertices - self.mesh.centre).T).min(1) - depth
            T = transform(R, centre - R @ self.mesh.centre)
            near = self._may_touch(T, depth)
            T, depth = T[near], depth[near]
            drawn, tried = drawn + batch, tried + len(T)
            T, ok = self.settle(T, depth)
            ok[ok] = np.isfinite(self.penetration(T[ok]))
            found.append(T[ok])
            pressed.append(depth[ok])
            if sum(map(len, found)) >= n:
                return np.concatenate(found)[:n], np.concatenate(pressed)[:n]
        raise MeshError(
            f"{self.mesh.name}: expected {n} poses that touch the sensor {self.sensor.name!r} as the approach and the housing "
            f"allow, found {sum(map(len, found))} among {drawn}; widen the approach, or check the object's unit"
        )

    def _may_touch(self, T: Array, depth: Array) -> NDArray[np.bool_]:
        """Whether any of the object may be in the window (n,) once it is moved along z from ``T`` (n, 4, 4) until its deepest
        point there is ``depth`` (n,) [m] below the membrane: the others need not be cast.

        Its lowest point of all may lie farther down, outside the window, but not below the housing. So the deepest one in the
        window belongs to the object's lowest part, up to ``above`` over its lowest point; and that part reaches no farther
        along x, or y, than the largest x - k (z - above) of the hull's corners, for any slope k >= 0 (weak duality).
        """
        sag = float(self.sensor.sag(*self.sensor.half_window))
        x, y, z = np.moveaxis(T[:, :3, :3] @ self._corners.T + T[:, :3, 3, None], 1, 0)
        steep: tuple[float, ...] = (0.0,)
        if self.sensor.housing_depth is not None:
            above = np.maximum(self.sensor.housing_depth - depth, sag) + 10 * _SETTLED
            z, steep = z - (z.min(1) + above)[:, None], _STEEP
        near = np.ones(len(T), bool)
        for along, half in zip((x, y), self.sensor.half_window + 10 * _SETTLED, strict=True):
            for way in (along, -along):
                near &= np.min([(way - k * z).max(1) for k in steep], 0) >= -half
        return near

    def approaches(self, T: Array) -> NDArray[np.bool_]:
        """Whether the approach allows poses ``T`` (n, 4, 4)."""
        if self.cones is None:
            return np.ones(len(T), bool)
        return allowed(approach_of(T[:, :3, :3]), self.cones)

    def _rotations(self, n: int, rng: np.random.Generator) -> Array:
        """Rotations (n, 3, 3) uniform over what the approach allows."""
        if self.cones is None:
            return random_rotations(n, rng)
        a = in_cones(self.cones, n, rng)
        turn = rng.uniform(0, 2 * np.pi, n)
        c, s, o = np.cos(turn), np.sin(turn), np.zeros(n)
        Rz = np.stack([c, -s, o, s, c, o, o, o, o + 1], -1).reshape(n, 3, 3)
        return Rz @ facing(a)
