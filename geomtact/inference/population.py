"""Poses that are drawn from a distribution, and follow it by weights and moves while it changes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from geomtact.contact_space.contact_maps import centring_std, located
from geomtact.inference.particles import Particles, Target, poses_of
from geomtact.se3 import Array, exp, inverse, log, transform

# All choose where poses are drawn: they change how precise the evidence is, not what is estimated.
MOVES = 2  # of every pose at each step
_KEPT = 0.6  # share of the poses that the weights of a step leave effective
_ACCEPTED = 0.25  # share of moves accepted at which their size stays
_SMALL = 0.5  # share of the moves that are small motions
_NEAR = 8  # poses among which the other one of a difference is drawn
_ALONG = 1.0  # largest multiple of a difference
_TURN = 0.1  # rad, standard deviation of the first moves; they differ by a factor of ten from pose to pose
_SHARE_DECADES = 2  # over which changes of errors are spread
_HALVINGS = 30


@dataclass(eq=False)
class Population:
    """As many poses of each of some runs, run by run.

    Attributes
    ----------
    target : what decides about poses
    rng : draws them
    particles : equally probable
    log_evidence : (runs,) log integral of the function that they are drawn in proportion to
    best : as of ``sampler.Run``
    size : of moves, over that of the first ones
    contacts : that were cut
    """

    target: Target
    rng: np.random.Generator
    particles: Particles
    log_evidence: Array
    best: Array
    size: float = 1.0
    contacts: int = 0

    @property
    def runs(self) -> int:
        """How many runs there are."""
        return len(self.log_evidence)

    def move(self, log_density: Callable[[Particles], Array]) -> None:
        """Every pose by ``MOVES`` Metropolis steps, after which they still have the density, known up to a constant."""
        faster = self.target.sensors**2  # several contacts narrow sooner
        density = log_density(self.particles)
        for _ in range(MOVES):
            self.particles, density, accepted = _moved(
                self.target, self.particles, density, self.runs, log_density, self.size, self.rng
            )
            self.size = float(np.clip(self.size * np.exp(faster * (accepted - _ACCEPTED)), 1e-3, 1))
            self.best = np.maximum(self.best, self.particles.by_sensor.max(0, initial=-np.inf))
            self.contacts += len(self.particles) * self.target.sensors

    def reweigh(self, change: Array, most: float) -> float:
        """Weights of exp(step ``change``) for each pose (n,), with the largest step, ``most`` at most, that leaves enough of them
        effective; returns it."""
        step = _next_step(change.reshape(self.runs, -1), most)
        self.choose(step * change)
        return step

    def choose(self, log_weight: Array, n: int | None = None) -> None:
        """Poses by their weight (n,), as many in each run as before, or ``n``. In each run one has a weight."""
        weight = log_weight.reshape(self.runs, -1)
        self.log_evidence = self.log_evidence + np.logaddexp.reduce(weight, 1) - np.log(weight.shape[1])
        self.particles = self.particles.take(resampled(weight, n or weight.shape[1], self.rng))

    def that_touch(self) -> Population | None:
        """The poses alone that touch all sensors; None where a run has none."""
        missed = self.particles.missed
        if missed.reshape(self.runs, -1).all(1).any():
            return None
        out = replace(self)
        out.choose(np.where(missed, -np.inf, 0.0))
        return out


def effective(log_weight: Array) -> Array:
    """Effective sample size (...) of draws of ``log_weight`` (..., m)."""
    most = log_weight.max(-1, keepdims=True)
    weight = np.exp(log_weight - np.where(np.isfinite(most), most, 0.0))
    return np.asarray(weight.sum(-1) ** 2 / np.maximum(np.square(weight).sum(-1), 1e-300))


def resampled(log_weight: Array, n: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """``n`` rows by their weight for each run of ``log_weight`` (runs, m), one run after the other."""
    weight = np.exp(log_weight - log_weight.max(1, keepdims=True))
    return np.concatenate([run * len(each) + systematic(each, n, rng) for run, each in enumerate(weight)])


def systematic(weight: Array, n: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """``n`` rows by their ``weight`` (m,), as evenly as can be (systematic resampling)."""
    total = np.cumsum(weight)
    return np.minimum(np.searchsorted(total, (np.arange(n) + rng.random()) / n * total[-1]), len(total) - 1)


def different(log_weight: Array, n: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """``n`` rows by their weight (m,), none of them twice; fewer where fewer have one."""
    drawn = np.where(np.isfinite(log_weight), log_weight + rng.gumbel(size=len(log_weight)), -np.inf)
    return np.argsort(-drawn, kind="stable")[: min(n, int(np.isfinite(log_weight).sum()))]


def _next_step(change: Array, most: float) -> float:
    """By how much, ``most`` at most, the exponent may grow so that weights of exp(step ``change``) (runs, n) leave a share
    ``_KEPT`` of the poses of each run effective."""

    def leaves_enough(step: float) -> bool:
        return bool((effective(step * change) >= _KEPT * change.shape[1]).all())

    if leaves_enough(most):
        return most
    low, high = 0.0, most
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if leaves_enough(middle) else (low, middle)
    return min(max(low, 1e-4), most)


def _moved(
    target: Target,
    particles: Particles,
    density: Array,
    runs: int,
    log_density: Callable[[Particles], Array],
    size: float,
    rng: np.random.Generator,
) -> tuple[Particles, Array, float]:
    """Every pose after one Metropolis step, the log ``density`` (n,) of each, and the share of small motions that was accepted.

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
        found = log_density(new)
        gain = found - density[some] + images
        taken = np.flatnonzero(np.log(rng.random(len(some))) < gain)
        new = new.take(taken)
        allowed = target.admits(new)  # of those alone, because it takes as long as a contact
        accepted[some[taken[allowed]]] = True
        particles = particles.put(some[taken[allowed]], new.take(np.flatnonzero(allowed)))
        density = density.copy()
        density[some[taken[allowed]]] = found[taken[allowed]]
    return particles, density, float(accepted[small].mean()) if small.any() else _ACCEPTED


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
    turn = exp(np.column_stack([rotvec, np.zeros((n, 3))]))[:, :3, :3]
    shift = scale * centring_std(target.index.sensor) * rng.normal(size=(n, 3))
    about = target.query.centroid
    where = (turn @ (T[:, :3, 3] - about)[..., None])[..., 0] + about + shift
    return transform(turn @ T[:, :3, :3], where)


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
