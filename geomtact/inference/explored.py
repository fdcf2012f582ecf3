"""The distribution of a pose within the cells of an index: what the sampler leaves of it, and the density at any pose.

The posterior is a mixture of posteriors by powers of the likelihood. Of each there are poses drawn from it, and its evidence, so
that its density is known wherever the likelihood is made.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geomtact.contact_space.contact_maps import ContactMaps, located
from geomtact.contact_space.index import Index
from geomtact.inference.particles import Particles, Target, log_target, poses_of, prior_at
from geomtact.scoring.contact_likelihood import INTERCEPT, POWERS, ContactQuery
from geomtact.se3 import Array, check_transforms


@dataclass(frozen=True, eq=False)
class Explored:
    """The distribution of the pose after one touch: a mixture of the posteriors by powers of the likelihood, ``POWERS`` or the
    smallest of them.

    Attributes
    ----------
    target : what poses are judged by
    particles : of each posterior, poses drawn from it, equally probable
    log_evidence : of each, the log of the mean of the power of the likelihood over the coarse posterior
    exponents : of the likelihood, step by step
    contacts : that were cut
    log_measure : log of the uniform measure of poses that touch over that of the cells that hold them
    hearts : (m,) rows of ``poses``, the densest of each leading mode, the most probable mode first
    masses : (m,) of these modes
    """

    target: Target
    particles: tuple[Particles, ...]
    log_evidence: tuple[float, ...]
    exponents: tuple[float, ...]
    contacts: int
    log_measure: float = 0.0
    hearts: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    masses: Array = field(default_factory=lambda: np.zeros(0))

    @property
    def index(self) -> Index:
        """All touches of the object."""
        return self.target.index

    @cached_property
    def weights(self) -> Array:
        """Weight of each posterior; the last one has those of the powers that are left out too."""
        weights, last = self.target.query.weights, len(self.particles) - 1
        return np.append(weights[:last], weights[last:].sum())

    @cached_property
    def weight(self) -> Array:
        """Mass of each particle of all posteriors."""
        return np.concatenate([np.full(len(p), w / len(p)) for p, w in zip(self.particles, self.weights, strict=True)])

    @cached_property
    def particle_log_density(self) -> Array:
        """Log density at each particle of all posteriors."""
        return np.concatenate([self.log_density_of(p) for p in self.particles])

    def log_density_of(self, particles: Particles) -> Array:
        """Log density (n,) at ``particles`` (n,)."""
        return particles.log_prior + self._posteriors(particles.log_likelihood, particles.log_coarse)

    def _posteriors(self, log_likelihood: Array, log_coarse: Array) -> Array:
        """Log density (n,) over the prior."""
        each = [
            np.log(weight) + log_target(log_likelihood, log_coarse, power) - log_evidence
            for power, weight, log_evidence in zip(POWERS, self.weights, self.log_evidence, strict=False)
        ]
        return np.asarray(np.logaddexp.reduce(each, 0))

    @cached_property
    def poses(self) -> Array:
        """T_sensor_object (n, 4, 4) of the particles of all posteriors."""
        return np.concatenate([poses_of(p.poses, p.depth, self.index.mesh.centre) for p in self.particles])

    @cached_property
    def depth(self) -> Array:
        """Penetration (n,) of the particles of all posteriors [m]."""
        return np.concatenate([p.depth for p in self.particles])

    @property
    def expected_gain(self) -> float:
        """Mean log density under the distribution itself [nats]."""
        return float(self.weight @ self.particle_log_density)

    def log_density(self, T: ArrayLike) -> Array:
        """Log density (n,), relative to the uniform, at poses ``T_sensor_object`` (n, 4, 4) of the contact pose space."""
        query, log_prior = self.target.query, self.target.log_prior
        poses, membrane = located(self.index, np.asarray(T, float))
        cut = ContactMaps.of(self.index).compare(query.samples, query.area, poses, membrane)
        density = self._posteriors(query.log_likelihood(cut.energy), self.target.log_coarse[poses.place])
        return density + prior_at(self.index, log_prior, poses.place, cut.reach - membrane)

    def draw(self, n: int, rng: np.random.Generator) -> Array:
        """``n`` poses T_sensor_object (n, 4, 4) drawn by ``rng`` among the particles, at any image under the symmetry.

        Instead of the few that no depth makes touch by the mesh, others are drawn again.
        """
        T, touches = self._settled(rng.choice(len(self.weight), n, p=self.weight))
        if touches.any():
            T[~touches] = T[rng.choice(np.flatnonzero(touches), n - int(touches.sum()))]
        return self.index.directions.any_image(T, rng)

    def settled(self, rows: NDArray[np.int64]) -> Array:
        """Poses T_sensor_object (n, 4, 4) of the particles ``rows`` (n,).

        Height maps miss what lies between their pixels, so that a pose may touch by them and not quite by the mesh, or press a
        little too deep: it is moved along z.
        """
        return self._settled(rows)[0]

    def _settled(self, rows: NDArray[np.int64]) -> tuple[Array, NDArray[np.bool_]]:
        """:meth:`settled`, and which (n,) of them touch by the mesh."""
        T, space = self.poses[rows], self.index.space
        touches = np.isfinite(space.penetration(T))
        off = np.flatnonzero(~touches)
        settled, ok = space.settle(T[off], self.depth[rows[off]])
        T[off[ok]], touches[off[ok]] = settled[ok], True
        return T, touches

    def arrays(self) -> dict[str, NDArray[Any]]:
        """All that :meth:`of_arrays` needs beside the index."""
        return {
            "T": self.poses,
            "log_likelihood": np.concatenate([p.log_likelihood for p in self.particles]),
            "depth": self.depth,
            "counts": np.array([len(p) for p in self.particles]),
            "log_evidence": np.array(self.log_evidence),
            "log_coarse": self.target.log_coarse.astype(np.float32),
            "log_prior": np.zeros(0) if self.target.log_prior is None else self.target.log_prior,
            "exponents": np.array(self.exponents),
            "contacts": np.array(self.contacts),
            "log_measure": np.array(self.log_measure),
            "hearts": self.hearts,
            "masses": self.masses,
            "touched": self.target.query.touched,
            "source": np.array(self.target.query.source),
        }

    @classmethod
    def of_arrays(cls, index: Index, arrays: Mapping[str, NDArray[Any]]) -> Explored:
        """Inverse of :meth:`arrays`.

        Raises
        ------
        KeyError, ValueError, PoseError
            They are not what it gives.
        """
        T, depth, counts = check_transforms(arrays["T"]), arrays["depth"], arrays["counts"]
        log_coarse = arrays["log_coarse"].astype(float)
        log_prior = arrays["log_prior"] if len(arrays["log_prior"]) else None
        if (
            not 1 < len(counts) <= len(POWERS)
            or not len(T) == len(depth) == len(arrays["log_likelihood"]) == counts.sum()
        ):
            raise ValueError("particles of different number")
        if len(arrays["hearts"]) != len(arrays["masses"]) or not (arrays["hearts"] < len(T)).all():
            raise ValueError("modes that are not of its particles")
        if len(log_coarse) != index.places or (log_prior is not None and len(log_prior) != len(index)):
            raise ValueError("densities that are not of its grid")
        poses, membrane = located(index, T)
        prior = prior_at(index, log_prior, poses.place, depth)
        whole = Particles(
            replace(poses, reach=membrane + depth), depth, arrays["log_likelihood"], log_coarse[poses.place], prior
        )
        source = str(arrays["source"])
        if source not in INTERCEPT:
            raise ValueError(f"a contact of another source: {source}")
        query = ContactQuery.showing(arrays["touched"].astype(bool), index.sensor, source)
        return cls(
            Target(index, query, log_coarse, log_prior),
            tuple(whole.take(rows) for rows in np.split(np.arange(len(T)), np.cumsum(counts)[:-1])),
            tuple(arrays["log_evidence"].tolist()),
            tuple(arrays["exponents"].tolist()),
            int(arrays["contacts"]),
            float(arrays["log_measure"]),
            arrays["hearts"],
            arrays["masses"],
        )

    def credible_level(self, log_density: float) -> float:
        """Mass of the poses that are denser than ``log_density``."""
        return float(self.weight @ (self.particle_log_density > log_density))
