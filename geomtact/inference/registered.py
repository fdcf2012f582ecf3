"""Poses of several sensors drawn about those that registration finds, and led from there to the posterior.

Few poses that are drawn in cells lie near the mode, the fewer the more sensors there are. But registration to all contacts moves
many of them there. It says nothing about how probable a mode is. So poses are drawn about those that it found, from a
distribution whose density is known, and go step by step from there to the posterior. That gives the evidence again.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

from geomtact.contact_space.contact_maps import located, sample_pitch
from geomtact.geometry.distance import PoseDistance
from geomtact.inference.particles import Particles, Target, poses_of
from geomtact.inference.population import Population, effective
from geomtact.inference.student import Student, log_volume
from geomtact.inference.systematic_errors import ERRORS
from geomtact.registration.protocol import Refinement
from geomtact.se3 import Array, exp, inverse, log

# as ``registration.filterreg.FilterReg.search``, to all contacts, in the first sensor's frame
Search = Callable[[Array, Callable[[Array], Array], int], tuple[NDArray[np.int64], Refinement]]

# All choose where poses are drawn: they change how precise the evidence is, not what is estimated.
_SEARCHED, _FEWEST = (
    1 / 8,
    96,
)  # of the poses that are registered roughly, those that are registered to the end; at least
_MODES = 12  # about which poses are drawn, at most
_APART = 2e-3  # m: mean distance by which two modes differ, at least
_WIDER = 3.0  # standard deviations of the draws over those of registration, whose likelihood is sharper
_DRAWS = 4  # for each pose that is kept
_SHARES = np.linspace(0.02, 1, 50)  # of the way to the posterior, that the first step may have


@dataclass(frozen=True, eq=False)
class AboutModes:
    """An even mixture of Student's distributions of motions from some poses.

    Attributes
    ----------
    target : what decides about poses
    hearts : (m, 4, 4)
    bases : m arrays (d, 6) that motions are along
    students : of their coordinates
    led_to : poses (r, 4, 4) to which registration moved some, of those that touch all sensors
    origin : (r,) places of the index from which these came; -1 of those that registration left where they were
    best : (S,) the largest log likelihood by each sensor of all of them
    contacts : that were cut on all sensors
    """

    target: Target
    hearts: Array
    bases: list[Array]
    students: list[Student]
    led_to: Array
    origin: NDArray[np.int64]
    best: Array
    contacts: int

    @classmethod
    def of(cls, target: Target, drawn: Particles, search: Search) -> AboutModes | None:
        """About the likeliest of the poses to which registration moves those ``drawn``; None if all miss a sensor."""

        def rate(T: Array) -> Array:
            return target.particles_at(T).log_likelihood

        kept, refinement = search(target.poses(drawn), rate, max(int(_SEARCHED * len(drawn)), _FEWEST))
        found = target.particles_at(refinement.T)
        likely = np.where(found.missed, -np.inf, found.log_likelihood)
        touching, distance = np.isfinite(likely), PoseDistance(target.index.mesh)
        rows: list[int] = []
        free = touching.copy()
        while free.any() and len(rows) < _MODES:
            rows.append(int(np.where(free, likely, -np.inf).argmax()))
            free &= ~distance.within(refinement.T[rows[-1]], refinement.T, _APART)
            free[rows[-1]] = False
        if not rows:
            return None
        hearts = refinement.T[rows]
        bases = [target.index.directions.motions(heart[:3, :3]) for heart in hearts]
        pitch = sample_pitch(target.index.sensor)
        least = np.repeat([pitch / target.index.mesh.radius_rms, pitch], 3)
        students = []
        for basis, covariance in zip(bases, refinement.covariance[rows], strict=True):
            along = np.linalg.pinv(basis)
            scale = along.T @ (_WIDER**2 * covariance + np.diag(least**2)) @ along
            students.append(Student(np.zeros(len(basis)), np.linalg.cholesky(scale)))
        origin = np.where(refinement.converged, drawn.poses.place[kept], -1)[touching]
        contacts = (len(drawn) + len(kept)) * target.sensors
        best = found.by_sensor[touching].max(0)
        return cls(target, hearts, bases, students, refinement.T[touching], origin, best, contacts)

    @cached_property
    def _distance(self) -> PoseDistance:
        return PoseDistance(self.target.index.mesh)

    def draw(self, n: int, rng: np.random.Generator) -> tuple[Array, NDArray[np.bool_]]:
        """Poses (n, 4, 4) without errors, and which of them count (n,): only the image of a placement that is nearest to the pose
        that it is drawn about, by turns of less than pi."""
        of, out, counts = rng.integers(len(self.hearts), size=n), np.empty((n, 4, 4)), np.ones(n, bool)
        for mode, (heart, basis, student) in enumerate(zip(self.hearts, self.bases, self.students, strict=True)):
            some = np.flatnonzero(of == mode)
            xi = student.draw(len(some), rng) @ basis
            out[some] = heart @ exp(xi)
            counts[some] = self._distance.is_nearest(heart, out[some]) & (np.linalg.norm(xi[:, :3], axis=1) < np.pi)
        return out, counts

    def log_density(self, particles: Particles) -> Array:
        """Log density (n,) at ``particles`` (n,), relative to the uniform."""
        T = poses_of(particles.poses, particles.depth, self.target.index.mesh.centre)
        aligned = np.stack([inverse(heart) @ self._distance.aligned(heart, T) for heart in self.hearts])
        each = []
        for xi, basis, student in zip(log(aligned), self.bases, self.students, strict=True):
            x = xi @ np.linalg.pinv(basis)
            turn = np.linalg.norm(x[:, :-3], axis=1)
            each.append(student.log_density(x) - log_volume(turn, len(basis) - 3))
        uniform = np.log(self.target.index.uniform_density(T))
        return np.asarray(np.logaddexp.reduce(each, 0) - np.log(len(each)) - uniform)


def bridged(about: AboutModes, power: float, runs: int, n: int, rng: np.random.Generator) -> Population | None:
    """``n`` poses for each run from the posterior by that ``power`` of the likelihood, and its evidence; None where none that
    were drawn touch all sensors."""
    target = about.target
    m = _DRAWS * n * runs
    drawn, counts = about.draw(m, rng)
    poses, membrane = located(target.index, drawn)
    errors = rng.random((m, target.carried, ERRORS))
    particles = target.admitted(target.evaluated(poses, membrane, errors=errors))

    def change(particles: Particles) -> Array:
        return particles.log_target(power) - about.log_density(particles)

    def between(share: float, particles: Particles) -> Array:
        return (1 - share) * about.log_density(particles) + share * particles.log_target(power)

    best = particles.by_sensor.max(0)
    population = Population(target, rng, particles, np.zeros(runs), best, contacts=m * target.sensors)
    log_weight = np.where(particles.missed | ~counts, -np.inf, change(particles))
    each = log_weight.reshape(runs, -1)
    if not np.isfinite(each).any(1).all():
        return None
    enough = [share for share in _SHARES if (effective(share * each) >= n).all()]
    share = float(enough[-1] if enough else _SHARES[0])
    population.choose(share * log_weight, n)
    while True:
        population.move(partial(between, share))
        if share >= 1:
            return population
        share = min(share + population.reweigh(change(population.particles), 1 - share), 1.0)


def united(one: Population | None, other: Population | None) -> Population | None:
    """Two populations of one distribution, each of which may have missed what the other found: poses of each by its evidence. The
    larger evidence is kept, which at worst makes the density too small."""
    if one is None or other is None:
        return one or other
    share = expit(other.log_evidence - one.log_evidence)
    rows, rng = [], one.rng
    n = len(one.particles) // one.runs
    for run, each in enumerate(share):
        of = rng.random(n) < each
        rows.append(np.where(of, len(one.particles), 0) + run * n + np.arange(n))
    return Population(
        one.target,
        rng,
        one.particles.joined(other.particles).take(np.concatenate(rows)),
        np.maximum(one.log_evidence, other.log_evidence),
        np.maximum(one.best, other.best),
        one.size,
        one.contacts + other.contacts,
    )
