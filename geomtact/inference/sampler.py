"""The density of the pose at any pose, normalised by a sequential Monte Carlo sampler.

The density at a pose is the likelihood there over its mean, the evidence. So a posterior needs no cell about a pose: it needs the
likelihood, which is made where it is asked for, and the evidence, a mean over the contact pose space. Both come from poses that
are drawn where a coarse posterior puts its mass, weighed, and moved while the target goes, step by step, from the coarse density
to the likelihood (Del Moral, Doucet and Jasra 2006). What is left at a step are poses drawn from the posterior by a power of the
likelihood. The posterior is a mixture of these (see ``scoring.contact_likelihood``).

Given a rotation, a contact moves with the object. So the object's centre is drawn about where the contact's centroid is the
observed one, and moves turn the object about that point of the membrane.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.special import ndtr, ndtri

from geomtact.contact_space.contact_maps import ContactMaps, Placements, located, sample_pitch
from geomtact.contact_space.index import Index
from geomtact.errors import InputError
from geomtact.inference.explored import Density
from geomtact.inference.particles import SURE, OtherSensor, Particles, Target, poses_of
from geomtact.scoring.contact_likelihood import POWERS, ContactQuery
from geomtact.se3 import Array, exp, inverse, log, transform

_UNIFORM = 0.2  # share of the uniform distribution in the coarse posterior, by which poses are drawn; hand-set
# All other constants choose where poses are drawn: they change how precise the evidence is, not what is estimated.
_ALIGNED = 0.7  # share of the draws whose centre is aligned
_WIDTH = 1.5  # standard deviation of aligned centres, in samples of the window
_CUTS = 3  # contacts that are cut for a draw, at most
_DRAWS = 4  # draws for each pose that is kept
# Of several sensors: poses that are kept, by power, over those with one. Hardly any touch all sensors at first. By larger powers
# than these, runs too often miss the true mode.
_OF_SEVERAL = (16, 8, 6)
_OF_SEVERAL_COST = 12  # contacts that this takes, over those with one sensor
_MOVES = 2  # of every pose at each step
_STEPS = 11  # that are usual, for the budget
_KEPT = 0.6  # share of the poses that the weights of a step leave effective
_ACCEPTED = 0.25  # share of moves accepted at which their size stays
_SMALL = 0.5  # share of the moves that are small motions
_NEAR = 8  # poses among which the other one of a difference is drawn
_ALONG = 1.0  # largest multiple of a difference
_TURN = 0.1  # rad, standard deviation of the first moves; they differ by a factor of ten from pose to pose
_SHARE_DECADES = 2  # over which changes of errors are spread
_EXPONENTS = np.geomspace(2e-4, POWERS[-1], 40)  # of the likelihood, that the first step may have
_HALVINGS = 30


@dataclass(frozen=True, eq=False)
class Run:
    """What one run of the sampler found.

    Attributes
    ----------
    density : of the pose
    particles : of each posterior by a power of the likelihood, poses without errors drawn from it, equally probable
    contacts : that were cut
    log_measure : log of the uniform measure of poses that touch over that of the cells that hold them
    best : (S,) the largest log likelihood by each of several sensors of all poses that were tried; S is 0 for one sensor alone
    """

    density: Density
    particles: tuple[Particles, ...]
    contacts: int
    log_measure: float
    best: Array

    @property
    def log_evidence(self) -> tuple[float, ...]:
        """Of each posterior."""
        return self.density.log_evidence


def explore(
    index: Index,
    query: ContactQuery,
    coarse: Array,
    contacts: int,
    rng: np.random.Generator,
    log_prior: NDArray[np.floating] | None = None,
    others: Sequence[OtherSensor] = (),
    runs: int = 1,
) -> tuple[Run, ...]:
    """The distribution of the pose, found ``runs`` times from about ``contacts`` contacts on each sensor, all at once.

    Parameters
    ----------
    coarse : (n,) mass of the places of the index in a coarse posterior; a share of the uniform one is mixed in
    log_prior : (N,) log density of the prior in the cells of the index, relative to the uniform; None for the uniform
    others : the other sensors that touch the object, or do not

    Raises
    ------
    InputError
        No pose that was drawn touches the sensor, or none that was found touches all that show contact.
    """
    cells = index.weight.astype(float) / index.weight.sum(dtype=float)
    measure = cells.sum(0)
    share = (1 - _UNIFORM) * coarse / coarse.sum() + _UNIFORM * measure
    log_coarse = np.log(share / measure).astype(np.float32).astype(float)  # as files hold it
    target = Target(index, query, log_coarse, log_prior, tuple(others))
    known = 0.0  # log of the mean of the coarse density under the prior
    if log_prior is not None:
        share = share / measure * (cells * np.exp(log_prior.reshape(cells.shape))).sum(0)
        known = float(np.log(share.sum()))
    usual = _DRAWS * _CUTS + _MOVES * _STEPS
    numbers = [max(contacts // usual, 20)] * len(POWERS)
    if others:
        numbers = [max(int(contacts / usual * more / _OF_SEVERAL_COST), 20) for more in _OF_SEVERAL]
    n = numbers[0]
    drawn, log_weight, cut = _draw(target, share, runs, _DRAWS * n, rng)
    # the evidence of the coarse posterior is known: what is left is an error of the measure, which all poses of a run share
    whole = np.logaddexp.reduce(log_weight + drawn.log_target(0).reshape(runs, -1), 1)
    if not np.isfinite(whole).all():
        raise InputError(f"{index.mesh.name}: no pose that was drawn touches the sensor; allow more contacts")
    log_weight = log_weight + (known - whole)[:, None]

    def by_power(exponent: float) -> Array:
        """Log weights (runs, m) of the draws in the posterior by that power."""
        return log_weight + drawn.log_target(exponent).reshape(runs, -1)

    powers = POWERS[: len(numbers)]
    # the first exponent is the largest that leaves enough draws effective: a distinctive contact begins low
    exponents = _EXPONENTS[powers[-1] >= _EXPONENTS]
    effective = np.array([_effective(by_power(exponent)) for exponent in exponents])
    enough = (effective >= np.minimum(n, effective.max(0))).all(1)
    enough[0] = True
    power = float(exponents[np.flatnonzero(enough)[-1]])
    # the posteriors by powers of at most this one are those of the draws
    found, evidence = [], []
    for each in (*(each for each in powers if each < power), power):
        weight = by_power(each)
        evidence.append(np.logaddexp.reduce(weight, 1))
        found.append(drawn.take(_resampled(weight, n, rng)))
    particles, log_evidence, size = found[-1], evidence[-1], 1.0
    faster = target.sensors**2  # several contacts narrow sooner
    best = drawn.by_sensor.max(0, initial=-np.inf)
    while True:
        for _ in range(_MOVES):
            particles, accepted = _moved(target, particles, runs, power, size, rng)
            size = float(np.clip(size * np.exp(faster * (accepted - _ACCEPTED)), 1e-3, 1))
            best = np.maximum(best, particles.by_sensor.max(0, initial=-np.inf))
            cut += runs * n * target.sensors
        if power in powers:
            found[powers.index(power) :] = [particles]
            evidence[powers.index(power) :] = [log_evidence]
            if n != numbers[powers.index(power)]:
                n = numbers[powers.index(power)]
                particles = particles.take(_resampled(np.zeros((runs, len(particles) // runs)), n, rng))
        if power >= powers[-1]:
            break
        change = (particles.log_likelihood - particles.log_coarse).reshape(runs, n)
        after = min(each for each in powers if each > power)
        step = _next_step(change, after - power)
        log_evidence = log_evidence + np.logaddexp.reduce(step * change, 1) - np.log(n)
        particles = particles.take(_resampled(step * change, n, rng))
        power = after if step == after - power else power + step
        if others and power == SURE:
            touches = np.where(particles.missed, -np.inf, 0.0).reshape(runs, n)
            if not np.isfinite(touches).any(1).all():
                raise InputError(f"{index.mesh.name}: no pose that was found touches all sensors; allow more contacts")
            log_evidence = log_evidence + np.logaddexp.reduce(touches, 1) - np.log(n)
            particles = particles.take(_resampled(touches, n, rng))
    return tuple(
        Run(
            Density(target, tuple(float(each[run]) for each in evidence)),
            tuple(each.take(np.arange(len(each)).reshape(runs, -1)[run]) for each in found),
            cut // runs,
            float(known - whole[run]),
            best,
        )
        for run in range(runs)
    )


def _effective(log_weight: Array) -> Array:
    """How many draws of equal weight would do as well (...), of those of ``log_weight`` (..., m)."""
    most = log_weight.max(-1, keepdims=True)
    weight = np.exp(log_weight - np.where(np.isfinite(most), most, 0.0))
    return np.asarray(weight.sum(-1) ** 2 / np.maximum(np.square(weight).sum(-1), 1e-300))


def _resampled(log_weight: Array, n: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """``n`` rows by their weight for each run of ``log_weight`` (runs, m), one run after the other."""
    weight = np.exp(log_weight - log_weight.max(1, keepdims=True))
    return np.concatenate([run * len(each) + systematic(each, n, rng) for run, each in enumerate(weight)])


def systematic(weight: Array, n: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """``n`` rows by their ``weight`` (m,), as evenly as can be (systematic resampling)."""
    total = np.cumsum(weight)
    return np.minimum(np.searchsorted(total, (np.arange(n) + rng.random()) / n * total[-1]), len(total) - 1)


def _next_step(change: Array, most: float) -> float:
    """By how much, ``most`` at most, the exponent may grow so that weights of exp(step ``change``) (runs, n) leave a share
    ``_KEPT`` of the poses of each run effective."""

    def leaves_enough(step: float) -> bool:
        return bool((_effective(step * change) >= _KEPT * change.shape[1]).all())

    if leaves_enough(most):
        return most
    low, high = 0.0, most
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if leaves_enough(middle) else (low, middle)
    return max(low, 1e-4)


def _moved(
    target: Target, particles: Particles, runs: int, power: float, size: float, rng: np.random.Generator
) -> tuple[Particles, float]:
    """Every pose after one Metropolis step, and the share of small motions that was accepted.

    Half of the poses move at a time: some by small motions, some by multiples of the motion from one pose of the other half of
    their run to another near it (ter Braak 2006), which follow the directions that the contact leaves open. Both keep the
    uniform measure.
    """
    small = rng.random(len(particles)) < _SMALL
    accepted = np.zeros(len(particles), bool)
    half = rng.random(len(particles)) < 0.5
    run = np.arange(len(particles)) * runs // len(particles)
    for moving in (half, ~half):
        some, others = np.flatnonzero(moving), np.flatnonzero(~moving)
        if not len(some) or np.bincount(run[others], minlength=runs).min() < 2:
            continue
        T = poses_of(particles.poses, particles.depth, target.index.mesh.centre)
        others = others[np.lexsort((particles.poses.place[others], run[others]))]
        moved, nudged = T[some], small[some]
        moved[nudged] = _nudged(target, moved[nudged], size, rng)
        moved[~nudged] = _differences(T[others], run[others], run[some[~nudged]], rng) @ moved[~nudged]
        now = particles.take(some)
        poses, membrane = located(target.index, moved)
        errors = _nudged_errors(now.errors, rng)
        new = target.evaluated(replace(poses, reach=membrane + now.depth), membrane=membrane, errors=errors)
        new = replace(new, draw=now.draw)
        images = _log_images(target, poses.rotation) - _log_images(target, now.poses.rotation)
        gain = new.log_target(power) - now.log_target(power) + images
        taken = np.flatnonzero(np.log(rng.random(len(some))) < gain)
        new = new.take(taken)
        allowed = target.admits(new)  # of those alone, because it takes as long as a contact
        accepted[some[taken[allowed]]] = True
        particles = particles.put(some[taken[allowed]], new.take(np.flatnonzero(allowed)))
    return particles, float(accepted[small].mean()) if small.any() else _ACCEPTED


def _nudged_errors(shares: Array, rng: np.random.Generator) -> Array:
    """``shares`` (n, S, 4) of errors, of one sensor a pose changed a little; round the ends, so that they stay uniform."""
    n, sensors, d = shares.shape
    if not sensors:
        return shares
    step = 10 ** -(_SHARE_DECADES * rng.random((n, 1))) * rng.normal(size=(n, d))
    out = shares.copy()
    row, changed = np.arange(n), rng.integers(sensors, size=n)
    out[row, changed] = (out[row, changed] + step) % 1
    return out


def _log_images(target: Target, R: Array) -> Array:
    """Log (n,) of how many images of ``R`` (n, 3, 3) the approach allows, up to a constant: a placement with more of them has
    the larger measure."""
    return np.asarray(np.log(np.maximum(target.index.directions.density(R), 1e-300)))


def _nudged(target: Target, T: Array, size: float, rng: np.random.Generator) -> Array:
    """``T`` (n, 4, 4) turned about the observed contact's centroid and shifted."""
    n = len(T)
    scale = size * 10 ** -rng.random((n, 1))
    rotvec = scale * _TURN * rng.normal(size=(n, 3))
    if target.index.space.on_known_faces:
        rotvec[:, :2] = 0
    turn = Rotation.from_rotvec(rotvec).as_matrix()
    shift = scale * _WIDTH * sample_pitch(target.index.sensor) * rng.normal(size=(n, 3))
    about = target.query.centroid
    where = np.einsum("nij,nj->ni", turn, T[:, :3, 3] - about) + about + shift
    return transform(turn @ T[:, :3, :3], where)


def _draw(target: Target, share: Array, runs: int, n: int, rng: np.random.Generator) -> tuple[Particles, Array, int]:
    """``n`` poses for each run, one run after the other, their log weights (runs, n), and how many contacts were cut.

    A place is drawn in proportion to ``share`` (m,), a rotation uniformly in its cell, a centre in its lattice cell. A weight
    is the uniform density over that of the draw, over n.
    """
    index = target.index
    place = np.concatenate([systematic(share, n, rng) for _ in range(runs)])
    share = share / share.sum()
    drawn = transform(index.directions.draw(index.rotation[place], rng), np.zeros(3))
    rotation = index.directions.canonical(drawn)[:, :3, :3]
    direction = index.directions.direction_of_rotation(index.rotation[place]).astype(np.int32)
    step = index.resolution.step
    middle = np.rint(index.shift[place] / step) * step
    reach = index.height[0, place].astype(float) + index.resolution.penetrations[0]
    poses = Placements(place, direction, rotation, middle, reach)
    about, cut = _aligned(target, poses, step)
    centre, density = _centres(about, middle, step, _WIDTH * sample_pitch(index.sensor), rng)
    depth = index.sensor.max_penetration * rng.random(len(place))
    errors = rng.random((len(place), target.carried, 4))
    particles = target.admitted(target.evaluated(replace(poses, centre=centre), depth=depth, errors=errors))
    log_weight = np.log(index.cell_measure[place]) - np.log(share[place]) - np.log(density * n)
    return particles, log_weight.reshape(runs, n), cut + len(place) * target.sensors


def _differences(T: Array, run: NDArray[np.int64], of: NDArray[np.int64], rng: np.random.Generator) -> Array:
    """Motions (n, 4, 4) along those from poses ``T`` (m, 4, 4) to others near them, for each of the runs ``of`` (n,).

    The poses come run by run, as ``run`` (m,) says, those near each other one after the other. Motions are in the sensor frame,
    so that they act on images under the symmetry alike.
    """
    count = np.bincount(run)
    start = np.cumsum(count) - count
    first = rng.integers(count[of])
    second = (first + rng.integers(1, _NEAR + 1, size=len(of))) % count[of]
    share = _ALONG * rng.choice([-1.0, 1.0], len(of)) * 10 ** -rng.random(len(of))
    return exp(share[:, None] * log(T[start[of] + second] @ inverse(T[start[of] + first])))


def _aligned(target: Target, poses: Placements, step: float) -> tuple[Array, int]:
    """The object's centre (n, 2) at which the contact's centroid is about the observed one, NaN where none within the cell is;
    and how many contacts were cut."""
    query, maps = target.query, ContactMaps.of(target.index)
    centre, cut, near = poses.centre.copy(), 0, np.arange(len(poses.reach))
    reach = poses.reach.copy()
    for _ in range(_CUTS - 1):
        some = Placements(poses.place[near], poses.direction[near], poses.rotation[near], centre[near], reach[near])
        found = maps.compare(query.samples, query.area, some)
        cut += len(near)
        touches = np.isfinite(found.reach)[:, None]
        centre[near] += np.where(touches, query.centroid[:2] - found.centroid, np.nan)
        reach[near] = found.reach
        off = np.abs(centre - poses.centre).max(1)
        inside = off <= 0.5 * step + 2 * _WIDTH * sample_pitch(target.index.sensor)
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
