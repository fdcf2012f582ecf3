"""Cells of one contact pose space seen from another sensor: which of its cells they fall into, and how much of them touches.

A cell is some degrees and millimetres wide, which moves a part by more at a second sensor than the gel is deep: the cell's
own pose seldom touches there, though a part of the cell does. So each cell counts by the share of it that touches.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from geomtact.contact_space.index import Index
from geomtact.se3 import Array, transform

# which of the places asked for, where each falls (place, height of the centre [m], how far beside it [m])
Placed = tuple[NDArray[np.int64], NDArray[np.int32], NDArray[np.float32], NDArray[np.float32]]
_CHUNK = 1 << 15  # places worked on at a time
_FAR = 3.0  # standard deviations beyond which nothing of a cell touches
_SPREAD = 1.2  # of heights over the other sensor, in units of what the steps of both grids come to


@dataclass(frozen=True)
class RigStd:
    """How well the pose of one sensor relative to another is known: standard deviations.

    Attributes
    ----------
    rotation : [rad]
    translation : [m]
    """

    rotation: float = 0.0
    translation: float = 0.0


@dataclass(frozen=True, eq=False)
class Carry:
    """Poses of ``here`` carried to the sensor of ``there``, which sees the same object.

    Attributes
    ----------
    here, there : contact pose spaces of one object
    T_there_here : (4, 4) of the sensor of ``here`` in the frame of that of ``there``
    rig : how well ``T_there_here`` is known
    """

    here: Index
    there: Index
    T_there_here: Array
    rig: RigStd = RigStd()

    @cached_property
    def std(self) -> float:
        """Standard deviation [m] of the object's height over the other sensor within a cell, at that sensor's own grid."""
        grids = (self.here, self.there)
        steps = sum((g.angle_step * g.mesh.radius_rms) ** 2 + g.resolution.step**2 for g in grids) / 12
        lever = float(np.linalg.norm(self.T_there_here[:3, 3]))
        rig = self.rig.translation**2 + (self.rig.rotation * lever) ** 2
        return float(np.sqrt(_SPREAD**2 * steps + rig))

    def shares(self, cells: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """The place (n,) of ``there`` that the pose of each of ``cells`` (n,) falls into, and which share (P, n) of the cell
        touches there at each of the P penetrations."""
        rotation = self._rotations_there(self.here.rotations)
        near, found, z, beside = self._near(*self._placed(slice(None), rotation, np.zeros(3, np.float32)))
        place = np.zeros(self.here.places, np.int64)
        share = np.zeros((len(self.there.height), self.here.places), np.float32)
        place[near], share[:, near] = found, self._shares(self.there.height[:, found].T, z, beside).T
        share[:, near] *= self.there.weight[:, found] > 0
        at = cells % self.here.places
        return place[at], share[:, at]

    def mean(self, density: NDArray[np.floating]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Mean over each place of ``here`` (n,) of a density (P m,) over the poses of ``there``, 0 where those do not touch; and
        the share (n,) of each place that touches.

        All penetrations of a place count as its middle one: they differ by less than a cell spreads.
        """
        n, bins = self.here.places, len(self.there.height)
        # what belongs to one place stands together
        height = np.ascontiguousarray(self.there.height.T)
        weight = (self.there.weight.T > 0).astype(np.float32)
        weighed = np.ascontiguousarray(density.reshape(bins, -1).T.astype(np.float32) * weight)
        total, touching = np.zeros(n, np.float32), np.zeros(n, np.float32)

        def work(part: slice) -> None:
            for rotation, shift in self._draws:
                near, found, z, beside = self._near(*self._placed(part, rotation, shift))
                share = self._shares(height[found], z, beside)
                total[part][near] += np.einsum("nl,nl->n", share, weighed[found]) / len(self._draws)
                touching[part][near] += np.einsum("nl,nl->n", share, weight[found]) / len(self._draws)

        self._over_all(work)
        return total, touching

    def reached(self) -> NDArray[np.float32]:
        """The share (n,) of each place of ``here`` at which the object would reach the other sensor's membrane, however deep."""
        out = np.zeros(self.here.places, np.float32)
        top = self.there.height[0] + np.float32(self.there.sensor.max_penetration / len(self.there.height) / 2)

        def work(part: slice) -> None:
            for rotation, shift in self._draws:
                inside, found, z, beside = self._placed(part, rotation, shift)
                share = ndtr((top[found] - z) / self.std) * np.exp(-0.5 * (beside / self.std) ** 2)
                out[part][inside] += share / len(self._draws)

        self._over_all(work)
        return out

    def _over_all(self, work: Callable[[slice], None]) -> None:
        """Do ``work`` on all places, some at a time."""
        parts = [slice(i, i + _CHUNK) for i in range(0, self.here.places, _CHUNK)]
        with ThreadPoolExecutor(2 if len(parts) > 1 else 1) as pool:
            list(pool.map(work, parts))

    def _placed(self, part: slice, rotation_there: NDArray[np.int32], shift: NDArray[np.float32]) -> Placed:
        """Those of the places in ``part`` (m,) that lie over the other sensor, the places (m,) of ``there`` they fall into, the
        height (m,) of the object's centre, and how far (m,) that lies beside the place's cell.

        Poses are turned so that they fall into ``rotation_there`` (M,), and moved by ``shift`` (3,).
        """
        there, step = self.there, np.float32(self.there.resolution.step)
        x, y, z = (each[part] + by for each, by in zip(self._centres, shift, strict=True))
        ny, nx = there.table.shape[1:]
        column = np.rint(x / -step).astype(np.int32) + nx // 2
        row = np.rint(y / -step).astype(np.int32) + ny // 2
        cell = (rotation_there[self.here.rotation[part]] * ny + row) * nx + column
        inside = np.flatnonzero((column >= 0) & (column < nx) & (row >= 0) & (row < ny))
        found = there.table.reshape(-1)[cell[inside]]
        off = np.abs(np.stack([x[inside], y[inside]], 1) - there.shift[found]) - np.float32(0.5) * step
        return inside, found, z[inside], np.sqrt((np.maximum(off, 0) ** 2).sum(1))

    def _near(
        self,
        inside: NDArray[np.int64],
        found: NDArray[np.int32],
        z: NDArray[np.float32],
        beside: NDArray[np.float32],
    ) -> Placed:
        """Of what is placed over the other sensor, what may touch: most poses are far above it, or would be deep in it."""
        gap = self.there.height[0][found] - z
        near = (gap > -_FAR * self.std) & (gap < _FAR * self.std + self.there.sensor.max_penetration)
        return inside[near], found[near], z[near], beside[near]

    def _shares(
        self, height: NDArray[np.float32], z: NDArray[np.float32], beside: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """Share (n, P) of cells that touches at each penetration of places whose heights are ``height`` (n, P), when the
        object's centre is expected at height ``z`` (n,), ``beside`` (n,) the place."""
        width = self.there.sensor.max_penetration / height.shape[1]
        variance = self.std**2 + width**2 / 12
        # a place may stand for a neighbour that does not touch
        squares = (height - z[:, None]) ** 2 + (beside**2)[:, None]
        out: NDArray[np.float32] = np.exp(squares * np.float32(-0.5 / variance)) * np.float32(
            width / np.sqrt(2 * np.pi * variance)
        )
        return out

    @cached_property
    def _centres(self) -> NDArray[np.float32]:
        """The object's centre (3, n) in the other sensor's frame, at the middle penetration of every place of ``here``."""
        here, T = self.here, self.T_there_here
        local = np.stack([*here.shift.T, here.height[len(here.height) // 2]])
        return (T[:3, :3].astype(np.float32) @ local + T[:3, 3:].astype(np.float32)).astype(np.float32)

    @cached_property
    def _draws(self) -> list[tuple[NDArray[np.int32], NDArray[np.float32]]]:
        """Draws within all cells: for each the rotations of ``there`` (M,) that those of ``here`` fall into, and a shift (3,) in
        the other sensor's frame."""
        quarter = self.here.resolution.step / 4
        corners = quarter * np.array([[-1, -1, 0], [1, 1, 0], [-1, 1, 0], [1, -1, 0]])
        turned = [self._rotations_there(rotations) for rotations in self.here.turned_within]
        return list(zip(turned, (corners @ self.T_there_here[:3, :3].T).astype(np.float32), strict=True))

    def _rotations_there(self, rotations: Array) -> NDArray[np.int32]:
        """The rotation of ``there`` (M,) that each of ``rotations`` (M, 3, 3) of ``here`` falls into."""
        R = self.T_there_here[:3, :3] @ rotations
        _, direction, turn = self.there.directions.lookup(transform(R, np.zeros(3)))
        return (self.there.directions.first_turn[direction] + turn).astype(np.int32)
