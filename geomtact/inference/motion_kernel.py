"""The filter's prediction step: a motion applied to a distribution over the cells of a contact pose space."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix, diags, identity

from geomtact.contact_space.cell_transfer import CellTransfer
from geomtact.contact_space.index import Index
from geomtact.geometry.approach import allowed, approach_of
from geomtact.inference.motion import Motion
from geomtact.se3 import Array, exp, transform

# All constants of the prediction are hand-set.
_TWISTS = 4096  # number of motions drawn
_ROTATIONS = 1 << 17, 16, 128  # rotations drawn to count how many leave their cell: in total, least and most per cell
_CARRIED = 150_000, 2, 64  # points carried along with the sensor: in total, least and most per cell
_LEAST_TAP = 1e-4  # share of a lattice cell shifted so far below which it is dropped
_FEW = 0.5  # share of all rotations up to which only those that hold mass are shifted
_UNIFORM_LEVELS = 0.1  # relative deviation of the shares of the penetrations up to which these count as uniform


@dataclass(frozen=True, eq=False)
class Mixture:
    """A distribution over the cells of an index: ``mass`` (n,) in ``cells`` (n,), and a share ``uniform`` of the uniform one."""

    cells: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    mass: NDArray[np.floating] = field(default_factory=lambda: np.zeros(0))
    uniform: float = 1.0

    def with_uniform(self, uniform: float) -> Mixture:
        """The distribution with a share ``uniform`` more of the uniform one."""
        return Mixture(self.cells, (1 - uniform) * self.mass, (1 - uniform) * self.uniform + uniform)

    def normalised(self) -> Mixture:
        """Of total mass 1; uniform where there is none."""
        total = float(self.mass.sum()) + self.uniform
        return Mixture(self.cells, self.mass / total, self.uniform / total) if total > 0 else Mixture()


@dataclass(frozen=True, eq=False)
class MotionKernel:
    """A motion applied to distributions over the cells of ``index``.

    Cells are about as wide as the motion, so what counts is the share of a cell that leaves it. Shifts along x and along y,
    changes of penetration, and turns are taken one after the other, each of them reversible: between two cells as much of the
    uniform distribution goes one way as the other. What would leave the contact pose space stays in its cell, because contact
    goes on; were it dropped, a shaft would lose against a plate from frame to frame, whatever is seen. So the uniform
    distribution stays what it is.
    """

    index: Index
    motion: Motion
    seed: int = 0

    def __call__(self, before: Mixture) -> Mixture:
        """The distribution one frame later, over the sensor as it stands."""
        if not len(before.cells):
            return before
        index, (M, depths, ny, nx) = self.index, self._share.shape
        level, place = np.divmod(before.cells, index.places)
        rotation = index.rotation[place]
        live = np.flatnonzero(np.bincount(rotation, minlength=M))
        # shifts stay within a rotation: the others are empty until the turn
        some: slice | NDArray[np.int64] = live if len(live) < _FEW * M else slice(None)
        kept = np.arange(M)[some]
        row = np.zeros(M, np.int64)
        row[kept] = np.arange(len(kept))
        at = self._slot[place] + ((row[rotation] - rotation) * depths + level % depths) * (ny * nx)
        shape = (len(kept), depths, ny, nx)
        grid = np.bincount(at, before.mass, len(kept) * depths * ny * nx).astype(np.float32).reshape(shape)
        share, (along_y, along_x, deeper, turned) = self._share[some], (stay[some] for stay in self._stay)
        _step(grid, along_y, share, self._shifts(ny) @ grid)
        _step(grid, along_x, share, grid @ self._shifts(nx))
        if depths > 1:
            _step(grid, deeper, share, self._deeper(grid))
        leaving = self._leaving if len(kept) == M else self._leaving[some]
        after = (leaving.T @ grid.reshape(len(kept), -1)).reshape(self._share.shape)
        after *= self._share
        after[some] += turned * grid
        mass = after.ravel()[self._slot + np.arange(depths)[:, None] * (ny * nx)]
        mass = (mass * self._pressed if depths == 1 else mass).ravel()
        possible = index.possible
        return Mixture(possible, mass if len(possible) == len(mass) else mass[possible], before.uniform)

    def left(self, T_after_before: Array) -> NDArray[np.float32]:
        """Which share (P, n) of every place touches at each penetration after the sensor has moved over an object at rest: what
        lay at T lies at ``T_after_before @ T`` (4, 4); relative to a sensor that stands still."""
        share = self._touching(T_after_before)
        total = np.maximum(share.sum(0), 1e-30)
        return np.asarray(share * (np.minimum(1, total / self._standing) / total))

    def carried(
        self, before: Mixture, T_after_before: Array, left: NDArray[np.float32], rng: np.random.Generator
    ) -> Mixture:
        """The distribution over the sensor after it has moved as for :attr:`left`. What does not touch any more is lost.

        A step may be much shorter than a cell, so points drawn in every cell are carried: a few of them cross over.
        """
        index, (ny, nx), cells = self.index, self.index.table.shape[1:], before.cells
        points, least, most = _CARRIED
        draws = min(max(points // len(cells), least), most)
        level, place = np.divmod(cells, index.places)
        step, height = index.resolution.step, index.height[level, place]
        local = np.column_stack([step * np.rint(index.shift[place] / step), height])
        centre = local @ T_after_before[:3, :3].T + T_after_before[:3, 3]
        live, row = np.unique(index.rotation[place], return_inverse=True)
        drawn = self._drawn[rng.integers(len(self._drawn), size=(draws, len(live))), live]
        _, rotation = self._rotation_of(T_after_before[:3, :3] @ drawn.reshape(-1, 3, 3))
        rotation = rotation.reshape(draws, -1)[:, row].ravel()
        sunk = np.tile((height - centre[:, 2]) / (index.sensor.max_penetration / len(left)), draws)
        centre = np.tile(centre[:, :2], (draws, 1))
        x, y = index.lattice(centre + step * rng.uniform(-0.5, 0.5, centre.shape))
        there = index.table[rotation, np.clip(y, 0, ny - 1), np.clip(x, 0, nx - 1)]
        # the table names a neighbour where a cell does not touch
        mass = before.mass / draws * left[:, place]
        held = np.tile(mass.sum(0), draws)
        own = (self._slot[there] == self._counted(rotation, x, y)) & (x >= 0) & (x < nx)
        stays = own & (there == np.tile(place, draws))
        leaves = np.flatnonzero(own & ~stays)
        out = np.zeros((len(mass), index.places))
        for at_depth, each in zip(out, mass, strict=True):
            np.add.at(at_depth, there[leaves], each[leaves % len(cells)])
        # within its own place the object keeps its penetration, but for how far it has sunk
        deeper = np.rint(np.tile(level, draws)[stays] + sunk[stays] + rng.uniform(-0.5, 0.5, int(stays.sum())))
        np.add.at(out, (np.clip(deeper, 0, len(left) - 1).astype(int), there[stays]), held[stays])
        out[np.asarray(index.weight) == 0] = 0
        found = np.flatnonzero(out)
        return Mixture(found, out.reshape(-1)[found], before.uniform)

    def _touching(self, T_after_before: Array) -> NDArray[np.float32]:
        return CellTransfer(self.index, self.index, T_after_before).shares()

    @cached_property
    def _standing(self) -> NDArray[np.float32]:
        """Which share (n,) of every place touches by :class:`CellTransfer` where nothing moves."""
        return np.maximum(self._touching(np.eye(4)).sum(0), 1e-30)

    @cached_property
    def _slot(self) -> NDArray[np.int64]:
        """Where every place (n,) has its first penetration in the grid (M, D, ny, nx) of :attr:`_share`, counted through."""
        x, y = self.index.lattice(self.index.shift.astype(float))
        return self._counted(self.index.rotation, x, y)

    def _counted(self, rotation: NDArray[np.integer], x: NDArray[np.int64], y: NDArray[np.int64]) -> NDArray[np.int64]:
        _, ny, nx = self.index.table.shape
        return (rotation.astype(np.int64) * len(self._levels) * ny + y) * nx + x

    @cached_property
    def _measure(self) -> Array:
        """Haar measure (M,) of every rotation."""
        directions = self.index.directions
        return np.repeat(directions.weights / directions.turns, directions.turns)

    @cached_property
    def _share(self) -> NDArray[np.float32]:
        """Which share of every cell touches (M, D, ny, nx), relative to the cell of which most does.

        D penetrations, or one that stands for all where the motion mixes them.
        """
        index, depths = self.index, len(self._levels)
        ny, nx = index.table.shape[1:]
        out = np.zeros(len(self._measure) * depths * ny * nx, np.float32)
        weight = np.asarray(index.weight).reshape(-1, depths, index.places).mean(0)
        out[self._slot + np.arange(depths)[:, None] * (ny * nx)] = weight / self._measure[index.rotation]
        return out.reshape(-1, depths, ny, nx) / out.max()

    @cached_property
    def _pressed(self) -> NDArray[np.float32]:
        """Which share (P, n) of the measure of every place lies at each penetration."""
        weight = np.asarray(self.index.weight)
        return weight / weight.sum(0)

    @cached_property
    def _stay(self) -> list[NDArray[np.float32]]:
        """Share of every cell (M, D, ny, nx) that stays when cells are shifted along y, along x, pressed deeper, or turned."""
        share, (_, _, ny, nx) = self._share, self._share.shape
        turned = (self._leaving @ share.reshape(len(share), -1)).reshape(share.shape)
        leaves = (self._shifts(ny) @ share, share @ self._shifts(nx), self._deeper(share), turned)
        return [np.maximum(1 - each, 0) for each in leaves]

    def _shifts(self, n: int) -> NDArray[np.float32]:
        """Share (n, n) of each of ``n`` lattice cells in a row that is shifted into each other one."""
        apart = np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
        share = np.append(self._taps, np.float32(0))[np.minimum(apart, len(self._taps))]
        return _off_diagonal(share)

    def _deeper(self, grid: NDArray[np.float32]) -> NDArray[np.float32]:
        """What comes into each cell of ``grid`` (M, D, ny, nx) from other penetrations."""
        flat = _off_diagonal(self._levels) @ grid.reshape(*grid.shape[:2], -1)
        return np.asarray(flat.reshape(grid.shape))

    @cached_property
    def _twists(self) -> Array:
        return self.motion.twists(self.index.mesh, _TWISTS, np.random.default_rng(self.seed))

    @cached_property
    def _taps(self) -> NDArray[np.float32]:
        """Share (k + 1,) of a lattice cell that is shifted by 0 .. k cells, to either side, along x or y."""
        step = np.abs(self._twists[:, 3:].ravel()) / self.index.resolution.step
        taps = np.array([np.maximum(1 - np.abs(step - i), 0).mean() for i in range(int(step.max()) + 2)])
        taps[1:] /= 2
        taps = taps[: 1 + int(np.flatnonzero(taps > _LEAST_TAP)[-1])]
        return np.asarray(taps / (taps[0] + 2 * taps[1:].sum()), np.float32)

    @cached_property
    def _levels(self) -> NDArray[np.float32]:
        """Share (D, D) of a bin of penetration that goes to another one, reflected at the least and the largest."""
        bins = len(self.index.height)
        step = self._twists[:, 3:].ravel() / (self.index.sensor.max_penetration / bins)
        start = (np.arange(16 * bins) + 0.5) / 16
        depth = bins - np.abs(bins - (start[:, None] + step) % (2 * bins))
        moved = np.minimum(depth.astype(np.int64), bins - 1) + bins * start.astype(np.int64)[:, None]
        share = np.bincount(moved.ravel(), minlength=bins**2).reshape(bins, bins) / (16 * len(step))
        share = 0.5 * (share + share.T)
        if np.abs(share * bins - 1).max() < _UNIFORM_LEVELS:
            return np.ones((1, 1), np.float32)
        np.fill_diagonal(share, share.diagonal() + 1 - share.sum(1))
        return share.astype(np.float32)

    @cached_property
    def _turns(self) -> csr_matrix:
        """Share (M, M) of each rotation's cell that is turned into another's."""
        directions, (n, M) = self.index.directions, self._drawn.shape[:2]
        R, start = self._drawn.reshape(-1, 3, 3), np.tile(np.arange(M), n)
        turn = self._twists[np.random.default_rng(self.seed).integers(_TWISTS, size=len(R)), :3]
        if directions.level is None:  # an exact face stays one
            face = approach_of(R)
            turn = (turn * face).sum(1, keepdims=True) * face
        T, end = self._rotation_of(R @ exp(np.pad(turn, ((0, 0), (0, 3))))[:, :3, :3])
        end = np.where(allowed(approach_of(T[:, :3, :3]), directions.cones), end, start)
        goes = csr_matrix((self._measure[start] / n, (start, end)), (M, M)) + 1e-12 * identity(M)
        flux = 0.5 * (goes + goes.T)
        for _ in range(20):  # takes off the sampling errors: a cell's measure is shared out, no more and no less
            scale = diags(np.sqrt(self._measure / np.asarray(flux.sum(1)).ravel()))
            flux = scale @ flux @ scale
        return (diags(1 / self._measure) @ flux).tocsr().astype(np.float32)

    @cached_property
    def _leaving(self) -> csr_matrix:
        """:attr:`_turns` without what stays."""
        out = self._turns.copy()
        out.setdiag(0)
        out.eliminate_zeros()
        return out

    @cached_property
    def _drawn(self) -> Array:
        """Rotations (n, M, 3, 3) drawn within the cell of each rotation of the grid."""
        (total, least, most), M = _ROTATIONS, len(self._measure)
        n = min(max(total // M, least), most)
        drawn = self.index.directions.draw(np.tile(np.arange(M), n), np.random.default_rng(self.seed))
        return drawn.reshape(n, M, 3, 3)

    def _rotation_of(self, R: Array) -> tuple[Array, NDArray[np.int64]]:
        """The canonical images (n, 4, 4) of rotations ``R`` (n, 3, 3), and the rotation (n,) of the grid that holds each."""
        T, direction, turn = self.index.directions.lookup(transform(R, np.zeros(3)))
        return T, self.index.directions.first_turn[direction] + turn


def _step(
    grid: NDArray[np.float32], stays: NDArray[np.float32], share: NDArray[np.float32], comes: NDArray[np.float32]
) -> None:
    """``grid`` after a step, in place: what ``stays`` of it, and of what ``comes`` the ``share`` that a cell can hold."""
    grid *= stays
    comes *= share
    grid += comes


def _off_diagonal(matrix: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.asarray(matrix - np.diag(np.diag(matrix)))
