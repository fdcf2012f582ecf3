"""The distribution of a pose from two runs of the sampler that have to agree.

One run does not show what it has missed. So two are compared: where they disagree on the evidence, one has missed what the other
found; where the masses of the modes add up to more than 1, both have. Then more contacts are cut, or the sharpest powers are left
out.
"""

from __future__ import annotations

import functools
import itertools
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from geomtact.contact_space.index import Index
from geomtact.errors import InputError
from geomtact.inference.explored import Explored
from geomtact.inference.mode_mass import weighed
from geomtact.inference.particles import Particles, poses_of
from geomtact.inference.sampler import Run, explore, systematic
from geomtact.inference.systematic_errors import NODES, random_errors
from geomtact.scoring.contact_likelihood import POWERS, ContactQuery
from geomtact.se3 import Array

_POSES, _FOR_EACH = (300, 600), 20  # poses that are kept in the end, at least and at most, and contacts for each
_AGREE = 1.0  # nats: mean difference of two log evidences, by the weights of the powers, above which no run is believed; hand-set
_MORE = 4  # times as many contacts are cut in each attempt after the first
_LEFT_OUT = 3  # powers that an attempt may leave out, before the last
_WEIGHING = 0.5  # contacts that weigh the modes, for each that finds them


def explore_twice(
    index: Index,
    query: ContactQuery,
    coarse: Array,
    contacts: int,
    rng: np.random.Generator,
    log_prior: NDArray[np.floating] | None = None,
) -> Explored:
    """The distribution of the pose with its modes, by two runs that share a sixteenth of the ``contacts`` and have to agree on
    the evidence; arguments as of :func:`explore`.

    Where they do not, the largest powers of the likelihood are left out until they do, ``_LEFT_OUT`` of them at most. If that
    does not help, both are repeated with a quarter of the contacts, and then with all, where as many powers are left out as need
    be.

    Raises
    ------
    InputError
        No pose that was drawn touches the sensor, or the runs agree on nothing.
    """
    cut, all_powers = 0, len(POWERS)
    for asked in (contacts // _MORE**2, contacts // _MORE, contacts):
        one, other = explore(index, query, coarse, asked // 2, rng, log_prior, runs=2)
        cut += one.contacts + other.contacts
        least = 2 if asked == contacts else all_powers - _LEFT_OUT
        for powers in range(all_powers, least - 1, -1):
            run = replace(pooled(one, other, powers, rng), contacts=cut)
            apart = float(run.density.weights @ np.abs(np.subtract(one.log_evidence, other.log_evidence)[:powers]))
            if apart < _AGREE:
                found = _explored_from(run, int(np.clip(asked // _FOR_EACH, *_POSES)), rng)
                found, log_sum = weighed(found, run.log_measure, round(_WEIGHING * asked), rng)
                if log_sum < 0:
                    return found
                cut = found.contacts
    raise InputError(
        f"{index.mesh.name}: {cut:,} contacts do not settle how likely the observed one is; allow more by Effort(contacts=)"
    )


def pooled(one: Run, other: Run, powers: int, rng: np.random.Generator) -> Run:
    """Two runs as one: of each posterior by the smallest ``powers`` the particles of both, by how likely each run makes the
    contact."""
    particles, evidence = [], []
    each = zip(one.particles, other.particles, one.log_evidence, other.log_evidence, strict=True)
    for first, second, a, b in itertools.islice(each, powers):
        evidence.append(float(np.logaddexp(a, b) - np.log(2)))
        share, n = float(np.exp(a - np.logaddexp(a, b))), len(first) + len(second)
        of_first = systematic(np.ones(len(first)), round(share * n), rng)
        of_second = systematic(np.ones(len(second)), n - round(share * n), rng)
        particles.append(first.take(of_first).joined(second.take(of_second)))
    measure = float(np.logaddexp(one.log_measure, other.log_measure) - np.log(2))
    density = replace(one.density, log_evidence=tuple(evidence))
    return replace(one, density=density, particles=tuple(particles), log_measure=measure)


def _explored_from(run: Run, n: int, rng: np.random.Generator) -> Explored:
    """Up to ``n`` poses of a ``run`` with errors, drawn by ``rng``: those that are in the contact pose space.

    Raises
    ------
    InputError
        None is.
    """
    density, target = run.density, run.density.target
    mass = np.concatenate([np.full(len(p), w / len(p)) for p, w in zip(run.particles, density.weights, strict=True)])
    each = functools.reduce(Particles.joined, run.particles).take(systematic(mass, min(len(mass), n), rng))
    T = density.displaced(poses_of(each.poses, each.depth, target.index.mesh.centre), random_errors(len(each), rng))
    moved = target.particles_at(T)
    inside = np.flatnonzero(np.isfinite(moved.log_target(1)))
    if not len(inside):
        raise InputError(f"{target.index.mesh.name}: no pose that was found touches the sensor; allow more contacts")
    density = replace(density, log_inside=float(np.log(len(inside) / len(each))))
    contacts = run.contacts + len(each) + NODES * len(inside)
    T = T[inside]
    return Explored(density, T, moved.depth[inside], density.log_density(T), contacts)
