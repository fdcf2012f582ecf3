"""Approach directions modulo the object's symmetry.

Of the directions that symmetry makes one (an orbit) one is kept, the *canonical image*.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from geomtact.geometry.approach import FACE_TOLERANCE, Cones, allowed, facing
from geomtact.geometry.symmetry import Symmetry
from geomtact.se3 import Array

_GENERIC = np.array([0.5402, 0.2911, 0.7896])  # of no machined object's symmetry: picks one image of each orbit


def canonical_image(a: Array, symmetry: Symmetry, cones: Cones | None) -> tuple[NDArray[np.int64], Array]:
    """Which group element (n,) carries each direction to its orbit's canonical allowed image, and that image (n, 3)."""
    images = images_of(a, symmetry)
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


def images_of(a: Array, symmetry: Symmetry) -> Array:
    """Images (n, G, 3) of directions ``a`` (n, 3) under the elements of the group; about an axis, but for turns."""
    return np.asarray(np.einsum("gji,nj->ngi", symmetry.elements[:, :3, :3], a))


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
    x, y = _across(*axis.tolist())
    return np.arctan2(a @ y, a @ x)


@cache
def _across(*axis: float) -> tuple[Array, Array]:
    """Where azimuths about an ``axis`` begin (3,), and what is a quarter of a turn ahead (3,)."""
    x, y, _ = facing(-np.array(axis))
    return x, y
