"""The posterior: a distribution over the discretised contact pose space, and all that is asked of it."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geomtact.contact_space.draw import draw_within
from geomtact.contact_space.space import ContactSpace
from geomtact.errors import UsageError
from geomtact.geometry.approach import to_json
from geomtact.geometry.mesh import Mesh
from geomtact.inference.distribution import (
    CellDistribution,
    cell_log_density,
    leading_rows,
    nearest_images,
    row_log_density,
    row_log_prob,
    row_poses,
)
from geomtact.inference.files import load, save
from geomtact.inference.modes import Mode, grown, mode_at, modes_within
from geomtact.se3 import Array, check_transforms, inverse
from geomtact.sensing.reading import Observation
from geomtact.sensing.sensor import Sensor

_TIE = 1e-9  # nats: log densities that differ by less are equal


@dataclass(frozen=True, eq=False)
class Posterior(CellDistribution):
    """The distribution of an object's pose after a touch; its attributes are those of :class:`CellDistribution`."""

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickled without what can be computed again; its index is read from the cache, once in each process."""
        return Posterior, tuple(getattr(self, each.name) for each in fields(self))

    def __repr__(self) -> str:
        gain = f"information gain {self.information_gain_nats:.1f} nats" if self.contact else "no contact"
        where = f"{self.mesh.name} on {self.sensor.name}, {self.frame} frame"
        return f"Posterior({where}, {len(self.index):,} poses, {gain})"

    @property
    def mesh(self) -> Mesh:
        return self.index.mesh

    @property
    def sensor(self) -> Sensor:
        return self.index.sensor

    @property
    def observation(self) -> Observation | None:
        """The image of the sensor whose cells it lives on: the first with contact. None for a loaded posterior."""
        return self.observations[self.provenance.base] if self.observations else None

    @property
    def space(self) -> ContactSpace:
        """The contact pose space, undiscretised, in the sensor's frame."""
        return self.index.space

    @property
    def settings(self) -> dict[str, Any]:
        """All that was resolved, in types of JSON: a record to keep, not to decide by."""
        view = self.provenance.views[self.provenance.base] if self.provenance.views else None
        return {
            **self.provenance.to_json(),
            "kind": None if view is None else view.kind,
            "contact_method": None if view is None else view.contact_method,
            "seed": self.seed,
            "poses": len(self.index),
            "grid": self.index.resolution.to_json(),
            "approach": to_json(self.index.approach),
        }

    @cached_property
    def poses(self) -> Array:
        """Poses (N, 4, 4) of the object in ``frame``, one per particle or cell."""
        return row_poses(self, np.arange(len(self.log_prob)))

    @cached_property
    def log_prob(self) -> NDArray[np.floating]:
        """Log probability (N,) of each of :attr:`poses`, normalised."""
        return row_log_prob(self)

    @cached_property
    def entropy_nats(self) -> float:
        """Minus the mean log density under the posterior itself: 0 for the uniform, lower for a narrower one."""
        p = self._probability
        return -float(p @ np.where(p > 0, self._log_density, 0.0)) if self.contact else 0.0

    @property
    def information_gain_nats(self) -> float:
        """Minus :attr:`entropy_nats`: the information that the images and the prior give about the pose."""
        return 0.0 - self.entropy_nats

    @property
    def effective_poses(self) -> float:
        """How many cells of mean size, equally likely, would be as uncertain."""
        return float(len(self.index) * np.exp(self.entropy_nats)) if self.contact else 0.0

    def modes(self, k: int = 5) -> list[Mode]:
        """The ``k`` most probable modes, most probable first; none without contact.

        All images of a pose under the object's symmetry are one placement. With a prior, or a frame before, each mode is reported
        at the image nearest to it: to a Gaussian's pose, to the first mode of a posterior or of the frame before, to the poses of
        a pair around it, or where a function is largest. Distances are mean squares over the surface.
        """
        if not self.contact or k < 1:
            return []
        if self.explored is not None:
            return modes_within(self, k)
        return [mode_at(self, cell, mass) for cell, mass in grown(self, k)]

    def likeliest(self, n: int) -> Array:
        """The ``n`` most probable poses (m, 4, 4) in ``frame``, most probable first: particles, or one a cell.

        Fewer where there are fewer, none without contact. Most are neighbours; for places that are apart see :meth:`modes`, which
        has the same images under the object's symmetry.
        """
        if self.explored is not None:
            rows = np.argsort(-self._log_density, kind="stable")[: max(n, 0)]
            return self.T_frame_sensor @ nearest_images(self, self.explored.poses[rows])
        rows = leading_rows(self, n) if self.contact and n > 0 else np.zeros(0, np.int64)
        rows = rows[np.argsort(-self.cell_log_prob[rows], kind="stable")]
        return self.T_frame_sensor @ nearest_images(self, self.index.poses(self.cells[rows]))

    def log_density(self, T: ArrayLike) -> Any:
        """Natural log of the density at ``T`` (4, 4) or (n, 4, 4), in ``frame``, relative to the uniform distribution.

        -inf outside the contact pose space; inside it finite, unless the prior ruled T out, or the grid alone decides and the
        cell of T misses another sensor that shows contact. Where the pose is resolved within the cells, at most that of the
        densest pose in ``poses``. Without contact, -inf where T would touch, however deep, and elsewhere the prior's, 0 without
        one.

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
                out[touching] = self._within(inside[touching], depth[touching])
        else:
            off_contact = self.off_contact_log_density
            free = self.space.caster.penetration(self.sensor, inside) <= 0
            out[free] = off_contact(T.reshape(-1, 4, 4)[free]) if off_contact else 0.0
        return float(out[0]) if T.ndim == 2 else out.reshape(T.shape[:-2])

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
        finite, share = np.isfinite(density), np.array([_share(pose, self.seed) for pose in T.reshape(-1, 4, 4)])
        if self.contact:
            edges = np.unique(np.concatenate([density[finite] - _TIE, density[finite] + _TIE]))
            whole = np.rint(self._probability * 2.0**52)  # whole numbers up to 2**53 add up to the same in any order
            below = np.cumsum(np.bincount(np.searchsorted(edges, self._log_density), whole, len(edges) + 1))
            above, upto = (1 - below[np.searchsorted(edges, density + off)] / below[-1] for off in (_TIE, -_TIE))
            share = above + share * (upto - above)
        out = np.where(finite, share, 1.0)
        return float(out[0]) if T.ndim == 2 else out.reshape(T.shape[:-2])

    def sample(self, n: int, rng: np.random.Generator | int) -> Array:
        """``n`` poses (n, 4, 4) drawn by ``rng``, or by one of that seed, from the posterior: among its particles, or uniform
        within each cell; and over the symmetry.

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
        if self.explored is not None:
            return self.T_frame_sensor @ self.explored.draw(n, rng)
        cells = self._draw_cells(n, rng)
        return self.T_frame_sensor @ draw_within(self.index, self.space, cells, rng)[0]

    def save(self, path: str | Path) -> None:
        """Write it to the file ``path``, such as posterior.npz (no pickles).

        Raises
        ------
        InputError
            It cannot be written there.
        """
        save(self, path)

    @staticmethod
    def load(path: str | Path, cache_dir: str | Path | None = None) -> Posterior:
        """Read what :meth:`save` wrote: the file ``path``, or the posterior.npz in that folder. Its index is opened from
        ``cache_dir``, by default ``$GEOMTACT_CACHE`` or the user's cache folder, or rebuilt where it is missing.

        Raises
        ------
        InputError
            The file cannot be read, or is no posterior.
        CacheError
            Its index cannot be opened or built.
        """
        return Posterior(**vars(load(path, cache_dir)))

    @cached_property
    def _probability(self) -> Array:
        if self.explored is not None:
            return self.explored.weight
        # exponentials in single precision take a fifth of the time, and the scores have no more
        return np.exp(self.cell_log_prob.astype(np.float32)).astype(float)

    @cached_property
    def _log_density(self) -> Array:
        """Log density (N,) of the particles or cells relative to the uniform distribution."""
        if self.explored is not None:
            return self.explored.log_density
        return row_log_density(self, np.arange(len(self.cells)))

    def _within(self, T: Array, depth: Array) -> Array:
        """Log density (n,) at poses ``T`` (n, 4, 4) in the sensor frame, which press ``depth`` (n,) [m] deep."""
        if self.explored is not None:
            # what is denser than all poses that were found was missed, and the evidence with it
            return np.minimum(self.explored.density.log_density(T), self.explored.log_density.max())
        return cell_log_density(self, self.index.lookup(T, depth))

    def _draw_cells(self, n: int, rng: np.random.Generator) -> NDArray[np.int64]:
        total = np.cumsum(self._probability)
        row = np.minimum(np.searchsorted(total, rng.random(n) * total[-1]), len(total) - 1)
        return self.cells[row]


def _share(T: Array, seed: int) -> float:
    """A number in [0, 1) that depends on T and the seed alone."""
    digest = hashlib.blake2b((np.round(T, 12) + 0.0).tobytes() + seed.to_bytes(8, "little", signed=True), digest_size=8)
    return int.from_bytes(digest.digest(), "little") / 2**64
