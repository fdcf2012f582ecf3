"""Poses that may be the object's, and what decides how probable each is: the contact that is cut there, and the prior."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geomtact.contact_space.contact_maps import ContactMaps, Placements, located
from geomtact.contact_space.index import Index
from geomtact.scoring.contact_likelihood import ContactQuery
from geomtact.se3 import Array, transform


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
        return np.where(touches, self.log_prior + tempered(self.log_likelihood, self.log_coarse, power), -np.inf)

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
class Target:
    """What a pose is judged by.

    Attributes
    ----------
    index, query : all touches of the object, and the observed contact
    log_coarse : (n,) log density of the coarse posterior at the places of the index, without the prior
    log_prior : (N,) log density of the prior in the cells of the index; None for the uniform
    """

    index: Index
    query: ContactQuery
    log_coarse: Array
    log_prior: NDArray[np.floating] | None

    def evaluated(self, poses: Placements, membrane: Array | None = None, depth: Array | None = None) -> Particles:
        """n poses as particles, the membrane's apex ``membrane`` (n,) beyond their centre or ``depth`` (n,) deep. Those that do
        not touch or press too deep have no likelihood; see :meth:`admits`."""
        cut = ContactMaps.of(self.index).compare(self.query.samples, self.query.area, poses, membrane, depth)
        found = replace(poses, reach=cut.reach.astype(float))
        if depth is None:
            assert membrane is not None
            depth = found.reach - membrane
        ok = np.isfinite(cut.energy[:, 0]) & (depth <= self.index.sensor.max_penetration)
        depth = np.where(ok, depth, 0.0)
        log_likelihood = np.full(len(depth), -np.inf)
        log_likelihood[ok] = self.query.log_likelihood(cut.energy[ok])
        log_prior = prior_at(self.index, self.log_prior, poses.place, depth)
        return Particles(found, depth, log_likelihood, self.log_coarse[poses.place], log_prior)

    def particles_at(self, T: ArrayLike) -> Particles:
        """Poses ``T_sensor_object`` (n, 4, 4) as particles; those that are forbidden have no likelihood."""
        poses, membrane = located(self.index, np.asarray(T, float))
        return self.admitted(self.evaluated(poses, membrane))

    def admitted(self, particles: Particles) -> Particles:
        """``particles`` (n,), without a likelihood where the approach or the sensor's housing forbids them."""
        touches = np.flatnonzero(np.isfinite(particles.log_likelihood))
        forbidden = touches[~self.admits(particles.take(touches))]
        log_likelihood = particles.log_likelihood.copy()
        log_likelihood[forbidden] = -np.inf
        return replace(particles, log_likelihood=log_likelihood)

    def admits(self, particles: Particles) -> NDArray[np.bool_]:
        """Whether the approach and the sensor's housing allow ``particles`` (n,)."""
        space = self.index.space
        if space.cones is None and space.sensor.housing_depth is None:
            return np.ones(len(particles), bool)
        return space.admits(poses_of(particles.poses, particles.depth, self.index.mesh.centre))


def poses_of(poses: Placements, depth: Array, middle: Array) -> Array:
    """T_sensor_object (n, 4, 4) of an object with its centre at ``middle`` (3,), that presses ``depth`` (n,) [m] deep."""
    height = np.where(np.isfinite(poses.reach), poses.reach, depth) - depth
    return transform(poses.rotation, np.column_stack([poses.centre, height]) - poses.rotation @ middle)


def tempered(log_likelihood: Array, log_coarse: Array, power: float) -> Array:
    """Log density (n,) of the posterior by a power of the likelihood, up to a constant."""
    out = (1 - power) * log_coarse
    if power > 0:
        out = out + power * log_likelihood
    return out


def prior_at(index: Index, log_prior: NDArray[np.floating] | None, place: NDArray[np.int64], depth: Array) -> Array:
    """Log density (n,) of the prior, known in the cells of ``index``, at places (n,) and penetrations (n,) [m]."""
    if log_prior is None:
        return np.zeros(len(place))
    return log_prior[index.level_of(place, depth) * index.places + place].astype(float)
