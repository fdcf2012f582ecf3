"""Touches with known poses, on which figures are given: uniform over the contact pose space, rigid or elastic, noisy."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geomtact.contact_space.contact_class import contact_class
from geomtact.contact_space.space import ContactSpace
from geomtact.contact_space.touch import LEAST_CONTACT, simulate_mask, spoilt
from geomtact.errors import InputError
from geomtact.se3 import Array
from geomtact.sensing.noise import MODERATE, Noise

PENETRATION = (0.3e-3, 1.5e-3)
GEL_KINDS = {"elastic": True, "rigid": False, "both": None}  # gels, as ``each_touch`` takes them
_TRIED = 2000  # touches, at most, for each one found of a class


@dataclass(frozen=True)
class Touch:
    """One touch: the true pose (4, 4), how deep it presses [m], and what the sensor reports (H, W) bool."""

    T_sensor_object: Array
    penetration: float
    mask: NDArray[np.bool_]
    elastic: bool


def penetrations(space: ContactSpace) -> tuple[float, float]:
    """Least and largest penetration [m] of touches on a sensor, whose gel may be thinner."""
    high = min(PENETRATION[1], space.sensor.max_penetration)
    return min(PENETRATION[0], high / 2), high


def counts(space: ContactSpace, mask: NDArray[np.bool_]) -> bool:
    """Whether a mask (H, W) of the sensor's own resolution is a touch: 1 mm^2 of contact at least."""
    return bool(mask.sum() * np.prod(space.sensor.pixel_pitch) >= LEAST_CONTACT)


def random_touches(
    space: ContactSpace,
    n: int,
    seed: int,
    elastic: bool | None = None,
    noise: Noise = MODERATE,
    only: str | None = None,
) -> list[Touch]:
    """``n`` touches of an object on a sensor, all at once: see :func:`each_touch`."""
    return list(each_touch(space, n, seed, elastic, noise, only))


def each_touch(
    space: ContactSpace,
    n: int,
    seed: int,
    elastic: bool | None = None,
    noise: Noise = MODERATE,
    only: str | None = None,
) -> Iterator[Touch]:
    """``n`` touches of the object of ``space`` on its sensor, one by one.

    Poses are uniform over the contact pose space with a penetration of 0.3 to 1.5 mm and at least 1 mm^2 of contact.
    They come from casts at the exact pose, not from the index.

    Parameters
    ----------
    elastic : True for an elastic gel, False for the thesis's threshold, None for one after the other
    only : the class of contact that they all are of, one of ``contact_class.CLASSES``; None for touches of any class

    Raises
    ------
    InputError
        Hardly any touch of the object is of that class, or large enough to count.
    """
    rng = np.random.default_rng(seed)
    made = tried = 0
    while made < n:
        some = 64 if only else min(64, 2 * (n - made) + 8)
        T, depth = space.sample(some, rng, penetrations(space))
        tried += len(T)
        if tried > _TRIED * (made + 1):
            kind = f"{only} ones" if only else "large enough"
            raise InputError(f"{space.mesh.name}: of {tried:,} touches {made} were {kind}; take another object")
        for pose, d in zip(T, depth, strict=True):
            if only is not None and contact_class(space, pose) != only:
                continue
            soft = made % 2 == 1 if elastic is None else elastic
            mask = simulate_mask(space, pose, soft)
            if counts(space, mask):
                yield Touch(pose, float(d), spoilt(mask, space, noise, rng), soft)
                made += 1
            if made == n:
                return
