"""The masses of the leading modes of an explored posterior: of one touch by importance sampling.

It may fit hundreds of places, of which particles find some. Those that are found hold all particles, so that a count says
how often a place was found, not how probable it is. But the density is known: so its integral about a mode is made instead, from
poses that are drawn round by round as the poses before them say (Cappe et al. 2008).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from geomtact.contact_space.contact_maps import sample_pitch
from geomtact.geometry.distance import PoseDistance, mode_radius
from geomtact.geometry.mesh import Mesh
from geomtact.inference.explored import Explored
from geomtact.inference.student import Student, log_volume
from geomtact.inference.systematic_errors import errors_of
from geomtact.se3 import Array, exp, inverse, log

# These choose where the density is looked at: they change how precise a mass is, not what is estimated.
_MODES = 5, 20  # that are weighed, at least and at most
_ROUNDS, _DRAWS = 3, 150  # of poses, for each mode
_EFFECTIVE = 20  # draws that decide about the next round's, at least
_SAMPLES = 0.5  # of the window: width of the covariance that is known before
_POINTS = 128  # of the surface, for distances


def weighed(
    explored: Explored, further: Array, log_measure: float, contacts: int, rng: np.random.Generator
) -> tuple[Explored, float]:
    """``explored``, of one sensor, with its leading modes, as many as ``contacts`` contacts weigh, and the log of the sum of
    all mass as it was found: theirs, and the share of the poses that are beside them.

    Each is the poses within the mode radius of its densest pose, of the particles and the ``further`` ones (c, 4, 4). If all mass
    adds up to more than 1, the evidence is too small; then the masses are divided by the sum.
    """
    density, mesh = explored.density, explored.index.mesh
    distance, radius = PoseDistance(mesh, _POINTS), mode_radius(mesh)
    count = int(np.clip(contacts // (_ROUNDS * _DRAWS), *_MODES))
    hearts, members = _grown(explored, further, distance, radius, count)
    modes = _modes(explored, hearts, members, distance)
    for _ in range(_ROUNDS):
        draws = [mode.students[-1].draw(_DRAWS, rng) for mode in modes]
        xi = np.stack([each @ mode.basis for mode, each in zip(modes, draws, strict=True)])
        T = np.stack([mode.heart for mode in modes])[:, None] @ exp(xi)
        shares = rng.random((*xi.shape[:2], 4))
        moved = density.target.displaced(T, errors_of(shares))
        near = np.stack([distance.within(mode.heart, each, radius) for mode, each in zip(modes, moved, strict=True)])
        turn = np.linalg.norm(xi[..., :3], axis=-1)
        # beyond these turns a placement is met again
        nearest = [distance.is_nearest(mode.heart, each) for mode, each in zip(modes, T, strict=True)]
        near &= (turn < np.pi) & np.stack(nearest)
        found = np.full(near.shape, -np.inf)
        carried = shares[near][:, None] if density.target.carried else None
        particles = density.target.particles_at(T[near], carried)
        with np.errstate(divide="ignore"):  # where the approach allows no image
            log_density = density.of_exact(particles) + np.log(explored.index.uniform_density(T[near]))
        log_density += log_volume(turn[near], len(modes[0].basis) - 3)  # 0 or 1 turns, on a known face, give the same
        found[near] = np.where(np.isfinite(particles.log_likelihood), log_density, -np.inf)
        for mode, each, log_densities in zip(modes, draws, found, strict=True):
            mode.add(each, log_densities)
    # errors take the poses of a mode out of the contact pose space as often as all others
    log_mass = np.array([mode.log_integral + log_measure for mode in modes])
    most = max(float(log_mass.max()), 0.0)
    mass = _shared_out(explored, members, np.exp(log_mass - most))
    beside = 1 - explored.weight[np.unique(np.concatenate(members))].sum()
    log_sum = float(np.logaddexp(most + np.log(max(mass.sum(), 1e-300)), np.log(max(beside, 1e-300))))
    mass *= np.exp(most - max(log_sum, 0.0))
    order = np.argsort(-mass, kind="stable")
    contacts = explored.contacts + _ROUNDS * _DRAWS * len(modes)
    return replace(explored, hearts=hearts[order], masses=mass[order], contacts=contacts), log_sum


def counted(
    explored: Explored, further: Array, draws: float, led_to: tuple[Array, NDArray[np.int64]] | None = None
) -> Explored:
    """``explored``, of several sensors, with its leading modes; ``further`` is as of :func:`weighed`.

    The mass of a mode is the share of the poses near it: of several contacts there are few modes, and an integral about one would
    be over the errors of all contacts too. How often a mode was found says how many like it were missed: by the rule of
    succession modes that are found k times are found with the probability k / (k + 1). So one stands for (k + 1) / k of its mass
    (Horvitz and Thompson 1952), and a pose beside all modes for twice its mass. A mode is found by its share of the independent
    ``draws`` that all poses come from, or by registration from so many places (r,) that were ``led_to`` poses (r, 4, 4) near it,
    -1 being none; whichever is more.
    """
    mesh = explored.index.mesh
    distance, radius = PoseDistance(mesh, _POINTS), mode_radius(mesh)
    hearts, members = _grown(explored, further, distance, radius, _MODES[1])
    mass = _shared_out(explored, members, np.array([explored.weight[rows].sum() for rows in members]))
    found = np.maximum(mass * draws, 1)
    if led_to is not None:
        T, origin = led_to
        near = np.stack([distance.within(heart, T, radius) for heart in hearts]) & (origin >= 0)
        found = np.maximum(found, np.array([len(np.unique(origin[each])) for each in near], float))
    whole = mass @ (1 + 1 / found) + 2 * max(1 - mass.sum(), 0)
    order = np.argsort(-mass, kind="stable")
    return replace(explored, hearts=hearts[order], masses=mass[order] / whole)


def shares_near(mesh: Mesh, hearts: Array, T: Array) -> Array:
    """Share (m,) of the poses ``T`` (n, 4, 4) near each of ``hearts`` (m, 4, 4); a pose counts for the first that it is near."""
    distance, radius, free = PoseDistance(mesh, _POINTS), mode_radius(mesh), np.ones(len(T), bool)
    out = np.zeros(len(hearts))
    for i, heart in enumerate(hearts):
        near = free & distance.within(heart, T, radius)
        out[i] = near.mean()
        free &= ~near
    return out


def _modes(explored: Explored, hearts: Array, members: list[NDArray[np.int64]], distance: PoseDistance) -> list[_Mode]:
    """Modes at ``hearts`` (m, 4, 4), which the rows ``members`` of the poses are near."""
    pitch, directions = _SAMPLES * sample_pitch(explored.index.sensor), explored.index.directions
    modes = []
    for heart, rows in zip(hearts, members, strict=True):
        basis = directions.motions(heart[:3, :3])
        poses, weight = explored.poses[rows], explored.weight[rows]
        if not len(rows):
            poses, weight = heart[None], np.ones(1)
        motions = log(inverse(heart) @ distance.aligned(heart, poses)) @ np.linalg.pinv(basis)
        least = np.where(basis[:, :3].any(1), pitch / explored.index.mesh.radius_rms, pitch)
        modes.append(_Mode(heart, basis, least, [Student.of(motions, weight, least)]))
    return modes


def _grown(
    explored: Explored, further: Array, distance: PoseDistance, radius: float, count: int
) -> tuple[Array, list[NDArray[np.int64]]]:
    """The densest pose (m, 4, 4) of each of ``count`` modes, densest first, and the particles near it."""
    poses = np.concatenate([explored.poses, further])
    log_density = np.concatenate([explored.log_density, explored.density.log_density(further)])
    covered = np.zeros(len(poses), bool)
    hearts: list[int] = []
    members: list[NDArray[np.int64]] = []
    for row in np.argsort(-log_density, kind="stable").tolist():
        if len(hearts) == count:
            break
        if not covered[row]:
            near = distance.within(poses[row], poses, radius)
            near[row] = True
            covered |= near
            hearts.append(row)
            members.append(np.flatnonzero(near[: len(explored.poses)]))
    return poses[hearts], members


def _shared_out(explored: Explored, members: list[NDArray[np.int64]], mass: Array) -> Array:
    """``mass`` (m,) of modes that may overlap: a pose counts for the most probable of its modes."""
    out, free = mass.copy(), np.ones(len(explored.poses), bool)
    for i in np.argsort(-mass, kind="stable"):
        weight = explored.weight[members[i]]
        if len(weight):
            out[i] *= weight[free[members[i]]].sum() / weight.sum()
        free[members[i]] = False
    return out


@dataclass(eq=False)
class _Mode:
    """Draws about one mode.

    Attributes
    ----------
    heart : (4, 4), from which motions are
    basis : (d, 6) that their coordinates are along, turns first
    least : (d,) standard deviations [rad, m] of the covariance that is known before
    students : that were drawn from, and the next one
    motions, log_density : of all draws
    log_integral : log of the integral of the density about it, from the draws so far
    """

    heart: Array
    basis: Array
    least: Array
    students: list[Student]
    motions: list[Array] = field(default_factory=list)
    log_density: list[Array] = field(default_factory=list)
    log_integral: float = -np.inf

    def add(self, motions: Array, log_density: Array) -> None:
        """A round of draws from the last of the distributions."""
        self.motions.append(motions)
        self.log_density.append(log_density)
        drawn = np.concatenate(self.motions)
        # all rounds are drawn from the mean of their distributions
        density = np.logaddexp.reduce([each.log_density(drawn) for each in self.students], 0) - np.log(
            len(self.students)
        )
        log_weight = np.concatenate(self.log_density) - density
        self.log_integral = _log_mean(log_weight)
        weight = _flattened(log_weight)
        self.students.append(Student.of(drawn, weight, self.least) if weight.any() else self.students[-1])


def _log_mean(log_weight: Array) -> float:
    """Log of the mean weight, where none counts more than sqrt(n) mean ones (Ionides 2008): a draw where hardly any was to be
    expected would else decide alone."""
    n = len(log_weight)
    most = np.logaddexp.reduce(log_weight) - 0.5 * np.log(n)
    return float(np.logaddexp.reduce(np.minimum(log_weight, most)) - np.log(n))


def _flattened(log_weight: Array) -> Array:
    """Weights (n,) raised to the largest power at which enough draws are effective; all 0 where no draw has any."""
    out, finite = np.zeros(len(log_weight)), np.isfinite(log_weight)
    if not finite.any():
        return out
    for power in np.linspace(1, 0, 21):
        weight = np.exp(power * log_weight[finite] - power * log_weight.max())
        if weight.sum() ** 2 >= _EFFECTIVE * np.square(weight).sum():
            break
    out[finite] = weight
    return out
