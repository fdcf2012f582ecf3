"""Other poses of an object, touched from the same known contact face, that show the same contact as a touch.

Two poses show the same contact if their contacts, without noise, overlap as well as two noisy tactile images of one
touch do. The search starts from the grid's poses and goes by the rigid contact, cast anew at every step, then by the
elastic contact, which gives the verdict. No score of the library enters.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from geomtact.contact_space.index import Index
from geomtact.contact_space.space import ContactSpace
from geomtact.contact_space.touch import simulate_mask, spoilt
from geomtact.contact_space.touches import Touch
from geomtact.geometry.distance import PoseDistance
from geomtact.localizer import Localizer
from geomtact.se3 import Array, exp
from geomtact.sensing.moments import moments, without_specks
from geomtact.sensing.noise import Noise

SPACING_MM = 3.0  # poses nearer to each other than this count as one
STARTS = 150  # poses of the grid that are searched from
_JUDGED, _TRIES = 60, 6  # of them in contact at all; moves a round
_NEARLY = 0.15  # overlap that a last search, by the elastic contact, may make up for
_SEARCH, _VERDICT, _READING = (36, 48), (72, 96), (144, 192)  # grids over the window
_PAIRS = 8  # of noisy tactile images
Mask = NDArray[np.bool_]


def alike(localizer: Localizer, touch: Touch, noise: Noise, rng: np.random.Generator) -> tuple[Array, float]:
    """Poses (n, 4, 4) that show the same contact as ``touch``, ``SPACING_MM`` apart, the true one first; and the
    overlap needed."""
    space, index, true = localizer.space, localizer.index, touch.T_sensor_object
    sensor, along = space.sensor, space.sensor.along
    needed = overlap_of_readings(simulate_mask(space, true, touch.elastic, along(_READING)), space, noise, rng)
    cast = space.caster.contact(sensor, true, along(_SEARCH)).mask
    felt = simulate_mask(space, true, touch.elastic, along(_VERDICT))

    def rigid(T: Array) -> Array:
        return overlap(cast, space.caster.depths(sensor, T, along(_SEARCH)) > 0)

    def soft(T: Array) -> Array:
        return np.array([overlap(felt, simulate_mask(space, one, touch.elastic, along(_VERDICT))) for one in T])

    rows, columns = np.nonzero(cast)
    x, y = sensor.pixel_centres(cast.shape)
    pivot = np.array([x[columns].mean(), y[rows].mean(), 0.0]) if len(rows) else np.zeros(3)
    reach = np.array([0, 0, index.angle_step / 2, *[index.resolution.step / 3] * 2, 0.25e-3])
    T, merit = climbed(starts(index, space, true, rng), rigid, pivot, reach, 5, 1.0, rng)
    T = T[np.argsort(-merit, kind="stable")[:_JUDGED]]
    T = T[soft(T) >= needed - _NEARLY]
    T, merit = climbed(T, soft, pivot, reach / 3, 3, needed, rng)
    distance, kept = PoseDistance(space.mesh), [true]
    for one in rng.permutation(T[merit >= needed]):
        if (distance.mean(one, np.stack(kept)) >= 1e-3 * SPACING_MM).all() and np.isfinite(space.penetration(one)[0]):
            kept.append(one)
    return np.stack(kept), needed


def overlap(mask: Mask, others: Mask) -> Array:
    """Intersection over union (...) of contacts ``others`` (..., h, w) with ``mask`` (h, w)."""
    shared, either = (mask & others).sum((-2, -1)), (mask | others).sum((-2, -1))
    return np.asarray(shared / np.maximum(either, 1))


def overlap_of_readings(mask: Mask, space: ContactSpace, noise: Noise, rng: np.random.Generator) -> float:
    """Median overlap of two noisy tactile images of the contact ``mask`` (h, w), specks left out."""
    area = space.sensor.pixel_area(mask.shape)
    readings = [without_specks(spoilt(mask, space, noise, rng), area) for _ in range(2 * _PAIRS)]
    return float(np.median([overlap(a, b) for a, b in zip(readings[::2], readings[1::2], strict=True)]))


def starts(index: Index, space: ContactSpace, T: Array, rng: np.random.Generator) -> Array:
    """Poses (n, 4, 4) of the grid, shifted so that their contacts lie where that at ``T`` (4, 4) does: those that overlap most.

    Only poses that so stay within their own cells; ties are broken at random.
    """
    shape, half = index.resolution.mask_shape, space.sensor.half_window
    mask = space.caster.contact(space.sensor, T, shape).mask
    scale = float(np.hypot(*half))
    off = (moments(mask[None], space.sensor)[0, :2, None] - index.moments[:2]) * scale
    near = (np.abs(off) <= index.resolution.step).all(0) & (np.asarray(index.weight).reshape(-1) > 0)
    ids = np.flatnonzero(near)
    shift = off[:, ids].T
    column, row = np.rint(shift / (2 * half) * shape[::-1]).astype(int).T
    y, x = np.nonzero(mask)
    y, x = y - row[:, None], x - column[:, None]
    inside = (y >= 0) & (y < shape[0]) & (x >= 0) & (x < shape[1])
    stored = index.masks(ids)
    shared = (stored[np.arange(len(ids))[:, None], y * inside, x * inside] & inside).sum(1)
    merit = shared / (mask.sum() + stored.sum((1, 2)) - shared)
    best = np.lexsort((rng.random(len(ids)), -merit))[:STARTS]
    poses = index.poses(ids[best])
    poses[:, :2, 3] += shift[best]
    return poses


def climbed(
    T: Array,
    merit: Callable[[Array], Array],
    pivot: Array,
    reach: Array,
    rounds: int,
    enough: float,
    rng: np.random.Generator,
) -> tuple[Array, Array]:
    """``T`` (n, 4, 4) moved at random, ever less, wherever that raises their ``merit``, and the merit (n,) so reached.

    Parameters
    ----------
    pivot : (3,) point of the sensor frame about which is turned [m]
    reach : (6,) standard deviation of the first moves, turn and shift along the sensor's axes [rad, m]
    enough : merit from which a pose is left alone
    """
    T, reached = T.copy(), merit(T)
    for k in range(rounds):
        todo = np.flatnonzero(reached < enough)
        if not len(todo):
            break
        move = 0.5**k * reach * rng.normal(size=(len(todo), _TRIES, 6))
        turn = exp(np.concatenate([move[..., :3], 0 * move[..., 3:]], -1))
        turn[..., :3, 3] = pivot - turn[..., :3, :3] @ pivot + move[..., 3:]
        tried = turn @ T[todo, None]
        score = merit(tried.reshape(-1, 4, 4)).reshape(len(todo), -1)
        best, better = score.argmax(1), score.max(1) > reached[todo]
        T[todo[better]] = tried[better, best[better]]
        reached[todo] = np.maximum(reached[todo], score.max(1))
    return T, reached
