"""Which touch to make next: the one with the largest expected information gain for its cost (thesis 8.2).

Places are drawn from the posterior, and poses of each. Every action is tried at all of these poses in simulation. What
it would show at one pose of a place is compared with what it would show at other poses of this and of all other places: so
a difference counts only if it distinguishes places, as the localizer could, not if it lies between two poses of one place.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geomtact.contact_space.space import ContactSpace
from geomtact.errors import UsageError
from geomtact.inference.posterior import Posterior
from geomtact.planning.actions import PRESSED, Probe, Touch
from geomtact.planning.draws import check_contact, draw_places
from geomtact.planning.grid import grid_of_touches
from geomtact.se3 import Array
from geomtact.sensing.sensor import Sensor

LEAST = 0.05  # expected information gain below which an action does not help [nats]; hand-set
_PLACES = 128  # drawn from the posterior; hand-set
# Of many actions, the best ``_CLOSELY`` are evaluated at all poses. They are chosen at ``_WITHIN`` poses of every ``_ONE_IN``-th
# place, where at least ``_LEAST_PLACES`` are drawn. Hand-set, for speed.
_CLOSELY, _WITHIN, _ONE_IN = 24, 3, 4
_LEAST_PLACES = 32
# Standard deviations at one pose: of the sensor's stop and of the contact's centre [m], and of the contact's log area, log size
# and stretches. Measured on simulated touches of five objects with the calibration's noise, half of them elastic.
_POSITION_STD, _MOMENTS_STD = 0.3e-3, (0.4, 0.15, 0.17, 0.17)
_FREEDOM = 5.0  # degrees of freedom of the Student t, as in scoring.moments
_WRONG = 0.01  # probability that a contact is reported wrongly, or missed; hand-set
_RULED_OUT = 0.05  # likelihood relative to the best pose's below which a pose is discarded; hand-set


@dataclass(frozen=True, eq=False)
class Action:
    """The expected outcome of an action.

    Attributes
    ----------
    T_world_sensor : (4, 4), in the posterior's frame; a probe's point, with +z along its direction
    expected_nats : information about the pose
    cost : as given
    expected_discarded : share (0..1) of the poses still possible that the outcome is expected to rule out, the thesis's
        information function
    contact : probability that it touches
    number : among the actions given, from 1
    of : the action itself
    roughly : whether it was tried at some of the poses alone, as one of many with less information: do not compare its
        ``expected_discarded`` with others'
    """

    T_world_sensor: Array
    expected_nats: float
    cost: float
    expected_discarded: float
    contact: float
    number: int
    of: Touch | Probe
    roughly: bool = False

    def __repr__(self) -> str:
        kind = type(self.of).__name__.lower()
        return f"Action({kind} {self.number}: {self.expected_nats:.2f} nats, touches with {100 * self.contact:.0f} %)"


def next_touch(
    posterior: Posterior, actions: Iterable[Touch | Probe | ArrayLike] | None = None, n: int = _PLACES, seed: int = 0
) -> list[Action]:
    """``actions`` by the information that they are expected to give for their cost, the best first; ties in their order.

    Of more than 24, those with less information at some of the poses are not tried at the others, and come last.

    Parameters
    ----------
    posterior : of the touches so far; actions are in its frame
    actions : touches and probes; a pose (4, 4) is a touch without travel; by default :func:`grid_of_touches`
    n : places drawn from the posterior; no action can be expected to give more than log(n) nats
    seed : of the draws

    Raises
    ------
    InputError
        The posterior is of an image without contact.
    UsageError, PoseError
        There is no action, or one that is impossible.
    """
    check_contact(posterior)
    if actions is None:
        actions = grid_of_touches(posterior)
    tried = [a if isinstance(a, Touch | Probe) else Touch(np.asarray(a)) for a in actions]
    if not tried:
        raise UsageError("next_touch: no actions to choose from; give some, or none at all for a grid of touches")
    T = draw_places(posterior, n, np.random.default_rng(seed), len(PRESSED))
    few = T[:_WITHIN, ::_ONE_IN] if len(tried) > _CLOSELY and n >= _LEAST_PLACES else T
    ranked = _ranked(evaluate(posterior.space, action, few, number) for number, action in enumerate(tried, 1))
    if few is T:
        return ranked
    closely = _ranked(evaluate(posterior.space, action.of, T, action.number) for action in ranked[:_CLOSELY])
    return closely + [replace(action, roughly=True) for action in ranked[_CLOSELY:]]


def _ranked(actions: Iterable[Action]) -> list[Action]:
    """The most information for its cost first; ties in the order in which they were given."""
    return sorted(actions, key=lambda a: (-round(a.expected_nats / a.cost, 9), a.number))


def evaluate(space: ContactSpace, action: Touch | Probe, T_world_object: Array, number: int = 1) -> Action:
    """What is expected of ``action`` where the object is equally likely at each of n places, of which d poses
    ``T_world_object`` (d, n, 4, 4) are given, d >= 2."""
    touches, shown = action.shows(space, T_world_object)
    likelihood = likelihoods(touches, shown, _noise(space.sensor)[: shown.shape[-1]])
    return Action(
        action.T_world_sensor,
        information(likelihood),
        float(action.cost),
        discarded(likelihood),
        float(touches.mean()),
        number,
        action,
    )


def likelihoods(touches: NDArray[np.bool_], shown: Array, noise: Array) -> Array:
    """How likely each of n outcomes is at each of n places (n, n), relative to chance; a row an outcome.

    The outcomes are those at the first pose of each place; its other poses say what is to be expected there. What is
    shown scatters about it by a Student t, with the covariance that it has within the places.

    Parameters
    ----------
    touches : (d, n) whether the action touches at each of the d poses of n places
    shown : (d, n, k) what it shows there
    noise : (k,) standard deviation of what is shown, at one pose
    """
    touched, touches, seen, shown = touches[0], touches[1:], shown[0], shown[1:]
    seen = seen + noise * np.random.default_rng(0).normal(size=seen.shape)
    count = touches.sum(0)
    mean = (shown * touches[..., None]).sum(0) / np.maximum(count, 1)[:, None]
    off = (shown - mean)[touches]
    covariance = np.diag(noise**2) + off.T @ off / max(1, np.maximum(count - 1, 0).sum())
    whiten = np.linalg.inv(np.linalg.cholesky(covariance)).T
    square = (((seen @ whiten)[:, None, None] - shown @ whiten) ** 2).sum(-1)  # outcomes, poses, places
    log_t = np.where(touches, -0.5 * (_FREEDOM + len(noise)) * np.log1p(square / _FREEDOM), -np.inf)
    alike = np.exp(log_t - log_t.max((1, 2), keepdims=True)) if touches.any() else np.zeros(log_t.shape)
    chance = alike.sum((1, 2), keepdims=True) / max(1, touches.sum())
    both = touched[:, None, None] & touches
    with np.errstate(invalid="ignore"):
        ratio = np.where(both, alike / chance, 1.0)
    right = touched[:, None, None] == touches
    return (np.where(right, 1 - _WRONG, _WRONG) * ratio).mean(1)


def information(likelihood: Array) -> float:
    """Expected information [nats] about which of n equally likely places is the right one, of ``likelihood`` (n, n).

    H(place) - E[-log P(place | outcome)], each outcome evaluated by what other poses of its place show: 0 to log(n). An
    outcome that misleads in the mean counts 0, because it can be ignored.
    """
    right = np.diag(likelihood) / likelihood.mean(1)
    return float(max(0.0, np.log(np.maximum(right, 1e-12)).mean()))


def discarded(likelihood: Array) -> float:
    """Share (0..1) of n equally likely places that an outcome is expected to rule out, of ``likelihood`` (n, n)."""
    return float((likelihood < _RULED_OUT * likelihood.max(1, keepdims=True)).mean())


def ambiguity(ranked: Sequence[Action]) -> str | None:
    """The message why none of the actions helps; None where one does."""
    most = max(action.expected_nats for action in ranked if not action.roughly)
    if most >= LEAST:
        return None
    if max(action.contact for action in ranked) <= LEAST:
        why = "hardly any of them would meet the object; let them reach farther, or aim elsewhere"
    elif min(action.contact for action in ranked) >= 1 - LEAST:
        why = "each would touch, and show the same at all poses that are still possible; touch elsewhere or from other sides"
    else:
        why = "each would show the same at all poses that are still possible; touch elsewhere or from other sides"
    return f"the pose stays as uncertain: the expected information gain of these actions is at most {most:.2f} nats, for {why}"


def _noise(sensor: Sensor) -> Array:
    """Standard deviation (7,) of the outcome of a touch."""
    blur = _POSITION_STD / np.hypot(*sensor.half_window)
    return np.array([blur, blur, blur, *_MOMENTS_STD])
