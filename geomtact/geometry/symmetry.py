"""The rotation symmetry of a solid, found from its surface and proven by surface distance.

Every symmetry keeps the surface's centroid and its second moments. Where these leave an axis open (two or three equal
moments) rotations are scanned, and the promising ones are aligned to the surface (point to plane). Only what then maps the whole
surface onto itself within the tolerance is kept: candidates may be wrong, results may not. Mirrors are no rotations.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from geomtact.se3 import Array, hat, random_rotations, transform

MAX_ORDER = 64  # of a discrete axis
_MAX_GROUP = 2 * MAX_ORDER
_SAME = 0.01  # rad: rotations nearer than this are one element; elements of one group are 2 pi / MAX_ORDER apart


@dataclass(frozen=True, eq=False)
class Symmetry:
    """Proper rotations that map an object onto itself.

    Attributes
    ----------
    kind : "none", "discrete", "axis" (any turn about an axis) or "sphere" (any rotation about the centre)
    elements : (G, 4, 4) object to object, the identity first. "discrete": the whole group. "axis": the identity, and a
        half turn that swaps the axis's ends if that is a symmetry too. "none" and "sphere": the identity.
    axis : (3,) unit vector in the object frame for "axis", else None
    centre : (3,) point that every symmetry keeps [m]
    """

    kind: str
    elements: Array
    axis: Array | None
    centre: Array

    def sampled(self, n: int = 72) -> Array:
        """Elements (m, 4, 4) with continuous ones discretised: ``n`` turns of an axis, ``n * n`` rotations of a sphere.

        For priors and pictures; distances have closed forms. The turns of an axis start at 0 and are equally spaced.
        """
        if self.axis is not None:
            turns = Rotation.from_rotvec(2 * np.pi / n * np.arange(n)[:, None] * self.axis).as_matrix()
            return (about(turns, self.centre)[:, None] @ self.elements).reshape(-1, 4, 4)
        if self.kind == "sphere":
            return about(_even_rotations(n * n), self.centre)
        return self.elements

    @property
    def motions(self) -> Array:
        """Directions (d, 6) of xi, in T exp(xi^), that change where an object is: all but turns that are symmetries."""
        shifts = np.eye(6)[3:]
        if self.kind == "sphere":
            return shifts
        if self.axis is None:
            return np.eye(6)
        across = np.linalg.svd(self.axis[None])[2][1:]
        return np.concatenate([np.hstack([across, np.cross(self.centre, across)]), shifts])

    @cached_property
    def turn_parts(self) -> tuple[Array, Array, Array]:
        """What a turn by an angle about the axis leaves, multiplies by its cosine and by its sine: (3, 3) each."""
        assert self.axis is not None
        along = np.outer(self.axis, self.axis)
        return along, np.eye(3) - along, hat(self.axis)

    def turned(self, angle: Array) -> Array:
        """Turns (n, 3, 3) by ``angle`` (n,) [rad] about the axis."""
        along, across, ahead = self.turn_parts
        angle = angle[:, None, None]
        return along + np.cos(angle) * across + np.sin(angle) * ahead

    @property
    def density(self) -> float:
        """Of the uniform distribution of rotations, per rad of each direction that changes how the object is turned."""
        if self.kind == "sphere":
            return 1.0
        return len(self.elements) / (8 * np.pi**2 if self.axis is None else 4 * np.pi)


def about(R: ArrayLike, centre: ArrayLike) -> Array:
    """Rotations ``R`` (..., 3, 3) about ``centre`` (3,) [m] as (..., 4, 4)."""
    R, centre = np.asarray(R, float), np.asarray(centre, float)
    return transform(R, centre - R @ centre)


def group_of(rotvecs: ArrayLike, centre: ArrayLike) -> Array:
    """The finite group (G, 4, 4), identity first, that rotation vectors (k, 3) [rad] about ``centre`` (3,) [m] generate."""
    group = _closure(Rotation.from_rotvec(np.asarray(rotvecs, float).reshape(-1, 3)).as_matrix())
    if group is None:
        raise ValueError(f"the rotations generate no group of at most {_MAX_GROUP} elements")
    return about(group, centre)


def find_symmetry(vertices: ArrayLike, faces: ArrayLike, tolerance: float = 5e-5) -> Symmetry:
    """The rotations that map a surface onto itself.

    Parameters
    ----------
    vertices : (V, 3) [m], in the object frame
    faces : (F, 3)
    tolerance : largest distance from the turned surface to the original one, and back [m]

    Returns
    -------
    Symmetry
        A tessellated body of revolution counts as continuous if every turn stays within the tolerance, else by the number
        of its sides, up to MAX_ORDER.
    """
    body = _Body(np.asarray(vertices, float), np.asarray(faces), tolerance)
    identity = np.eye(4)[None]
    if body.holds(random_rotations(16, np.random.default_rng(1))):
        return Symmetry("sphere", identity, None, body.centre)
    axes, rotations = body.candidates()
    for axis in axes:
        if body.holds(_turns(axis, np.random.default_rng(2).uniform(0, 2 * np.pi, 32))):
            axis = _upward(axis)
            flip = _turns(_perpendicular(axis), np.array([0, np.pi]))
            elements = about(flip, body.centre) if body.holds(flip[1:]) else identity
            return Symmetry("axis", elements, axis, body.centre)
    turns = [_turns(axis, np.array([2 * np.pi / n]))[0] for axis in axes for n in range(MAX_ORDER, 1, -1)]
    group = np.eye(3)[None]
    for R in turns + rotations:  # the axes of inertia first: they are the more exact
        if _are_in(R[None], group)[0] or not body.holds(R[None]):
            continue
        larger = _closure(np.concatenate([group, R[None]]))
        if larger is not None and body.holds(larger[~_are_in(larger, group)]):
            group = larger
    kind = "discrete" if len(group) > 1 else "none"
    return Symmetry(kind, about(group, body.centre), None, body.centre)


class _Body:
    """A surface about its centroid, and how far rotations move it off itself."""

    def __init__(self, vertices: Array, faces: NDArray, tolerance: float) -> None:
        import open3d as o3d

        self.tolerance = tolerance
        corners = vertices[faces]
        area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
        self.centre = np.average(corners.mean(1), axis=0, weights=area)
        corners = corners - self.centre
        total = corners.sum(1)
        # Integral of x x^T over a triangle: its area / 12 times (a a^T + b b^T + c c^T + s s^T), s = a + b + c.
        second = np.einsum("f,fki,fkj->ij", area, corners, corners) + np.einsum("f,fi,fj->ij", area, total, total)
        self.moments, columns = np.linalg.eigh(second / (12 * area.sum()))
        self.principal = columns.T

        rng = np.random.default_rng(0)
        face = rng.choice(len(faces), size=4000, p=area / area.sum())
        weight = rng.dirichlet(np.ones(3), size=4000)
        samples = np.einsum("nk,nki->ni", weight, corners[face])
        own = vertices[np.unique(faces)] - self.centre
        own = own[rng.permutation(len(own))[:20_000]]
        self.samples = samples
        self.points = np.concatenate([own[:200], samples[:200], own[200:], samples[200:]])
        self.scene = o3d.t.geometry.RaycastingScene()
        self.scene.add_triangles(
            o3d.core.Tensor.from_numpy((vertices - self.centre).astype(np.float32)),
            o3d.core.Tensor.from_numpy(faces.astype(np.uint32)),
        )

    def distances(self, R: Array, points: Array) -> Array:
        """Distance (m, n) [m] of ``points`` (n, 3), turned by each of ``R`` (m, 3, 3), from the surface."""
        turned = np.einsum("mij,nj->mni", R, points).astype(np.float32)
        return self.scene.compute_distance(turned).numpy()

    def holds(self, R: Array) -> bool:
        """Whether all of ``R`` (m, 3, 3) and their inverses map the surface onto itself."""
        both = np.concatenate([R, np.swapaxes(R, -1, -2)])
        few = self.points[:400]
        return bool(
            all(self.distances(S[None], few).max() <= self.tolerance for S in both)
            and all(self.distances(S[None], self.points).max() <= self.tolerance for S in both)
        )

    def candidates(self) -> tuple[list[Array], list[Array]]:
        """Directions (3,) that may be axes of turns of any order, and further rotations (3, 3) to test."""
        axes = list(self.principal)
        low, mid, high = self.moments
        # What the tolerance can do to second moments, generously: too many candidates only cost time.
        blur = 8 * self.tolerance * np.sqrt(high)
        if high - low <= blur:
            threefold = self._aligned(_hemisphere(2000), 3)
            axes += threefold
            return axes, [
                _turns(a, np.array([2 * np.pi / n]))[0] for n in (2, 5) for a in self._aligned(_hemisphere(2000), n)
            ]
        if mid - low <= blur or high - mid <= blur:
            first, second = (self.principal[0], self.principal[1]) if mid - low <= blur else self.principal[1:]
            angle = np.linspace(0, np.pi, 360, endpoint=False)[:, None]
            around = np.cos(angle) * first + np.sin(angle) * second
            return axes, [_turns(a, np.array([np.pi]))[0] for a in self._aligned(around, 2)]
        return axes, []

    def _aligned(self, directions: Array, order: int) -> list[Array]:
        """Of ``directions`` (n, 3), the best apart as axes of this order, each aligned to the surface."""
        angle = 2 * np.pi / order
        R = Rotation.from_rotvec(angle * directions).as_matrix()
        score = np.concatenate([self.distances(part, self.samples[:64]).mean(1) for part in np.array_split(R, 16)])
        found: list[Array] = []
        tried: list[Array] = []
        for k in score.argsort():
            if len(tried) == 24:
                break
            if all(abs(directions[k] @ a) < np.cos(np.radians(6)) for a in tried):
                tried.append(directions[k])
                axis = self._align(R[k])
                if self.holds(_turns(axis, np.array([angle]))):
                    found.append(_upward(axis))
        return found

    def _align(self, R: Array) -> Array:
        """Axis (3,) of the rotation near ``R`` that fits the surface best: Gauss-Newton, point to plane."""
        import open3d as o3d

        points = self.samples[:600]
        for _ in range(8):
            turned = points @ R.T
            query = o3d.core.Tensor.from_numpy(turned.astype(np.float32))
            nearest = self.scene.compute_closest_points(query)
            # a face of no area has none
            normals = np.nan_to_num(nearest["primitive_normals"].numpy().astype(float))
            residual = ((turned - nearest["points"].numpy()) * normals).sum(1)
            J = np.cross(turned, normals)
            # Turns that the surface does not resist are left alone.
            step = np.linalg.pinv(J.T @ J, rcond=1e-6, hermitian=True) @ (J.T @ residual)
            R = Rotation.from_rotvec(-step).as_matrix() @ R
        rotvec = Rotation.from_matrix(R).as_rotvec()
        return rotvec / max(float(np.linalg.norm(rotvec)), 1e-12)


def _turns(axis: Array, angles: Array) -> Array:
    return Rotation.from_rotvec(np.asarray(angles)[:, None] * axis).as_matrix()


def _are_in(R: Array, group: Array) -> NDArray[np.bool_]:
    """Which of ``R`` (m, 3, 3) are among ``group`` (G, 3, 3)."""
    cosine = (R.reshape(-1, 9) @ group.reshape(-1, 9).T - 1) / 2
    return np.asarray((cosine > np.cos(_SAME)).any(1))


def _closure(generators: Array) -> Array | None:
    """The group (G, 3, 3) that rotations generate, identity first; None if it is larger than _MAX_GROUP."""
    group, walked = np.eye(3)[None], 0
    while walked < len(group) <= _MAX_GROUP:
        products = group[walked] @ generators
        new = products[~_are_in(products, group)]
        while len(new):
            group = np.concatenate([group, new[:1]])
            new = new[~_are_in(new, new[:1])]
        walked += 1
    return _polished(group) if len(group) <= _MAX_GROUP else None


def _polished(group: Array) -> Array:
    """The exact group near one whose elements are slightly off: each is the mean of all quotients that should equal it."""
    for _ in range(3):
        products = np.einsum("aij,bkj->abik", group, group)  # a b^-1: so the errors fall quadratically
        which = np.einsum("abij,gij->abg", products, group).argmax(2)
        total = np.zeros_like(group)
        np.add.at(total, which.reshape(-1), products.reshape(-1, 3, 3))
        u, _, vt = np.linalg.svd(total)
        group = u @ vt
    group[0] = np.eye(3)
    return group


def _upward(axis: Array) -> Array:
    """``axis`` or its opposite: the one whose largest component is positive."""
    largest = np.flatnonzero(np.abs(axis) > np.abs(axis).max() - 1e-6)[0]
    return axis * np.sign(axis[largest])


def _perpendicular(axis: Array) -> Array:
    """A unit vector perpendicular to ``axis``, along a coordinate axis where possible."""
    side = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    return side / np.linalg.norm(side)


def _hemisphere(n: int) -> Array:
    """``n`` directions (n, 3) spread evenly over half a sphere (Fibonacci spiral)."""
    k = np.arange(n) + 0.5
    z, turn = k / n, np.pi * (1 + np.sqrt(5)) * k
    return np.stack([np.sqrt(1 - z**2) * np.cos(turn), np.sqrt(1 - z**2) * np.sin(turn), z], -1)


def _even_rotations(n: int) -> Array:
    """``n`` rotations (n, 3, 3) spread evenly, the identity first (super-Fibonacci spirals, Alexa 2022)."""
    s = np.arange(n) + 0.5
    inner, outer = np.sqrt(s / n), np.sqrt(1 - s / n)
    alpha, beta = 2 * np.pi * s / np.sqrt(2), 2 * np.pi * s / 1.533751168755204288118041
    quat = np.stack([inner * np.sin(alpha), inner * np.cos(alpha), outer * np.sin(beta), outer * np.cos(beta)], -1)
    R = Rotation.from_quat(quat)
    return (R * R[0].inv()).as_matrix()
