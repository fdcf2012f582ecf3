"""Rotations as approach direction and turn (Hopf coordinates), modulo the object's symmetry.

A rotation is its approach (``geometry.approach``) and its *turn*, what is left: a rotation about the sensor's z. Haar
measure is solid angle times turn. Directions are HEALPix pixels (Gorski et al. 2005), so level l has 12 * 4^l directions
and 6 * 2^l turns, nested and of equal volume (Yershova et al. 2010): 576, 4,608, 36,864 and 294,912 rotations for l = 1
to 4. About plane faces, where a little tilt changes much of the contact, directions may be finer (``disks``).

What the object's symmetry makes equal is kept once, and what the scene rules out (``approach``) not at all: every
allowed direction is mapped to one canonical image of its orbit, and a pixel's weight is the solid angle that lands in it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from geomtact.geometry.approach import (
    FACE_TOLERANCE,
    Approach,
    Cones,
    allowed,
    approach_of,
    check_approach,
    facing,
    in_cone,
    in_cones,
    sunflower,
)
from geomtact.geometry.cells import SphereCells
from geomtact.geometry.orbits import (
    apart,
    at_polar,
    axis_of,
    azimuth_in_cones,
    azimuth_of,
    canonical_image,
    images_of,
    turn_period,
)
from geomtact.geometry.symmetry import Symmetry, about
from geomtact.se3 import Array, cross, hat, random_rotations, transform

_TIE = 1e-9  # of a turn's step: halfway between two turns the first is taken, whatever the last digit that a processor computes
_BATCH = 2**16  # directions proposed at once; after 16 times as many, a cell counts as one without area


def level_turns(level: int) -> int:
    """Turns at a level: as far apart as its directions."""
    return 6 * 2**level


def level_step(level: int) -> float:
    """Angle between neighbouring rotations of a level [rad]: the cube root of a cell's volume in SO(3)."""
    return float((8 * np.pi**2 / (12 * 4**level * level_turns(level))) ** (1 / 3))


@dataclass(frozen=True)
class Directions:
    """The approach directions that are modelled, and the way from any pose to its cell.

    Attributes
    ----------
    vectors : (D, 3) unit vectors, object frame
    weights : (D,) share of the allowed directions that each stands for, sums to 1
    turns : (D,) number of turns of each
    periods : (D,) range of the turn [rad]: 2 pi, less where symmetry repeats it, 0 where the turn means nothing
    symmetry : the object's
    cones : the allowed approaches, None for all
    cells : of the sphere, None for exact faces and spheres
    """

    vectors: Array
    weights: Array
    turns: NDArray[np.int64]
    periods: Array
    symmetry: Symmetry
    cones: Cones | None
    cells: SphereCells | None
    _cell: NDArray[np.int64]

    @classmethod
    def make(
        cls,
        symmetry: Symmetry,
        approach: Approach | None = None,
        level: int = 2,
        turn_step: float | None = None,
        disks: Cones | None = None,
    ) -> Directions:
        """Directions of one HEALPix ``level``, finer in ``disks`` (direction (3,), half angle [rad]): see ``SphereCells``;
        ``turn_step`` [rad] spaces the turns of exact faces."""
        cones = check_approach(approach)
        if symmetry.kind == "sphere" or (cones and cones[0][1] == 0):
            return cls._faces(symmetry, cones, turn_step or level_step(level))
        cells = SphereCells.make(symmetry, cones, level, disks or [])
        fine, area = cells.points()
        image = canonical_image(fine, symmetry, cones)[1]
        key = cells.cell_of(image)
        total = np.bincount(key, area)
        kept = np.flatnonzero(total)
        cell = np.full(len(cells), -1)
        cell[kept] = np.arange(len(kept))
        weights: Array = total[kept].astype(float)
        if symmetry.kind == "axis" and cones is None:
            # the rows of fine points may line up with the bands, whose areas are known
            weights = -np.diff(cells.band_cosines)[kept]
        vectors = cells.vectors(image, area, key)
        turns = np.full(len(kept), level_turns(level))
        periods = np.full(len(kept), 2 * np.pi)
        return cls(vectors, weights / weights.sum(), turns, periods, symmetry, cones, cells, cell)

    @classmethod
    def _faces(cls, symmetry: Symmetry, cones: Cones | None, turn_step: float) -> Directions:
        if symmetry.kind == "sphere":
            vectors = np.array([cones[0][0] if cones else [0.0, 0.0, 1.0]])
            periods, weights = np.zeros(1), np.ones(1)
        else:
            assert cones is not None
            faces = np.stack([v for v, _ in cones])
            near = np.linalg.norm(faces[:, None] - faces, axis=-1) <= FACE_TOLERANCE
            image = canonical_image(faces[_first_of_each(near)], symmetry, cones)[1]
            same = apart(image, image, symmetry) <= FACE_TOLERANCE
            first = _first_of_each(same)
            vectors = image[first]
            periods = np.array([turn_period(v, symmetry) for v in vectors])
            # faces that symmetry makes equal are one, which stands for all of them
            weights = same[first].sum(1) / len(image)
        turns = np.maximum(1, np.ceil(periods / turn_step - 1e-9)).astype(np.int64)
        return cls(vectors, weights, turns, periods, symmetry, cones, None, np.arange(len(vectors)))

    @property
    def level(self) -> int | None:
        """HEALPix level, or None for exact faces and spheres."""
        return None if self.cells is None else self.cells.level

    def angle_step(self, turn_step: float) -> float:
        """Angle between neighbouring rotations [rad]; ``turn_step`` is that of exact faces."""
        if self.level is not None:
            return level_step(self.level)
        return turn_step if self.periods.any() else 0.0

    def disk_step(self, a: Array) -> float:
        """Angle [rad] across the cells of the disk that holds an approach direction ``a`` (3,); inf where none does."""
        return np.inf if self.cells is None else self.cells.disk_step(a)

    @cached_property
    def _along_x(self) -> Array:
        """What is along the sensor's x axis at turn 0 of each direction (D, 3), object frame."""
        return facing(self.vectors)[:, 0]

    @cached_property
    def first_turn(self) -> NDArray[np.int64]:
        """Which of :meth:`rotations` is turn 0 of each direction (D,)."""
        return np.cumsum(self.turns) - self.turns

    def direction_of_rotation(self, rotations: ArrayLike) -> NDArray[np.int64]:
        """The direction (n,) of rotations (n,), counted as :meth:`rotations` does."""
        return np.searchsorted(self.first_turn, np.asarray(rotations), side="right") - 1

    def rotations(self) -> tuple[Array, NDArray[np.int64], Array]:
        """R_sensor_object (M, 3, 3) of all cells, direction by direction, their direction (M,) and turn [rad] (M,)."""
        direction = np.repeat(np.arange(len(self.vectors)), self.turns)
        turn = np.concatenate([np.arange(n) * p / n for n, p in zip(self.turns, self.periods, strict=True)])
        Rz = Rotation.from_euler("z", turn[:, None]).as_matrix()
        return Rz @ facing(self.vectors)[direction], direction, turn

    def draw(self, cells: ArrayLike, rng: np.random.Generator) -> Array:
        """Allowed rotations (n, 3, 3) uniform within cells (n,), counted as :meth:`rotations` does."""
        cells = np.asarray(cells)
        k = self.direction_of_rotation(cells)
        turn = cells - self.first_turn[k]
        psi = turn * self.periods[k] / self.turns[k] + rng.uniform(-0.5, 0.5, len(k)) * self.periods[k] / self.turns[k]
        a = self._draw_directions(k, rng)
        Rz = Rotation.from_euler("z", psi[:, None]).as_matrix()
        R = Rz @ facing(self.vectors[k]) @ np.swapaxes(_smallest_rotation(self.vectors[k], a), -1, -2)
        if self.symmetry.kind == "axis" and self.cones is not None:  # the cell's meridian may lie beside the cones
            R = self.any_image(transform(R, np.zeros(3)), rng)[:, :3, :3]
        return R

    def _draw_directions(self, k: NDArray[np.int64], rng: np.random.Generator) -> Array:
        """Approach directions (n, 3) uniform over the allowed ones of direction cells ``k`` (n,), made canonical."""
        a = self.vectors[k].copy()
        if self.cells is None:
            return a
        kept, cells, sym = np.flatnonzero(self._cell >= 0), self.cells, self.symmetry
        if self.cones is not None:
            for cell in np.unique(k):
                mine = np.flatnonzero(k == cell)
                a[mine] = self._draw_in_cones(kept[cell], a[mine], cells, rng)
            return a
        todo = np.arange(len(k))
        for _ in range(200):  # until the draw falls into the cell; a cell too thin to be hit keeps its own direction
            if not len(todo):
                break
            cell = kept[k[todo]]
            if sym.axis is not None:
                cosine = cells.band_cosines
                new = at_polar(np.atleast_1d(rng.uniform(cosine[cell + 1], cosine[cell])), a[todo], sym.axis)
                fits = np.ones(len(new), bool)
            else:
                new = in_cone(*cells.disk_around(cell), rng)
                own = np.abs(canonical_image(new, sym, None)[1] - new).max(-1) < 1e-9
                fits = (cells.cell_of(new) == cell) & own
            a[todo[fits]] = new[fits]
            todo = todo[~fits]
        return a

    def _draw_in_cones(self, cell: np.int64, a: Array, cells: SphereCells, rng: np.random.Generator) -> Array:
        """``a`` (n, 3), the direction of one cell, replaced by such draws; kept where the cell has no area."""
        caps = cells.caps_of(cell)
        n, tried, found = 0, 0, []
        while n < len(a) and tried < 16 * _BATCH:
            new = in_cones(caps, min(_BATCH, max(32, 8 * len(a), tried)), rng)
            tried += len(new)
            image = canonical_image(new[allowed(new, self.cones)], self.symmetry, self.cones)[1]
            found.append(image[cells.cell_of(image) == cell])
            n += len(found[-1])
        new = np.concatenate(found)[: len(a)]
        if self.symmetry.axis is not None:
            new = at_polar(new @ self.symmetry.axis, a[: len(new)], self.symmetry.axis)
        return np.concatenate([new, a[len(new) :]])

    def motions(self, R: ArrayLike) -> Array:
        """Directions (d, 6) of xi, in T exp(xi^), that change where an object turned by ``R`` (3, 3) is and may be allowed: on an
        exact face it turns about the sensor's axis alone."""
        R, sym = np.asarray(R, float), self.symmetry
        if self.cells is not None or sym.kind == "sphere":
            return sym.motions
        about_axis = np.concatenate([R[2], np.cross(sym.centre, R[2])])
        turns = self.periods[self._direction_at(R[None])[0]] > 0
        return np.concatenate([about_axis[None][: int(turns)], np.eye(6)[3:]])

    def _direction_at(self, R: Array) -> NDArray[np.int64]:
        """The direction (n,) of rotations ``R`` (n, 3, 3)."""
        return self.lookup(transform(R, np.zeros(3)))[1]

    def density(self, R: ArrayLike) -> Array:
        """Density (n,) of the uniform distribution of allowed rotations at ``R`` (n, 3, 3), modulo the symmetry, per rad of
        each direction of :meth:`motions` that turns the object."""
        R, cones = np.asarray(R, float), self.cones
        if cones is None or self.symmetry.kind == "sphere":
            return np.full(len(R), self.symmetry.density)
        if self.cells is None:
            k = self._direction_at(R)
            return np.asarray(self.weights[k] / np.where(self.periods[k] > 0, self.periods[k], 1.0))
        share = allowed(-np.einsum("nj,kji->nki", R[:, 2], self._images), cones).mean(1)
        return np.asarray(self.symmetry.density * share / self._allowed_share)

    @cached_property
    def _images(self) -> Array:
        """The symmetry's rotations (k, 3, 3), of a continuous one so many that their share in a cone is known."""
        return self.symmetry.sampled(1440)[:, :3, :3]

    @cached_property
    def _allowed_share(self) -> float:
        """Share of the sphere that the cones cover, each place once."""
        total, cones = 0.0, self.cones or []
        for v, half in cones:
            held_by = sum(allowed(sunflower(v, half, 2000), [cone]).astype(int) for cone in cones)
            total += float(np.sin(half / 2) ** 2 * np.mean(1 / held_by))
        return total

    def any_image(self, T: ArrayLike, rng: np.random.Generator) -> Array:
        """``T`` (n, 4, 4) replaced by its images under the object's symmetry, drawn uniformly among those allowed."""
        T = np.array(T, float)
        sym, n = self.symmetry, len(T)
        if sym.kind == "none":
            return T
        if self.cones is None:
            S = sym.elements[rng.integers(len(sym.elements), size=n)]
            if sym.axis is not None:
                turn = Rotation.from_rotvec(rng.uniform(0, 2 * np.pi, (n, 1)) * sym.axis)
                S = about(turn.as_matrix(), sym.centre) @ S
            elif sym.kind == "sphere":
                S = about(random_rotations(n, rng), sym.centre)
            return T @ S
        if sym.kind == "sphere":
            turn = Rotation.from_euler("z", rng.uniform(0, 2 * np.pi, (n, 1))).as_matrix()
            return _about(T, sym.centre, turn @ facing(in_cones(self.cones, n, rng)))
        images = images_of(approach_of(T[:, :3, :3]), sym)
        if sym.axis is None:
            ok = allowed(images, self.cones)
            return T @ sym.elements[np.argmax(ok * (1 - rng.random(ok.shape)), axis=1)]
        element, azimuth = azimuth_in_cones(images, sym.axis, self.cones, rng)
        angle = azimuth_of(images[np.arange(n), element], sym.axis) - azimuth
        R = Rotation.from_rotvec(angle[:, None] * sym.axis).as_matrix()
        return T @ sym.elements[element] @ about(R, sym.centre)

    def canonical(self, T: ArrayLike) -> Array:
        """The image (n, 4, 4) under the object's symmetry, ``T @ S``, that the grid stores."""
        T = np.asarray(T, float)
        sym = self.symmetry
        if sym.kind == "sphere":
            R = np.broadcast_to(facing(self.vectors[0]), T[:, :3, :3].shape)
            return _about(T, sym.centre, R)
        a = approach_of(T[:, :3, :3])
        element, _ = canonical_image(a, sym, self.cones)
        T = T @ sym.elements[element]
        if sym.kind == "axis":
            a = approach_of(T[:, :3, :3])
            target = self.vectors[self.direction_of(a)]
            axis = axis_of(sym)
            angle = azimuth_of(a, axis) - azimuth_of(target, axis)
            T = _about(T, sym.centre, T[:, :3, :3] @ sym.turned(angle))
        return T

    def direction_of(self, a: ArrayLike) -> NDArray[np.int64]:
        """Cell (n,) of canonical approach directions ``a`` (n, 3); where a pixel is not kept, the nearest that is."""
        a = np.asarray(a, float)
        if self.cells is None:
            return np.argmin(apart(a, self.vectors, self.symmetry), axis=1)
        cell = self._cell[self.cells.cell_of(a)]
        missing = np.flatnonzero(cell < 0)
        if len(missing):
            cell[missing] = np.argmax(a[missing] @ self.vectors.T, axis=1)
        return cell

    def lookup(self, T: ArrayLike) -> tuple[Array, NDArray[np.int64], NDArray[np.int64]]:
        """Canonical pose (n, 4, 4), direction (n,) and turn index (n,) of the cells that hold ``T`` (n, 4, 4)."""
        T = self.canonical(T)
        R = T[:, :3, :3]
        a = approach_of(R)
        k = self.direction_of(a)
        # carry the cell's direction onto the pose's by the smallest rotation, and what is along x at its turn 0 with it: what
        # remains is the turn
        x = (R @ _carried(self._along_x[k], self.vectors[k], a)[..., None])[..., 0]
        n, period = self.turns[k], self.periods[k]
        safe = np.where(period > 0, period, 1.0)
        turn = np.arctan2(x[:, 1], x[:, 0]) % (2 * np.pi)
        nearest = np.ceil((turn % safe) * n / safe - 0.5 - _TIE).astype(np.int64)
        j = np.where(period > 0, nearest % n, 0)
        return T, k, j


def _first_of_each(same: NDArray[np.bool_]) -> list[int]:
    """The first of each class, of a relation (n, n)."""
    return [i for i in range(len(same)) if not same[i, :i].any()]


def _about(T: Array, centre: Array, R: Array) -> Array:
    """``T`` with its rotation replaced by ``R``, the object's point ``centre`` staying where it is."""
    where = T[:, :3, :3] @ centre + T[:, :3, 3]
    return transform(R, where - R @ centre)


def _carried(x: Array, a: Array, b: Array) -> Array:
    """Vectors ``x`` (n, 3) turned by :func:`_smallest_rotation`, without its matrices."""
    v = cross(a, b)
    ahead = cross(v, x)
    return x + ahead + cross(v, ahead) / np.maximum(1 + (a * b).sum(-1, keepdims=True), 1e-9)


def _smallest_rotation(a: Array, b: Array) -> Array:
    """Rotations (n, 3, 3) that carry unit vectors ``a`` onto ``b`` along great circles (Rodrigues)."""
    v = cross(a, b)
    c = (a * b).sum(-1)[:, None, None]
    W = hat(v)
    return np.eye(3) + W + W @ W / np.maximum(1 + c, 1e-9)
