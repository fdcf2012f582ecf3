"""How far apart two poses of an object are, in the motion of its points, modulo its symmetry.

Mean point distance is ADD (Hinterstoisser et al. 2012), the thesis's pose error; the largest point distance is MSSD
(Hodan et al. 2020). Both are taken at the image under the object's symmetry that is nearest in mean square, the object's centre
put on itself: between poses far apart they may be a little above their least over the symmetry group, between near ones they
are that.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geomtact.geometry.mesh import Mesh, outermost
from geomtact.geometry.symmetry import Symmetry
from geomtact.se3 import Array, apply, transform

_BATCH = 2048


@dataclass(frozen=True, eq=False)
class PoseDistance:
    """Distances between poses of ``mesh``, over ``n`` points spread evenly over its surface."""

    mesh: Mesh
    n: int = 256

    @cached_property
    def points(self) -> Array:
        return self.mesh.surface_points(self.n)

    def mean(self, T: ArrayLike, others: ArrayLike) -> Array:
        """Mean point distance (m,) [m] from the pose ``T`` (4, 4) to ``others`` (m, 4, 4)."""
        return self._distances(T, others, "mean")

    def largest(self, T: ArrayLike, others: ArrayLike) -> Array:
        """Largest point distance (m,) [m] from the pose ``T`` (4, 4) to ``others`` (m, 4, 4)."""
        return self._distances(T, others, "max")

    def within(self, T: ArrayLike, others: ArrayLike, radius: float) -> NDArray[np.bool_]:
        """Whether each of ``others`` (m, 4, 4) lies within ``radius`` [m] of ``T`` in mean point distance."""
        T, others = np.asarray(T, float), np.asarray(others, float)
        # the mean of the points moves no further than the points do in the mean
        moved = (others[:, :3] - T[:3]) @ np.append(self.anchor, 1.0)
        near = np.flatnonzero((moved**2).sum(1) <= (radius + self.slack) ** 2)
        out = np.zeros(len(others), bool)
        out[near] = self.mean(T, others[near]) <= radius
        return out

    @cached_property
    def anchor(self) -> Array:
        """A point (3,) of the object that its symmetry leaves in place, as near as may be to the mean of its points."""
        symmetry, mean = self.mesh.symmetry, self.points.mean(0)
        if symmetry is None or symmetry.kind == "none":
            return mean
        if symmetry.kind == "sphere":
            return symmetry.centre
        mean = apply(symmetry.elements, mean[None])[:, 0].mean(0)
        if symmetry.axis is not None:
            mean = symmetry.centre + (mean - symmetry.centre) @ symmetry.axis * symmetry.axis
        return mean

    @cached_property
    def slack(self) -> float:
        """How much further [m] than the mean point distance the anchor may move between two poses."""
        return 2 * float(np.linalg.norm(self.points.mean(0) - self.anchor))

    @cached_property
    def _centred(self) -> Array:
        return self.points - self.mesh.centre

    def turned(self, R: ArrayLike, others: ArrayLike) -> Array:
        """Root mean square point distance (m,) [m] that the rotation alone makes, from ``R`` (3, 3) to ``others``
        (m, 3, 3), about :attr:`anchor`, modulo the object's symmetry."""
        symmetry, others = self.mesh.symmetry, np.asarray(others, float).reshape(-1, 3, 3)
        if symmetry is not None and symmetry.kind == "sphere":
            return np.zeros(len(others))
        about = self.points - self.anchor
        C = about.T @ about / len(about)
        Q = (np.asarray(R, float).T @ others).reshape(-1, 9)
        overlap = [Q @ kernel for kernel in _kernels(symmetry, C)]
        nearest = overlap[0] + np.hypot(*overlap[1:]) if len(overlap) > 1 else overlap[0]
        return np.sqrt(np.maximum(2 * (np.trace(C) - nearest.max(1)), 0))

    def _distances(self, T: ArrayLike, others: ArrayLike, over: str) -> Array:
        T, others = np.asarray(T, float), np.asarray(others, float).reshape(-1, 4, 4)
        out = np.zeros(len(others))
        points = np.ascontiguousarray(self.points.T)
        here = T[:3, :3] @ points + T[:3, 3:]
        for i in range(0, len(others), _BATCH):
            there = self.aligned(T, others[i : i + _BATCH])
            d = there[:, :3, :3] @ points
            d += there[:, :3, 3:] - here
            d = np.sqrt(np.einsum("mik,mik->mk", d, d))
            out[i : i + _BATCH] = d.mean(1) if over == "mean" else d.max(1)
        return out

    def aligned(self, T: ArrayLike, others: ArrayLike) -> Array:
        """The images (m, 4, 4) of ``others`` under the object's symmetry whose rotations are nearest to that of ``T``, by how far
        they move points about the object's centre, in mean square."""
        T, others = np.asarray(T, float), np.asarray(others, float)
        symmetry = self.mesh.symmetry
        if symmetry is None or symmetry.kind == "none":
            return others
        if symmetry.kind == "sphere":
            where = apply(others, symmetry.centre[None])[:, 0]
            return transform(T[:3, :3], where - T[:3, :3] @ symmetry.centre)
        # E |T p - T' S p|^2 is least where tr(R^T R' S C) is largest, C = E p p^T about the centre
        Q = (T[:3, :3].T @ others[:, :3, :3]).reshape(-1, 9)
        gains = [Q @ kernel for kernel in self._overlap]
        if symmetry.kind == "discrete":
            return others @ symmetry.elements[gains[0].argmax(1)]
        fixed, cosine, sine = gains
        best = (fixed + np.hypot(cosine, sine)).argmax(1)
        row = np.arange(len(others))
        S = symmetry.turned(np.arctan2(sine[row, best], cosine[row, best]))
        S = S @ symmetry.elements[best, :3, :3]
        return others @ transform(S, symmetry.centre - S @ symmetry.centre)

    def is_nearest(self, T: ArrayLike, others: ArrayLike) -> NDArray[np.bool_]:
        """Whether each of ``others`` (m, 4, 4) is the nearest to ``T`` of its images under the object's symmetry; turns about an
        axis are not looked at, because no motion of ``Symmetry.motions`` makes them."""
        T, others = np.asarray(T, float), np.asarray(others, float)
        symmetry = self.mesh.symmetry
        if symmetry is None or len(symmetry.elements) == 1:
            return np.ones(len(others), bool)
        if symmetry.axis is not None:  # a half turn swaps its ends
            return np.asarray((others[:, :3, :3] @ symmetry.axis) @ (T[:3, :3] @ symmetry.axis) > 0)
        return np.asarray(np.abs(self.aligned(T, others) - others).max((1, 2)) < 1e-9)

    @cached_property
    def _overlap(self) -> list[Array]:
        """:func:`_kernels` of the points about the object's centre."""
        return _kernels(self.mesh.symmetry, self._centred.T @ self._centred / len(self._centred))


def _kernels(symmetry: Symmetry | None, C: Array) -> list[Array]:
    """What the nine numbers of R^T R' are multiplied by (9, G) for tr(R^T R' S C) with each element S, of every part of a turn
    about the symmetry's axis before it, or of none; ``C`` (3, 3) = E p p^T."""
    elements = np.eye(3)[None] if symmetry is None else symmetry.elements[:, :3, :3]
    parts = (np.eye(3),) if symmetry is None or symmetry.axis is None else symmetry.turn_parts
    return [np.ascontiguousarray(np.swapaxes(part @ elements @ C, 1, 2).reshape(-1, 9).T) for part in parts]


def mssd(T_true: ArrayLike, T: ArrayLike, mesh: Mesh) -> Array:
    """MSSD (m,) [m]: largest distance of corresponding surface points of ``mesh`` at ``T_true`` (4, 4) and ``T`` (m, 4, 4).

    Over a finite symmetry group it is the least over the group; over a continuous one it is taken at the image that is
    nearest in mean square. A point's distance is convex in the point, so the hull's vertices hold the largest.
    """
    T, symmetry = np.asarray(T, float).reshape(-1, 4, 4), mesh.symmetry
    if symmetry is not None and symmetry.kind == "discrete":
        images = T[:, None] @ symmetry.elements
    else:
        images = PoseDistance(mesh).aligned(T_true, T)[:, None]
    corners = outermost(mesh.vertices)
    here = apply(T_true, corners)
    return np.array([np.linalg.norm(apply(some, corners) - here, axis=-1).max(-1).min() for some in images])


def mode_radius(mesh: Mesh) -> float:
    """Mean point distance within which poses belong to one mode [m]: 5 mm or 5 % of the diameter, the smaller."""
    return min(5e-3, 0.05 * mesh.diameter)
