"""The direction an object is approached from, and cones of directions that a scene leaves.

A pose's *approach* is the direction from the object towards the sensor in the object frame, ``a = R^T (0, 0, -1)``. A scene
that rules touches out leaves a union of cones of approaches; a cone of half angle 0 is exactly that face.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geomtact.errors import UsageError
from geomtact.se3 import Array

Approach = Sequence[tuple[ArrayLike, float]]
Cones = list[tuple[Array, float]]  # unit vectors (3,) and half angles [rad]
NO_TILT = 1e-8  # rad that an approach of half angle 0 leaves, so that no variance is 0
FACE_TOLERANCE = 1e-6  # rad: how near a pose must come to an approach of half angle 0


def approach_of(R: ArrayLike) -> Array:
    """Direction (..., 3) from the object towards the sensor, in the object frame, of R_sensor_object (..., 3, 3)."""
    return -np.asarray(R, float)[..., 2, :]


def facing(a: ArrayLike) -> Array:
    """A rotation R_sensor_object (..., 3, 3) whose approach is the unit vector ``a`` (..., 3): turn 0 of that direction."""
    z = -np.asarray(a, float)
    z_x, z_y, z_z = np.moveaxis(z, -1, 0)
    # x is perpendicular to z and to the sensor's z axis, or to its y axis where z is nearly along that; all written out, because
    # ``np.cross`` of few vectors takes five times as long
    along, none = np.abs(z_z) > 0.9, np.zeros_like(z_x)
    x = np.stack([np.where(along, z_z, -z_y), np.where(along, none, z_x), np.where(along, -z_x, none)], -1)
    x /= np.linalg.norm(x, axis=-1, keepdims=True)
    x_x, x_y, x_z = np.moveaxis(x, -1, 0)
    y = np.stack([z_y * x_z - z_z * x_y, z_z * x_x - z_x * x_z, z_x * x_y - z_y * x_x], -1)
    return np.stack([x, y, z], -2)


def check_approach(approach: Approach | None) -> list[tuple[Array, float]] | None:
    """Approach as [(unit vector (3,), half angle [rad])].

    Raises
    ------
    UsageError
        Not a list of directions with angles, a direction of no length, an angle outside 0..pi, or exact faces mixed
        with cones.
    """
    if approach is None:
        return None
    try:
        pairs = [(np.asarray(direction, float), float(angle)) for direction, angle in approach]
    except (TypeError, ValueError):
        given = " ".join(repr(approach).split())[:100]
        raise UsageError(
            f"approach: expected [((x, y, z), half_angle)], the angle in radians, 0 for exactly that face, got {given}"
        ) from None
    cones = []
    for v, angle in pairs:
        if v.shape != (3,) or not np.isfinite(v).all() or np.linalg.norm(v) < 1e-12:
            raise UsageError(f"approach: expected a direction of three numbers in the object frame, got {v.tolist()}")
        if not 0 <= angle <= np.pi:
            raise UsageError(f"approach: the half angle is in radians, 0 to pi, got {angle:g}")
        cones.append((v / np.linalg.norm(v), angle))
    if not cones:
        raise UsageError("approach: an empty list rules out every touch; leave it out to allow all")
    if len({angle == 0 for _, angle in cones}) > 1:
        raise UsageError("approach: half angles of 0 (exact faces) cannot be mixed with cones; give all one kind")
    return cones


def to_json(approach: Approach | None) -> list[tuple[list[float], float]] | None:
    """An approach as JSON: directions and half angles [rad]."""
    return None if approach is None else [(np.asarray(v, float).tolist(), float(angle)) for v, angle in approach]


def allowed(a: ArrayLike, cones: list[tuple[Array, float]] | None) -> NDArray[np.bool_]:
    """Whether approach directions ``a`` (..., 3) lie within one of the cones."""
    a = np.asarray(a, float)
    if cones is None:
        return np.ones(a.shape[:-1], bool)
    ok = np.zeros(a.shape[:-1], bool)
    for v, half_angle in cones:
        # the chord keeps its precision at small angles, where the cosine has none
        chord = np.linalg.norm(a - v, axis=-1)
        ok |= 2 * np.arcsin(np.minimum(1, chord / 2)) <= half_angle + FACE_TOLERANCE
    return ok


def in_cone(middle: Array, half_angle: Array, rng: np.random.Generator) -> Array:
    """Directions (n, 3) uniform over cones of ``half_angle`` (n,) [rad] about ``middle`` (n, 3)."""
    cosine = 1 - rng.random(len(middle)) * (1 - np.cos(half_angle))
    return _tilted(middle, cosine, rng.uniform(0, 2 * np.pi, len(middle)))


def in_cones(cones: list[tuple[Array, float]], n: int, rng: np.random.Generator) -> Array:
    """Directions (n, 3) uniform over the union of cones, or of exact faces."""
    a = np.zeros((n, 3))
    v, half = np.stack([v for v, _ in cones]), np.array([half for _, half in cones])
    size = np.where(half > 0, np.sin(half / 2) ** 2, 1.0)
    todo = np.arange(n)
    while len(todo):
        i = rng.choice(len(cones), len(todo), p=size / size.sum())
        a[todo] = in_cone(v[i], half[i], rng)
        # a direction inside m cones is drawn m times too often
        m = sum(allowed(a[todo], [cone]).astype(int) for cone in cones)
        todo = todo[rng.random(len(todo)) * m > 1]
    return a


def sunflower(middle: Array, half_angle: float, n: int) -> Array:
    """Directions (n, 3) that share a cone equally: equal steps of the cosine, each a golden angle further round."""
    i = np.arange(n)
    cosine = 1 - (i + 0.5) / n * (1 - np.cos(half_angle))
    return _tilted(np.tile(middle, (n, 1)), cosine, np.pi * (3 - np.sqrt(5)) * i)


def _tilted(middle: Array, cosine: Array, turn: Array) -> Array:
    """Directions (n, 3) at angles of ``cosine`` (n,) from ``middle`` (n, 3), ``turn`` (n,) [rad] round it."""
    side = np.sqrt(np.maximum(0, 1 - cosine**2))
    local = np.stack([side * np.cos(turn), side * np.sin(turn), cosine], -1)
    # the third row of facing(-v) is v: the cone's axis is the local z
    return np.einsum("nij,ni->nj", facing(-middle), local)
