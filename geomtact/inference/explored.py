"""The distribution of a pose within the cells of an index: what the sampler leaves of it, and the density at any pose.

The posterior is a mixture of posteriors by powers of the likelihood. Of each there are poses drawn from it, and its evidence, so
that its density is known wherever the likelihood is made.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import logsumexp

from geomtact.contact_space.contact_maps import ContactMaps, Placements, located
from geomtact.contact_space.index import Index
from geomtact.scoring.contact_likelihood import POWERS, ContactQuery
from geomtact.se3 import Array, check_transforms, transform


@dataclass(frozen=True, eq=False)
class Particles:
    """n poses with what decides about them.

    Attributes
    ----------
    poses : n of them, their ``reach`` as it was found
    depth : (n,) penetration [m]
    log_likelihood : (n,)
    log_coarse : (n,) log density of the coarse posterior, without the prior
    log_prior : (n,) log density of the prior
    """

    poses: Placements
    depth: Array
    log_likelihood: Array
    log_coarse: Array
    log_prior: Array

    def __len__(self) -> int:
        return len(self.depth)

    def log_target(self, power: float) -> Array:
        """Log (n,) of the density of the posterior by a power of the likelihood, up to a constant; -inf where nothing is
        touched."""
        touches = np.isfinite(self.log_likelihood)
        return np.where(touches, self.log_prior + log_target(self.log_likelihood, self.log_coarse, power), -np.inf)

    def take(self, rows: NDArray[np.int64]) -> Particles:
        """Those of ``rows`` (m,)."""
        return self._each(lambda a, _: a[rows], self)

    def put(self, rows: NDArray[np.int64], other: Particles) -> Particles:
        """These with ``other`` (m,) at ``rows`` (m,)."""

        def replaced(a: NDArray[Any], b: NDArray[Any]) -> NDArray[Any]:
            a = a.copy()
            a[rows] = b
            return a

        return self._each(replaced, other)

    def joined(self, other: Particles) -> Particles:
        """These and ``other`` (m,)."""
        return self._each(lambda a, b: np.concatenate([a, b]), other)

    def _each(self, of: Callable[[NDArray[Any], NDArray[Any]], NDArray[Any]], other: Particles) -> Particles:
        poses = Placements(*map(of, vars(self.poses).values(), vars(other.poses).values()))
        mine, others = (list(vars(each).values())[1:] for each in (self, other))
        return Particles(poses, *map(of, mine, others))


@dataclass(frozen=True, eq=False)
class Explored:
    """The distribution of the pose after one touch: a mixture of the posteriors by powers of the likelihood, ``POWERS``.

    Attributes
    ----------
    index, query : all touches of the object, and the observed contact
    log_coarse : (n,) log density of the coarse posterior at the places of the index, without the prior
    log_prior : (N,) log density of the prior in the cells of the index; None for the uniform
    particles : of each posterior, poses drawn from it, equally probable
    log_evidence : of each, the log of the mean of the power of the likelihood over the coarse posterior
    exponents : of the likelihood, step by step
    contacts : that were cut
    """

    index: Index
    query: ContactQuery
    log_coarse: Array
    log_prior: NDArray[np.floating] | None
    particles: tuple[Particles, ...]
    log_evidence: tuple[float, ...]
    exponents: tuple[float, ...]
    contacts: int

    @cached_property
    def weight(self) -> Array:
        """Mass of each particle of all posteriors."""
        return np.concatenate(
            [np.full(len(p), w / len(p)) for p, w in zip(self.particles, self.query.weights, strict=True)]
        )

    @cached_property
    def particle_log_density(self) -> Array:
        """Log density at each particle of all posteriors."""
        return np.concatenate([p.log_prior + self._posteriors(p.log_likelihood, p.log_coarse) for p in self.particles])

    def _posteriors(self, log_likelihood: Array, log_coarse: Array) -> Array:
        """Log density (n,) over the prior."""
        each = [
            np.log(weight) + log_target(log_likelihood, log_coarse, power) - log_evidence
            for power, weight, log_evidence in zip(POWERS, self.query.weights, self.log_evidence, strict=True)
        ]
        return np.asarray(logsumexp(each, 0))

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
        poses, membrane = located(self.index, np.asarray(T, float))
        cut = ContactMaps.of(self.index).compare(self.query.samples, self.query.area, poses, membrane)
        density = self._posteriors(self.query.log_likelihood(cut.energy), self.log_coarse[poses.place])
        return density + prior_at(self.index, self.log_prior, poses.place, cut.reach - membrane)

    def draw(self, n: int, rng: np.random.Generator) -> Array:
        """``n`` poses T_sensor_object (n, 4, 4) drawn by ``rng`` among the particles, at any image under the symmetry."""
        T = self.settled(rng.choice(len(self.weight), n, p=self.weight))
        return self.index.directions.any_image(T, rng)

    def settled(self, rows: NDArray[np.int64]) -> Array:
        """Poses T_sensor_object (n, 4, 4) of the particles ``rows`` (n,).

        Height maps miss what lies between their pixels, so that a pose may touch by them and not quite by the mesh, or press a
        little too deep: it is moved along z.
        """
        T, space = self.poses[rows], self.index.space
        off = np.flatnonzero(~np.isfinite(space.penetration(T)))
        settled, ok = space.settle(T[off], self.depth[rows[off]])
        T[off[ok]] = settled[ok]
        return T

    def arrays(self) -> dict[str, NDArray[Any]]:
        """All that :meth:`of_arrays` needs beside the index."""
        return {
            "T": self.poses,
            "log_likelihood": np.concatenate([p.log_likelihood for p in self.particles]),
            "depth": self.depth,
            "counts": np.array([len(p) for p in self.particles]),
            "log_evidence": np.array(self.log_evidence),
            "log_coarse": self.log_coarse.astype(np.float32),
            "log_prior": np.zeros(0) if self.log_prior is None else self.log_prior,
            "exponents": np.array(self.exponents),
            "contacts": np.array(self.contacts),
            "touched": self.query.touched,
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
        if len(counts) != len(POWERS) or not len(T) == len(depth) == len(arrays["log_likelihood"]) == counts.sum():
            raise ValueError("particles of different number")
        if len(log_coarse) != index.places or (log_prior is not None and len(log_prior) != len(index)):
            raise ValueError("densities that are not of its grid")
        poses, membrane = located(index, T)
        prior = prior_at(index, log_prior, poses.place, depth)
        whole = Particles(
            replace(poses, reach=membrane + depth), depth, arrays["log_likelihood"], log_coarse[poses.place], prior
        )
        return cls(
            index,
            ContactQuery.showing(arrays["touched"].astype(bool), index.sensor),
            log_coarse,
            log_prior,
            tuple(whole.take(rows) for rows in np.split(np.arange(len(T)), np.cumsum(counts)[:-1])),
            tuple(arrays["log_evidence"].tolist()),
            tuple(arrays["exponents"].tolist()),
            int(arrays["contacts"]),
        )

    def credible_level(self, log_density: float) -> float:
        """Mass of the poses that are denser than ``log_density``."""
        return float(self.weight @ (self.particle_log_density > log_density))


def poses_of(poses: Placements, depth: Array, middle: Array) -> Array:
    """T_sensor_object (n, 4, 4) of an object with its centre at ``middle`` (3,), that presses ``depth`` (n,) [m] deep."""
    height = np.where(np.isfinite(poses.reach), poses.reach, depth) - depth
    return transform(poses.rotation, np.column_stack([poses.centre, height]) - poses.rotation @ middle)


def log_target(log_likelihood: Array, log_coarse: Array, power: float) -> Array:
    """Log density (n,) of the posterior by a power of the likelihood, up to a constant."""
    out = (1 - power) * log_coarse
    if power > 0:
        out = out + power * log_likelihood
    return out


def log_likelihood_at(maps: ContactMaps, query: ContactQuery, T: ArrayLike, depth: Array | None = None) -> Array:
    """Log likelihood (n,) of the observed contact at ``T_sensor_object`` (n, 4, 4), where the object is moved along z to press
    ``depth`` (n,) [m] deep if that is given."""
    poses, membrane = located(maps.index, np.asarray(T, float))
    where = {"membrane": membrane} if depth is None else {"depth": depth}
    return query.log_likelihood(maps.compare(query.samples, query.area, poses, **where).energy)


def prior_at(index: Index, log_prior: NDArray[np.floating] | None, place: NDArray[np.int64], depth: Array) -> Array:
    """Log density (n,) of the prior, known in the cells of ``index``, at places (n,) and penetrations (n,) [m]."""
    if log_prior is None:
        return np.zeros(len(place))
    return log_prior[index.level_of(place, depth) * index.places + place].astype(float)
