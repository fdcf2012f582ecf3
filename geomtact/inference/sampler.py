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
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri

from geomtact.contact_space.contact_maps import ContactMaps, Placements, centring_std
from geomtact.contact_space.index import Index
from geomtact.errors import InputError
from geomtact.inference.explored import Density
from geomtact.inference.particles import SURE, OtherSensor, Particles, Target, poses_of
from geomtact.inference.population import MOVES, Population, different, effective, resampled, systematic
from geomtact.inference.pose_prior import ALIGNED, NormalPrior, PosePrior
from geomtact.inference.registered import AboutModes, Search, bridged, united
from geomtact.inference.systematic_errors import ERRORS, errors_of
from geomtact.scoring.contact_likelihood import POWERS, ContactQuery
from geomtact.se3 import Array, transform

_UNIFORM = 0.2  # share of the uniform distribution in the coarse posterior, by which poses are drawn; hand-set
# All other constants choose where poses are drawn: they change how precise the evidence is, not what is estimated.
_CUTS = 3  # contacts that are cut for a draw, at most
_DRAWS = 4  # draws for each pose that is kept
# Of several sensors: poses that are kept, by power, over those with one: hardly any touch all sensors at first.
_OF_SEVERAL = (16, 8, 6, 4, 3)
_REGISTERED = 2 / 3  # of the draws of several sensors
_OF_SEVERAL_COST = 12  # contacts that this takes, over those with one sensor
_MEASURED = 2000  # draws by which the measure of what touches is known, where a prior is no one of the cells
_STEPS = 11  # that are usual, for the budget
_EXPONENTS = np.geomspace(2e-4, POWERS[-1], 40)  # of the likelihood, that the first step may have


# a power of the likelihood, the log evidence of its posterior (runs,), and particles, run by run
Stop = tuple[float, Array, Particles]


@dataclass(frozen=True, eq=False)
class Run:
    """What one run of the sampler found.

    Attributes
    ----------
    density : of the pose, by each power of the likelihood at which the sampler stopped
    particles : of each of these posteriors, poses without errors drawn from it, equally probable
    contacts : that were cut
    log_measure : log of the uniform measure of poses that touch over that of the cells that hold them
    best : (S,) the largest log likelihood by each of several sensors of all poses that were tried; S is 0 for one sensor alone
    about : modes that registration found; None of one sensor
    """

    density: Density
    particles: tuple[Particles, ...]
    contacts: int
    log_measure: float
    best: Array
    about: AboutModes | None = None

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
    prior: PosePrior | None = None,
    others: Sequence[OtherSensor] = (),
    runs: int = 1,
    search: Search | None = None,
) -> tuple[Run, ...]:
    """The distribution of the pose, found ``runs`` times from about ``contacts`` contacts on each sensor, all at once.

    Parameters
    ----------
    coarse : (n,) mass of the places of the index in a coarse posterior; a share of the uniform one is mixed in
    prior : None for the uniform
    others : the other sensors that touch the object, or do not
    search : registers poses to all contacts together, where there are several

    Raises
    ------
    InputError
        No pose that was drawn touches the sensor, or none that was found touches all that show contact.
    """
    target, share, known = _coarse_target(index, query, coarse, prior, others)
    usual = _DRAWS * _CUTS + MOVES * _STEPS
    numbers = [max(contacts // usual, 20)] * len(POWERS)
    if others:
        numbers = [max(int(contacts / usual * more / _OF_SEVERAL_COST), 20) for more in _OF_SEVERAL]
    number = dict(zip(POWERS, numbers, strict=True))
    largest = max(number)
    drawn, log_weight, cut = _draw(target, share, runs, _DRAWS * numbers[0], rng)
    if isinstance(prior, NormalPrior):
        drawn, log_weight, more = _or_by_prior(target, prior, drawn, log_weight, rng)
        cut += more
    whole = np.logaddexp.reduce(log_weight + drawn.log_target(0).reshape(runs, -1), 1)
    if not np.isfinite(whole).all():
        raise InputError(f"{index.mesh.name}: no pose that was drawn touches the sensor; allow more contacts")
    # the evidence of the coarse posterior is known: what is left is an error of the measure, which all poses of a run share
    log_measure = np.full(runs, _log_measure(target, rng)) if isinstance(prior, NormalPrior) else known - whole
    stops, power, population = _begun(target, drawn, log_weight + log_measure[:, None], number, rng)
    population.contacts = cut
    about = None
    if search and power < SURE:
        weight = (log_weight + drawn.log_target(power).reshape(runs, -1)).ravel()
        some = different(weight, round(_REGISTERED * len(drawn)), rng)
        about = AboutModes.of(target, drawn.take(some), search)
    if about:
        population.best = np.maximum(population.best, about.best)
        population.contacts += about.contacts
    while True:
        population.move(partial(Particles.log_target, power=power))
        sure = population if not others or power >= SURE else population.that_touch()
        if sure and (others or power in number):
            stops.append((power, sure.log_evidence, sure.particles))
        if power in number and len(population.particles) != runs * number[power]:
            population.choose(np.zeros(len(population.particles)), number[power])
        if power >= largest:
            break
        after = min(each for each in number if each > power)
        step = population.reweigh(population.particles.log_likelihood - population.particles.log_coarse, after - power)
        power = after if step == after - power else power + step
        if others and power == SURE:
            surely = _surely(population, about, log_measure)
            if surely is None:
                break
            population = surely
    if len(stops) < 2:
        raise InputError(f"{index.mesh.name}: no pose that was found touches all sensors; allow more contacts")
    powers, evidence, found = zip(*stops, strict=True)
    return tuple(
        Run(
            Density(target, tuple(float(each[run]) for each in evidence), powers),
            tuple(each.take(np.arange(len(each)).reshape(runs, -1)[run]) for each in found),
            population.contacts // runs,
            float(log_measure[run]),
            population.best,
            about,
        )
        for run in range(runs)
    )


def _coarse_target(
    index: Index,
    query: ContactQuery,
    coarse: Array,
    prior: PosePrior | None,
    others: Sequence[OtherSensor],
) -> tuple[Target, Array, float]:
    """What poses are judged by, arguments as of :func:`explore`; in proportion to what places are drawn (n,); and the log of the
    mean of the coarse density under the prior."""
    cells = index.weight.astype(float) / index.weight.sum(dtype=float)
    measure = cells.sum(0)
    share = (1 - _UNIFORM) * coarse / coarse.sum() + _UNIFORM * measure
    log_coarse = np.log(share / measure).astype(np.float32).astype(float)  # as files hold it
    target = Target(index, query, log_coarse, prior, tuple(others))
    if prior is None:
        return target, share, 0.0
    share = share / measure * (cells * np.exp(prior.in_cells.reshape(cells.shape))).sum(0)
    return target, share, float(np.log(share.sum()))


def _begun(
    target: Target, drawn: Particles, log_weight: Array, number: dict[float, int], rng: np.random.Generator
) -> tuple[list[Stop], float, Population]:
    """The posteriors by small powers, which the draws give; and the first power that they do not, with its posterior.

    ``log_weight`` (runs, m) is that of the draws in the uniform distribution, ``number`` how many poses each power keeps.
    """
    runs, n = len(log_weight), next(iter(number.values()))

    def by_power(exponent: float) -> Array:
        """Log weights (runs, m) of the draws in the posterior by that power."""
        return log_weight + drawn.log_target(exponent).reshape(runs, -1)

    # the first exponent is the largest that leaves enough draws effective: a distinctive contact begins low
    exponents = _EXPONENTS[max(number) >= _EXPONENTS]
    kept = np.array([effective(by_power(exponent)) for exponent in exponents])
    enough = (kept >= np.minimum(n, kept.max(0))).all(1)
    enough[0] = True
    power = float(exponents[np.flatnonzero(enough)[-1]])
    # the posteriors by powers of at most this one are those of the draws
    stops: list[Stop] = []
    for each in (*(each for each in number if each < power), power):
        weight = by_power(each)
        stops.append((each, np.logaddexp.reduce(weight, 1), drawn.take(resampled(weight, n, rng))))
    _, log_evidence, particles = stops.pop()
    return stops, power, Population(target, rng, particles, log_evidence, drawn.by_sensor.max(0, initial=-np.inf))


def _surely(population: Population, about: AboutModes | None, log_measure: Array) -> Population | None:
    """The ``population``, at the power ``SURE``, where it touches all sensors, with what lies ``about`` modes; None where neither
    does. ``log_measure`` (runs,) is as of :class:`Run`."""
    touching = population.that_touch()
    n = len(population.particles) // population.runs
    more = bridged(about, SURE, population.runs, n, population.rng) if about else None
    if more is not None:
        more.log_evidence = more.log_evidence + log_measure
        more.best = np.maximum(more.best, population.best)
        more.contacts += 0 if touching else population.contacts
    return united(touching, more)


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
    centre, density = _centres(about, middle, step, centring_std(index.sensor), rng)
    depth = index.sensor.max_penetration * rng.random(len(place))
    errors = rng.random((len(place), target.carried, ERRORS))
    particles = target.admitted(target.evaluated(replace(poses, centre=centre), depth=depth, errors=errors))
    log_weight = np.log(index.cell_measure[place]) - np.log(share[place]) - np.log(density * n)
    return particles, log_weight.reshape(runs, n), cut + len(place) * target.sensors


def _log_measure(target: Target, rng: np.random.Generator) -> float:
    """As of :class:`Run`, from poses that are drawn uniformly."""
    drawn, log_weight, _ = _draw(target, target.index.weight.sum(0, dtype=float), 1, _MEASURED, rng)
    return float(-np.logaddexp.reduce(np.where(np.isfinite(drawn.log_likelihood), log_weight[0], -np.inf)))


def _or_by_prior(
    target: Target, prior: NormalPrior, drawn: Particles, log_weight: Array, rng: np.random.Generator
) -> tuple[Particles, Array, int]:
    """Poses ``drawn`` in the cells, or as many that are drawn from the ``prior``, of whichever more are effective; their log
    weights (runs, n) as of :func:`_draw`, and how many contacts were cut."""
    poses, depth, log_ratio, rotation = prior.draw(len(drawn), target.query, rng)
    errors = rng.random((len(drawn), target.carried, ERRORS))
    found = target.admitted(target.evaluated(poses, depth=depth, errors=errors))
    # Over all poses a Gaussian alone has the mean that the sum over images has over poses that are no images of each other. So a
    # pose is weighed by the density that was drawn from, over that sum.
    T = target.displaced(
        poses_of(replace(found.poses, rotation=rotation), depth, target.index.mesh.centre), errors_of(errors[:, 0])
    )
    own = np.where(np.isfinite(found.log_likelihood), prior.own_density(T) - found.log_prior, -np.inf)
    by_prior = (log_ratio + own).reshape(log_weight.shape) - np.log(log_weight.shape[1])

    def enough(particles: Particles, weight: Array) -> float:
        return float(effective(weight + particles.log_target(_EXPONENTS[0]).reshape(weight.shape)).min())

    cut = (1 + target.sensors) * len(drawn)
    return (found, by_prior, cut) if enough(found, by_prior) > enough(drawn, log_weight) else (drawn, log_weight, cut)


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
        inside = off <= 0.5 * step + 2 * centring_std(target.index.sensor)
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
    share = np.where(known, ALIGNED, 0.0)
    about = np.where(known[:, None], target, middle)
    first, last = ndtr((low - about) / width), ndtr((high - about) / width)
    within = np.maximum(last - first, 1e-12)
    normal = about + width * ndtri(np.clip(first + within * rng.random(middle.shape), 1e-12, 1 - 1e-12))
    uniform = low + step * rng.random(middle.shape)
    aligned = rng.random(len(middle)) < share
    centre = np.where(aligned[:, None], np.clip(normal, low, high), uniform)
    density = np.exp(-0.5 * ((centre - about) / width) ** 2) / (np.sqrt(2 * np.pi) * width * within) * step
    return centre, (1 - share) + share * density.prod(1)
