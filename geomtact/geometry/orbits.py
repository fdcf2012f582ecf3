"""Approach directions modulo the object's symmetry, and the cells of the sphere that they fall into.

Of the directions that symmetry makes one (an orbit) one is kept, the *canonical image*. Cells are HEALPix pixels (Gorski et al.
2005) or, about an axis that the object may be turned around as one likes, bands of polar angle.
"""

from __future__ import annotations

import healpix
import numpy as np
from numpy.typing import ArrayLike, NDArray

from geomtact.geometry.approach import FACE_TOLERANCE, allowed, facing, sunflower
from geomtact.geometry.symmetry import Symmetry
from geomtact.se3 import Array

_FINE = 3  # levels between a pixel and the points that measure how much of it is kept
_PER_CONE = 2048  # points that measure a cone at least
_GENERIC = np.array([0.5402, 0.2911, 0.7896])  # of no machined part's symmetry: picks one image of each orbit


def canonical_image(
    a: Array, symmetry: Symmetry, cones: list[tuple[Array, float]] | None
) -> tuple[NDArray[np.int64], Array]:
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


def fine_points(symmetry: Symmetry, cones: list[tuple[Array, float]] | None, level: int) -> tuple[Array, Array]:
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


def disk_around(pixel: ArrayLike, level: int) -> tuple[Array, float]:
    """Middles (..., 3) of pixels and the half angle [rad] of a disk about each that holds it."""
    middle = np.stack(healpix.pix2vec(2**level, pixel, nest=True), -1)
    return middle, 1.1 * np.sqrt(4 * np.pi / (12 * 4**level))


def caps_of(
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
    middle, widest = disk_around(cell, level)
    middles = symmetry.elements[:, :3, :3] @ middle
    near = np.arccos(np.clip(middles @ v.T, -1, 1)) <= half + widest + FACE_TOLERANCE
    thin = half < widest
    caps = [cones[i] for i in np.flatnonzero(near.any(0) & thin)]
    return caps + [(m, widest) for m in middles[(near & ~thin).any(1)]]


def azimuth_in_cones(
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
        azimuth[todo] = azimuth_of(v[c], axis) + rng.uniform(-1, 1, len(todo)) * reach[todo, g, c]
        # an azimuth inside m cones is drawn m times too often
        off = np.abs((azimuth[todo, None] - azimuth_of(v, axis) + np.pi) % (2 * np.pi) - np.pi)
        m = ((off <= reach[todo, g]) & (tilt[todo, g] <= half + FACE_TOLERANCE)).sum(1)
        todo = todo[rng.random(len(todo)) * m > 1]
    return element, azimuth


def cell_count(symmetry: Symmetry, level: int) -> int:
    return _bands(level) if symmetry.kind == "axis" else 12 * 4**level


def _bands(level: int) -> int:
    """Bands of polar angle about a symmetry axis, as wide as a HEALPix pixel of that level."""
    return int(np.ceil(np.pi / np.sqrt(4 * np.pi / (12 * 4**level))))


def cell_of(a: Array, symmetry: Symmetry, level: int) -> NDArray[np.int64]:
    if symmetry.kind == "axis":
        n = _bands(level)
        angle = np.arccos(np.clip(a @ axis_of(symmetry), -1, 1))
        return np.minimum((angle / np.pi * n).astype(np.int64), n - 1)
    return np.asarray(healpix.vec2pix(2**level, *a.T, nest=True), np.int64)


def band_edges(symmetry: Symmetry, level: int) -> Array:
    """Cosines of the polar angles between the bands; what a flip makes equal counts once, for the upper end."""
    cosine = np.cos(np.linspace(0, np.pi, _bands(level) + 1))
    return np.maximum(cosine, 0) if len(symmetry.elements) > 1 else cosine


def band_vectors(
    image: Array, area: Array, key: NDArray[np.int64], symmetry: Symmetry, cones: list[tuple[Array, float]] | None
) -> Array:
    """Directions of the mean polar angle of each band ``key`` (n,), on an azimuth that the approach allows."""
    axis = axis_of(symmetry)
    middles = np.stack([v for v, _ in cones]) if cones else facing(axis)[:1]
    halves = np.array([half for _, half in cones]) if cones else np.array([np.pi])
    out = []
    for k in np.unique(key):
        members = np.arccos(np.clip(image[key == k] @ axis, -1, 1))
        polar = np.average(members, weights=area[key == k])
        if cones:  # the mean may lie in none of them
            polar = members[np.abs(members - polar).argmin()]
        # of a band, the direction on the azimuth of a cone's own is the deepest inside it
        each = at_polar(np.full(len(middles), np.cos(polar)), middles, axis)
        inside = halves - np.arccos(np.clip((each * middles).sum(-1), -1, 1))
        out.append(each[inside.argmax()])
    return np.array(out)


def at_polar(cosine: Array, a: Array, axis: Array) -> Array:
    """Directions (n, 3) at polar angles of ``cosine`` (n,) from ``axis``, on the azimuths of ``a`` (n, 3)."""
    side = a - (a @ axis)[:, None] * axis
    norm = np.linalg.norm(side, axis=-1, keepdims=True)
    side = np.where(norm > 1e-9, side / np.maximum(norm, 1e-9), facing(axis)[0])
    return cosine[:, None] * axis + np.sqrt(np.maximum(0, 1 - cosine**2))[:, None] * side


def pixel_vectors(
    mean: Array,
    image: Array,
    cell: NDArray[np.int64],
    symmetry: Symmetry,
    cones: list[tuple[Array, float]] | None,
    level: int,
) -> Array:
    """The mean direction of each cell, or the canonical image nearest to it where the mean lies off its own cell."""
    vectors = mean / np.linalg.norm(mean, axis=1, keepdims=True)
    canonical = canonical_image(vectors, symmetry, cones)[1]
    here = np.arange(len(vectors))
    off = np.abs(canonical - vectors).max(-1) > 1e-9
    off |= ~allowed(vectors, cones)
    pixel = cell_of(vectors, symmetry, level)
    own = np.zeros(cell_count(symmetry, level), np.int64) - 1
    own[cell_of(image, symmetry, level)] = cell
    off |= own[pixel] != here
    for k in np.flatnonzero(off):
        member = image[cell == k]
        vectors[k] = member[np.argmax(member @ vectors[k])]
    return vectors


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
