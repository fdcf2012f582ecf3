"""The discretised contact pose space of one object on one sensor, with what the sensor would see at each pose.

A *place* is an approach direction, a turn, and a lattice cell of the object's centre over the window; a *pose* is a
place at one penetration. Every array is laid out penetration by penetration, so pose ``i`` is penetration
``i // places`` of place ``i % places``.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from geomtact.contact_space.resolution import Resolution
from geomtact.contact_space.space import ContactSpace
from geomtact.geometry.approach import NO_TILT, Approach, approach_of
from geomtact.geometry.distance import PoseDistance
from geomtact.geometry.mesh import Mesh
from geomtact.geometry.rotations import Directions
from geomtact.se3 import Array, hat, transform
from geomtact.sensing.sensor import Sensor

_TURNED = 8  # rotations of a cell that stand for all of it
_DRAWN = 30_000  # poses that stand for all
# poses about one, in widths of a cell in tilts, turn, x and y, whose heights show how those of its cell differ
_AROUND = np.random.default_rng(0).uniform(-0.75, 0.75, (32, 5))
_AROUND = np.concatenate([_AROUND, -_AROUND])


@dataclass(frozen=True, eq=False)
class Index:
    """A discretised contact pose space (thesis 6.1.1 to 6.1.3).

    Attributes
    ----------
    mesh, sensor, approach : what it was built for; the mesh with its symmetry
    resolution : of the grid
    key : content hash of all that, its name in the cache
    rotation : (n,) rotation of each place
    shift : (n, 2) object's centre along x and y, sensor frame [m]: a point of the cell at which it touches
    height : (P, n) the centre's z at each penetration [m]
    weight : (P, n) share of the uniform measure in each pose's cell; sums to 1, 0 where the housing forbids it
    deflated : (m,) the contact masks, packed and compressed: see :func:`deflate`
    area : (P, n) number of contact pixels
    moments : (6, P n) moments of each mask (see ``sensing.moments``)
    table : (rotations, ny, nx) place of each lattice cell, the nearest one where the cell does not touch
    folder : its entry in the cache; None where it is in none
    """

    mesh: Mesh
    sensor: Sensor
    approach: Approach | None
    resolution: Resolution
    key: str
    rotation: NDArray[np.int32]
    shift: NDArray[np.float32]
    height: NDArray[np.float32]
    weight: NDArray[np.float32]
    deflated: NDArray[np.uint8]
    area: NDArray[np.uint16]
    moments: NDArray[np.float32]
    table: NDArray[np.int32]
    folder: Path | None = None

    ARRAYS = ("rotation", "shift", "height", "weight", "deflated", "area", "moments", "table")

    def __len__(self) -> int:
        return self.height.size

    def __repr__(self) -> str:
        return f"Index({self.mesh.name} on {self.sensor.name}, {len(self):,} poses)"

    @property
    def places(self) -> int:
        return self.height.shape[1]

    @cached_property
    def bits(self) -> NDArray[np.uint64]:
        """The contact masks (P, words, n), packed along the words."""
        words = np.frombuffer(zlib.decompress(self.deflated.tobytes()), np.uint64)
        return words.reshape(self.height.shape[0], -1, self.places)

    @property
    def bytes_per_pose(self) -> float:
        return sum(getattr(self, a).nbytes for a in self.ARRAYS) / len(self)

    @property
    def angle_step(self) -> float:
        """Angle between neighbouring rotations [rad]."""
        return self.directions.angle_step(self.resolution.turn_step)

    @cached_property
    def space(self) -> ContactSpace:
        """The contact pose space, undiscretised."""
        return ContactSpace(self.mesh, self.sensor, self.approach)

    @cached_property
    def directions(self) -> Directions:
        """The modelled approach directions."""
        assert self.mesh.symmetry is not None
        return self.resolution.directions(self.mesh.symmetry, self.approach)

    @cached_property
    def rotations(self) -> Array:
        """R_sensor_object (M, 3, 3) of every rotation of the grid."""
        return self.directions.rotations()[0]

    def poses(self, ids: ArrayLike | None = None) -> Array:
        """T_sensor_object (m, 4, 4) of poses ``ids`` (m,), all by default."""
        i = np.arange(len(self)) if ids is None else np.asarray(ids)
        level, place = np.divmod(i, self.places)
        R = self.rotations[self.rotation[place]]
        centre = np.concatenate([self.shift[place], self.height[level, place, None]], 1)
        return transform(R, centre - R @ self.mesh.centre)

    def perhaps_within(self, T: Array, distance: PoseDistance, radius: float) -> NDArray[np.int64]:
        """Pose ids (n,) of all cells whose own pose may lie within ``radius`` [m] of ``T`` (4, 4), in mean point distance."""
        # the mean over a surface is seldom less than a third of the root mean square: farther rotations are left out
        turned = distance.turned(T[:3, :3], self.rotations) <= 3 * radius
        here = T[:3, :3] @ distance.anchor + T[:3, 3]
        return self.around(np.flatnonzero(turned), distance.anchor, here, radius + distance.slack)

    def around(
        self, rotations: NDArray[np.int64], point: ArrayLike, where: ArrayLike, reach: float
    ) -> NDArray[np.int64]:
        """Pose ids (m,) of some rotations, at which ``point`` (3,) of the object lies within ``reach`` [m] of ``where``
        (3,) in the sensor frame along each axis."""
        centre = np.asarray(where, float) - self.rotations[rotations] @ (np.asarray(point, float) - self.mesh.centre)
        step = self.resolution.step
        # a place may lie up to half a step off the middle of its lattice cell
        k = np.arange(-int(np.ceil(reach / step + 0.5)), int(np.ceil(reach / step + 0.5)) + 1)
        x, y = self.lattice(centre)
        ny, nx = self.table.shape[1:]
        x, y = (x[:, None] + k)[:, None, :], (y[:, None] + k)[:, :, None]
        on_lattice = (x >= 0) & (x < nx) & (y >= 0) & (y < ny)
        place = self.table[np.asarray(rotations)[:, None, None], np.clip(y, 0, ny - 1), np.clip(x, 0, nx - 1)]
        owner = np.broadcast_to(np.arange(len(centre))[:, None, None], place.shape)
        # cells that do not touch name their neighbours' places, which stand for themselves already
        place, first = np.unique(place[on_lattice], return_index=True)
        owner = owner[on_lattice][first]
        near = (np.abs(self.shift[place] - centre[owner, :2]) <= reach).all(1)
        near &= self.rotation[place] == np.asarray(rotations)[owner]
        place, owner = place[near], owner[near]
        level, row = np.nonzero(np.abs(self.height[:, place] - centre[owner, 2]) <= reach)
        return (level * self.places + place[row]).astype(np.int64)

    def lattice(self, centre: Array) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Column and row (n,) of the lattice cell that holds the object's centre (n, 2 or 3); maybe off the lattice."""
        ny, nx = self.table.shape[1:]
        step = self.resolution.step
        x = np.rint(-centre[:, 0] / step).astype(np.int64) + nx // 2
        y = np.rint(-centre[:, 1] / step).astype(np.int64) + ny // 2
        return x, y

    def deeper(self, score: NDArray[np.floating], by: float) -> NDArray[np.floating]:
        """``score`` (P, n), of the cells of all places and penetrations, at those ``by`` [m] deeper: those that are not
        as deep get the lowest there is."""
        bins = min(round(by * len(score) / self.sensor.max_penetration), len(score) - 1)
        if not bins:
            return score
        out = np.full_like(score, score[np.isfinite(score)].min())
        out[bins:] = score[:-bins]
        return out

    def cell_covariance(self, T: ArrayLike) -> Array:
        """Spread (..., 6, 6) of the poses in the cell around each ``T`` (..., 4, 4): covariance of xi in T exp(xi^), radians and
        metres.

        A cell is as wide in tilt, turn, x and y as the grid is fine; but where its poses touch, at one penetration, they lie as
        high as the object's surface lets them: by what the cells round about say, a plane and what is left of it.
        """
        T = np.asarray(T, float)
        R, t = T.reshape(-1, 4, 4)[:, :3, :3], T.reshape(-1, 4, 4)[:, :3, 3]
        up = R[:, 2]
        cones = self.directions.cones
        turn, step = max(self.angle_step, NO_TILT), self.resolution.step
        # the cells of disks leave less tilt, and an approach no more than its cones are wide
        tilt = np.array([min(turn, self.directions.disk_step(a)) for a in approach_of(R)])
        if cones is not None:
            tilt = np.minimum(tilt, max(NO_TILT, 2 * max(half for _, half in cones)))
        turned, moved = np.zeros((2, len(R), 5, 3))
        turned[:, :2] = tilt[:, None, None] * np.linalg.svd(up[:, None])[2][:, 1:]
        turned[:, 2] = turn * up
        moved[:, 3, 0] = moved[:, 4, 1] = step

        centre = R @ self.mesh.centre + t
        rotvec = _AROUND @ turned
        around = R[:, None] @ Rotation.from_rotvec(rotvec.reshape(-1, 3)).as_matrix().reshape(*rotvec.shape, 3)
        poses = transform(around, centre[:, None] + _AROUND @ moved - around @ self.mesh.centre).reshape(-1, 4, 4)
        level = len(self.height) // 2
        place = self.lookup(poses, np.full(len(poses), 0.5 * self.sensor.max_penetration)) % self.places
        height = self.height[level, place].astype(float).reshape(-1, len(_AROUND))
        height -= height.mean(1, keepdims=True)
        lean = np.linalg.lstsq(_AROUND, height.T, rcond=None)[0].T
        moved[:, :, 2] = lean
        depth = self.sensor.max_penetration / len(self.height)
        left = np.square(height - lean @ _AROUND.T).mean(1) + depth**2 / 12

        way = np.concatenate([turned, moved @ R], -1)
        about_centre = np.swapaxes(way, 1, 2) @ way / 12
        about_centre[:, 3:, 3:] += left[:, None, None] * up[:, :, None] * up[:, None]
        # a rotation about the object's centre is one about its origin and a shift
        J = np.eye(6)
        J[3:, :3] = hat(self.mesh.centre)
        return (J @ about_centre @ J.T).reshape(*T.shape[:-2], 6, 6)

    def lookup(self, T: ArrayLike, penetration: ArrayLike) -> NDArray[np.int64]:
        """The pose id (n,) whose cell holds each ``T`` (n, 4, 4), which presses ``penetration`` (n,) [m] deep.

        Constant time a pose. A pose between the cells that touch gets the nearest one that does.
        """
        T, k, j = self.directions.lookup(np.asarray(T, float).reshape(-1, 4, 4))
        centre = T[:, :2, :3] @ self.mesh.centre + T[:, :2, 3]
        place = self.place_of(self.directions.first_turn[k] + j, centre)
        return self.level_of(place, np.asarray(penetration, float)) * self.places + place

    def level_of(self, place: NDArray[np.int64], penetration: Array) -> NDArray[np.int64]:
        """The bin (n,) of each ``penetration`` (n,) [m] at a place (n,), or the nearest that the housing does not forbid."""
        bins = len(self.resolution.penetrations)
        depth = np.where(np.isfinite(penetration), penetration, 0) / self.sensor.max_penetration
        level = np.clip((depth * bins).astype(np.int64), 0, bins - 1)
        some = self.weight[:, place] > 0
        return np.where(some[level, np.arange(len(place))], level, _nearest_true(some, level))

    def place_of(self, rotation: NDArray[np.int64], centre: Array) -> NDArray[np.int64]:
        """The place (n,) of a rotation (n,) of the grid with the object's centre at ``centre`` (n, 2 or 3), or the nearest."""
        ny, nx = self.table.shape[1:]
        x, y = self.lattice(centre)
        return self.table[rotation, np.clip(y, 0, ny - 1), np.clip(x, 0, nx - 1)].astype(np.int64)

    def draw(self, ids: ArrayLike, rng: np.random.Generator) -> tuple[Array, Array]:
        """Poses (m, 4, 4) uniform within the cells of ``ids`` (m,), and the penetration (m,) [m] each one is to have.

        Heights are those of the cell's own pose: ``ContactSpace.settle`` brings each to its penetration. Some of the
        poses may lie off the contact pose space, where a cell straddles its border.
        """
        level, place = np.divmod(np.asarray(ids), self.places)
        R = self.directions.draw(self.rotation[place], rng)
        step = self.resolution.step
        centre = np.zeros((len(place), 3))
        centre[:, :2] = (np.rint(self.shift[place] / step) + rng.uniform(-0.5, 0.5, (len(place), 2))) * step
        centre[:, 2] = self.height[level, place]
        bins = len(self.resolution.penetrations)
        depth = (level + rng.random(len(place))) / bins * self.sensor.max_penetration
        return transform(R, centre - R @ self.mesh.centre), depth

    @cached_property
    def touching(self) -> NDArray[np.float32]:
        """Share (n,) of the lattice cell of each place in which the object can touch."""
        share = self.weight.max(0) / self._of_rotation[self.rotation]
        return (share / share.max()).astype(np.float32)

    @cached_property
    def cell_measure(self) -> Array:
        """Uniform measure (n,) of the whole lattice cell of each place at all depths, whether it touches or not."""
        return np.asarray(self._of_rotation[self.rotation] * self._of_lattice_cell, float)

    def uniform_density(self, T: ArrayLike) -> Array:
        """Density (n,) of :attr:`cell_measure` at ``T`` (n, 4, 4), per rad and metre of each of ``directions.motions``."""
        volume = self.resolution.step**2 * self.sensor.max_penetration
        return self.directions.density(np.asarray(T, float)[:, :3, :3]) * self._of_lattice_cell / volume

    @cached_property
    def _of_lattice_cell(self) -> float:
        """Measure of one lattice cell at all depths where the object touches, if it had the only rotation."""
        largest = (self.weight.max(0) / self._of_rotation[self.rotation]).max() * len(self.weight)
        return float(largest / self.weight.sum(dtype=float))

    @cached_property
    def _of_rotation(self) -> Array:
        """Measure of every rotation of the grid, relative to the others."""
        directions = self.directions
        return np.repeat(directions.weights / directions.turns, directions.turns)

    @cached_property
    def _mass_before(self) -> Array:
        """Uniform measure of all poses before each (N + 1,)."""
        return np.concatenate([[0.0], np.cumsum(self.weight, dtype=np.float64)])

    @cached_property
    def log_weight(self) -> NDArray[np.float32]:
        """Log of the uniform measure of every pose's cell (N,); -inf where the housing forbids the pose."""
        with np.errstate(divide="ignore"):
            return np.log(np.asarray(self.weight).ravel())

    @cached_property
    def possible(self) -> NDArray[np.int64]:
        """Ids (n,) of the poses that the housing does not forbid."""
        return np.flatnonzero(np.asarray(self.weight).reshape(-1) > 0)

    @cached_property
    def log_possible_weight(self) -> NDArray[np.float32]:
        """:attr:`log_weight` of :attr:`possible`."""
        return self.log_weight[self.possible]

    def at_share(self, share: ArrayLike) -> NDArray[np.int64]:
        """The pose id (n,) up to which the poses hold ``share`` (n,), 0 to 1, of the uniform measure."""
        total = self._mass_before[-1]
        return np.clip(np.searchsorted(self._mass_before, np.asarray(share) * total, "right") - 1, 0, len(self) - 1)

    @cached_property
    def turned_within(self) -> Array:
        """A few rotations (k, M, 3, 3) drawn within the cell of every rotation of the grid; always the same ones."""
        rng, every = np.random.default_rng(0), np.arange(len(self.rotations))
        return np.stack([self.directions.draw(every, rng) for _ in range(_TURNED)])

    @cached_property
    def drawn_moments(self) -> NDArray[np.float32]:
        """Moments (6, m) of poses drawn by their measure; always the same ones."""
        found = self.at_share((np.arange(_DRAWN) + np.random.default_rng(0).random(_DRAWN)) / _DRAWN)
        return np.ascontiguousarray(self.moments[:, found])

    def masks(self, ids: ArrayLike) -> NDArray[np.bool_]:
        """The stored contact masks (m, h, w) of poses ``ids`` (m,)."""
        level, place = np.divmod(np.asarray(ids), self.places)
        return unpack(self.bits[level, :, place], self.resolution.mask_shape)


def pack(masks: NDArray[np.bool_]) -> NDArray[np.uint64]:
    """Masks (..., h*w) as packed words (..., h*w/64)."""
    return np.packbits(masks, axis=-1).view(np.uint64)


def deflate(bits: NDArray[np.uint64]) -> NDArray[np.uint8]:
    """Packed masks (P, words, n) compressed by zlib, to a fifteenth or so."""
    return np.frombuffer(zlib.compress(bits.tobytes(), 1), np.uint8)


def unpack(words: NDArray[np.uint64], shape: tuple[int, int]) -> NDArray[np.bool_]:
    """Masks (m, h, w) of packed ``words`` (m, h*w/64): what :func:`pack` packed."""
    bits = np.unpackbits(np.ascontiguousarray(words).view(np.uint8), axis=1)
    return bits.astype(bool).reshape(-1, *shape)


def _nearest_true(table: NDArray[np.bool_], row: NDArray[np.int64]) -> NDArray[np.int64]:
    """For each column the row nearest to ``row`` in which ``table`` (P, n) is true."""
    distance = np.abs(np.arange(len(table))[:, None] - row)
    return np.argmin(np.where(table, distance, len(table) + distance), axis=0)
