"""Rotations as approach direction and turn (Hopf coordinates), modulo the object's symmetry.

A rotation is its approach (``geometry.approach``) and its *turn*, what is left: a rotation about the sensor's z. Haar
measure is solid angle times turn. Directions are HEALPix pixels (Gorski et al. 2005), so level l has 12 * 4^l directions
and 6 * 2^l turns, nested and of equal volume (Yershova et al. 2010): 576, 4,608, 36,864 and 294,912 rotations for l = 1
to 4.

What the object's symmetry makes equal is kept once, and what the scene rules out (``approach``) not at all: every
allowed direction is mapped to one canonical image of its orbit, and a pixel's weight is the solid angle that lands in it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import healpix
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from geomtact.geometry.approach import (
    FACE_TOLERANCE,
    Approach,
    allowed,
    approach_of,
    check_approach,
    facing,
    in_cone,
    in_cones,
    sunflower,
)
from geomtact.geometry.symmetry import Symmetry, about
from geomtact.se3 import Array, hat, random_rotations, transform

_FINE = 3  # levels between a pixel and the points that measure how much of it is kept
_PER_CONE = 2048  # points that measure a cone at least
_BATCH = 2**16  # directions proposed at once; after 16 times as many, a cell is taken for one without area
_GENERIC = np.array([0.5402, 0.2911, 0.7896])  # of no machined part's symmetry: picks one image of each orbit


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
    level : HEALPix level, or None for exact faces and spheres
    """

    vectors: Array
    weights: Array
    turns: NDArray[np.int64]
    periods: Array
    symmetry: Symmetry
    cones: list[tuple[Array, float]] | None
    level: int | None
    _cell: NDArray[np.int64]

    @classmethod
    def make(
        cls, symmetry: Symmetry, approach: Approach | None = None, level: int = 2, turn_step: float | None = None
    ) -> Directions:
        """Directions of one HEALPix ``level``; ``turn_step`` [rad] spaces the turns of exact faces."""
        cones = check_approach(approach)
        if symmetry.kind == "sphere" or (cones and cones[0][1] == 0):
            return cls._faces(symmetry, cones, turn_step or level_step(level))
        fine, area = _fine_points(symmetry, cones, level)
        image = _canonical(fine, symmetry, cones)[1]
        key = _bin(image, symmetry, level)
        total = np.bincount(key, area)
        mean = np.stack([np.bincount(key, area * image[:, i]) for i in range(3)], -1).astype(float)
        kept = np.flatnonzero(total)
        cell = np.full(_bin_count(symmetry, level), -1)
        cell[kept] = np.arange(len(kept))
        weights = total[kept] / total.sum()
        if symmetry.kind == "axis":
            vectors = _on_meridian(image, area, key, symmetry, cones)
            if cones is None:  # the rows of fine points may line up with the bands, whose areas are known
                weights = -np.diff(_edges(symmetry, level))[kept]
                weights /= weights.sum()
        else:
            vectors = _inside(mean[kept], image, cell[key], symmetry, cones, level)
        turns = np.full(len(kept), level_turns(level))
        periods = np.full(len(kept), 2 * np.pi)
        return cls(vectors, weights, turns, periods, symmetry, cones, level, cell)

    @classmethod
    def _faces(cls, symmetry: Symmetry, cones: list[tuple[Array, float]] | None, turn_step: float) -> Directions:
        if symmetry.kind == "sphere":
            vectors = np.array([cones[0][0] if cones else [0.0, 0.0, 1.0]])
            periods, weights = np.zeros(1), np.ones(1)
        else:
            assert cones is not None
            faces = np.stack([v for v, _ in cones])
            near = np.linalg.norm(faces[:, None] - faces, axis=-1) <= FACE_TOLERANCE
            image = _canonical(faces[_first_of_each(near)], symmetry, cones)[1]
            same = _apart(image, image, symmetry) <= FACE_TOLERANCE
            first = _first_of_each(same)
            vectors = image[first]
            periods = np.array([_turn_period(v, symmetry) for v in vectors])
            # faces that symmetry makes equal are one, which stands for all of them
            weights = same[first].sum(1) / len(image)
        turns = np.maximum(1, np.ceil(periods / turn_step - 1e-9)).astype(np.int64)
        return cls(vectors, weights, turns, periods, symmetry, cones, None, np.arange(len(vectors)))

    def angle_step(self, turn_step: float) -> float:
        """Angle between neighbouring rotations [rad]; ``turn_step`` is that of exact faces."""
        if self.level is not None:
            return level_step(self.level)
        return turn_step if self.periods.any() else 0.0

    @cached_property
    def first_turn(self) -> NDArray[np.int64]:
        """Which of :meth:`rotations` is turn 0 of each direction (D,)."""
        return np.cumsum(self.turns) - self.turns

    def rotations(self) -> tuple[Array, NDArray[np.int64], Array]:
        """R_sensor_object (M, 3, 3) of all cells, direction by direction, their direction (M,) and turn [rad] (M,)."""
        direction = np.repeat(np.arange(len(self.vectors)), self.turns)
        turn = np.concatenate([np.arange(n) * p / n for n, p in zip(self.turns, self.periods, strict=True)])
        Rz = Rotation.from_euler("z", turn[:, None]).as_matrix()
        return Rz @ facing(self.vectors)[direction], direction, turn

    def draw(self, cells: ArrayLike, rng: np.random.Generator) -> Array:
        """Allowed rotations (n, 3, 3) uniform within cells (n,), counted as :meth:`rotations` does."""
        _, direction, turn = self.rotations()
        k = direction[np.asarray(cells)]
        psi = turn[np.asarray(cells)] + rng.uniform(-0.5, 0.5, len(k)) * self.periods[k] / self.turns[k]
        a = self._draw_directions(k, rng)
        Rz = Rotation.from_euler("z", psi[:, None]).as_matrix()
        R = Rz @ facing(self.vectors[k]) @ np.swapaxes(_smallest_rotation(self.vectors[k], a), -1, -2)
        if self.symmetry.kind == "axis" and self.cones is not None:  # the cell's meridian may lie beside the cones
            R = self.any_image(transform(R, np.zeros(3)), rng)[:, :3, :3]
        return R

    def _draw_directions(self, k: NDArray[np.int64], rng: np.random.Generator) -> Array:
        """Approach directions (n, 3) uniform over the allowed ones of direction cells ``k`` (n,), made canonical."""
        a = self.vectors[k].copy()
        if self.level is None:
            return a
        kept, level, sym = np.flatnonzero(self._cell >= 0), self.level, self.symmetry
        if self.cones is not None:
            for cell in np.unique(k):
                mine = np.flatnonzero(k == cell)
                a[mine] = self._draw_in_cones(kept[cell], a[mine], self.cones, rng)
            return a
        todo = np.arange(len(k))
        for _ in range(200):  # until the draw falls into the cell; a cell too thin to be hit keeps its own direction
            if not len(todo):
                break
            cell = kept[k[todo]]
            if sym.axis is not None:
                edges = _edges(sym, level)
                new = _at_polar(np.atleast_1d(rng.uniform(edges[cell + 1], edges[cell])), a[todo], sym.axis)
                fits = np.ones(len(new), bool)
            else:
                middle, widest = _disk(cell, level)
                new = in_cone(middle, np.full(len(cell), widest), rng)
                own = np.abs(_canonical(new, sym, None)[1] - new).max(-1) < 1e-9
                fits = (_bin(new, sym, level) == cell) & own
            a[todo[fits]] = new[fits]
            todo = todo[~fits]
        return a

    def _draw_in_cones(
        self, cell: np.int64, a: Array, cones: list[tuple[Array, float]], rng: np.random.Generator
    ) -> Array:
        """``a`` (n, 3), the direction of one pixel or band, replaced by such draws; kept where the cell has no area."""
        assert self.level is not None
        caps = _caps(cell, self.symmetry, cones, self.level)
        n, tried, found = 0, 0, []
        while n < len(a) and tried < 16 * _BATCH:
            new = in_cones(caps, min(_BATCH, max(32, 8 * len(a), tried)), rng)
            tried += len(new)
            image = _canonical(new[allowed(new, cones)], self.symmetry, cones)[1]
            found.append(image[_bin(image, self.symmetry, self.level) == cell])
            n += len(found[-1])
        new = np.concatenate(found)[: len(a)]
        if self.symmetry.axis is not None:
            new = _at_polar(new @ self.symmetry.axis, a[: len(new)], self.symmetry.axis)
        return np.concatenate([new, a[len(new) :]])

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
        images = np.einsum("gji,nj->ngi", sym.elements[:, :3, :3], approach_of(T[:, :3, :3]))
        if sym.axis is None:
            ok = allowed(images, self.cones)
            return T @ sym.elements[np.argmax(ok * (1 - rng.random(ok.shape)), axis=1)]
        element, azimuth = _into_cones(images, sym.axis, self.cones, rng)
        angle = _azimuth(images[np.arange(n), element], sym.axis) - azimuth
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
        element, _ = _canonical(a, sym, self.cones)
        T = T @ sym.elements[element]
        if sym.kind == "axis":
            a = approach_of(T[:, :3, :3])
            target = self.vectors[self.direction_of(a)]
            axis = _axis(sym)
            angle = _azimuth(a, axis) - _azimuth(target, axis)
            S = Rotation.from_rotvec(angle[:, None] * axis).as_matrix()
            T = _about(T, sym.centre, T[:, :3, :3] @ S)
        return T

    def direction_of(self, a: ArrayLike) -> NDArray[np.int64]:
        """Cell (n,) of canonical approach directions ``a`` (n, 3); where a pixel is not kept, the nearest that is."""
        a = np.asarray(a, float)
        if self.level is None:
            return np.argmin(_apart(a, self.vectors, self.symmetry), axis=1)
        cell = self._cell[_bin(a, self.symmetry, self.level)]
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
        # carry the cell's direction onto the pose's by the smallest rotation: what remains is the turn
        level = R @ _smallest_rotation(self.vectors[k], a)
        x = (level @ np.swapaxes(facing(self.vectors[k]), -1, -2))[:, :, 0]
        n, period = self.turns[k], self.periods[k]
        safe = np.where(period > 0, period, 1.0)
        turn = np.arctan2(x[:, 1], x[:, 0]) % (2 * np.pi)
        j = np.where(period > 0, np.rint((turn % safe) * n / safe).astype(np.int64) % n, 0)
        return T, k, j


def _canonical(
    a: Array, symmetry: Symmetry, cones: list[tuple[Array, float]] | None
) -> tuple[NDArray[np.int64], Array]:
    """Which group element (n,) carries each direction to its orbit's canonical allowed image, and that image (n, 3)."""
    images = np.einsum("gji,nj->ngi", symmetry.elements[:, :3, :3], a)
    if symmetry.kind == "axis":
        axis = _axis(symmetry)
        score = images @ axis
        ok = np.ones(score.shape, bool)
        if cones is not None:  # a turn about the axis may bring an image into a cone
            ok = np.zeros(score.shape, bool)
            for v, half_angle in cones:
                tilt = np.arccos(np.clip(score, -1, 1)) - np.arccos(np.clip(v @ axis, -1, 1))
                ok |= np.abs(tilt) <= half_angle + FACE_TOLERANCE
    else:
        score = images @ _GENERIC
        ok = allowed(images, cones)
    best = np.argmax(np.where(ok, score, score - 10.0), axis=1)
    return best, images[np.arange(len(a)), best]


def _fine_points(symmetry: Symmetry, cones: list[tuple[Array, float]] | None, level: int) -> tuple[Array, Array]:
    """Directions (n, 3) that lie evenly over the cones, and the area (n,) of each in pixels of the finest grid."""
    nside = 2 ** max(level + _FINE, 6)
    fine = np.stack(healpix.pix2vec(nside, np.arange(12 * nside**2), nest=True), -1)
    if cones is None:
        return fine, np.ones(len(fine))
    pixels = [12 * nside**2 * np.sin(half / 2) ** 2 for _, half in cones]
    # widest first: of a narrow cone only what sticks out of a wide one counts
    order = np.argsort(pixels)[::-1]
    # about an axis the rows of the finest grid may line up with the bands
    wide = [cones[i] for i in order if pixels[i] >= _PER_CONE and symmetry.axis is None]
    points = [fine[allowed(fine, wide)]]
    area = [np.ones(len(points[0]))]
    for rank, i in enumerate(order[len(wide) :], len(wide)):
        v, half = cones[i]
        own = sunflower(v, half, max(_PER_CONE, int(pixels[i])))
        size = pixels[i] / len(own)
        own = own[~allowed(own, [cones[j] for j in order[:rank]])]
        points.append(own)
        area.append(np.full(len(own), size))
    return np.concatenate(points), np.concatenate(area)


def _disk(pixel: ArrayLike, level: int) -> tuple[Array, float]:
    """Middles (..., 3) of pixels and the half angle [rad] of a disk about each that holds it."""
    middle = np.stack(healpix.pix2vec(2**level, pixel, nest=True), -1)
    return middle, 1.1 * np.sqrt(4 * np.pi / (12 * 4**level))


def _caps(
    cell: np.int64, symmetry: Symmetry, cones: list[tuple[Array, float]], level: int
) -> list[tuple[Array, float]]:
    """Caps that hold all allowed directions whose images fall into a pixel or band: the smaller of its disk and the cones."""
    v, half = np.stack([v for v, _ in cones]), np.array([half for _, half in cones])
    if symmetry.axis is not None:
        width = np.pi / _bands(level)
        polar = np.arccos(np.clip(v @ symmetry.axis, -1, 1))
        ends = [polar, np.pi - polar][: len(symmetry.elements)]
        near = np.min([np.abs(end - (cell + 0.5) * width) for end in ends], axis=0) <= half + width / 2 + FACE_TOLERANCE
        return [cones[i] for i in np.flatnonzero(near)]
    middle, widest = _disk(cell, level)
    middles = symmetry.elements[:, :3, :3] @ middle
    near = np.arccos(np.clip(middles @ v.T, -1, 1)) <= half + widest + FACE_TOLERANCE
    thin = half < widest
    caps = [cones[i] for i in np.flatnonzero(near.any(0) & thin)]
    return caps + [(m, widest) for m in middles[(near & ~thin).any(1)]]


def _into_cones(
    images: Array, axis: Array, cones: list[tuple[Array, float]], rng: np.random.Generator
) -> tuple[NDArray[np.int64], Array]:
    """Which of the images (n, G, 3) and the azimuth (n,) about ``axis`` to turn it to, uniform over what the cones allow."""
    v, half = np.stack([v for v, _ in cones]), np.array([half for _, half in cones])
    polar, polar_v = (np.arctan2(np.linalg.norm(np.cross(axis, a), axis=-1), a @ axis) for a in (images, v))
    polar = polar[..., None]
    tilt = np.abs(polar - polar_v)
    # spherical law of haversines: how far from a cone's azimuth its border is met; a pole is met all round
    room = np.sin((half + 1e-3 * FACE_TOLERANCE) / 2) ** 2 - np.sin(tilt / 2) ** 2
    reach = 2 * np.arcsin(np.sqrt(np.clip(room / np.maximum(np.sin(polar) * np.sin(polar_v), 1e-30), 0, 1)))
    chance = np.where(tilt <= half + FACE_TOLERANCE, reach + 1e-12, 0).reshape(len(images), -1).cumsum(1)
    element, azimuth = np.zeros(len(images), np.int64), np.zeros(len(images))
    todo = np.arange(len(images))
    while len(todo):
        pick = (rng.random((len(todo), 1)) * chance[todo, -1:] < chance[todo]).argmax(1)
        g, c = np.divmod(pick, len(cones))
        element[todo] = g
        azimuth[todo] = _azimuth(v[c], axis) + rng.uniform(-1, 1, len(todo)) * reach[todo, g, c]
        # an azimuth inside m cones is drawn m times too often
        off = np.abs((azimuth[todo, None] - _azimuth(v, axis) + np.pi) % (2 * np.pi) - np.pi)
        m = ((off <= reach[todo, g]) & (tilt[todo, g] <= half + FACE_TOLERANCE)).sum(1)
        todo = todo[rng.random(len(todo)) * m > 1]
    return element, azimuth


def _bin_count(symmetry: Symmetry, level: int) -> int:
    return _bands(level) if symmetry.kind == "axis" else 12 * 4**level


def _bands(level: int) -> int:
    """Bands of polar angle about a symmetry axis, as wide as a HEALPix pixel of that level."""
    return int(np.ceil(np.pi / np.sqrt(4 * np.pi / (12 * 4**level))))


def _bin(a: Array, symmetry: Symmetry, level: int) -> NDArray[np.int64]:
    if symmetry.kind == "axis":
        n = _bands(level)
        angle = np.arccos(np.clip(a @ _axis(symmetry), -1, 1))
        return np.minimum((angle / np.pi * n).astype(np.int64), n - 1)
    return np.asarray(healpix.vec2pix(2**level, *a.T, nest=True), np.int64)


def _edges(symmetry: Symmetry, level: int) -> Array:
    """Cosines of the polar angles between the bands; what a flip makes equal counts once, for the upper end."""
    cosine = np.cos(np.linspace(0, np.pi, _bands(level) + 1))
    return np.maximum(cosine, 0) if len(symmetry.elements) > 1 else cosine


def _on_meridian(
    image: Array, area: Array, key: NDArray[np.int64], symmetry: Symmetry, cones: list[tuple[Array, float]] | None
) -> Array:
    """Directions of the mean polar angle of each band ``key`` (n,), on an azimuth that the approach allows."""
    axis = _axis(symmetry)
    middles = np.stack([v for v, _ in cones]) if cones else facing(axis)[:1]
    halves = np.array([half for _, half in cones]) if cones else np.array([np.pi])
    out = []
    for k in np.unique(key):
        members = np.arccos(np.clip(image[key == k] @ axis, -1, 1))
        polar = np.average(members, weights=area[key == k])
        if cones:  # the mean may lie in none of them
            polar = members[np.abs(members - polar).argmin()]
        # of a band, the direction on the azimuth of a cone's own is the deepest inside it
        each = _at_polar(np.full(len(middles), np.cos(polar)), middles, axis)
        inside = halves - np.arccos(np.clip((each * middles).sum(-1), -1, 1))
        out.append(each[inside.argmax()])
    return np.array(out)


def _at_polar(cosine: Array, a: Array, axis: Array) -> Array:
    """Directions (n, 3) at polar angles of ``cosine`` (n,) from ``axis``, on the azimuths of ``a`` (n, 3)."""
    side = a - (a @ axis)[:, None] * axis
    norm = np.linalg.norm(side, axis=-1, keepdims=True)
    side = np.where(norm > 1e-9, side / np.maximum(norm, 1e-9), facing(axis)[0])
    return cosine[:, None] * axis + np.sqrt(np.maximum(0, 1 - cosine**2))[:, None] * side


def _inside(
    mean: Array,
    image: Array,
    cell: NDArray[np.int64],
    symmetry: Symmetry,
    cones: list[tuple[Array, float]] | None,
    level: int,
) -> Array:
    """The mean direction of each cell, or the canonical image nearest to it where the mean lies off its own cell."""
    vectors = mean / np.linalg.norm(mean, axis=1, keepdims=True)
    canonical = _canonical(vectors, symmetry, cones)[1]
    here = np.arange(len(vectors))
    off = np.abs(canonical - vectors).max(-1) > 1e-9
    off |= ~allowed(vectors, cones)
    pixel = _bin(vectors, symmetry, level)
    own = np.zeros(_bin_count(symmetry, level), np.int64) - 1
    own[_bin(image, symmetry, level)] = cell
    off |= own[pixel] != here
    for k in np.flatnonzero(off):
        member = image[cell == k]
        vectors[k] = member[np.argmax(member @ vectors[k])]
    return vectors


def _apart(a: Array, b: Array, symmetry: Symmetry) -> Array:
    """How far apart (n, m) [rad, for small angles] directions ``a`` (n, 3) and ``b`` (m, 3) are, up to turns of an axis."""
    if symmetry.axis is None:
        return np.linalg.norm(a[:, None] - b, axis=-1)
    polar_a, polar_b = (
        np.arctan2(np.linalg.norm(np.cross(v, symmetry.axis), axis=-1), v @ symmetry.axis) for v in (a, b)
    )
    return np.abs(polar_a[:, None] - polar_b)


def _first_of_each(same: NDArray[np.bool_]) -> list[int]:
    """The first of each class, of a relation (n, n)."""
    return [i for i in range(len(same)) if not same[i, :i].any()]


def _turn_period(a: Array, symmetry: Symmetry) -> float:
    """Turn after which the object pressed along ``a`` looks the same."""
    if symmetry.axis is not None:
        cosine = abs(float(a @ symmetry.axis))
        if abs(cosine - 1) < FACE_TOLERANCE**2 * 10:
            return 0.0
        # lying on its side, an object whose ends can be swapped looks the same after half a turn
        return np.pi if len(symmetry.elements) > 1 and cosine < 1e-4 else 2 * np.pi
    same = np.linalg.norm(symmetry.elements[:, :3, :3] @ a - a, axis=-1) < 1e-4
    return 2 * np.pi / int(same.sum())


def _axis(symmetry: Symmetry) -> Array:
    assert symmetry.axis is not None
    return symmetry.axis


def _azimuth(a: Array, axis: Array) -> Array:
    x, y, _ = facing(-axis)
    return np.arctan2(a @ y, a @ x)


def _about(T: Array, centre: Array, R: Array) -> Array:
    """``T`` with its rotation replaced by ``R``, the object's point ``centre`` staying where it is."""
    where = T[:, :3, :3] @ centre + T[:, :3, 3]
    return transform(R, where - R @ centre)


def _smallest_rotation(a: Array, b: Array) -> Array:
    """Rotations (n, 3, 3) that carry unit vectors ``a`` onto ``b`` along great circles (Rodrigues)."""
    v = np.cross(a, b)
    c = (a * b).sum(-1)[:, None, None]
    W = hat(v)
    return np.eye(3) + W + W @ W / np.maximum(1 + c, 1e-9)
