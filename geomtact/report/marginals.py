"""Marginals of the posterior: the position of the object's centre, and its turn and tilt relative to the first mode."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from geomtact.geometry.symmetry import Symmetry
from geomtact.inference.distribution import row_poses
from geomtact.se3 import Array

if TYPE_CHECKING:
    from geomtact.inference.posterior import Posterior

_POSES, _TURNS = 40_000, 4_000  # that the distributions of the centre and of the turns are drawn from


@dataclass(frozen=True)
class Samples:
    """Values with weights that sum to one.

    ``mark`` is the first mode's value, ``step`` the grid's in the same unit; values lie between ``least`` and ``most``.
    """

    label: str
    values: Array
    weights: Array
    mark: float
    step: float
    least: float = -np.inf
    most: float = np.inf

    def histogram(self, most: int = 36) -> tuple[Array, Array]:
        """Probability in each of n <= ``most`` bins (n,), and their edges (n + 1,), over all but a thousandth of the mass.

        A bin spans a whole number of the grid's steps, else the grid shows as a comb.
        """
        order = np.argsort(self.values)
        mass = np.cumsum(self.weights[order])
        first, last = self.values[order[np.searchsorted(mass, [0.0005, min(0.9995, mass[-1])])]]
        low, high = min(first, self.mark), max(last, self.mark)
        width = self.step * max(1, np.ceil((high - low) / ((most - 2) * self.step)))
        bins = int((high - low) // width) + 2
        start = low - 0.5 * (bins * width - (high - low))
        # where values lie whole steps apart, no edge falls on them
        start = first - (np.floor((first - start) / self.step) + 0.5) * self.step
        return np.histogram(self.values, start + width * np.arange(bins + 1), weights=self.weights)


def marginals(posterior: Posterior, T_first: Array) -> list[Samples]:
    """Distributions of the centre's x, y, z [mm], and of turn and tilt against ``T_first`` [degrees] modulo symmetry.

    The turn is about the z axis of the posterior's frame, the tilt is the rest: R = R_z(turn) R_tilt R_first. A ball has
    neither.
    """
    some = _systematic(np.exp(np.asarray(posterior.log_prob, float)), _POSES)
    poses = row_poses(posterior, some)
    weights = np.full(len(some), 1 / len(some))
    centre = np.asarray(posterior.mesh.centre, float)
    at = 1e3 * (poses[:, :3, :3] @ centre + poses[:, :3, 3])
    first = 1e3 * (T_first[:3, :3] @ centre + T_first[:3, 3])
    grid = posterior.index.resolution
    ball = posterior.mesh.symmetry is not None and posterior.mesh.symmetry.kind == "sphere"
    # the height of a ball varies with its penetration alone, that of other objects mostly with the rotation
    depth_step = posterior.sensor.max_penetration / len(grid.penetrations)
    steps = 1e3 * np.array([grid.step, grid.step, depth_step if ball else grid.step])
    out = [
        Samples(f"centre {axis}, {posterior.frame} frame [mm]", at[:, k], weights, float(first[k]), float(steps[k]))
        for k, axis in enumerate("xyz")
    ]
    if ball:
        return out
    few = poses[:: _POSES // _TURNS, :3, :3]
    turn, tilt = turn_and_tilt(few, T_first[:3, :3], posterior.mesh.symmetry)
    even = np.full(len(few), 1 / len(few))
    angle = float(np.degrees(posterior.index.angle_step))
    return [
        *out,
        Samples("turn about z from mode 1 [°]", turn, even, 0.0, angle, -180.0, 180.0),
        Samples("tilt from mode 1 [°]", tilt, even, 0.0, angle, 0.0, 180.0),
    ]


def turn_and_tilt(R: Array, R_first: Array, symmetry: Symmetry | None) -> tuple[Array, Array]:
    """Turn (n,) in (-180, 180] and tilt (n,) in [0, 180] [degrees] that lead from ``R_first`` (3, 3) to ``R`` (n, 3, 3).

    Of all symmetry images of a rotation, the one nearest to ``R_first`` counts.
    """
    if symmetry is not None and symmetry.kind != "none":
        images = symmetry.sampled()[:, :3, :3]
        # the trace of R S R_first^T grows as its angle shrinks
        nearest = np.einsum("nij,sjk,ik->ns", R, images, R_first, optimize=True).argmax(1)
        R = R @ images[nearest]
    x, y, z, w = Rotation.from_matrix(R @ R_first.T).as_quat(canonical=True).T
    turn = np.degrees(2 * np.arctan2(z, w))
    return (turn + 180) % 360 - 180, np.degrees(2 * np.arctan2(np.hypot(x, y), np.hypot(z, w)))


def _systematic(weights: Array, n: int) -> np.ndarray:
    """Indices (n,) drawn in proportion to ``weights`` by a comb of equal steps, so that the same posterior looks the same."""
    cumulated = np.cumsum(weights)
    return np.searchsorted(cumulated, (np.arange(n) + 0.5) / n * cumulated[-1])
