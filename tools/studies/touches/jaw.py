"""Objects between two opposed fingers of a jaw, both with a sensor: the usual scene of a robot."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from geomtact.contact_space.cell_transfer import ExtrinsicsStd
from geomtact.contact_space.space import ContactSpace
from geomtact.contact_space.touch import simulate_mask, spoilt
from geomtact.contact_space.touches import Touch, counts, penetrations
from geomtact.evaluation import SimultaneousTouches
from geomtact.planning.jaw import close_jaw
from geomtact.se3 import Array, exp, inverse, random_rotations, transform
from geomtact.sensing.noise import Noise

_MOST_OPEN = 80e-3  # m between the fingers
_REACH = 0.3  # m: the jaw is within so much of the origin of the world, along each axis
# How well the second finger's pose relative to the first is known: by the opening alone, or loosely.
OPENING, LOOSE = ExtrinsicsStd(0.0, 0.1e-3), ExtrinsicsStd(float(np.deg2rad(0.5)), 0.5e-3)


def grasps(
    space: ContactSpace, n: int, seed: int, noise: Noise, elastic: bool | None, std: ExtrinsicsStd
) -> Iterator[SimultaneousTouches]:
    """``n`` grasps of an object, uniform over the poses at which the first finger touches it and the second does too;
    ``elastic`` is as of ``contact_space.touches.each_touch``.

    The second finger is said to be beside where it is, by a draw from ``std``: of ``OPENING`` along the jaw's axis alone.
    """
    rng, made = np.random.default_rng([seed, 17]), 0
    while made < n:
        T_jaw_object = space.sample(1, rng, penetrations(space))[0][0]
        stops, touches = close_jaw(space, T_jaw_object, np.eye(4), rng.uniform(*penetrations(space), 2))
        if not touches.all() or np.linalg.norm(stops[0, :3, 3] - stops[1, :3, 3]) > _MOST_OPEN:
            continue
        is_elastic = made % 2 == 1 if elastic is None else elastic
        both = [_touch(space, T, is_elastic, noise, rng) for T in inverse(stops) @ T_jaw_object]
        if all(counts(space, touch.mask) for touch in both):
            made += 1
            T_world_jaw = transform(random_rotations(1, rng)[0], rng.uniform(-_REACH, _REACH, 3))
            stated = np.stack([stops[0], stops[1] @ exp(_off(std, rng))])
            yield SimultaneousTouches(T_world_jaw @ stated, T_world_jaw @ T_jaw_object, both)


def _touch(space: ContactSpace, T: Array, elastic: bool, noise: Noise, rng: np.random.Generator) -> Touch:
    mask = simulate_mask(space, T, elastic)
    if counts(space, mask):
        mask = spoilt(mask, space, noise, rng)
    return Touch(T, float(space.penetration(T[None])[0]), mask, elastic)


def _off(std: ExtrinsicsStd, rng: np.random.Generator) -> Array:
    """By what motion (6,) the second finger is off."""
    off = rng.normal(size=6) * np.repeat([std.rotation, std.translation], 3)
    return off * [0, 0, 0, 0, 0, 1] if std == OPENING else off
