"""A distribution over the cells of a contact index, and what can be read off single cells."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geomtact.contact_space.index import Index
from geomtact.inference.explored import Explored
from geomtact.inference.facts import Diagnostics, Provenance
from geomtact.inference.reference import Reference
from geomtact.se3 import Array
from geomtact.sensing.reading import Observation

LEADING_CELLS = 400  # number of the most probable cells from which modes are grown; hand-set


@dataclass(frozen=True)
class Refined:
    """What registration found at one mode: its pose in the sensor frame, and the observable directions there."""

    T: Array
    covariance: Array
    observable: Array
    length: float
    moved: bool


@dataclass(frozen=True, eq=False)
class CellDistribution:
    """The content of a posterior.

    Attributes
    ----------
    index : the discretised contact pose space it lives on
    cells : (N,) pose ids of the index, ascending; cells that are not among them have no mass
    cell_log_prob : (N,) log probability of each, normalised
    frame : "sensor" or "world"
    T_frame_sensor : (4, 4)
    contact : whether the image shows any contact
    off_contact_log_density : without contact, the prior's log density at poses (n, 4, 4) in ``frame``; it is not saved
    log_evidence : log of the mean likelihood under the prior, comparable between objects for the same images and effort
    seed : of the random choices made where credible levels tie
    refined : what registration found at the leading modes, by their number, where the pose is resolved within the cells
    explored : the distribution within the cells, which keep the masses that they had before; None where it is that of the cells
    reference : poses of the prior or of the frame before, by which modes are reported at one of their images under the object's
        symmetry
    observations : one for each image, in the order given; none for a loaded posterior
    provenance, diagnostics : what it was made from, and signs of trouble in it
    timing_ms, warnings : time by stage; one line each
    """

    index: Index
    cells: NDArray[np.int64]
    cell_log_prob: NDArray[np.floating]
    frame: str = "sensor"
    T_frame_sensor: Array = field(default_factory=lambda: np.eye(4))
    contact: bool = True
    off_contact_log_density: Callable[[Array], Array] | None = None
    log_evidence: float = 0.0
    seed: int = 0
    refined: dict[int, Refined] = field(default_factory=dict)
    explored: Explored | None = None
    reference: Reference | None = None
    observations: list[Observation] = field(default_factory=list)
    provenance: Provenance = field(default_factory=Provenance)
    diagnostics: Diagnostics = field(default_factory=Diagnostics)
    timing_ms: dict[str, float] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)


def rows_of(posterior: CellDistribution, ids: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """The row (n,) that may be that of each pose id (n,), and whether it is."""
    row = np.minimum(np.searchsorted(posterior.cells, ids), len(posterior.cells) - 1)
    return row, posterior.cells[row] == ids


def row_log_density(posterior: CellDistribution, rows: NDArray[np.int64]) -> Array:
    """Log density (m,) of ``rows`` (m,) relative to the uniform distribution."""
    with np.errstate(divide="ignore", invalid="ignore"):
        density = (posterior.cell_log_prob[rows] - posterior.index.log_weight[posterior.cells[rows]]).astype(float)
    return np.where(np.isfinite(density), density, -np.inf)


def cell_log_density(posterior: CellDistribution, ids: ArrayLike) -> Array:
    """Log density (n,) in the cells of pose ids (n,) of the index, relative to the uniform distribution."""
    row, held = rows_of(posterior, np.asarray(ids))
    return np.where(held, row_log_density(posterior, row), -np.inf)


def cell_densities(posterior: CellDistribution) -> NDArray[np.float32]:
    """Density (N,) in every cell of the index, relative to the uniform distribution."""
    index, cells = posterior.index, posterior.cells
    out = np.zeros(len(index), np.float32)
    out[cells] = np.exp(posterior.cell_log_prob.astype(np.float32) - index.log_weight[cells])
    return out


def row_poses(posterior: CellDistribution, rows: ArrayLike) -> Array:
    """Poses (m, 4, 4) of ``rows`` (m,) in the posterior's frame: those rows of ``Posterior.poses``."""
    if posterior.explored is not None:
        return posterior.T_frame_sensor @ posterior.explored.poses[np.asarray(rows, np.int64)]
    return posterior.T_frame_sensor @ posterior.index.poses(posterior.cells[np.asarray(rows, np.int64)])


def row_log_prob(posterior: CellDistribution) -> NDArray[np.floating]:
    """Log probability (N,) of each of ``Posterior.poses``, normalised."""
    return posterior.cell_log_prob if posterior.explored is None else np.log(posterior.explored.weight)


def leading_rows(posterior: CellDistribution, n: int = LEADING_CELLS) -> NDArray[np.int64]:
    """The ``n`` rows (m,) with the most mass, in any order; fewer where fewer have mass."""
    p = posterior.cell_log_prob
    rows = np.zeros(0, np.int64)
    if len(p) > 100 * n:
        # the quantile of every fiftieth row leaves few to look at; for a small n, by chance, too few
        some, few = p[::50], max(1, n // 5)
        rows = np.flatnonzero(p >= np.partition(some, -few)[-few])
    if len(rows) < n:
        rows = np.arange(len(p))
    if len(rows) > n:
        rows = rows[np.argpartition(p[rows], -n)[-n:]]
    return rows[p[rows] > -np.inf]


def nearest_images(posterior: CellDistribution, T: Array) -> Array:
    """The images (n, 4, 4) of poses ``T`` (n, 4, 4), in the sensor frame, that are nearest to the posterior's reference;
    themselves without one."""
    reference = posterior.reference
    return T if reference is None else reference.nearest(T, posterior.index.space, posterior.T_frame_sensor)
