"""Cells of one contact pose space seen from another sensor: which of its cells they fall into, and how much of them touches.

A cell is some degrees and millimetres wide, which moves an object by more at a second sensor than the gel is deep: the
cell's own pose seldom touches there, though some of the cell does. So each cell counts by the share of it that touches.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from geomtact.contact_space.index import Index
from geomtact.geometry.approach import allowed, approach_of
from geomtact.se3 import Array, transform

# which places of the one sensor, the place of the other that each falls into, or the nearest, and the object's centre (3, n)
# there [m]
Placed = tuple[NDArray[np.int64], NDArray[np.int32], NDArray[np.float32]]
# the rotation of the other sensor that each of the one falls into, and a shift (3,) in the other sensor's frame [m]
Draw = tuple[NDArray[np.int32], NDArray[np.float32]]
_CHUNK = 1 << 15  # places worked on at a time
_FAR = 3.0  # standard deviations beyond which nothing of a cell touches; hand-set
# Share of poses whose height is far from their cell's, because a limb of the object leaves the window; hand-set.
_JUMPS = 0.02
_BESIDE = 0.3  # std, in steps of the grid, by which neighbours share in a cell, of which few poses are tried; hand-set
MISSED_CONTACT_SHARE = 0.1  # share of touching poses whose contact is too small or shallow to be seen; hand-set
_SPREAD = 1.2  # std of heights over the other sensor, relative to the steps of both grids; measured by casting


@dataclass(frozen=True)
class ExtrinsicsStd:
    """Uncertainty of one sensor's pose relative to another: standard deviations.

    Attributes
    ----------
    rotation : [rad]
    translation : [m]
    """

    rotation: float = 0.0
    translation: float = 0.0


@dataclass(frozen=True, eq=False)
class CellTransfer:
    """Cells of ``here`` transferred to the sensor of ``there``, which touches the same object.

    Attributes
    ----------
    here, there : contact pose spaces of one object
    T_there_here : (4, 4) of the sensor of ``here`` in the frame of that of ``there``
    extrinsics_std : uncertainty of ``T_there_here``
    """

    here: Index
    there: Index
    T_there_here: Array
    extrinsics_std: ExtrinsicsStd = ExtrinsicsStd()

    @cached_property
    def std(self) -> float:
        """Standard deviation [m] of the object's height over the other sensor within a cell, at that sensor's own grid."""
        grids = (self.here, self.there)
        steps = sum((g.angle_step * g.mesh.radius_rms) ** 2 + g.resolution.step**2 for g in grids) / 12
        return float(np.sqrt(_SPREAD**2 * steps + self._extrinsics_std**2))

    @property
    def _extrinsics_std(self) -> float:
        """Standard deviation [m] of the object along each axis of the other sensor that the extrinsics add."""
        lever = float(np.linalg.norm(self.T_there_here[:3, 3]))
        return float(np.hypot(self.extrinsics_std.translation, self.extrinsics_std.rotation * lever))

    def shares(self) -> NDArray[np.float32]:
        """Which share (P, n) of each place of ``here`` touches the other sensor at each of its P penetrations."""
        share = np.zeros((len(self.there.height), self.here.places), np.float32)
        heights = np.ascontiguousarray(self.there.height.T)
        possible = self.there.weight > 0

        def work(part: NDArray[np.int64]) -> None:
            for draw in self._draws:
                places, found, centre = self._near(*self._placed(part, *draw))
                each = self._shares(heights.take(found, 0), found, centre).T
                share[:, places] += each * possible[:, found] / len(self._draws)

        self._in_parts(np.arange(len(self._within_reach[0])), work)
        return share

    def mean(
        self, density: NDArray[np.floating], unlikely: NDArray[np.bool_] | None = None
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Mean over each place of ``here`` (n,) of a density (P m,) over the poses of ``there``, 0 where those do not touch; and
        the share (n,) of each place that touches.

        All penetrations of a place count as its middle one: they differ by less than a cell spreads. Where ``unlikely`` (n,), one
        pose within a place is tried.
        """
        n, bins = self.here.places, len(self.there.height)
        # what belongs to one place stands together
        weight = (self.there.weight.T > 0).astype(np.float32)
        weighed = density.reshape(bins, -1).T.astype(np.float32) * weight
        rows = np.ascontiguousarray(np.concatenate([self.there.height.T, weighed, weight], 1))
        anywhere = weighed.sum(1), weight.sum(1)
        total, touching = np.zeros(n, np.float32), np.zeros(n, np.float32)
        jump = np.float32(_JUMPS * self.there.sensor.max_penetration / bins / self.there.mesh.diameter)

        def work(part: NDArray[np.int64], draws: list[Draw]) -> None:
            for draw in draws:
                placed = self._placed(part, *draw)
                for out, each in zip((total, touching), anywhere, strict=True):
                    out[placed[0]] += jump * each.take(placed[1]) / len(draws)
                places, found, centre = self._near(*placed)
                height, weighed, weight = np.split(rows.take(found, 0), 3, 1)
                share = self._shares(height, found, centre)
                total[places] += np.einsum("nl,nl->n", share, weighed) / len(draws)
                touching[places] += np.einsum("nl,nl->n", share, weight) / len(draws)

        rough = np.zeros(n, bool) if unlikely is None else unlikely
        rough = rough[self._within_reach[0]]
        self._in_parts(np.flatnonzero(rough), lambda part: work(part, self._draws[:1]))
        self._in_parts(np.flatnonzero(~rough), lambda part: work(part, self._draws))
        return total, touching

    def no_contact_likelihood(self) -> NDArray[np.float32]:
        """How likely (n,) it is for each place of ``here`` that the other sensor shows no contact."""
        return 1 - np.float32(1 - MISSED_CONTACT_SHARE) * self.reached()

    def reached(self) -> NDArray[np.float32]:
        """The share (n,) of each place of ``here`` at which the object would reach the other sensor's membrane, however deep."""
        out = np.zeros(self.here.places, np.float32)
        top = self.there.height[0] + np.float32(self.there.sensor.max_penetration / len(self.there.height) / 2)

        def work(part: NDArray[np.int64]) -> None:
            for draw in self._draws:
                places, found, centre = self._placed(part, *draw)
                own = (self.there.touching[found] * (self._beside(found, centre) == 0).all(1)).astype(np.float32)
                own *= centre[2] > -self.there.mesh.reach  # not behind the sensor
                out[places] += own * ndtr((top[found] - centre[2]) / self.std) / len(self._draws)

        self._in_parts(np.arange(len(self._within_reach[0])), work)
        return out

    @staticmethod
    def _in_parts(rows: NDArray[np.int64], work: Callable[[NDArray[np.int64]], None]) -> None:
        """Do ``work`` on ``rows`` (m,) of :attr:`_within_reach`, as many at a time as a processor keeps at hand."""
        for i in range(0, len(rows), _CHUNK):
            work(rows[i : i + _CHUNK])

    def _placed(self, part: NDArray[np.int64], rotation_there: NDArray[np.int32], shift: NDArray[np.float32]) -> Placed:
        """Those of the rows ``part`` of :attr:`_within_reach` that lie over the other sensor.

        Poses are turned so that they fall into ``rotation_there`` (M,), and moved by ``shift`` (3,).
        """
        there, step = self.there, np.float32(self.there.resolution.step)
        place, rotation, centres = self._within_reach
        centre = centres.take(part, 1) + shift[:, None]
        ny, nx = there.table.shape[1:]
        column, row = np.rint(centre[:2] / -step).astype(np.int32) + np.array([[nx // 2], [ny // 2]], np.int32)
        there_turned = rotation_there[rotation[part]]
        cell = (there_turned * ny + row) * nx + column
        inside = np.flatnonzero((there_turned >= 0) & (column >= 0) & (column < nx) & (row >= 0) & (row < ny))
        return place[part[inside]], there.table.reshape(-1)[cell[inside]], centre[:, inside]

    def _near(self, places: NDArray[np.int64], found: NDArray[np.int32], centre: NDArray[np.float32]) -> Placed:
        """Of what is placed over the other sensor, what may touch: most poses are far above it, or would be deep in it."""
        gap = self.there.height[0].take(found) - centre[2]
        near = np.flatnonzero((gap > -_FAR * self.std) & (gap < _FAR * self.std + self.there.sensor.max_penetration))
        return places[near], found[near], centre[:, near]

    def _shares(
        self, height: NDArray[np.float32], found: NDArray[np.int32], centre: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """Share (n, P) of cells that touches at each penetration of the places ``found`` (n,), whose heights are ``height``
        (n, P), when the object's centre is expected at ``centre`` (3, n)."""
        width = self.there.sensor.max_penetration / height.shape[1]
        variance = self.std**2 + width**2 / 12
        out: NDArray[np.float32] = np.exp((height - centre[2][:, None]) ** 2 * np.float32(-0.5 / variance))
        # a place may stand for a neighbour that does not touch
        beside = self._beside(found, centre)
        overlap = np.exp(
            np.float32(-0.5 / (_BESIDE * self.there.resolution.step) ** 2) * np.einsum("ni,ni->n", beside, beside)
        )
        return out * (overlap * np.float32(width / np.sqrt(2 * np.pi * variance)))[:, None]

    def _beside(self, found: NDArray[np.int32], centre: NDArray[np.float32]) -> NDArray[np.float32]:
        """How far (n, 2) [m] the object's centre (3, n) lies beside the cells of places ``found`` (n,); 0 within."""
        off = np.abs(centre[:2].T - self._middles.take(found, 0)) - np.float32(
            (0.5 + 1e-5) * self.there.resolution.step
        )
        return np.maximum(off, 0)

    @cached_property
    def _middles(self) -> NDArray[np.float32]:
        """Middle (n, 2) [m] of the lattice cell of each place of ``there``."""
        step = np.float32(self.there.resolution.step)
        return np.asarray(step * np.rint(self.there.shift / step))

    @cached_property
    def _within_reach(self) -> tuple[NDArray[np.int64], NDArray[np.int32], NDArray[np.float32]]:
        """The places (m,) of ``here`` that may lie over the other sensor, their rotations (m,), and the object's centre (3, m) in
        the other sensor's frame, at the middle penetration. Most lie beside its window, or far above it."""
        here, there, T = self.here, self.there, self.T_there_here.astype(np.float32)
        local = np.stack([*here.shift.T, here.height[len(here.height) // 2]])
        centres = np.einsum("ij,jn->in", T[:3, :3], local) + T[:3, 3:]  # threads of @ would wait for each other
        ny, nx = there.table.shape[1:]
        margin = 0.5 * here.resolution.step
        beside = np.abs(centres[:2]) - 0.5 * there.resolution.step * np.array([[nx], [ny]])
        above = centres[2] - there.height.max() - _FAR * self.std
        place = np.flatnonzero((beside < margin).all(0) & (above < margin))
        return place, np.asarray(here.rotation[place]), np.ascontiguousarray(centres[:, place])

    @cached_property
    def _draws(self) -> list[Draw]:
        """Draws within all cells: for each the rotations of ``there`` (M,) that those of ``here`` fall into, and a shift (3,) in
        the other sensor's frame."""
        turned = [self._rotations_there(rotations) for rotations in self.here.turned_within]
        # evenly over the lattice cell (Roberts, R2 sequence)
        even = (0.5 + np.outer(np.arange(len(turned)), [0.7548776662466927, 0.5698402909980532])) % 1 - 0.5
        shifts = self.here.resolution.step * even @ self.T_there_here[:3, :2].T
        shifts[:, :2] += self._extrinsics_std * np.random.default_rng(0).normal(size=(len(turned), 2))
        return list(zip(turned, shifts.astype(np.float32), strict=True))

    def _rotations_there(self, rotations: Array) -> NDArray[np.int32]:
        """The rotation of ``there`` (M,) that each of ``rotations`` (M, 3, 3) of ``here`` falls into; -1 where the approach rules
        it out by more than half a cell."""
        directions = self.there.directions
        T, direction, turn = directions.lookup(transform(self.T_there_here[:3, :3] @ rotations, np.zeros(3)))
        out = (directions.first_turn[direction] + turn).astype(np.int32)
        if directions.cones is not None:
            wider = [(v, half + 0.5 * self.there.angle_step) for v, half in directions.cones]
            out[~allowed(approach_of(T[:, :3, :3]), wider)] = -1
        return out
