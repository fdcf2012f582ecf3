"""Kitting (thesis 8.3): a simulated cell in which an object is grasped, localized, touched again, and placed in a fixture.

Geometric and quasi-static. The world is the gripper that holds the object, so a second gripper's closings, at known poses
relative to it, all count in one product. The fixture is a recess of the object's own shape, wider by a clearance on all sides.
The robot places the object only if it probably fits by the posterior; else it touches again, and at last refuses.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geomtact.contact_space.cell_transfer import ExtrinsicsStd
from geomtact.contact_space.space import ContactSpace
from geomtact.contact_space.touch import simulate_mask, spoilt
from geomtact.contact_space.touches import counts, penetrations
from geomtact.errors import InputError
from geomtact.geometry.distance import PoseDistance, mode_radius
from geomtact.inference.posterior import Posterior
from geomtact.localizer import Localizer
from geomtact.planning.draws import draw_places
from geomtact.planning.grid import grid_of_touches
from geomtact.planning.jaw import OPPOSITE, close_jaw, first_grasp
from geomtact.planning.next_touch import evaluate
from geomtact.se3 import Array, inverse, transform
from geomtact.sensing.noise import MODERATE, Noise
from tools.studies.kitting.fixture import Fixture

SURE = 0.95  # estimated probability of fitting from which the object is placed
_DRAWS = 1000  # poses that are believed
_ASKED = 60  # of these, by their weights, of which it is asked whether they fit
_TRIED, _PLACES, _PRESSES = 16, 40, 3  # touches to choose from, places to distinguish, depths at which each is pressed


@dataclass(frozen=True, eq=False)
class Felt:
    """The contacts of fingers: where each stopped (n, 4, 4), in the world, and its mask (H, W), empty without contact."""

    T_world_sensor: Array
    masks: list[NDArray[np.bool_]]

    def __add__(self, more: Felt) -> Felt:
        return Felt(np.concatenate([self.T_world_sensor, more.T_world_sensor]), self.masks + more.masks)


@dataclass(frozen=True, eq=False)
class Believed:
    """Poses ``T`` (n, 4, 4) of the object in the world, first the one by which it would be placed, their ``weight`` (n,), which
    sums to 1, and the probability that the right one is among what was ``found``."""

    T: Array
    weight: Array
    found: float


@dataclass(frozen=True, eq=False)
class Decision:
    """The pose ``T_world_part`` (4, 4) by which to place the object, and the ``probability`` that it fits then."""

    T_world_part: Array
    probability: float

    @property
    def sure(self) -> bool:
        return self.probability >= SURE


@dataclass(frozen=True, eq=False)
class Step:
    """After a number of touches of a jaw: all contacts, the posterior, the weighted poses, and a decision for each clearance."""

    felt: Felt
    posterior: Posterior
    belief: Believed
    decisions: list[Decision]


def touch_with_jaw(
    space: ContactSpace, T_world_part: Array, T_world_jaw: Array, elastic: bool, noise: Noise, rng: np.random.Generator
) -> Felt:
    """The jaw closes at ``T_world_jaw`` (4, 4), each finger until the object presses 0.3 to 1.5 mm into it, at an unknown depth.

    Where neither finger meets the object, that both met nothing is felt, at the jaw's origin. A finger stopped by too small a
    contact adds no information.
    """
    stopped, touches = close_jaw(space, T_world_part, T_world_jaw, rng.uniform(*penetrations(space), 2))
    T, masks = [], []
    for T_world_sensor in stopped[touches]:
        mask = _felt(space, T_world_sensor, T_world_part, elastic)
        if mask is not None:
            T.append(T_world_sensor)
            masks.append(spoilt(mask, space, noise, rng))
    if not touches.any():
        nothing = np.zeros(space.sensor.image_size_px[::-1], bool)
        return Felt(T_world_jaw @ np.stack([np.eye(4), OPPOSITE]), [nothing, nothing])
    return Felt(np.array(T).reshape(-1, 4, 4), masks)


def believe(posterior: Posterior, rng: np.random.Generator) -> Believed:
    """The first mode of ``posterior`` and poses drawn from it; the right one is among what was found as far as the mode's
    probability says less than the draws do."""
    mesh, first, drawn = posterior.mesh, posterior.modes(1)[0], draw_places(posterior, _DRAWS, rng)[0]
    near = PoseDistance(mesh).within(first.T, drawn, mode_radius(mesh)).mean()
    found = min(first.probability / max(near, 1 / _DRAWS), 1.0)
    return Believed(np.concatenate([first.T[None], drawn]), np.full(1 + _DRAWS, 1 / (1 + _DRAWS)), found)


def decide(belief: Believed, fixture: Fixture, clearances: Sequence[float]) -> list[Decision]:
    """For each of ``clearances`` [m] the probability that the object fits, placed by the pose that explains the contacts best.

    P(fits | T) is the weight of the poses T' believed at which inv(T) T' needs no more than the clearance, times the probability
    that what was found holds the right one: where few poses were tried, that one fits itself proves nothing.
    """
    even = (np.arange(_ASKED) + 0.5) / _ASKED
    drawn = np.minimum(np.searchsorted(np.cumsum(belief.weight), even), len(belief.T) - 1)
    needed = fixture.clearance_needed(inverse(belief.T[0]) @ belief.T[drawn])
    return [Decision(belief.T[0], float((needed <= clearance).mean() * belief.found)) for clearance in clearances]


def choose_jaw(posterior: Posterior, belief: Believed, made: Array, rng: np.random.Generator) -> Array:
    """The jaw's pose (4, 4) whose first finger has the largest expected information gain (thesis 8.2).

    As in ``planning.next_touch``, but the places to be distinguished are drawn as for the decision, finer than the grid's cells.
    """
    touches = grid_of_touches(posterior, made=made, seed=int(rng.integers(2**31)))
    some = [touches[i] for i in rng.permutation(len(touches))[:_TRIED]]
    places = belief.T[rng.choice(len(belief.T), _PLACES, p=belief.weight)]
    T = np.tile(places, (_PRESSES, 1, 1, 1))
    _, best = max((evaluate(posterior.space, touch, T).expected_nats, i) for i, touch in enumerate(some))
    # fingers that meet nothing meet each other in the middle
    return some[best].T_world_sensor @ transform(np.eye(3), [0.0, 0.0, 0.5 * some[best].travel])


def kit(
    localizer: Localizer,
    fixture: Fixture,
    T_world_part: Array,
    clearances: Sequence[float],
    rng: np.random.Generator,
    touches: int = 4,
    elastic: bool = True,
    noise: Noise = MODERATE,
) -> Iterator[Step]:
    """Touch an object that lies at ``T_world_part`` (4, 4), unknown to the robot, up to ``touches`` times with a jaw.

    The first closing is at the world's origin, along z. A caller who is sure enough stops asking for the next step.

    Raises
    ------
    InputError
        No touch had contact.
    NoPoseAgreesError
        No pose agrees with all contacts.
    """
    felt = touch_with_jaw(localizer.space, T_world_part, np.eye(4), elastic, noise, rng)
    if not felt.masks or not felt.masks[0].any():
        raise InputError("kit: expected a grasp with contact, no finger touched the object; take another seed")
    for touch in range(1, touches + 1):
        # the simulated cell knows exactly where its fingers are
        posterior = localizer.localize(
            felt.masks, "mask", T_world_sensor=felt.T_world_sensor, extrinsics_std=ExtrinsicsStd()
        )
        belief = believe(posterior, rng)
        yield Step(felt, posterior, belief, decide(belief, fixture, clearances))
        if touch < touches:
            jaw = choose_jaw(posterior, belief, felt.T_world_sensor, rng)
            felt += touch_with_jaw(localizer.space, T_world_part, jaw, elastic, noise, rng)


def draw_part(space: ContactSpace, rng: np.random.Generator) -> Array:
    """A pose (4, 4) of the object at which a jaw at the world's origin grasps it, and both fingers touch it."""
    least = penetrations(space)[0]
    while True:
        T_world_part = inverse(first_grasp(space.mesh, rng))
        stopped, touches = close_jaw(space, T_world_part, np.eye(4), (least, least))
        # a harder grasp shows more, and a rigid gel more than an elastic one
        if touches.all() and all(_felt(space, T, T_world_part, True) is not None for T in stopped):
            return T_world_part


def _felt(space: ContactSpace, T_world_sensor: Array, T_world_part: Array, elastic: bool) -> NDArray[np.bool_] | None:
    """The mask (H, W) without noise; None where it is smaller than a contact that counts."""
    mask = simulate_mask(space, inverse(T_world_sensor) @ T_world_part, elastic)
    return mask if counts(space, mask) else None
