"""Approach directions modulo the object's symmetry, and the cells of the sphere that they fall into.

Of the directions that symmetry makes one (an orbit) one is kept, the *canonical image*. Cells are HEALPix pixels (Gorski et al.
2005) or, about an axis that the object may be turned around as one likes, bands of polar angle. Where a scene asks for finer
ones, about a plane face say, a disk is cut out of them: a round cell in its middle and six round about, all of one area.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import healpix
import numpy as np
from numpy.typing import ArrayLike, NDArray

from geomtact.geometry.approach import FACE_TOLERANCE, allowed, facing, sunflower
from geomtact.geometry.symmetry import Symmetry
from geomtact.se3 import Array

Cones = list[tuple[Array, float]]
_PARTS = 7  # cells of a disk that is cut finer: one in its middle, six round about
_SAME = 0.01  # rad: how near to each other the directions of one face come out, by mesh and symmetry
_FINE = 3  # levels between a pixel and the points that measure how much of it is kept
_PER_CONE, _MOST = 2048, 1 << 16  # points that measure a cone or a disk at least, and a cone about a disk at most
_GENERIC = np.array([0.5402, 0.2911, 0.7896])  # of no machined part's symmetry: picks one image of each orbit


def canonical_image(a: Array, symmetry: Symmetry, cones: Cones | None) -> tuple[NDArray[np.int64], Array]:
    """Which group element (n,) carries each direction to its orbit's canonical allowed image, and that image (n, 3)."""
    images = np.einsum("gji,nj->ngi", symmetry.elements[:, :3, :3], a)
    if symmetry.kind == "axis":
        axis = axis_of(symmetry)
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


def images_of(v: Array, symmetry: Symmetry) -> Array:
    """A direction's images (G, 3) under the elements of the group; about an axis, but for turns."""
    return np.asarray(symmetry.elements[:, :3, :3].swapaxes(1, 2) @ v)


def is_near(v: Array, disks: Cones, tolerance: float = _SAME) -> bool:
    """Whether a direction (3,) is that of one of the disks, give or take ``tolerance`` [rad]."""
    return any(np.linalg.norm(v - other) < tolerance for other, _ in disks)


def middle_cell(half: float) -> float:
    """Half angle [rad] of the cell in the middle of a disk of half angle ``half`` [rad]."""
    return float(half / np.sqrt(_PARTS))


@dataclass(frozen=True, eq=False)
class Partition:
    """The sphere cut into cells, as far as symmetry and approach leave them.

    Attributes
    ----------
    symmetry : the object's
    cones : the allowed approaches, None for all
    level : HEALPix level of the pixels; bands about an axis are as wide as these
    finer : disks (direction (3,), half angle [rad]) cut into seven cells each, the nearest where they overlap; images
        under the symmetry included
    """

    symmetry: Symmetry
    cones: Cones | None
    level: int
    finer: Cones

    @classmethod
    def make(cls, symmetry: Symmetry, cones: Cones | None, level: int, finer: Cones) -> Partition:
        """With the images of ``finer`` under the symmetry; about an axis, of the disks those about the axis."""
        images: Cones = []
        for v, half in finer:
            if symmetry.axis is None or np.linalg.norm(np.cross(v, symmetry.axis)) < _SAME:
                for image in images_of(v, symmetry):
                    images += [] if is_near(image, images) else [(image, half)]
        return cls(symmetry, cones, level, images)

    def __len__(self) -> int:
        if self.symmetry.axis is not None:
            return len(self.edges) - 1
        return 12 * 4**self.level + _PARTS * len(self.finer)

    @cached_property
    def edges(self) -> Array:
        """Polar angles (n + 1,) [rad] between the bands about the symmetry axis."""
        axis = axis_of(self.symmetry)
        n = int(np.ceil(np.pi / np.sqrt(4 * np.pi / (12 * 4**self.level))))
        edges = [np.linspace(0, np.pi, n + 1)]
        for v, half in self.finer:
            rings = np.array([middle_cell(half), half])
            edges.append(rings if v @ axis > 0 else np.pi - rings)
        return np.unique(np.concatenate(edges))

    @property
    def band_cosines(self) -> Array:
        """Cosines (n + 1,) of :attr:`edges`; what a flip makes equal counts once, for the upper end."""
        cosine = np.cos(self.edges)
        return np.maximum(cosine, 0) if len(self.symmetry.elements) > 1 else cosine

    @cached_property
    def middles(self) -> Array:
        """Middles (d, 3) of the disks that are cut finer."""
        return np.array([v for v, _ in self.finer]).reshape(-1, 3)

    def cell_of(self, a: Array) -> NDArray[np.int64]:
        """The cell (n,) of directions ``a`` (n, 3)."""
        if self.symmetry.axis is not None:
            angle = np.arccos(np.clip(a @ self.symmetry.axis, -1, 1))
            return np.clip(np.searchsorted(self.edges, angle, "right") - 1, 0, len(self) - 1)
        cell = np.asarray(healpix.vec2pix(2**self.level, *a.T, nest=True), np.int64)
        disk, part = self._part_of(a)
        return np.where(disk >= 0, 12 * 4**self.level + _PARTS * disk + part, cell)

    def finer_step(self, a: Array) -> float:
        """Angle [rad] across the cell of a direction ``a`` (3,) in a disk that is cut finer; inf elsewhere."""
        return min((2 * middle_cell(half) for v, half in self.finer if a @ v >= np.cos(half)), default=np.inf)

    def _part_of(self, a: Array) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """The disk (n,) that holds each direction, -1 for none, and which of its cells does (n,): 0 the middle one."""
        if not self.finer:
            return np.full(len(a), -1), np.zeros(len(a), np.int64)
        half = np.array([half for _, half in self.finer])
        disk = (a @ self.middles.T).argmax(1)
        v = self.middles[disk]
        # the share of the disk's area that lies nearer to its middle; by the chord, precise at small angles
        inner = ((a - v) ** 2).sum(1) / (4 * np.sin(half[disk] / 2) ** 2)
        x, y, _ = np.moveaxis(facing(v), 1, 0)
        turn = np.arctan2((a * y).sum(1), (a * x).sum(1)) / (2 * np.pi) % 1
        part = np.where(inner * _PARTS <= 1, 0, 1 + (turn * (_PARTS - 1)).astype(np.int64) % (_PARTS - 1))
        return np.where(inner <= 1, disk, -1), part

    def points(self) -> tuple[Array, Array]:
        """Allowed directions (n, 3) that lie evenly, and the area (n,) of each in pixels of the finest grid."""
        nside = 2 ** max(self.level + _FINE, 6)
        fine = np.stack(healpix.pix2vec(nside, np.arange(12 * nside**2), nest=True), -1)

        def pixels(half: float) -> float:
            return float(12 * nside**2 * np.sin(half / 2) ** 2)

        # as close together as over the smallest disk, up to a number
        smallest = min((pixels(half) for _, half in self.finer), default=np.inf)

        def spread(disks: Cones, first: int = 0) -> list[tuple[Array, float]]:
            """Points over each disk from the ``first`` on, as far as it sticks out of those before it, and the area of one."""
            found = []
            for rank, (v, half) in enumerate(disks[first:], first):
                n = min(_PER_CONE * pixels(half) / smallest, _MOST)
                own = sunflower(v, half, int(max(_PER_CONE, pixels(half), n)))
                found.append((own[~allowed(own, disks[:rank])], pixels(half) / len(own)))
            return found

        sets, wide = [(fine, 1.0)], self.cones
        if self.cones is not None:
            # widest first: of a narrow cone only what sticks out of a wide one counts
            ordered = sorted(self.cones, key=lambda cone: -cone[1])
            # about an axis the rows of the finest grid may line up with the bands
            wide = [cone for cone in ordered if pixels(cone[1]) >= _PER_CONE and self.symmetry.axis is None]
            sets = [(fine[allowed(fine, wide)], 1.0), *spread(ordered, len(wide))]
        if self.finer and self.symmetry.axis is None:
            # the finest grid is too coarse for their cells; the points of thin cones are not
            sets[0] = fine[allowed(fine, wide) & ~allowed(fine, self.finer)], 1.0
            sets += [(a[allowed(a, wide)], area) for a, area in spread(self.finer)]
        return np.concatenate([a for a, _ in sets]), np.concatenate([np.full(len(a), area) for a, area in sets])

    def disk_around(self, cell: ArrayLike) -> tuple[Array, Array]:
        """Middles (..., 3) of cells and the half angle (...) [rad] of a disk about each that holds it."""
        cell = np.asarray(cell)
        pixels = 12 * 4**self.level
        middle = np.stack(healpix.pix2vec(2**self.level, np.minimum(cell, pixels - 1), nest=True), -1)
        widest = np.full(cell.shape, 1.1 * np.sqrt(4 * np.pi / pixels))
        disk, part = np.divmod(cell - pixels, _PARTS)
        for i, (v, half) in enumerate(self.finer):
            middle[disk == i] = v
            widest[disk == i] = half
        return middle, np.where((disk >= 0) & (part == 0), 1.001 * widest / np.sqrt(_PARTS), widest)

    def caps_of(self, cell: np.int64) -> Cones:
        """Caps that hold all allowed directions whose images fall into a cell: the smaller of its disk and the cones."""
        assert self.cones is not None
        v, half = np.stack([v for v, _ in self.cones]), np.array([half for _, half in self.cones])
        if self.symmetry.axis is not None:
            low, high = self.edges[cell], self.edges[cell + 1]
            polar = np.arccos(np.clip(v @ self.symmetry.axis, -1, 1))
            ends = [polar, np.pi - polar][: len(self.symmetry.elements)]
            off = np.min([np.abs(end - (low + high) / 2) for end in ends], axis=0)
            return [self.cones[i] for i in np.flatnonzero(off <= half + (high - low) / 2 + FACE_TOLERANCE)]
        middle, widest = self.disk_around(cell)
        middles = self.symmetry.elements[:, :3, :3] @ middle
        near = np.arccos(np.clip(middles @ v.T, -1, 1)) <= half + widest + FACE_TOLERANCE
        thin = half < widest
        caps = [self.cones[i] for i in np.flatnonzero(near.any(0) & thin)]
        return caps + [(m, float(widest)) for m in middles[(near & ~thin).any(1)]]

    def vectors(self, image: Array, area: Array, key: NDArray[np.int64]) -> Array:
        """A direction (c, 3) for each cell that canonical directions ``image`` (n, 3) of cells ``key`` (n,) meet, in order."""
        if self.symmetry.axis is not None:
            return self._of_bands(image, area, key)
        kept, cell = np.unique(key, return_inverse=True)
        # the mean of the cell's; of a disk's middle cell the disk's own, unless symmetry turns the object about it
        vectors: Array = np.stack([np.bincount(cell, area * image[:, i]) for i in range(3)], -1).astype(float)
        vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
        disk, part = np.divmod(kept - 12 * 4**self.level, _PARTS)
        middle = np.flatnonzero((disk >= 0) & (part == 0))
        own = self.middles[disk[middle]]
        turned = np.stack([images_of(v, self.symmetry) for v in own]) if len(own) else np.zeros((0, 1, 3))
        alone = (np.linalg.norm(turned - own[:, None], axis=-1) < _SAME).sum(1) == 1
        vectors[middle[alone]] = own[alone]
        # or the canonical image nearest to it, where that lies off its own cell
        off = np.abs(canonical_image(vectors, self.symmetry, self.cones)[1] - vectors).max(-1) > 1e-9
        off |= ~allowed(vectors, self.cones)
        off |= self.cell_of(vectors) != kept
        for k in np.flatnonzero(off):
            member = image[cell == k]
            vectors[k] = member[np.argmax(member @ vectors[k])]
        return vectors

    def _of_bands(self, image: Array, area: Array, key: NDArray[np.int64]) -> Array:
        """Directions of the mean polar angle of each band ``key`` (n,), on an azimuth that the approach allows."""
        axis = axis_of(self.symmetry)
        middles = np.stack([v for v, _ in self.cones]) if self.cones else facing(axis)[:1]
        halves = np.array([half for _, half in self.cones]) if self.cones else np.array([np.pi])
        out = []
        for k in np.unique(key):
            members = np.arccos(np.clip(image[key == k] @ axis, -1, 1))
            polar = np.average(members, weights=area[key == k])
            if self.cones:  # the mean may lie in none of them
                polar = members[np.abs(members - polar).argmin()]
            # of a band, the direction on the azimuth of a cone's own is the deepest inside it
            each = at_polar(np.full(len(middles), np.cos(polar)), middles, axis)
            inside = halves - np.arccos(np.clip((each * middles).sum(-1), -1, 1))
            out.append(each[inside.argmax()])
        return np.array(out)


def azimuth_in_cones(
    images: Array, axis: Array, cones: Cones, rng: np.random.Generator
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
        azimuth[todo] = azimuth_of(v[c], axis) + rng.uniform(-1, 1, len(todo)) * reach[todo, g, c]
        # an azimuth inside m cones is drawn m times too often
        off = np.abs((azimuth[todo, None] - azimuth_of(v, axis) + np.pi) % (2 * np.pi) - np.pi)
        m = ((off <= reach[todo, g]) & (tilt[todo, g] <= half + FACE_TOLERANCE)).sum(1)
        todo = todo[rng.random(len(todo)) * m > 1]
    return element, azimuth


def at_polar(cosine: Array, a: Array, axis: Array) -> Array:
    """Directions (n, 3) at polar angles of ``cosine`` (n,) from ``axis``, on the azimuths of ``a`` (n, 3)."""
    side = a - (a @ axis)[:, None] * axis
    norm = np.linalg.norm(side, axis=-1, keepdims=True)
    side = np.where(norm > 1e-9, side / np.maximum(norm, 1e-9), facing(axis)[0])
    return cosine[:, None] * axis + np.sqrt(np.maximum(0, 1 - cosine**2))[:, None] * side


def apart(a: Array, b: Array, symmetry: Symmetry) -> Array:
    """How far apart (n, m) [rad, for small angles] directions ``a`` (n, 3) and ``b`` (m, 3) are, up to turns of an axis."""
    if symmetry.axis is None:
        return np.linalg.norm(a[:, None] - b, axis=-1)
    polar_a, polar_b = (
        np.arctan2(np.linalg.norm(np.cross(v, symmetry.axis), axis=-1), v @ symmetry.axis) for v in (a, b)
    )
    return np.abs(polar_a[:, None] - polar_b)


def turn_period(a: Array, symmetry: Symmetry) -> float:
    """Turn after which the object pressed along ``a`` looks the same."""
    if symmetry.axis is not None:
        cosine = abs(float(a @ symmetry.axis))
        if abs(cosine - 1) < FACE_TOLERANCE**2 * 10:
            return 0.0
        # lying on its side, an object whose ends can be swapped looks the same after half a turn
        return np.pi if len(symmetry.elements) > 1 and cosine < 1e-4 else 2 * np.pi
    same = np.linalg.norm(symmetry.elements[:, :3, :3] @ a - a, axis=-1) < 1e-4
    return 2 * np.pi / int(same.sum())


def axis_of(symmetry: Symmetry) -> Array:
    assert symmetry.axis is not None
    return symmetry.axis


def azimuth_of(a: Array, axis: Array) -> Array:
    x, y, _ = facing(-axis)
    return np.arctan2(a @ y, a @ x)
