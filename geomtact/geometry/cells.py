"""The cells of the sphere that approach directions fall into.

Cells are HEALPix pixels (Gorski et al. 2005) or, about an axis that the object may be turned around as one likes, bands of polar
angle. Where these are too wide, about a plane face say, a disk is cut out of them: a round cell in its middle and six round
about, all of one area; about an axis, two bands.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import healpix
import numpy as np
from numpy.typing import ArrayLike, NDArray

from geomtact.geometry.approach import FACE_TOLERANCE, Cones, allowed, facing, sunflower
from geomtact.geometry.orbits import at_polar, axis_of, canonical_image, images_of
from geomtact.geometry.symmetry import Symmetry
from geomtact.se3 import Array

_PARTS = 7  # cells of a disk: one in its middle, six round about
_SAME = 0.01  # rad: how near to each other the directions of one face come out, by mesh and symmetry
_FINE = 3  # levels between a pixel and the points that measure how much of it is kept
_PER_CONE = 2048  # points that measure a cone or a disk at least
_MOST = 1 << 16  # and a cone at most, where they are to lie as close together as in a disk


def within_any(a: Array, disks: Cones, tolerance: float = _SAME) -> bool:
    """Whether one of some directions ``a`` (n, 3) is that of one of the disks, within ``tolerance`` [rad]."""
    return any((np.linalg.norm(a - middle, axis=-1) < tolerance).any() for middle, _ in disks)


def middle_angle(half: float) -> float:
    """Half angle [rad] of the cell in the middle of a disk of half angle ``half`` [rad]."""
    return float(2 * np.arcsin(np.sin(half / 2) / np.sqrt(_PARTS)))


@dataclass(frozen=True, eq=False)
class SphereCells:
    """The sphere cut into cells.

    Attributes
    ----------
    symmetry : the object's
    cones : the allowed approaches, None for all
    level : HEALPix level of the pixels; bands about an axis are as wide as these
    disks : (direction (3,), half angle [rad]) cut into seven cells each, all images under the symmetry; a direction in several
        belongs to the nearest
    """

    symmetry: Symmetry
    cones: Cones | None
    level: int
    disks: Cones

    @classmethod
    def make(cls, symmetry: Symmetry, cones: Cones | None, level: int, disks: Cones) -> SphereCells:
        """With the images of ``disks`` under the symmetry; about an axis, of those about the axis alone."""
        images: Cones = []
        for v, half in disks:
            if symmetry.axis is None or np.linalg.norm(np.cross(v, symmetry.axis)) < _SAME:
                for image in images_of(v[None], symmetry)[0]:
                    if not within_any(image, images):
                        images.append((image, half))
        return cls(symmetry, cones, level, images)

    def __len__(self) -> int:
        if self.symmetry.axis is not None:
            return len(self.edges) - 1
        return 12 * 4**self.level + _PARTS * len(self.disks)

    @cached_property
    def edges(self) -> Array:
        """Polar angles (n + 1,) [rad] between the bands about the symmetry axis."""
        axis = axis_of(self.symmetry)
        n = int(np.ceil(np.pi / np.sqrt(4 * np.pi / (12 * 4**self.level))))
        edges = [np.linspace(0, np.pi, n + 1)]
        for v, half in self.disks:
            rings = np.array([middle_angle(half), half])
            edges.append(rings if v @ axis > 0 else np.pi - rings)
        return np.unique(np.concatenate(edges))

    @property
    def band_cosines(self) -> Array:
        """Cosines (n + 1,) of :attr:`edges`; what a flip makes equal counts once, for the upper end."""
        cosine = np.cos(self.edges)
        return np.maximum(cosine, 0) if len(self.symmetry.elements) > 1 else cosine

    @cached_property
    def middles(self) -> Array:
        """Middles (d, 3) of the disks."""
        return np.array([v for v, _ in self.disks]).reshape(-1, 3)

    def cell_of(self, a: Array) -> NDArray[np.int64]:
        """The cell (n,) of directions ``a`` (n, 3)."""
        if self.symmetry.axis is not None:
            angle = np.arccos(np.clip(a @ self.symmetry.axis, -1, 1))
            return np.clip(np.searchsorted(self.edges, angle, "right") - 1, 0, len(self) - 1)
        cell = np.asarray(healpix.vec2pix(2**self.level, *a.T, nest=True), np.int64)
        disk, part = self._part_of(a)
        return np.where(disk >= 0, 12 * 4**self.level + _PARTS * disk + part, cell)

    def disk_step(self, a: Array) -> float:
        """Angle [rad] across the cells of the disk that holds a direction ``a`` (3,); inf where none does."""
        return min((2 * middle_angle(half) for v, half in self.disks if a @ v >= np.cos(half)), default=np.inf)

    @cached_property
    def _across(self) -> tuple[Array, Array]:
        """Two directions (n, 3) each across the middle of every disk."""
        x, y, _ = np.moveaxis(facing(self.middles), 1, 0)
        return x, y

    def _part_of(self, a: Array) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """The disk (n,) that holds each direction, -1 for none, and which of its cells does (n,): 0 the middle one."""
        if not self.disks:
            return np.full(len(a), -1), np.zeros(len(a), np.int64)
        half = np.array([half for _, half in self.disks])
        disk = (a @ self.middles.T).argmax(1)
        v = self.middles[disk]
        # the share of the disk's area that lies nearer to its middle; by the chord, precise at small angles
        inner = ((a - v) ** 2).sum(1) / (4 * np.sin(half[disk] / 2) ** 2)
        x, y = self._across[0][disk], self._across[1][disk]
        turn = np.arctan2((a * y).sum(1), (a * x).sum(1)) / (2 * np.pi) % 1
        part = np.where(inner * _PARTS <= 1, 0, 1 + (turn * (_PARTS - 1)).astype(np.int64) % (_PARTS - 1))
        return np.where(inner <= 1, disk, -1), part

    def points(self) -> tuple[Array, Array]:
        """Allowed directions (n, 3) that lie evenly, and the area (n,) of each in pixels of the finest grid."""
        fine = np.stack(healpix.pix2vec(self._nside, np.arange(12 * self._nside**2), nest=True), -1)
        # widest first: of a narrow cone only what sticks out of a wide one counts
        ordered = sorted(self.cones or [], key=lambda cone: -cone[1])
        # about an axis the rows of the finest grid may line up with the bands
        wide = [cone for cone in ordered if self._pixels(cone[1]) >= _PER_CONE and self.symmetry.axis is None]
        # these the finest grid measures, or a disk's points within it; thin cones have points of their own
        measured = None if self.cones is None else wide
        disks = self.disks if self.symmetry.axis is None else []
        sets = [(fine[allowed(fine, measured) & ~allowed(fine, disks)], 1.0), *self._over(ordered, len(wide))]
        sets += [(a[allowed(a, measured)], area) for a, area in self._over(disks)]
        return np.concatenate([a for a, _ in sets]), np.concatenate([np.full(len(a), area) for a, area in sets])

    @property
    def _nside(self) -> int:
        return int(2 ** max(self.level + _FINE, 6))

    def _pixels(self, half: float) -> float:
        """Area of a cone or disk of half angle ``half`` [rad], in pixels of the finest grid."""
        return float(12 * self._nside**2 * np.sin(half / 2) ** 2)

    def _over(self, cones: Cones, first: int = 0) -> list[tuple[Array, float]]:
        """Points (n, 3) over each cone from the ``first`` on, as far as it sticks out of those before it, and the area of one."""
        smallest = min((self._pixels(half) for _, half in self.disks), default=np.inf)
        found = []
        for rank, (v, half) in enumerate(cones[first:], first):
            area = self._pixels(half)
            own = sunflower(v, half, int(max(_PER_CONE, area, min(_PER_CONE * area / smallest, _MOST))))
            found.append((own[~allowed(own, cones[:rank])], area / len(own)))
        return found

    def disk_around(self, cell: ArrayLike) -> tuple[Array, Array]:
        """Middles (..., 3) of cells and the half angle (...) [rad] of a disk about each that holds it."""
        cell = np.asarray(cell)
        pixels = 12 * 4**self.level
        middle = np.stack(healpix.pix2vec(2**self.level, np.minimum(cell, pixels - 1), nest=True), -1)
        widest = np.full(cell.shape, 1.1 * np.sqrt(4 * np.pi / pixels))
        disk, part = np.divmod(cell - pixels, _PARTS)
        for i, (v, half) in enumerate(self.disks):
            middle[disk == i] = v
            widest[disk == i] = np.where(part[disk == i] == 0, middle_angle(half), half)
        return middle, widest

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
        # the mean of the cell's; of a disk's middle cell the disk's own, unless symmetry turns the object about it: images of a
        # pose that differ by a turn would all have it, and none of them is the canonical one
        vectors: Array = np.stack([np.bincount(cell, area * image[:, i]) for i in range(3)], -1).astype(float)
        vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
        disk, part = np.divmod(kept - 12 * 4**self.level, _PARTS)
        middle = np.flatnonzero((disk >= 0) & (part == 0))
        own = self.middles[disk[middle]]
        alone = (np.linalg.norm(images_of(own, self.symmetry) - own[:, None], axis=-1) < _SAME).sum(1) == 1
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
