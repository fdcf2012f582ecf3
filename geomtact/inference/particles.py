"""Poses that may be the object's, and what decides how probable each is: the contacts that are cut there, and the prior.

A pose that misses a sensor which shows contact is impossible. But hardly any pose at which one sensor is touched as observed
touches the others. So under small powers of the likelihood poses may miss, the less likely the farther: they lead to poses that
touch.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geomtact.contact_space.cell_transfer import MISSED_CONTACT_SHARE, ExtrinsicsStd
from geomtact.contact_space.contact_maps import Placements, located
from geomtact.contact_space.index import Index
from geomtact.inference.pose_prior import CellPrior, NormalPrior, PosePrior
from geomtact.inference.systematic_errors import ERRORS, displaced, errors_of, stand_of
from geomtact.scoring.contact_likelihood import POWERS, ContactQuery, mixture_weights
from geomtact.se3 import Array, inverse, transform

SURE = POWERS[1]  # of the likelihood: from this power on, no pose may miss a sensor that shows contact
_MISS = 2.5e7  # nats/m^2 of a distance by which a pose misses: where poses are drawn depends on it, not how probable they are
_FARTHEST = 50e-3  # m: the largest such distance


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
    missed : (n,) whether another sensor that shows contact is not touched, or too deeply
    draw : (n,) from which draw of the sampler each comes
    by_sensor : (n, S) log likelihood by each of S sensors, the first one first; S is 0 where there is one sensor alone
    errors : (n, S, ERRORS) of the contact on each, by the shares of all errors that are smaller (see ``systematic_errors``);
        those of one sensor alone do not matter here
    """

    poses: Placements
    depth: Array
    log_likelihood: Array
    log_coarse: Array
    log_prior: Array
    missed: NDArray[np.bool_]
    draw: NDArray[np.int64]
    by_sensor: Array
    errors: Array

    def __len__(self) -> int:
        return len(self.depth)

    def log_target(self, power: float) -> Array:
        """Log (n,) of the density of the posterior by a power of the likelihood, up to a constant; -inf where nothing is
        touched, and for powers of ``SURE`` and more where a sensor is missed."""
        touches = np.isfinite(self.log_likelihood) & ~(self.missed & (power >= SURE))
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
class OtherSensor:
    """A sensor on the object beside the one in whose cells poses are.

    Attributes
    ----------
    index, query : all touches of the object on it, and the observed contact, or that there is none
    T_sensor_first : (4, 4) of the first sensor in its frame
    extrinsics_std : uncertainty of that pose; None where it is not stated
    """

    index: Index
    query: ContactQuery
    T_sensor_first: Array
    extrinsics_std: ExtrinsicsStd | None = None

    def log_likelihood(self, T: Array, stand: Array) -> tuple[Array, Array]:
        """Log likelihood (n,) of what it shows, with the object at ``T`` (n, 4, 4) in the first sensor's frame and this one moved
        by ``stand`` (n, 4, 4); and by how much a contact that it shows is missed (n,) [m]."""
        query, sensor = self.query, self.index.sensor
        poses, membrane = located(self.index, inverse(stand) @ self.T_sensor_first @ T)
        cut, likely = query.compare(self.index, poses, membrane)
        depth = np.where(np.isfinite(cut.reach), cut.reach - membrane, -_FARTHEST)
        if not query.touched.any():
            # to the power p, for the coarse posterior holds the same share to the power 1 - p
            return np.where(depth > 0, np.log(MISSED_CONTACT_SHARE), 0.0), np.zeros(len(T))
        missed = np.clip(np.maximum(-depth, depth - sensor.max_penetration), 0, _FARTHEST)
        log_likelihood = np.full(len(T), query.log_likelihood_of_nothing)
        touches = np.isfinite(likely)
        log_likelihood[touches] = likely[touches]
        missed[~touches] = np.maximum(missed[~touches], 1e-6)
        return log_likelihood, missed


@dataclass(frozen=True, eq=False)
class Target:
    """What a pose is judged by.

    Attributes
    ----------
    index, query : all touches of the object on the first sensor that shows contact, and that contact
    log_coarse : (n,) log density of the coarse posterior at the places of the index, without the prior
    prior : None for the uniform
    others : the other sensors
    """

    index: Index
    query: ContactQuery
    log_coarse: Array
    prior: PosePrior | None
    others: tuple[OtherSensor, ...] = ()

    @property
    def sensors(self) -> int:
        """How many there are."""
        return 1 + len(self.others)

    @property
    def carried(self) -> int:
        """Of how many contacts particles carry the errors: those of one sensor alone matter to a prior that is narrower than
        them, and to nothing else."""
        return self.sensors if self.others or isinstance(self.prior, NormalPrior) else 0

    @property
    def weights(self) -> Array:
        """Weights (K,) of the posteriors by powers of the likelihood."""
        return mixture_weights([self.query, *(other.query for other in self.others)])

    def displaced(self, T: Array, errors: Array) -> Array:
        """Where the object is (..., 4, 4) whose contact on the first sensor is that at ``T`` (..., 4, 4) without ``errors``
        (..., 4)."""
        return shifted(T, self.index.mesh.centre, lambda c: displaced(c, errors, self.query.centroid))

    def evaluated(
        self,
        poses: Placements,
        membrane: Array | None = None,
        depth: Array | None = None,
        errors: Array | None = None,
    ) -> Particles:
        """n poses as particles, the membrane's apex ``membrane`` (n,) beyond their centre or ``depth`` (n,) deep, with ``errors``
        (n, S, ERRORS) of the contacts as of :class:`Particles`, by default none. Those that do not touch the first sensor or
        press too deep have no likelihood; see :meth:`admits`."""
        n = len(poses.reach)
        if errors is None:
            errors = np.full((n, self.carried, ERRORS), 0.5)
        cut, log_likelihood = self.query.compare(self.index, poses, membrane, depth)
        found = replace(poses, reach=cut.reach.astype(float))
        if depth is None:
            assert membrane is not None
            depth = found.reach - membrane
        ok = np.isfinite(log_likelihood) & (depth <= self.index.sensor.max_penetration)
        depth, log_likelihood = np.where(ok, depth, 0.0), np.where(ok, log_likelihood, -np.inf)
        log_prior = self.prior.log_density(poses, depth) if isinstance(self.prior, CellPrior) else np.zeros(n)
        missed, by_sensor = np.zeros(n, bool), np.full(errors.shape[:2], -np.inf)
        if self.carried and ok.any():
            by_sensor[:, 0] = log_likelihood
            T = poses_of(found, depth, self.index.mesh.centre)[ok]
            T = self.displaced(T, errors_of(errors[ok, 0]))
            if isinstance(self.prior, NormalPrior):
                log_prior[ok] = self.prior.log_density(T)
            for number, other in enumerate(self.others, 1):
                its, by = other.log_likelihood(T, stand_of(errors[ok, number], other.extrinsics_std))
                by_sensor[ok, number] = its
                log_likelihood[ok] += its - _MISS * by**2
                missed[ok] |= by > 0
        log_coarse = self.log_coarse[poses.place]
        return Particles(found, depth, log_likelihood, log_coarse, log_prior, missed, np.arange(n), by_sensor, errors)

    def poses(self, particles: Particles) -> Array:
        """Where the object is (n, 4, 4) at ``particles`` (n,), with the errors that they carry."""
        T = poses_of(particles.poses, particles.depth, self.index.mesh.centre)
        return self.displaced(T, errors_of(particles.errors[:, 0])) if self.carried else T

    def particles_at(self, T: ArrayLike, errors: Array | None = None) -> Particles:
        """Poses ``T_sensor_object`` (n, 4, 4) as particles, with ``errors`` as of :meth:`evaluated`.

        Those that are forbidden have no likelihood.
        """
        poses, membrane = located(self.index, np.asarray(T, float))
        return self.admitted(self.evaluated(poses, membrane, errors=errors))

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


def shifted(T: Array, middle: Array, moved: Callable[[Array], Array]) -> Array:
    """``T`` (..., 4, 4) with the object's centre, which is at ``middle`` (3,) in its frame, ``moved`` from where it is
    (..., 3)."""
    R = T[..., :3, :3]
    return transform(R, moved(T[..., :3, 3] + R @ middle) - R @ middle)


def tempered(log_likelihood: Array, log_coarse: Array, power: float) -> Array:
    """Log density (n,) of the posterior by a power of the likelihood, up to a constant."""
    out = (1 - power) * log_coarse
    if power > 0:
        out = out + power * log_likelihood
    return out
