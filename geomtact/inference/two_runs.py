"""The distribution of a pose from two runs of the sampler, which are compared.

One run does not show what it has missed. So two are compared: where they disagree on the evidence, one has missed what the other
found; where the masses of the modes add up to much more than 1, both have. Then more contacts are cut, or the sharpest powers are
left out. Where that does not help, the coarse posterior has half of the probability.

Of several sensors one registration leads both runs to modes, so that both miss what it misses. Then their agreement proves less,
and masses of modes leave room for it (``mode_mass.counted``).

How likely the contacts are at all is known even where the runs do not agree, only less exactly.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from geomtact.contact_space.index import Index
from geomtact.errors import InputError
from geomtact.inference.explored import Explored
from geomtact.inference.facts import UNEXPLAINED_NATS
from geomtact.inference.mode_mass import counted, shares_near, weighed
from geomtact.inference.particles import OtherSensor, Particles
from geomtact.inference.population import systematic
from geomtact.inference.pose_prior import NormalPrior, PosePrior
from geomtact.inference.registered import Search
from geomtact.inference.sampler import Run, explore
from geomtact.inference.systematic_errors import NODES, NODES_BESIDE, random_errors
from geomtact.scoring.contact_likelihood import POWERS, ContactQuery
from geomtact.se3 import Array

# of the likelihood, by which objects are compared: of the larger ones the one that distinguishes them best
EVIDENCE_POWER = POWERS[3]
# poses that are kept in the end, at least, which is as many as with several sensors, and at most; and contacts for each
_POSES, _FOR_EACH = (200, 600), 20
# nats for each sensor: the largest difference of two log evidences, in the mean by the weights of the powers, at which runs are
# believed, while more contacts may be cut and in the last attempt: to leave a contact to the cells costs more; hand-set
_AGREE, _AGREE_AT_LAST = 1.0, 2.0
# Of two runs that do not agree, one at least has missed something; where no pose explains all contacts, both may have. So what
# they found rests on one run, which was never tried against another: by the rule of succession one more run would find the same
# with the probability (0 + 1) / (0 + 2).
_TRUST = 0.5
_DISAGREE, _UNEXPLAINED = "two runs of the sampler do not agree", "no pose that was found explains all contacts"
# powers that an attempt may leave out, before the last: of several sensors, of a mask, and of depths, whose likelihood is
# sharper; where the gain of 20 touches each of pin and head levels off (seed 91), and of 10 scenes of four objects (seed 810)
_LEFT_OUT_OF_SEVERAL, _LEFT_OUT, _LEFT_OUT_OF_DEPTHS = 3, 2, 1
_SHARPEST = 100, 40  # poses beside these from which modes may grow, of one sensor and of several
_WEIGHING = 0.5  # contacts that weigh the modes, for each that finds them


@dataclass(frozen=True, eq=False)
class Finding:
    """What two runs found.

    Attributes
    ----------
    explored : the distribution of the pose; None where they found no pose that touches all sensors which show contact
    log_evidence : log of the prior mean of the likelihood of all contacts to the power ``EVIDENCE_POWER``; -inf where no pose was
        found that touches all sensors which show contact
    misfit_nats, unexplained_nats : as of ``facts.Diagnostics``
    why_not : why there is no distribution, or half of the probability is left to the cells
    """

    explored: Explored | None
    log_evidence: float = -np.inf
    misfit_nats: float = np.inf
    unexplained_nats: float | None = None
    why_not: str = ""


def explore_twice(
    index: Index,
    query: ContactQuery,
    coarse: Array,
    attempts: Sequence[int],
    rng: np.random.Generator,
    prior: PosePrior | None = None,
    others: Sequence[OtherSensor] = (),
    search: Search | None = None,
) -> Finding:
    """The distribution of the pose with its modes, by two runs that share the contacts of each of the ``attempts``, and have to
    agree on the evidence; other arguments as of :func:`explore`.

    Where they do not, the largest powers of the likelihood are left out until they do, one to three of them at most. If that
    does not help, the next attempt follows; so it does where runs of several sensors found no pose which explains all contacts.
    If the runs do not agree in the end, or explain too little, what they found has half of the probability, and the coarse
    posterior the rest.
    """
    cut, found = 0, Finding(None, unexplained_nats=np.inf if others else None)
    of_one = _LEFT_OUT if query.indentation is None else _LEFT_OUT_OF_DEPTHS
    left_out = _LEFT_OUT_OF_SEVERAL if others else of_one
    for asked in attempts:
        try:
            one, other = explore(index, query, coarse, asked // 2, rng, prior, others, 2, search)
            cut += one.contacts + other.contacts
            sharpest = one.particles[-1].joined(other.particles[-1])
            unexplained = _unexplained(one, other, sharpest) if others else None
            explains = unexplained is None or unexplained <= UNEXPLAINED_NATS
            why_not = _DISAGREE if explains else _UNEXPLAINED
            found = Finding(None, _log_evidence(one, other), _misfit(one, sharpest), unexplained, why_not)
            is_last, explored = asked == attempts[-1], None
            if explains:
                explored, cut = _agreed(one, other, left_out, _AGREE_AT_LAST if is_last else _AGREE, asked, cut, rng)
            if explored is None and is_last:
                explored = _by_one_run(one, other, asked, cut, rng)
        except InputError as error:
            found = replace(found, why_not=str(error))
            continue
        if explored is not None:
            if others:  # if all sensors were where they are said to be
                T = explored.hearts if one.about is None else np.concatenate([explored.hearts, one.about.led_to])
                unexplained = _unexplained(one, other, one.density.target.particles_at(T))
            return replace(found, explored=explored, unexplained_nats=unexplained)
    return found


def _agreed(
    one: Run, other: Run, left_out: int, most: float, asked: int, cut: int, rng: np.random.Generator
) -> tuple[Explored | None, int]:
    """The distribution of the pose by the largest power of the likelihood at which two runs differ by ``most`` nats a sensor,
    where ``left_out`` powers at most are larger, if there is one; and how many contacts were cut until then, ``cut`` of them
    before. All mass that was found may add up to more than 1 by as many nats; then the evidence is raised.

    Raises
    ------
    InputError
        No pose that was found touches the sensor.
    """
    for last in range(len(one.log_evidence) - 1, 0, -1):
        if one.density.powers[last] < POWERS[-1 - left_out]:
            break
        run = replace(pooled(one, other, last, rng), contacts=cut)
        apart = np.abs(np.subtract(one.log_evidence, other.log_evidence))[_kept(one, last)]
        if run.density.weights @ apart >= most * run.density.target.sensors:
            continue
        found, log_sum = _with_modes(one, other, run, last, asked, rng)
        if log_sum < most:
            return found, cut
        cut = found.contacts
    return None, cut


def _with_modes(
    one: Run, other: Run, run: Run, last: int, asked: int, rng: np.random.Generator
) -> tuple[Explored, float]:
    """The distribution of the pose by both runs as one ``run`` up to the ``last`` stop, with its modes; and the log of the sum of
    all mass as it was found, 0 of several sensors. If that is positive, the evidence is larger by as much."""
    further = _sharpest(one, other)
    if run.density.target.others:
        led_to = (one.about.led_to, one.about.origin) if one.about else None
        draws = _draws_left(one, last) + _draws_left(other, last)
        return counted(_explored_from(run, _POSES[0], rng)[0], further, draws, led_to), 0.0
    found, of_powers = _explored_from(run, int(np.clip(asked // _FOR_EACH, *_POSES)), rng)
    found, log_sum = weighed(found, further, run.log_measure, round(_WEIGHING * asked), rng)
    if log_sum > 0:
        more = np.where(np.array(found.density.powers) > 0, log_sum, 0.0)
        density = replace(found.density, log_evidence=tuple((found.density.log_evidence + more).tolist()))
        found = replace(found, density=density, log_density=density.mixed(of_powers - more))
    return found, log_sum


def _by_one_run(one: Run, other: Run, asked: int, cut: int, rng: np.random.Generator) -> Explored:
    """What two runs that do not agree found, with the probability ``_TRUST``, else the coarse posterior."""
    last = len(one.log_evidence) - 1
    run = replace(pooled(one, other, last, rng, alike=False), contacts=cut)
    found, _ = _with_modes(one, other, run, last, asked, rng)
    density = replace(found.density, trust=_TRUST)
    drawn, _ = _explored_from(replace(run, density=density, contacts=found.contacts), len(found.poses), rng)
    coarse = density.target.poses(run.particles[0])
    masses = _TRUST * found.masses + (1 - _TRUST) * shares_near(run.density.index.mesh, found.hearts, coarse)
    return replace(drawn, hearts=found.hearts, masses=masses)


def _log_evidence(one: Run, other: Run) -> float:
    """As of :class:`Finding`."""
    if EVIDENCE_POWER not in one.density.powers:
        return -np.inf
    stop, out = one.density.powers.index(EVIDENCE_POWER), []
    for run in (one, other):
        # the coarse density says where poses are drawn, and is taken out again
        log_coarse = run.particles[stop].log_coarse
        usual = 0.0
        if isinstance(run.density.target.prior, NormalPrior):  # its density is known up to a constant
            first = run.particles[0].log_coarse
            usual = run.log_evidence[0] + np.logaddexp.reduce(-first) - np.log(len(first))
        out.append(
            run.log_evidence[stop]
            + np.logaddexp.reduce((EVIDENCE_POWER - 1) * log_coarse)
            - np.log(len(log_coarse))
            - usual
        )
    return float(np.logaddexp.reduce(out) - np.log(2))


def _misfit(one: Run, found: Particles) -> float:
    """As of :class:`Finding`, by the poses ``found`` and those that registration led to."""
    target = one.density.target
    best = _likeliest(found)
    if one.about is not None:
        best = max(best, _likeliest(target.particles_at(one.about.led_to)))
    queries = [target.query, *(other.query for other in target.others)]
    outline = np.exp([query.log_outline for query in queries if query.touched.any()]).sum()
    return float(-POWERS[-1] * best / outline)


def _kept(run: Run, last: int) -> list[int]:
    """Which stops of the sampler are kept, if ``last`` is the last: those before it are of ``POWERS``."""
    return [stop for stop in range(last) if run.density.powers[stop] in POWERS] + [last]


def pooled(one: Run, other: Run, last: int, rng: np.random.Generator, alike: bool = True) -> Run:
    """Two runs as one, up to the ``last`` stop: of each posterior the particles of both, by how likely each run makes the
    contact. With several sensors that is mostly chance, where runs agree, and both count ``alike``."""
    particles, evidence, kept = [], [], _kept(one, last)
    for stop in kept:
        first, second = one.particles[stop], other.particles[stop]
        a, b = one.log_evidence[stop], other.log_evidence[stop]
        evidence.append(float(np.logaddexp(a, b) - np.log(2)))
        share, n = float(np.exp(a - np.logaddexp(a, b))), len(first) + len(second)
        if one.density.target.others and alike:
            share = 0.5
        of_first = systematic(np.ones(len(first)), round(share * n), rng)
        of_second = systematic(np.ones(len(second)), n - round(share * n), rng)
        particles.append(first.take(of_first).joined(second.take(of_second)))
    measure = float(np.logaddexp(one.log_measure, other.log_measure) - np.log(2))
    powers = tuple(one.density.powers[stop] for stop in kept)
    density = replace(one.density, log_evidence=tuple(evidence), powers=powers)
    return replace(one, density=density, particles=tuple(particles), log_measure=measure)


def _explored_from(run: Run, n: int, rng: np.random.Generator) -> tuple[Explored, Array]:
    """Up to ``n`` poses of a ``run`` with errors, drawn by ``rng``: those that are in the contact pose space; and what their
    density is mixed of.

    Raises
    ------
    InputError
        None is.
    """
    density, target = run.density, run.density.target
    mass = np.concatenate([np.full(len(p), w / len(p)) for p, w in zip(run.particles, density.weights, strict=True)])
    each = functools.reduce(Particles.joined, run.particles).take(systematic(mass, min(len(mass), n), rng))
    T = target.poses(each)
    if not target.carried:
        T = target.displaced(T, random_errors(len(each), rng))
    moved = target.particles_at(T)
    inside = np.flatnonzero(np.isfinite(moved.log_target(0)))
    if not len(inside):
        raise InputError(f"{target.index.mesh.name}: no pose that was found touches the sensor; allow more contacts")
    density = replace(density, log_inside=float(np.log(len(inside) / len(each))))
    averaged = NODES + (target.sensors - 1) * NODES_BESIDE
    contacts = run.contacts + target.sensors * len(each) + averaged * len(inside)
    T = T[inside]
    of_powers = density.of_powers(T)
    return Explored(density, T, moved.depth[inside], density.mixed(of_powers), contacts), of_powers


def _sharpest(one: Run, other: Run) -> Array:
    """The poses (n, 4, 4) that explain the contacts best, of those that two runs found by the largest power."""
    target, found = one.density.target, one.particles[-1].joined(other.particles[-1])
    best = np.argsort(-found.log_target(one.density.powers[-1]), kind="stable")[: _SHARPEST[bool(target.others)]]
    T = target.poses(found.take(best))
    return np.asarray(T[np.isfinite(target.particles_at(T).log_target(0))])


def _draws_left(run: Run, last: int) -> float:
    """Effective number of draws from which the particles at the ``last`` stop come."""
    count = np.unique(run.particles[last].draw, return_counts=True)[1]
    return float(count.sum() ** 2 / np.square(count).sum())


def _unexplained(one: Run, other: Run, found: Particles) -> float:
    """Nats by which the likeliest of the ``found`` poses explains each of several contacts less than the best pose of each sensor
    alone does, in the mean and by the largest power."""
    best = np.maximum(one.best, other.best)
    return float(POWERS[-1] * (best.sum() - _likeliest(found)) / len(best))


def _likeliest(found: Particles) -> float:
    """The largest log likelihood of poses that miss no sensor."""
    return float(found.log_likelihood[~found.missed].max(initial=-np.inf))
