"""The posterior: a distribution over the discretised contact pose space, and all that is asked of it."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geomtact.contact_space.draw import draw_within
from geomtact.contact_space.index import Index, spelled_out
from geomtact.contact_space.space import ContactSpace
from geomtact.errors import UsageError
from geomtact.geometry.mesh import Mesh
from geomtact.inference.modes import Mode, Refined, grown, mode_at
from geomtact.inference.reference import Reference
from geomtact.se3 import Array, check_transforms, inverse
from geomtact.sensing.sensor import Sensor

_TIE = 1e-9  # log densities that differ by less are the same
_SEEDS = 400  # of the most probable cells, from which modes are grown


@dataclass(frozen=True, eq=False)
class Posterior:
    """The distribution of an object's pose after a touch.

    Attributes
    ----------
    index : the discretised contact pose space it lives on
    cells : (N,) pose ids of the index, ascending; cells that are not among them, nor in their runs, have no mass
    log_prob : (N,) log probability of each, normalised
    frame : "sensor" or "world"
    T_frame_sensor : (4, 4)
    contact : whether the image shows any contact
    elsewhere : without contact, the prior's log density at poses (n, 4, 4) in ``frame``; it is not saved
    log_evidence : log of the mean likelihood under the prior, comparable between objects for the same images and effort
    seed : of the random choices made where credible levels tie
    runs : (N,) how many cells from each of ``cells`` on share one density, as the cells of a block do where there is
        little mass; one each by default
    refined : what registration found, by pose id
    reference : poses of the prior or of the frame before, by which modes are reported at one of their images under the object's
        symmetry
    observations : what the sensors saw, that on whose cells it lives first
    settings, timing_ms, warnings : how it came about
    """

    index: Index
    cells: NDArray[np.int64]
    log_prob: NDArray[np.floating]
    frame: str = "sensor"
    T_frame_sensor: Array = field(default_factory=lambda: np.eye(4))
    contact: bool = True
    elsewhere: Any = None
    log_evidence: float = 0.0
    seed: int = 0
    runs: NDArray[np.int64] | None = None
    refined: dict[int, Refined] = field(default_factory=dict)
    reference: Reference | None = None
    observations: list[Any] = field(default_factory=list)
    settings: dict[str, Any] = field(default_factory=dict)
    timing_ms: dict[str, float] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickled without what can be computed again; its index is read from the cache, once in each process."""
        return Posterior, tuple(getattr(self, each.name) for each in fields(self))

    def __repr__(self) -> str:
        known = f"{-self.entropy_nats:.1f} nats known" if self.contact else "no contact"
        where = f"{self.mesh.name} on {self.sensor.name}, {self.frame} frame"
        return f"Posterior({where}, {len(self.index):,} poses, {known})"

    @property
    def mesh(self) -> Mesh:
        return self.index.mesh

    @property
    def sensor(self) -> Sensor:
        return self.index.sensor

    @property
    def observation(self) -> Any:
        """The touch it came from, None for a loaded posterior."""
        return self.observations[0] if self.observations else None

    @property
    def space(self) -> ContactSpace:
        """The contact pose space, undiscretised, in the sensor's frame."""
        return self.index.space

    @cached_property
    def poses(self) -> Array:
        """Poses (N, 4, 4) of the object in ``frame``, one a run; refined ones where registration found better."""
        return self.poses_of(np.arange(len(self.cells)))

    def poses_of(self, rows: ArrayLike) -> Array:
        """Some rows (m,) of :attr:`poses` (m, 4, 4), without making them all."""
        return self.T_frame_sensor @ self._sensor_poses(np.asarray(rows, np.int64))

    @cached_property
    def entropy_nats(self) -> float:
        """Minus the mean log density under the posterior itself: 0 for the uniform, lower the more is known."""
        p = self._probability
        return -float(p @ np.where(p > 0, self._log_density, 0.0)) if self.contact else 0.0

    @property
    def effective_poses(self) -> float:
        """How many equally likely cells would be as uncertain: exp of the discrete entropy."""
        p = self._probability
        each = self.log_prob if self.runs is None else self.log_prob + self.index.log_share(self.cells, self.runs)
        return float(np.exp(-(p @ np.where(p > 0, each, 0.0)))) if len(p) else 0.0

    def modes(self, k: int = 5) -> list[Mode]:
        """The ``k`` most probable modes, most probable first; none without contact.

        All images of a pose under the object's symmetry are one placement. With a prior, or a frame before, each mode is reported
        at the image nearest to it: to a Gaussian's pose, to the first mode of a posterior or of the frame before, to the poses of
        a pair around it, or where a function is largest. Distances are mean squares over the surface.
        """
        if not self.contact or k < 1:
            return []
        return [mode_at(self, cell, mass) for cell, mass in grown(self, k)]

    def likeliest(self, n: int) -> Array:
        """The ``n`` most probable poses (m, 4, 4) in ``frame``, most probable first: one a cell, or a run of cells that are told
        alike; refined where registration found better.

        Fewer where there are fewer, none without contact. Most are neighbours; for places that are apart see :meth:`modes`, which
        has the same images under the object's symmetry.
        """
        rows = self._top_rows(n) if self.contact and n > 0 else np.zeros(0, np.int64)
        T = self._sensor_poses(rows[np.argsort(-self._log_mass_of_a_cell[rows], kind="stable")])
        return self.T_frame_sensor @ self.nearest_images(T)

    def nearest_images(self, T: Array) -> Array:
        """The images (n, 4, 4) of poses ``T`` (n, 4, 4), in the sensor frame, that are nearest to :attr:`reference`; themselves
        without one."""
        return T if self.reference is None else self.reference.nearest(T, self.space, self.T_frame_sensor)

    def leading_cells(self, k: int) -> NDArray[np.int64]:
        """Pose ids (m,) of the index at the heart of the ``k`` leading modes, weighed by the most probable cells alone."""
        found = grown(self, k, full=False) if self.contact and k > 0 else []
        return np.array([cell for cell, _ in found], np.int64)

    def likeliest_cells(self, n: int) -> NDArray[np.int64]:
        """Pose ids (m,) of the ``n`` most probable cells, or the hearts of runs of them, the most probable first."""
        rows = self._top_rows(n)
        return self._heart(rows[np.argsort(-self.log_prob[rows], kind="stable")[:n]])

    def shared_anew(
        self,
        cells: NDArray[np.int64],
        log_likelihood: ArrayLike,
        doubt: float = 0.0,
        elsewhere: float = 1.0,
        before: float = 1.0,
        log_prior: NDArray[np.floating] | None = None,
    ) -> Posterior:
        """The posterior in which what the runs that hold ``cells`` (n,) have together is shared out among them again, all but a
        share ``doubt``, which stays. Of what all other runs have, a share ``elsewhere`` counts.

        Each gets by what the images made of it before, to the power ``before``, times exp(``log_likelihood``) (n,), up to a
        constant; one without likelihood keeps what it has, and cells that no run holds get nothing. ``log_prior`` (M,) is the
        log mass of every cell of the index before the images, the uniform's by default.
        """
        row, held_here = self._rows_of(cells)
        row, which = np.unique(row[held_here], return_inverse=True)
        likeliest = np.full(len(row), -np.inf)
        np.maximum.at(likeliest, which, np.asarray(log_likelihood, float)[held_here])
        row, likeliest = row[likeliest > -np.inf], likeliest[likeliest > -np.inf]
        had = self.log_prob[row].astype(float)
        told, at = self._log_density_of(row), self.cells[row]
        with np.errstate(invalid="ignore"):
            if log_prior is not None:
                told = told - (log_prior[at] - self.index.log_weight[at])
            gets = had + likeliest - (1 - before) * np.where(had > -np.inf, told, 0.0)
        if not np.isfinite(gets).any():
            return self
        held = np.logaddexp.reduce(had)
        gets += held - np.logaddexp.reduce(gets)
        # all that counts, of what is left elsewhere: 1 where that counts in full
        total = np.log(elsewhere + (1 - elsewhere) * np.exp(held))
        with np.errstate(divide="ignore"):
            log_prob = self.log_prob + self.log_prob.dtype.type(np.log(elsewhere) - total)
            log_prob[row] = np.logaddexp(gets + np.log1p(-doubt), had + np.log(doubt)) - total
        return replace(self, log_prob=log_prob)

    def log_density(self, T: ArrayLike) -> Any:
        """Natural log of the density at ``T`` (4, 4) or (n, 4, 4), in ``frame``, relative to the uniform distribution.

        -inf outside the contact pose space; inside it finite, unless the prior ruled T out, or T misses another sensor that shows
        contact. Without contact, -inf where T would touch, however deep, and elsewhere the prior's, 0 without one.

        Raises
        ------
        PoseError
            ``T`` is no rigid pose.
        """
        T = check_transforms(T)
        inside = inverse(self.T_frame_sensor) @ T.reshape(-1, 4, 4)
        out = np.full(len(inside), -np.inf)
        if self.contact:
            depth = self.space.penetration(inside)
            touching = np.isfinite(depth)
            if touching.any():
                out[touching] = self.cell_log_density(self.index.lookup(inside[touching], depth[touching]))
        else:
            free = self.space.caster.penetration(self.sensor, inside) <= 0
            out[free] = self.elsewhere(T.reshape(-1, 4, 4)[free]) if self.elsewhere else 0.0
        return float(out[0]) if T.ndim == 2 else out.reshape(T.shape[:-2])

    def cell_log_density(self, ids: ArrayLike) -> Array:
        """Log density (n,) in the cells of pose ids (n,) of the index, relative to the uniform distribution."""
        row, held = self._rows_of(np.asarray(ids))
        return np.where(held, self._log_density_of(row), -np.inf)

    @cached_property
    def densities(self) -> NDArray[np.float32]:
        """Density (N,) in every cell of the index, relative to the uniform distribution."""
        out = np.zeros(len(self.index), np.float32)
        if self.runs is None:
            out[self.cells] = np.exp(self.log_prob.astype(np.float32) - self.index.log_weight[self.cells])
        else:
            density = np.exp(self._log_density.astype(np.float32))
            out[spelled_out(self.cells, self.runs)] = np.repeat(density, self.runs)
        return out

    def credible_level(self, T: ArrayLike) -> Any:
        """Smallest highest-density mass in [0, 1] whose region holds ``T`` (4, 4) or (n, 4, 4).

        Poses of one cell tie: a share of their mass counts, drawn uniformly from T and the posterior's seed. Without contact all
        poses that may not touch tie, whatever the prior makes of them.

        Raises
        ------
        PoseError
            ``T`` is no rigid pose.
        """
        T = check_transforms(T)
        density = np.atleast_1d(self.log_density(T)).ravel()
        known, share = np.isfinite(density), np.array([_share(pose, self.seed) for pose in T.reshape(-1, 4, 4)])
        if len(self.cells):
            edges = np.unique(np.concatenate([density[known] - _TIE, density[known] + _TIE]))
            whole = np.rint(self._probability * 2.0**52)  # whole numbers up to 2**53 add up to the same in any order
            below = np.cumsum(np.bincount(np.searchsorted(edges, self._log_density), whole, len(edges) + 1))
            above, upto = (1 - below[np.searchsorted(edges, density + off)] / below[-1] for off in (_TIE, -_TIE))
            share = above + share * (upto - above)
        out = np.where(known, share, 1.0)
        return float(out[0]) if T.ndim == 2 else out.reshape(T.shape[:-2])

    def sample(self, n: int, rng: np.random.Generator | int) -> Array:
        """``n`` poses (n, 4, 4) drawn by ``rng``, or by one of that seed, from the posterior: uniform within each cell, even a
        refined one, and over the symmetry.

        Raises
        ------
        UsageError
            There is no contact, so no distribution over touching poses; or neither generator nor seed.
        """
        if rng is None:
            raise UsageError(
                "sample: expected a generator or a seed, got None; give one, so that it can be drawn again"
            )
        if not self.contact:
            raise UsageError("sample: the image shows no contact, so there is no distribution of touching poses")
        rng = np.random.default_rng(rng)
        cells = self._draw_cells(n, rng)
        return self.T_frame_sensor @ draw_within(self.index, self.space, cells, rng)[0]

    def save(self, path: Any) -> None:
        """Write it to the file ``path``, such as posterior.npz (no pickles).

        Raises
        ------
        InputError
            It cannot be written there.
        """
        from geomtact.inference.files import save

        save(self, path)

    @staticmethod
    def load(path: Any, cache_dir: Any = None) -> Posterior:
        """Read what :meth:`save` wrote: the file ``path``, or the posterior.npz in that folder. Its index is opened from
        ``cache_dir``, by default ``$GEOMTACT_CACHE`` or the user's cache folder, or built anew where it is no longer there.

        Raises
        ------
        InputError
            The file cannot be read, or is no posterior.
        CacheError
            Its index cannot be opened or built.
        """
        from geomtact.inference.files import load

        return load(path, cache_dir)

    def _runs_of(self, rows: NDArray[np.int64]) -> NDArray[np.int64]:
        """How many cells each of ``rows`` (m,) stands for."""
        return np.ones(len(rows), np.int64) if self.runs is None else self.runs[rows]

    @cached_property
    def _probability(self) -> Array:
        # exponentials in single precision take a fifth of the time, and the scores have no more
        return np.exp(self.log_prob.astype(np.float32)).astype(float)

    @cached_property
    def _log_density(self) -> Array:
        """Log density (N,) of the runs relative to the uniform distribution."""
        return self._log_density_of(np.arange(len(self.cells)))

    def _log_density_of(self, rows: NDArray[np.int64]) -> Array:
        """As :attr:`_log_density`, of some rows (m,)."""
        with np.errstate(divide="ignore", invalid="ignore"):
            if self.runs is None:
                log_mass = self.index.log_weight[self.cells[rows]]
            else:
                log_mass = np.log(self.index.mass(self.cells[rows], self.runs[rows]))
            density = (self.log_prob[rows] - log_mass).astype(float)
        return np.where(np.isfinite(density), density, -np.inf)

    def _sensor_poses(self, rows: NDArray[np.int64]) -> Array:
        """Poses (m, 4, 4) of ``rows`` in the sensor frame."""
        return self._poses_of_cells(self._heart(rows))

    def _poses_of_cells(self, cells: NDArray[np.int64]) -> Array:
        """Poses (m, 4, 4) of ``cells`` (m,) in the sensor frame."""
        T = self.index.poses(cells)
        if self.refined:
            for i in np.flatnonzero(np.isin(cells, list(self.refined))):
                T[i] = self.refined[int(cells[i])].T
        return T

    def _heart(self, rows: NDArray[np.int64]) -> NDArray[np.int64]:
        """The cell (m,) that stands for each of ``rows`` (m,): that of a run with half of the run's measure before it."""
        cells, runs = self.cells[rows], self._runs_of(rows)
        many = runs > 1
        out = cells.copy()
        out[many] = self.index.within_runs(cells[many], runs[many], 0.5)
        return out

    def _draw_cells(self, n: int, rng: np.random.Generator) -> NDArray[np.int64]:
        total = np.cumsum(self._probability)
        row = np.minimum(np.searchsorted(total, rng.random(n) * total[-1]), len(total) - 1)
        cells, runs = self.cells[row], self._runs_of(row)
        many = runs > 1
        cells[many] = self.index.within_runs(cells[many], runs[many], rng.random(int(many.sum())))
        return cells

    @cached_property
    def _log_mass_of_a_cell(self) -> NDArray[np.floating]:
        """Log mass (N,) of each row, shared alike by the cells that it stands for."""
        p = self.log_prob
        if self.runs is not None:
            many = np.flatnonzero(self.runs > 1)
            p = p.copy()
            p[many] -= np.log(self.runs[many])
        return p

    def _top_rows(self, n: int = _SEEDS) -> NDArray[np.int64]:
        """The ``n`` rows (m,) with the most mass a cell, where there are as many."""
        p = self._log_mass_of_a_cell
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

    def _rows_of(self, ids: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """The row (n,) whose run may hold each pose id (n,), and whether it does."""
        row = np.maximum(np.searchsorted(self.cells, ids, "right") - 1, 0)
        return row, (ids >= self.cells[row]) & (ids < self.cells[row] + self._runs_of(row))


def _share(T: Array, seed: int) -> float:
    """A number in [0, 1) that depends on T and the seed alone."""
    digest = hashlib.blake2b((np.round(T, 12) + 0.0).tobytes() + seed.to_bytes(8, "little", signed=True), digest_size=8)
    return int.from_bytes(digest.digest(), "little") / 2**64
