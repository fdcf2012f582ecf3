"""Rigid transforms: ``T_a_b`` is 4x4 and maps b-coordinates into a, ``p_a = T_a_b @ p_b``.

Twists are ``xi = (rx, ry, rz, tx, ty, tz)``, rotation first, radians and metres, applied on the right:
``T exp(xi^)`` moves the object in its own frame (Barfoot, State Estimation for Robotics, ch. 7).
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from geomtact.errors import PoseError

Array = NDArray[np.float64]


def check_transforms(T: ArrayLike, name: str = "T") -> Array:
    """Return ``T`` as float64 (..., 4, 4) after checking that every matrix is a rigid transform.

    Raises
    ------
    PoseError
        Wrong shape, not finite, or not a rotation within 1e-6; says which.
    """
    try:
        out = np.asarray(T, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise PoseError(f"{name}: expected numbers, 4x4 matrices of one shape, got {type(T).__name__}") from None
    if out.ndim < 2 or out.shape[-2:] != (4, 4):
        raise PoseError(f"{name}: expected rigid transforms of shape (..., 4, 4), got {out.shape}; give 4x4 matrices")
    if not np.isfinite(out).all():
        raise PoseError(f"{name}: expected finite numbers, got NaN or infinity; look where they come from")
    R, last = out[..., :3, :3], out[..., 3, :]
    error = np.abs(R @ np.swapaxes(R, -1, -2) - np.eye(3)).max((-1, -2))
    mirrors, moved = np.linalg.det(R) < 0, np.abs(last - [0, 0, 0, 1]).max(-1)
    bad = np.flatnonzero((error > 1e-6) | mirrors | (moved > 1e-9))
    if len(bad):
        i = int(bad[0])
        which = name if out.ndim == 2 else f"{name}, matrix {i + 1} of {error.size}"
        if error.flat[i] > 1e-6:
            raise PoseError(
                f"{which}: the upper left 3x3 is no rotation (R R^T differs from 1 by {error.flat[i]:.2g}); "
                "orthonormalise it, and give translations in metres"
            )
        if mirrors.flat[i]:
            raise PoseError(f"{which}: the upper left 3x3 is no rotation but mirrors; use right-handed axes")
        transposed = np.abs(out.reshape(-1, 4, 4)[i, :, 3] - [0, 0, 0, 1]).max() <= 1e-9
        hint = "; it looks transposed: translations stand in the last column" if transposed else ""
        raise PoseError(f"{which}: the last row must be 0 0 0 1{hint}")
    return out


def check_pose(T: ArrayLike, name: str = "T") -> Array:
    """Return ``T`` as float64 (4, 4) after checking that it is one rigid transform.

    Raises
    ------
    PoseError
        As of :func:`check_transforms`, or there are several.
    """
    out = check_transforms(T, name)
    if out.shape != (4, 4):
        raise PoseError(f"{name}: expected one pose (4, 4), got shape {out.shape}")
    return out


def transform(R: ArrayLike, t: ArrayLike) -> Array:
    """Homogeneous (..., 4, 4) from rotations (..., 3, 3) and translations (..., 3) [m]."""
    R, t = np.asarray(R, float), np.asarray(t, float)
    shape = np.broadcast_shapes(R.shape[:-2], t.shape[:-1])
    T = np.zeros((*shape, 4, 4))
    T[..., :3, :3] = R
    T[..., :3, 3] = t
    T[..., 3, 3] = 1.0
    return T


def inverse(T: ArrayLike) -> Array:
    """Inverse of rigid transforms (..., 4, 4)."""
    T = np.asarray(T, float)
    Rt = np.swapaxes(T[..., :3, :3], -1, -2)
    return transform(Rt, -(Rt @ T[..., :3, 3, None])[..., 0])


def apply(T: ArrayLike, points: ArrayLike) -> Array:
    """Map ``points`` (n, 3) by ``T`` (..., 4, 4) -> (..., n, 3)."""
    T, points = np.asarray(T, float), np.asarray(points, float)
    return points @ np.swapaxes(T[..., :3, :3], -1, -2) + T[..., None, :3, 3]


def unit(v: ArrayLike) -> Array:
    """Vectors (..., 3) of length 1 along ``v`` (..., 3); 0 stays 0."""
    v = np.asarray(v, float)
    return np.asarray(v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-12))


def hat(w: ArrayLike) -> Array:
    """Cross-product matrices (..., 3, 3) of vectors (..., 3)."""
    w = np.asarray(w, float)
    out = np.zeros((*w.shape, 3))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        out[..., k, j] = w[..., i]
        out[..., j, k] = -w[..., i]
    return out


def cross(a: Array, b: Array) -> Array:
    """Cross products (n, 3) of vectors (n, 3): of few, ``np.cross`` takes five times as long."""
    out = np.empty_like(a)
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        out[:, i] = a[:, j] * b[:, k] - a[:, k] * b[:, j]
    return out


def exp(xi: ArrayLike) -> Array:
    """Exponential of twists (..., 6) -> (..., 4, 4) (Barfoot, eqs. 7.25 and 7.37)."""
    xi = np.asarray(xi, float)
    out = np.zeros((*xi.shape[:-1], 4, 4))
    _exp(np.ascontiguousarray(xi).reshape(-1, 6), out.reshape(-1, 4, 4))
    return out


def left_jacobian(w: ArrayLike) -> Array:
    """Matrices (..., 3, 3) by which the exponential of a twist with the turn ``w`` (..., 3) shifts (Barfoot, eq. 7.37)."""
    w = np.asarray(w, float)
    out = np.empty((*w.shape, 3))
    _left_jacobian(np.ascontiguousarray(w).reshape(-1, 3), out.reshape(-1, 3, 3))
    return out


def log(T: ArrayLike) -> Array:
    """Twist (..., 6) whose exponential is ``T`` (..., 4, 4), rotation angle at most pi."""
    T = np.asarray(T, float)
    out = np.empty((*T.shape[:-2], 6))
    _log(np.ascontiguousarray(T).reshape(-1, 4, 4), out.reshape(-1, 6))
    return out


@numba.njit(nogil=True, cache=True)  # type: ignore[untyped-decorator]
def _exp(xi, T):  # type: ignore[no-untyped-def]
    """Writes the exponential of every ``xi`` (n, 6) to ``T`` (n, 4, 4), which is 0."""
    V = np.empty((3, 3))
    for i in range(len(xi)):
        w, v = xi[i, :3], xi[i, 3:]
        sine, cosine, rest = _of_turn(np.sqrt(w[0] ** 2 + w[1] ** 2 + w[2] ** 2))
        _combined(w, sine, cosine, T[i, :3, :3])
        _combined(w, cosine, rest, V)
        for a in range(3):
            T[i, a, 3] = V[a, 0] * v[0] + V[a, 1] * v[1] + V[a, 2] * v[2]
        T[i, 3, 3] = 1.0


@numba.njit(nogil=True, cache=True)  # type: ignore[untyped-decorator]
def _left_jacobian(w, out):  # type: ignore[no-untyped-def]
    """Writes the matrix of every turn ``w`` (n, 3) to ``out`` (n, 3, 3)."""
    for i in range(len(w)):
        _, cosine, rest = _of_turn(np.sqrt(w[i, 0] ** 2 + w[i, 1] ** 2 + w[i, 2] ** 2))
        _combined(w[i], cosine, rest, out[i])


@numba.njit(nogil=True, cache=True)  # type: ignore[untyped-decorator]
def _log(T, xi):  # type: ignore[no-untyped-def]
    """Writes the logarithm of every ``T`` (n, 4, 4) to ``xi`` (n, 6)."""
    q, inverse_jacobian = np.empty(4), np.empty((3, 3))
    for i in range(len(T)):
        _quaternion(T[i], q)
        n = np.sqrt(q[0] ** 2 + q[1] ** 2 + q[2] ** 2)
        theta = 2 * np.arctan2(n, q[3])
        for a in range(3):
            xi[i, a] = q[a] * (theta / n if n > 1e-12 else 2.0)
        second = 1 / 12 + theta**2 / 720 if theta < 1e-4 else 1 / theta**2 - q[3] / (2 * n * theta)
        _combined(xi[i, :3], -0.5, second, inverse_jacobian)
        for a in range(3):
            xi[i, 3 + a] = 0.0
            for b in range(3):
                xi[i, 3 + a] += inverse_jacobian[a, b] * T[i, b, 3]


@numba.njit(nogil=True, cache=True)  # type: ignore[untyped-decorator]
def _of_turn(theta):  # type: ignore[no-untyped-def]
    """sin(x) / x, (1 - cos(x)) / x^2 and (x - sin(x)) / x^3 at ``theta`` [rad]."""
    if theta < 1e-5:
        return 1 - theta**2 / 6, 0.5 - theta**2 / 24, 1 / 6 - theta**2 / 120
    sine = np.sin(theta)
    return sine / theta, (1 - np.cos(theta)) / theta**2, (theta - sine) / theta**3


@numba.njit(nogil=True, cache=True)  # type: ignore[untyped-decorator]
def _combined(w, first, second, out):  # type: ignore[no-untyped-def]
    """Writes I + ``first`` W + ``second`` W^2 to ``out`` (3, 3), W the cross-product matrix of ``w`` (3,)."""
    on_diagonal = 1 - second * (w[0] ** 2 + w[1] ** 2 + w[2] ** 2)
    for a in range(3):
        b, c = (a + 1) % 3, (a + 2) % 3
        out[a, a] = on_diagonal + second * w[a] ** 2
        out[a, b] = second * w[a] * w[b] - first * w[c]
        out[b, a] = second * w[a] * w[b] + first * w[c]


@numba.njit(nogil=True, cache=True)  # type: ignore[untyped-decorator]
def _quaternion(T, q):  # type: ignore[no-untyped-def]
    """Writes the unit quaternion, x, y, z, w with w >= 0, of a rotation, the first of ``T`` (4, 4), to ``q`` (4,) (Shepperd
    1978)."""
    trace = T[0, 0] + T[1, 1] + T[2, 2]
    a = 0
    for other in (1, 2):
        if T[other, other] > T[a, a]:
            a = other
    b, c = (a + 1) % 3, (a + 2) % 3
    if trace > T[a, a]:
        q[0], q[1], q[2], q[3] = T[2, 1] - T[1, 2], T[0, 2] - T[2, 0], T[1, 0] - T[0, 1], 1 + trace
    else:
        q[a], q[b], q[c] = 1 + 2 * T[a, a] - trace, T[a, b] + T[b, a], T[a, c] + T[c, a]
        q[3] = T[c, b] - T[b, c]
    length = np.sqrt(q[0] ** 2 + q[1] ** 2 + q[2] ** 2 + q[3] ** 2)
    if q[3] < 0:
        length = -length
    for i in range(4):
        q[i] /= length


def adjoint(T: ArrayLike) -> Array:
    """Matrices (..., 6, 6) that carry twists over ``T`` (..., 4, 4): T exp(xi) = exp(adjoint(T) xi) T (Barfoot, eq. 7.40)."""
    T = np.asarray(T, float)
    R, out = T[..., :3, :3], np.zeros((*T.shape[:-2], 6, 6))
    out[..., :3, :3] = out[..., 3:, 3:] = R
    out[..., 3:, :3] = hat(T[..., :3, 3]) @ R
    return out


def random_rotations(n: int, rng: np.random.Generator) -> Array:
    """``n`` rotations (n, 3, 3) uniform in the Haar measure (Shoemake 1992: normalised Gaussian quaternions)."""
    q = rng.normal(size=(n, 4))
    return Rotation.from_quat(q / np.linalg.norm(q, axis=1, keepdims=True)).as_matrix()


def quat_xyzw(T: ArrayLike) -> Array:
    """Unit quaternion (4,) in the order x, y, z, w, with w >= 0, of ``T`` (4, 4)."""
    return Rotation.from_matrix(np.asarray(T, float)[:3, :3]).as_quat(canonical=True)
