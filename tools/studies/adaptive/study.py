"""What a touch constrains within a cell: by cells that are opened, and by a sampled density, on the same touches."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import logsumexp

from geomtact.contact_space.contact_class import contact_class
from geomtact.contact_space.contact_maps import located
from geomtact.contact_space.index import Index
from geomtact.contact_space.touches import Touch
from geomtact.geometry.distance import PoseDistance, mode_radius
from geomtact.inference.effort import EFFORTS, Effort
from geomtact.inference.explored import Density
from geomtact.inference.particles import Target, poses_of
from geomtact.inference.two_runs import explore_twice
from geomtact.localizer import Localizer
from geomtact.log_mass import log_mean_exp
from geomtact.scoring.contact_likelihood import POWERS, ContactQuery, mixture_weights
from geomtact.se3 import Array

ROOTS = (75_000, 300_000, 1_200_000)  # poses of the grids whose cells are opened
CONTACTS = (40_000, EFFORTS["balanced"].contacts, EFFORTS["exact"].contacts)  # as ``Effort.contacts``
CHILDREN = 32  # contacts that open a cell: two parts of each tilt, turn, x and y
_IN_CELL = 400  # poses drawn in the true cell
BUDGETS = (1_000, 3_000, 10_000, 30_000, 100_000, 300_000, 1_000_000, 3_000_000)  # of opening, for the chart
LEVELS = (0.5, 0.8, 0.9, 0.95)


@dataclass(frozen=True)
class Outcome:
    """One touch; information in nats. Lists hold a number for each of ``ROOTS``, or for each of ``CONTACTS``.

    Attributes
    ----------
    contact : one of ``contact_class.CLASSES``
    rank : of the true cell in the coarse posterior, 0 the most probable
    coarse_gain : log density of the coarse posterior at the true pose
    in_cell_gain : log density at the true pose within its cell, by the sampler's mixture; at most log 401
    touching : share of the true cell in which the object can touch
    gain, expected_gain, level : of the sampler: at the true pose, at most that of the densest particle; by its own particles;
        credible level of the true pose. Where its runs agree on nothing, of the cells.
    missed : whether the true pose is denser than every particle of the sampler
    cut : contacts that the sampler cut
    powers : of the likelihood that are kept; 1 where its runs agree on nothing
    first, held : mass of the first mode, and whether it holds the true pose
    """

    elastic: bool
    contact: str
    rank: list[int]
    coarse_gain: list[float]
    in_cell_gain: list[float]
    touching: list[float]
    gain: list[float]
    expected_gain: list[float]
    level: list[float]
    missed: list[bool]
    cut: list[int]
    powers: list[int]
    first: list[float]
    held: list[bool]


@dataclass(frozen=True)
class _Found:
    """What the sampler finds by one budget, as in :class:`Outcome`."""

    gain: float
    expected_gain: float
    level: float
    missed: bool
    cut: int
    powers: int
    first: float
    held: bool


def judged(localizers: Sequence[Localizer], touches: Sequence[Touch], seed: int, first: int) -> Iterator[Outcome]:
    """The outcome of each touch from the ``first`` on; ``localizers`` are on the grids of ``ROOTS``."""
    indexes = [localizer.index for localizer in localizers]
    for number, touch in enumerate(touches[first:], first):
        rng = np.random.default_rng([seed, number])
        query = ContactQuery.of(touch.mask, localizers[-1].sensor)
        log_masses = [localizer.scorer.log_mass(localizer.index, touch.mask) for localizer in localizers]
        roots = [
            _root(index, log_mass.ravel(), query, touch, rng)
            for index, log_mass in zip(indexes, log_masses, strict=True)
        ]
        rank, coarse, in_cell, touching = zip(*roots, strict=True)
        mass = np.exp(log_masses[-1]).sum(0)
        found = [_found(indexes[-1], query, mass, contacts, touch, rng) for contacts in CONTACTS]
        yield Outcome(
            touch.elastic,
            contact_class(localizers[-1].space, touch.T_sensor_object),
            [int(each) for each in rank],
            [float(each) for each in coarse],
            [float(each) for each in in_cell],
            [float(each) for each in touching],
            **{name: [getattr(each, name) for each in found] for name in _Found.__dataclass_fields__},
        )


def _found(
    index: Index, query: ContactQuery, mass: Array, contacts: int, touch: Touch, rng: np.random.Generator
) -> _Found:
    T = touch.T_sensor_object[None]
    explored = explore_twice(index, query, mass, Effort(0, contacts).attempts(1), rng).explored
    if explored is None:
        density = np.log(mass / index.weight.sum(0, dtype=float))
        at = float(density[located(index, T)[0].place[0]])
        level = float(mass[density > at].sum())
        return _Found(at, float(mass @ density), level, False, contacts, 1, 0.0, False)
    at, most = float(explored.density.log_density(T)[0]), float(explored.log_density.max())
    held = bool(PoseDistance(index.mesh).within(explored.hearts[0], T, mode_radius(index.mesh))[0])
    return _Found(
        min(at, most),
        explored.expected_gain,
        explored.credible_level(at),
        at > most,
        explored.contacts,
        len(explored.density.log_evidence),
        float(explored.masses[0]),
        held,
    )


def _root(
    index: Index, log_mass: Array, query: ContactQuery, touch: Touch, rng: np.random.Generator
) -> tuple[int, float, float, float]:
    """Rank of the true cell, coarse gain and gain within the cell, and the share of the cell that touches."""
    true = int(index.lookup(touch.T_sensor_object[None], np.array([touch.penetration]))[0])
    density = Density(Target(index, query, np.zeros(index.places), None), (0.0,) * len(POWERS))
    inside = density.of_powers(in_cell(density.target, true, rng))
    return (
        int((log_mass > log_mass[true]).sum()),
        float(log_mass[true] - index.log_weight[true]),
        _gain(density.of_powers(touch.T_sensor_object), inside, mixture_weights([query])),
        float(index.touching[true % index.places]),
    )


def _gain(at_truth: Array, inside: Array, weights: Array) -> float:
    """Log density at the true pose relative to the cell's mean, by the mixture of posteriors, whose logs are ``at_truth`` (1, K)
    there and ``inside`` (n, K) at others, up to constants. The true pose counts for the mean."""
    mean = log_mean_exp(np.concatenate([inside, at_truth]).T)
    return float(logsumexp(at_truth[0] - mean, b=weights))


def in_cell(target: Target, cell: int, rng: np.random.Generator) -> Array:
    """Poses (n, 4, 4) drawn evenly in a cell, of those that touch."""
    T, depth = target.index.draw(np.full(_IN_CELL, cell), rng)
    drawn = target.evaluated(located(target.index, T)[0], depth=depth)
    drawn = drawn.take(np.flatnonzero(np.isfinite(drawn.log_likelihood)))
    return poses_of(drawn.poses, drawn.depth, target.index.mesh.centre)


def summarise(outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """Means over touches: what opening cells would gain at each of ``BUDGETS``, and what the sampler gains."""
    column = {name: np.array([getattr(o, name) for o in outcomes]) for name in Outcome.__dataclass_fields__}
    rank, coarse = column["rank"], column["coarse_gain"]
    # a sliver at the window's edge may lie between the samples: there nothing is gained
    in_cell = np.where(np.isfinite(column["in_cell_gain"]), column["in_cell_gain"], 0.0)
    opened = [(coarse + (rank < budget / CHILDREN) * in_cell).mean(0).tolist() for budget in BUDGETS]
    flat = column["contact"] == "flat"
    half = column["touching"][:, -1] > 0.5
    groups = {
        "flat": flat,
        "more than half of the cell touches": ~flat & half,
        "less than half of the cell touches": ~flat & ~half,
        "rigid": ~column["elastic"],
        "elastic": column["elastic"],
    }
    return {
        "n": len(outcomes),
        "coarse_gain": coarse.mean(0).tolist(),
        "in_cell_gain": in_cell.mean(0).tolist(),
        "rank_quartiles": np.quantile(rank, [0.25, 0.5, 0.75], axis=0).T.tolist(),
        "budgets": list(BUDGETS),
        "opened_gain": opened,
        "sampled": _sampled(column, np.ones(len(outcomes), bool)),
        "groups": {
            name: {
                "n": int(some.sum()),
                "rank_median": float(np.median(rank[some, -1])),
                "in_cell_gain": float(in_cell[some, -1].mean()),
                "sampled": _sampled(column, some),
            }
            for name, some in groups.items()
            if some.any()
        },
    }


def _sampled(column: dict[str, Any], some: Any) -> list[dict[str, Any]]:
    """Figures of the sampler at each of ``CONTACTS``, over ``some`` of the touches."""
    out = []
    for k in range(len(CONTACTS)):
        gain, expected, level = (column[name][some, k] for name in ("gain", "expected_gain", "level"))
        off, sure = expected - gain, column["first"][some, k] > 0.5
        out.append(
            {
                "contacts": float(column["cut"][some, k].mean()),
                "missed": float(column["missed"][some, k].mean()),
                "gain": float(gain.mean()),
                "expected_gain": float(expected.mean()),
                "expected_less_gain": [float(off.mean()), float(1.96 * off.std() / np.sqrt(len(off)))],
                "coverage": [float((level <= q).mean()) for q in LEVELS],
                "settled": float((column["powers"][some, k] == len(POWERS)).mean()),
                "of_cells": float((column["powers"][some, k] == 1).mean()),
                "first": float(column["first"][some, k].mean()),
                "held": float(column["held"][some, k].mean()),
                "sure": [int(each.sum()) for each in (sure, sure & column["held"][some, k])],
            }
        )
    return out
