"""The density of the pose at any pose, normalised by a sequential Monte Carlo sampler.

The density at a pose is the likelihood there over its mean, the evidence. So a posterior needs no cell about a pose: it needs the
likelihood, which is made where it is asked for, and the evidence, a mean over the contact pose space. Both come from poses that
are drawn where a coarse posterior puts its mass, weighed, and moved while the target goes, step by step, from the coarse density
to the likelihood (Del Moral, Doucet and Jasra 2006). What is left are poses drawn from the posterior.

Given a rotation, a contact moves with the object. So the object's centre is drawn about where the contact's centroid is the
observed one, and moves turn the object about that point of the membrane.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation
from scipy.special import logsumexp, ndtr, ndtri

from geomtact.contact_space.contact_maps import ContactMaps, Placements, sample_pitch
from geomtact.scoring.contact_likelihood import ContactQuery
from geomtact.se3 import Array, transform

# All constants choose where poses are drawn: they change how precise the evidence is, not what is estimated.
_UNIFORM = 0.2  # share of the draws that go by the uniform measure
_ALIGNED = 0.7  # share of the draws whose centre is aligned
_WIDTH = 1.5  # standard deviation of aligned centres, in samples of the window
_CUTS = 3  # contacts that are cut for a draw, at most
_DRAWS = 4  # draws for each pose that is kept
_MOVES = 2  # of every pose at each step
_STEPS = 8  # that are usual, for the budget
_KEPT = 0.6  # share of the poses that the weights of a step leave effective
_ACCEPTED = 0.25  # share of moves accepted at which their size stays
_TURN = 0.1  # rad, standard deviation of the first moves; they differ by a factor of ten from pose to pose
_EXPONENTS = np.geomspace(0.02, 1, 24)  # of the likelihood, that the first step may have
_HALVINGS = 30


@dataclass(frozen=True, eq=False)
class Particles:
    """n poses with what decides about them.

    Attributes
    ----------
    poses : n of them, their ``reach`` as it was found
    depth : (n,) penetration, in shares of the deepest
    log_likelihood : (n,)
    log_coarse : (n,) log density of the coarse posterior
    """

    poses: Placements
    depth: Array
    log_likelihood: Array
    log_coarse: Array

    def __len__(self) -> int:
        return len(self.depth)

    def take(self, rows: NDArray[np.int64]) -> Particles:
        """Those of ``rows`` (m,)."""
        p = self.poses
        poses = Placements(p.direction[rows], p.rotation[rows], p.centre[rows], p.reach[rows])
        rest = (self.depth, self.log_likelihood, self.log_coarse)
        return Particles(poses, *(each[rows] for each in rest))

    def where(self, chosen: NDArray[np.bool_], other: Particles) -> Particles:
        """``other`` where ``chosen`` (n,), else this."""

        def mixed(a: NDArray[Any], b: NDArray[Any]) -> NDArray[Any]:
            return np.where(chosen.reshape(-1, *[1] * (a.ndim - 1)), b, a)

        p, q = self.poses, other.poses
        poses = Placements(
            mixed(p.direction, q.direction),
            mixed(p.rotation, q.rotation),
            mixed(p.centre, q.centre),
            mixed(p.reach, q.reach),
        )
        return Particles(
            poses,
            mixed(self.depth, other.depth),
            mixed(self.log_likelihood, other.log_likelihood),
            mixed(self.log_coarse, other.log_coarse),
        )


@dataclass(frozen=True, eq=False)
class Explored:
    """The distribution of the pose after one touch.

    Attributes
    ----------
    maps, query : contacts at any pose, and the observed one
    particles : poses drawn from the distribution, equally probable
    log_evidence : log of the mean likelihood over the contact pose space
    exponents : of the likelihood, step by step
    contacts : that were cut
    """

    maps: ContactMaps
    query: ContactQuery
    particles: Particles
    log_evidence: float
    exponents: tuple[float, ...]
    contacts: int

    @property
    def expected_gain(self) -> float:
        """Mean log density under the distribution itself [nats]."""
        return float(self.particles.log_likelihood.mean()) - self.log_evidence

    def log_density(self, T: ArrayLike, penetration: ArrayLike) -> Array:
        """Log density (n,), relative to the uniform, at poses ``T_sensor_object`` (n, 4, 4) of the contact pose space that press
        ``penetration`` (n,) [m] deep."""
        return log_likelihood_at(self.maps, self.query, T, penetration) - self.log_evidence

    def credible_level(self, log_density: float) -> float:
        """Mass of the poses that are denser than ``log_density``."""
        return float((self.particles.log_likelihood - self.log_evidence > log_density).mean())


def log_likelihood_at(maps: ContactMaps, query: ContactQuery, T: ArrayLike, penetration: ArrayLike) -> Array:
    """Log likelihood (n,) of the observed contact at ``T_sensor_object`` (n, 4, 4), where ``penetration`` (n,) is in metres."""
    penetration = np.asarray(penetration, float)
    compared = maps.compare(query.samples, maps.locate(np.asarray(T, float), penetration), query.area)
    return query.log_likelihood(compared.energy, penetration / maps.index.sensor.max_penetration)


def explore(maps: ContactMaps, query: ContactQuery, coarse: Array, contacts: int, rng: np.random.Generator) -> Explored:
    """The distribution of the pose, from about ``contacts`` contacts.

    Parameters
    ----------
    coarse : (n,) mass of the places of the index in a coarse posterior
    """
    measure = maps.index.weight.sum(0, dtype=float)
    measure /= measure.sum()
    share = (1 - _UNIFORM) * coarse / coarse.sum() + _UNIFORM * measure
    sampler = _Sampler(maps, query, measure, np.log(share / measure))
    n = max(contacts // (_DRAWS * _CUTS + _MOVES * _STEPS), 20)
    particles, log_weight, cut = sampler.draw(share, _DRAWS * n, rng)
    # the first exponent is the one that the draws suit best
    first = [log_weight + sampler.log_target(particles, exponent) for exponent in _EXPONENTS]
    best = int(np.argmax([_effective(each) for each in first]))
    power, log_evidence = float(_EXPONENTS[best]), float(logsumexp(first[best]))
    particles = particles.take(_resampled(first[best], n, rng))
    exponents, size = [power], 1.0
    while True:
        for _ in range(_MOVES):
            particles, accepted = sampler.move(particles, power, size, rng)
            size = float(np.clip(size * np.exp(accepted - _ACCEPTED), 1e-3, 1))
            cut += n
        if power >= 1:
            break
        step = _next_step(particles, power)
        change = step * (particles.log_likelihood - particles.log_coarse)
        log_evidence += float(logsumexp(change)) - np.log(n)
        particles, power = particles.take(_resampled(change, n, rng)), power + step
        exponents.append(power)
    return Explored(maps, query, particles, log_evidence, tuple(exponents), cut)


def _effective(log_weight: Array) -> float:
    """How many draws of equal weight would do as well."""
    if not np.isfinite(log_weight).any():
        return 0.0
    return float(np.exp(2 * logsumexp(log_weight) - logsumexp(2 * log_weight)))


def _resampled(log_weight: Array, n: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """``n`` rows by their weight."""
    return _systematic(np.exp(log_weight - log_weight.max()), n, rng)


def _systematic(weight: Array, n: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """``n`` rows by their ``weight`` (m,), as evenly as can be (systematic resampling)."""
    total = np.cumsum(weight)
    return np.minimum(np.searchsorted(total, (np.arange(n) + rng.random()) / n * total[-1]), len(total) - 1)


def _next_step(particles: Particles, power: float) -> float:
    """By how much the exponent may grow so that the weights leave a share ``_KEPT`` of the poses effective."""
    gain = particles.log_likelihood - particles.log_coarse
    low, high = 0.0, 1 - power
    if _effective(high * gain) >= _KEPT * len(gain):
        return high
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if _effective(middle * gain) >= _KEPT * len(gain) else (low, middle)
    return max(low, 1e-4)


@dataclass(frozen=True, eq=False)
class _Sampler:
    """Draws and moves of poses for one touch; ``measure`` (n,) and ``log_coarse`` (n,) are the uniform measure and the coarse log
    density of the index's places."""

    maps: ContactMaps
    query: ContactQuery
    measure: Array
    log_coarse: Array

    def log_target(self, particles: Particles, power: float) -> Array:
        """Log (n,) of the density that a step draws from, up to a constant."""
        out = np.full(len(particles), -np.inf)
        ok = np.isfinite(particles.log_likelihood)
        out[ok] = power * particles.log_likelihood[ok] + (1 - power) * particles.log_coarse[ok]
        return out

    def _admitted(self, poses: Placements, depth: Array, some: NDArray[np.bool_]) -> NDArray[np.bool_]:
        space = self.maps.index.space
        if space.cones is None and space.sensor.housing_depth is None:
            return np.ones(int(some.sum()), bool)
        return space.admits(self.transforms(poses, depth)[some])

    def transforms(self, poses: Placements, depth: Array) -> Array:
        """T_sensor_object (n, 4, 4)."""
        index = self.maps.index
        with np.errstate(invalid="ignore"):
            z = poses.reach - depth * index.sensor.max_penetration
        centre = np.column_stack([poses.centre, np.where(np.isfinite(z), z, 0)])
        return transform(poses.rotation, centre - poses.rotation @ index.mesh.centre)

    def move(
        self, particles: Particles, power: float, size: float, rng: np.random.Generator
    ) -> tuple[Particles, float]:
        """Every pose after one Metropolis step, and the share accepted.

        A pose is turned about the observed contact's centroid and shifted: such a motion keeps the uniform measure.
        """
        index, n = self.maps.index, len(particles)
        scale = size * 10 ** -rng.random((n, 1))
        turn = Rotation.from_rotvec(scale * _TURN * rng.normal(size=(n, 3))).as_matrix()
        shift = scale * _WIDTH * sample_pitch(index.sensor) * rng.normal(size=(n, 3))
        about = np.array([*self.query.centroid, 0.0])
        T = self.transforms(particles.poses, particles.depth)
        moved = T.copy()
        moved[:, :3, :3] = turn @ T[:, :3, :3]
        moved[:, :3, 3] = np.einsum("nij,nj->ni", turn, T[:, :3, 3] - about) + about + shift
        image, direction, j = index.directions.lookup(moved)
        centre = image[:, :3, :3] @ index.mesh.centre + image[:, :3, 3]
        guess = centre[:, 2] + particles.depth * index.sensor.max_penetration
        poses = Placements(direction.astype(np.int32), image[:, :3, :3], centre[:, :2], guess)
        place = index.place_of(index.directions.first_turn[direction] + j, centre)
        other = self.evaluated(poses, place, lambda reach: (reach - centre[:, 2]) / index.sensor.max_penetration)
        log_ratio = self.log_target(other, power) - self.log_target(particles, power)
        accepted = np.log(rng.random(n)) < log_ratio
        return particles.where(accepted, other), float(accepted.mean())

    def evaluated(self, poses: Placements, place: NDArray[np.int64], depth_at: Callable[[Array], Array]) -> Particles:
        """Poses at places (n,) as particles; ``depth_at`` gives their depth (n,) where the object's reach (n,) is found."""
        compared = self.maps.compare(self.query.samples, poses, self.query.area)
        found = replace(poses, reach=compared.reach.astype(float))
        depth = depth_at(found.reach)
        ok = compared.touches & (depth >= 0) & (depth <= 1)
        ok[ok] = self._admitted(found, depth, ok)
        log_likelihood = np.full(len(depth), -np.inf)
        log_likelihood[ok] = self.query.log_likelihood(compared.energy[ok], depth[ok])
        return Particles(found, np.where(ok, depth, 0.0), log_likelihood, self.log_coarse[place])

    def draw(self, share: Array, n: int, rng: np.random.Generator) -> tuple[Particles, Array, int]:
        """``n`` poses, their log weights (n,), and how many contacts were cut.

        A place is drawn by its ``share`` (m,), a rotation uniformly in its cell, a centre in its lattice cell. A weight is the
        uniform density over that of the draw, over n.
        """
        index = self.maps.index
        place = _systematic(share, n, rng)
        rotation = index.directions.draw(index.rotation[place], rng)
        direction = index.directions.direction_of_rotation(index.rotation[place]).astype(np.int32)
        step = index.resolution.step
        middle = np.rint(index.shift[place] / step) * step
        reach = index.height[0, place].astype(float) + index.resolution.penetrations[0]
        poses = Placements(direction, rotation, middle, reach)
        target, cut = _aligned(self.maps, self.query, poses, step)
        centre, density = _centres(target, middle, step, _WIDTH * sample_pitch(index.sensor), rng)
        particles = self.evaluated(replace(poses, centre=centre), place, lambda _: rng.random(n))
        # the measure of a whole cell, of which only the share touches that ``touching`` says
        volume = self.measure[place] / index.touching[place]
        return particles, np.log(volume) - np.log(share[place]) - np.log(density * n), cut + n


def _aligned(maps: ContactMaps, query: ContactQuery, poses: Placements, step: float) -> tuple[Array, int]:
    """The object's centre (n, 2) at which the contact's centroid is about the observed one, NaN where none within the cell is;
    and how many contacts were cut."""
    centre, cut, near = poses.centre.copy(), 0, np.arange(len(poses.reach))
    reach = poses.reach.copy()
    for _ in range(_CUTS - 1):
        some = Placements(poses.direction[near], poses.rotation[near], centre[near], reach[near])
        compared = maps.compare(query.samples, some, query.area)
        cut += len(near)
        centre[near] += np.where(compared.touches[:, None], query.centroid - compared.centroid, np.nan)
        reach[near] = compared.reach
        off = np.abs(centre - poses.centre).max(1)
        inside = off <= 0.5 * step + 2 * _WIDTH * sample_pitch(maps.index.sensor)
        centre[~inside] = np.nan
        near = np.flatnonzero(inside)
    return centre, cut


def _centres(
    target: Array, middle: Array, step: float, width: float, rng: np.random.Generator
) -> tuple[Array, NDArray[np.float64]]:
    """Centres (n, 2) in lattice cells about ``middle`` (n, 2), most of them normal about ``target`` (n, 2) where there is one;
    and their density (n,), that of the uniform being 1."""
    low, high = middle - step / 2, middle + step / 2
    known = np.asarray(np.isfinite(target).all(1), bool)
    share = np.where(known, _ALIGNED, 0.0)
    about = np.where(known[:, None], target, middle)
    first, last = ndtr((low - about) / width), ndtr((high - about) / width)
    within = np.maximum(last - first, 1e-12)
    normal = about + width * ndtri(np.clip(first + within * rng.random(middle.shape), 1e-12, 1 - 1e-12))
    uniform = low + step * rng.random(middle.shape)
    aligned = rng.random(len(middle)) < share
    centre = np.where(aligned[:, None], np.clip(normal, low, high), uniform)
    density = np.exp(-0.5 * ((centre - about) / width) ** 2) / (np.sqrt(2 * np.pi) * width * within) * step
    return centre, (1 - share) + share * density.prod(1)
