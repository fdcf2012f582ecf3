"""The modes of a posterior: grown around its densest particles or cells, each counting for one of them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from geomtact.geometry.distance import PoseDistance, mode_radius
from geomtact.inference.distribution import (
    CellDistribution,
    Refined,
    cell_log_density,
    leading_rows,
    nearest_images,
    rows_of,
)
from geomtact.se3 import Array, adjoint, inverse, log

_LEAST, _SPARE = 6, 2  # modes grown at least, and beyond those requested; hand-set
_POINTS = 128  # points of the surface for distances between modes; hand-set
# Particles that count as much as the covariance of registration (as many as a pose has directions) or of a cell; hand-set.
_REGISTERED, _OF_CELL = 6, 1


@dataclass(frozen=True)
class Mode:
    """One place where the object may be.

    Attributes
    ----------
    T : (4, 4), the object in the posterior's frame; of its images under the object's symmetry the one nearest to the prior, or to
        the frame before
    probability : mass within 5 mm or 5 % of the object's diameter, the smaller, of T (mean point distance modulo
        symmetry); each pose counts for its most probable mode only
    covariance : (6, 6) of xi = (rx, ry, rz, tx, ty, tz) in T exp(xi^), radians and metres
    observable : (r, 6) orthonormal rows: the observable directions of xi, rotations scaled by ``length``; no rows where
        they were not computed, as for modes that are not refined
    length : metres by which rotations are scaled before directions are compared
    refined : whether registration found a denser pose
    """

    T: Array
    probability: float
    covariance: Array
    observable: Array
    length: float
    refined: bool

    def __repr__(self) -> str:
        x, y, z = 1e3 * self.T[:3, 3] + 0.0
        return f"Mode({100 * self.probability:.2g} %, object's origin at ({x:.2f}, {y:.2f}, {z:.2f}) mm)"


def grown(posterior: CellDistribution, k: int) -> list[tuple[int, float]]:
    """The cell at the heart of each of the ``k`` leading modes and the mass of the mode, most probable first.

    A few more are grown than asked for: the cell with the most mass need not lie in the mode with the most.
    """
    seeds = np.sort(posterior.cells[leading_rows(posterior)])
    seeds = seeds[np.argsort(-cell_log_density(posterior, seeds) - posterior.index.log_weight[seeds], kind="stable")]
    poses = posterior.index.poses(seeds)
    distance, radius = PoseDistance(posterior.index.mesh, _POINTS), mode_radius(posterior.index.mesh)
    members: list[tuple[int, NDArray[np.int64]]] = []
    covered: set[int] = set()
    for cell, T in zip(seeds.tolist(), poses, strict=True):
        if len(members) == max(k, _LEAST) + _SPARE:
            break
        if cell not in covered:
            near = _within(posterior, T, distance, radius)
            members.append((cell, np.union1d(near, [cell])))
            covered.update(near.tolist())
    return _share_out(posterior, members)[:k]


def modes_within(posterior: CellDistribution, k: int) -> list[Mode]:
    """The ``k`` leading modes of an explored posterior, in its frame."""
    explored = posterior.explored
    assert explored is not None
    out, distance = [], PoseDistance(posterior.index.mesh, _POINTS)
    radius, free = mode_radius(posterior.index.mesh), np.ones(len(explored.poses), bool)
    hearts = explored.settled_hearts(k)
    for number, (heart, mass) in enumerate(zip(hearts, explored.masses[:k].tolist(), strict=True)):
        members = np.flatnonzero(free & distance.within(explored.hearts[number], explored.poses, radius))
        free[members] = False
        found = posterior.refined.get(number)
        if found is None:
            covariance = posterior.index.cell_covariance(heart)
            found = Refined(heart, covariance, np.zeros((0, 6)), posterior.index.mesh.radius_rms, False)
        # a covariance of few particles is that of registration or of a cell, more or less
        fixed = _REGISTERED if len(found.observable) else _OF_CELL
        near = log(inverse(found.T) @ distance.aligned(found.T, explored.poses[members]))
        found = replace(found, covariance=(near.T @ near + fixed * found.covariance) / (len(near) + fixed))
        found = carried(found, nearest_images(posterior, found.T[None])[0])
        T = posterior.T_frame_sensor @ found.T
        out.append(Mode(T, mass, found.covariance, found.observable, found.length, found.moved))
    return out


def mode_at(posterior: CellDistribution, cell: int, mass: float) -> Mode:
    """The mode with its heart at ``cell`` that holds ``mass``, in the posterior's frame."""
    T = _touching_pose(posterior, cell)
    found = Refined(T, posterior.index.cell_covariance(T), np.zeros((0, 6)), posterior.index.mesh.radius_rms, False)
    found = carried(found, nearest_images(posterior, found.T[None])[0])
    T = posterior.T_frame_sensor @ found.T
    return Mode(T, mass, found.covariance, found.observable, found.length, found.moved)


def _touching_pose(posterior: CellDistribution, cell: int) -> Array:
    """The pose (4, 4) of ``cell`` in the sensor frame, moved along z where it presses too deep: the index measures depths on
    height maps, which miss what lies between their pixels."""
    T = posterior.index.poses(np.array([cell]))
    if np.isnan(posterior.index.space.penetration(T)[0]):
        settled, ok = posterior.index.space.settle(
            T, posterior.index.resolution.penetrations[cell // posterior.index.places]
        )
        T = np.where(ok, settled, T)
    return np.asarray(T[0])


def carried(found: Refined, T: Array) -> Refined:
    """``found`` at its image ``T`` (4, 4) under the object's symmetry: a motion xi of the one is A xi of the other."""
    if np.array_equal(T, found.T):
        return found
    back = adjoint(inverse(found.T) @ T)  # xi of the image to xi
    A, scale = np.linalg.inv(back), np.repeat([found.length, 1.0], 3)
    observable = found.observable
    if len(observable):
        observable = np.linalg.qr((observable * scale @ back / scale).T)[0].T
    return replace(found, T=T, covariance=A @ found.covariance @ A.T, observable=observable)


def _share_out(posterior: CellDistribution, members: list[tuple[int, NDArray[np.int64]]]) -> list[tuple[int, float]]:
    """Modes with the cells within reach of each, made exclusive: a cell belongs to its most probable mode."""
    todo = [(cell, inside, _mass_of(posterior, inside)) for cell, inside in members]
    out: list[tuple[int, float]] = []
    while todo:
        best = int(np.argmax([mass.sum() for _, _, mass in todo]))
        cell, taken, mass = todo.pop(best)
        if mass.sum() <= 0:
            break
        out.append((int(cell), float(mass.sum())))
        for _, inside, left in todo:
            left[taken[np.searchsorted(taken, inside).clip(max=len(taken) - 1)] == inside] = 0
    return out


def _within(posterior: CellDistribution, T: Array, distance: PoseDistance, radius: float) -> NDArray[np.int64]:
    """Cells whose poses lie within ``radius`` [m] of ``T`` (4, 4) in mean point distance; sensor frame."""
    cells = posterior.index.perhaps_within(T, distance, radius)
    return cells[distance.within(T, posterior.index.poses(cells), radius)]


def _mass_of(posterior: CellDistribution, cells: NDArray[np.int64]) -> Array:
    """Probability (m,) of each of ``cells`` (m,); 0 where the posterior does not hold it."""
    row, held = rows_of(posterior, cells)
    return np.where(held, np.exp(posterior.cell_log_prob[row]), 0.0)
