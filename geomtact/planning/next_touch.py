"""Which touch to make next: the one whose outcome is expected to tell most about the pose (thesis 8.2).

Cells are drawn from the posterior, and poses within each. Every action is tried at all of these poses in simulation. What
it would show at one pose of a cell is compared with what it would show at other poses of this and of all other cells: so
a difference counts only if it tells cells apart, as the localizer could, not if it lies between two poses of one cell.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geomtact.contact_space.draw import draw_within
from geomtact.contact_space.index import Index
from geomtact.contact_space.space import ContactSpace
from geomtact.errors import InputError, UsageError
from geomtact.geometry.approach import facing, sunflower
from geomtact.se3 import Array, apply, check_transforms, inverse, transform
from geomtact.sensing.moments import moments
from geomtact.sensing.sensor import Sensor

LEAST = 0.05  # nats below which an action does not help
_CELLS = 128  # drawn from the posterior
# The share of the penetration that is pressed at each pose of a cell: first in the touch that is told, then in those that it
# is compared with. The localizer is not told it either.
_PRESSED = (0.5, 0.2, 0.4, 0.6, 0.8)
_SHAPE = (24, 32)  # of the casts
# Standard deviations at one pose: of where the sensor stops and of the contact's centre [m], and of the contact's log area,
# log size and stretches. Those of touches with the calibration's noise, half of them elastic, on five parts.
_BLUR, _NOISE = 0.3e-3, (0.4, 0.15, 0.17, 0.17)
_FREEDOM = 5.0  # of the Student t, as in scoring.moments
_WRONG = 0.01  # share of actions that report a contact where there is none, or none where there is one
_SAME_WAY = np.radians(15)
_RULED_OUT = 0.05  # of the likelihood of the likeliest pose: below it a pose is discarded


@dataclass(frozen=True, eq=False)
class Touch:
    """The sensor comes along its own +z to ``T_world_sensor`` and goes on for up to ``travel``; it stops as soon as the object
    presses against it, and shows the contact and where it stopped.

    Without travel it is merely placed there. That its housing strikes first shows nothing.

    Attributes
    ----------
    T_world_sensor : (4, 4), in the posterior's frame
    travel : [m]
    cost : in any unit, the same for all actions
    """

    T_world_sensor: Array
    travel: float = 0.0
    cost: float = 1.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "T_world_sensor", _one_pose(self.T_world_sensor))
        if not 0 <= self.travel < np.inf:
            raise UsageError(f"Touch: expected a travel >= 0, in metres, got {self.travel}")
        _check_cost(self.cost)

    def reached(self, space: ContactSpace, T_world_object: ArrayLike, pressed: float) -> Array:
        """Where the sensor stops (n, 4, 4) in the world, with objects at ``T_world_object`` (n, 4, 4) that may press
        ``pressed`` [m] into the gel."""
        T = inverse(self.T_world_sensor) @ np.asarray(T_world_object, float).reshape(-1, 4, 4)
        advance, _ = _advance(space, T, self.travel, pressed)
        return self.T_world_sensor @ _along_z(advance)

    def shows(self, space: ContactSpace, T_world_object: Array) -> tuple[NDArray[np.bool_], Array]:
        """Whether it touches (d, n) and what it shows (d, n, 7) with the object at ``T_world_object`` (d, n, 4, 4).

        That is how far the sensor went and the contact's moments, lengths in half diagonals of the window.
        """
        d, n = T_world_object.shape[:2]
        T = inverse(self.T_world_sensor) @ T_world_object.reshape(-1, 4, 4)
        sensor = space.sensor
        pressed = sensor.max_penetration * np.repeat(_PRESSED[:d], n)
        advance, below = _advance(space, T, self.travel, pressed)
        felt = below.max((1, 2)) > 0
        if sensor.housing_depth is not None and felt.any():
            stopped = _along_z(-advance[felt]) @ T[felt]
            felt[felt] = space.caster.lowest_outside(sensor, stopped) >= -sensor.housing_depth
        shown = np.zeros((d * n, 7))
        shown[felt, 0] = advance[felt] / np.hypot(*sensor.half_window)
        shown[felt, 1:] = moments(below[felt] > 0, sensor)
        return felt.reshape(d, n), shown.reshape(d, n, 7)


@dataclass(frozen=True, eq=False)
class Probe:
    """A thin finger comes along ``direction`` up to ``point`` and tells only whether it met the object on its way.

    Attributes
    ----------
    point : (3,) where its tip ends, in the posterior's frame [m]
    direction : (3,) in the posterior's frame, of any length
    cost : in any unit, the same for all actions
    """

    point: Array
    direction: Array
    cost: float = 1.0

    def __post_init__(self) -> None:
        for name in ("point", "direction"):
            value = np.asarray(getattr(self, name), float)
            if value.shape != (3,) or not np.isfinite(value).all():
                raise UsageError(f"Probe: expected a {name} of three finite numbers, got {getattr(self, name)}")
            object.__setattr__(self, name, value)
        if np.linalg.norm(self.direction) < 1e-12:
            raise UsageError("Probe: expected a direction, got one of no length")
        _check_cost(self.cost)

    @property
    def T_world_sensor(self) -> Array:
        """(4, 4): origin at the point, +z along the direction."""
        return transform(facing(-self.direction / np.linalg.norm(self.direction)).T, self.point)

    def shows(self, space: ContactSpace, T_world_object: Array) -> tuple[NDArray[np.bool_], Array]:
        """Whether it meets the object (d, n) at ``T_world_object`` (d, n, 4, 4), and nothing else (d, n, 0)."""
        T = inverse(self.T_world_sensor) @ T_world_object.reshape(-1, 4, 4)
        straight = replace(_straight(space.sensor), membrane_radius=0.0)
        felt = space.caster.ray_depths(straight, T, np.zeros((1, 2)))[:, 0] >= 0
        return felt.reshape(T_world_object.shape[:2]), np.zeros((*T_world_object.shape[:2], 0))


@dataclass(frozen=True, eq=False)
class Action:
    """What is expected of an action.

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
    """

    T_world_sensor: Array
    expected_nats: float
    cost: float
    expected_discarded: float
    contact: float
    number: int
    of: Touch | Probe

    def __repr__(self) -> str:
        kind = type(self.of).__name__.lower()
        return f"Action({kind} {self.number}: {self.expected_nats:.2f} nats, touches with {100 * self.contact:.0f} %)"


class Belief(Protocol):
    """What planning needs of a posterior, which is a later stage."""

    @property
    def contact(self) -> bool: ...
    @property
    def index(self) -> Index: ...
    @property
    def cells(self) -> NDArray[np.int64]: ...
    @property
    def log_prob(self) -> NDArray[np.floating]: ...
    @property
    def runs(self) -> NDArray[np.int64] | None: ...
    @property
    def T_frame_sensor(self) -> Array: ...
    @property
    def space(self) -> ContactSpace: ...
    def modes(self, k: int = 5) -> list[Any]: ...


def next_touch(
    posterior: Belief, actions: Iterable[Touch | Probe | ArrayLike] | None = None, n: int = _CELLS, seed: int = 0
) -> list[Action]:
    """``actions`` by the information that they are expected to give for their cost, the best first; ties in their order.

    Parameters
    ----------
    posterior : what is known now; actions are in its frame
    actions : touches and probes; a pose (4, 4) is a touch without travel; by default :func:`grid_of_touches`
    n : cells drawn from the posterior; no action can be seen to tell more than log(n)
    seed : of the draws

    Raises
    ------
    InputError
        The posterior is of an image without contact.
    UsageError, PoseError
        There is no action, or one that is impossible.
    """
    _check_contact(posterior)
    if actions is None:
        actions = grid_of_touches(posterior)
    tried = [a if isinstance(a, Touch | Probe) else Touch(np.asarray(a)) for a in actions]
    if not tried:
        raise UsageError("next_touch: no actions to choose from; give some, or none at all for a grid of touches")
    T = draw_cells(posterior, n, np.random.default_rng(seed), len(_PRESSED))
    judged = [judge(posterior.space, action, T, number) for number, action in enumerate(tried, 1)]
    return sorted(judged, key=lambda a: -round(a.expected_nats / a.cost, 9))


def draw_cells(posterior: Belief, n: int, rng: np.random.Generator, within: int = 1) -> Array:
    """Poses (d, n, 4, 4) of the object: ``n`` cells drawn from the posterior, and d = ``within`` poses in each."""
    p = np.exp(np.asarray(posterior.log_prob, float))
    row = rng.choice(len(p), n, p=p / p.sum())
    runs = np.ones(n, np.int64) if posterior.runs is None else posterior.runs[row]
    cells = posterior.index.within_runs(posterior.cells[row], runs, rng.random(n))
    T, _, _ = draw_within(posterior.index, posterior.space, np.tile(cells, within), rng)
    return posterior.T_frame_sensor @ T.reshape(-1, n, 4, 4)


def judge(space: ContactSpace, action: Touch | Probe, T_world_object: Array, number: int = 1) -> Action:
    """What is expected of ``action`` where the object is equally likely at each of n places, of which d poses
    ``T_world_object`` (d, n, 4, 4) are known, d >= 2."""
    felt, shown = action.shows(space, T_world_object)
    likelihood = likelihoods(felt, shown, _noise(space.sensor)[: shown.shape[-1]])
    return Action(
        action.T_world_sensor,
        information(likelihood),
        float(action.cost),
        discarded(likelihood),
        float(felt.mean()),
        number,
        action,
    )


def likelihoods(felt: NDArray[np.bool_], shown: Array, noise: Array) -> Array:
    """How likely each of n outcomes is at each of n places (n, n), relative to chance; a row an outcome.

    The outcomes are those at the first pose of each place; its other poses say what is to be expected there. What is
    shown scatters about it by a Student t, with the covariance that it has within the places.

    Parameters
    ----------
    felt : (d, n) whether the action touches at each of the d poses of n places
    shown : (d, n, k) what it shows there
    noise : (k,) standard deviation of what is shown, at one pose
    """
    told, felt, seen, shown = felt[0], felt[1:], shown[0], shown[1:]
    seen = seen + noise * np.random.default_rng(0).normal(size=seen.shape)
    count = felt.sum(0)
    mean = (shown * felt[..., None]).sum(0) / np.maximum(count, 1)[:, None]
    off = (shown - mean)[felt]
    covariance = np.diag(noise**2) + off.T @ off / max(1, np.maximum(count - 1, 0).sum())
    whiten = np.linalg.inv(np.linalg.cholesky(covariance)).T
    square = (((seen @ whiten)[:, None, None] - shown @ whiten) ** 2).sum(-1)  # outcomes, poses, places
    log_t = np.where(felt, -0.5 * (_FREEDOM + len(noise)) * np.log1p(square / _FREEDOM), -np.inf)
    alike = np.exp(log_t - log_t.max((1, 2), keepdims=True)) if felt.any() else np.zeros(log_t.shape)
    chance = alike.sum((1, 2), keepdims=True) / max(1, felt.sum())
    both = told[:, None, None] & felt
    with np.errstate(invalid="ignore"):
        ratio = np.where(both, alike / chance, 1.0)
    right = told[:, None, None] == felt
    return (np.where(right, 1 - _WRONG, _WRONG) * ratio).mean(1)


def information(likelihood: Array) -> float:
    """Expected information [nats] about which of n equally likely places is the right one, of ``likelihood`` (n, n).

    H(place) - E[-log P(place | outcome)], each outcome judged by what other poses of its place show: 0 to log(n). An
    outcome that misleads in the mean is worth nothing, for it can be ignored.
    """
    right = np.diag(likelihood) / likelihood.mean(1)
    return float(max(0.0, np.log(np.maximum(right, 1e-12)).mean()))


def discarded(likelihood: Array) -> float:
    """Share (0..1) of n equally likely places that an outcome is expected to rule out, of ``likelihood`` (n, n)."""
    return float((likelihood < _RULED_OUT * likelihood.max(1, keepdims=True)).mean())


def ambiguity(ranked: Sequence[Action]) -> str | None:
    """Why none of the actions helps, in words; None where one does."""
    most = max(action.expected_nats for action in ranked)
    if most >= LEAST:
        return None
    if max(action.contact for action in ranked) <= LEAST:
        why = "hardly any of them would meet the object; let them reach farther, or aim elsewhere"
    elif min(action.contact for action in ranked) >= 1 - LEAST:
        why = "each would touch, and show the same at all poses that are still possible; touch elsewhere or from other sides"
    else:
        why = "each would show the same at all poses that are still possible; touch elsewhere or from other sides"
    return f"the pose stays as uncertain as it is: these actions would tell at most {most:.2f} nats, for {why}"


def grid_of_touches(
    posterior: Belief,
    side: ArrayLike | None = None,
    reachable: Callable[[Array], bool] | None = None,
    made: Iterable[ArrayLike] = (),
    cost: float = 1.0,
    seed: int = 0,
) -> list[Touch]:
    """Touches from round about, aimed all over the region in which the object may be.

    The sensor comes from 17 directions of a half-sphere, or from those that the posterior's approach allows at its first
    mode, and starts clear of the object. Where the region is wide, up to 3 x 3 touches lie side by side. That the sensor's
    body may strike the first sensor, or a robot its own elbow, is for ``reachable`` to say.

    Parameters
    ----------
    side : (3,) middle of the half-sphere, towards the sensor, in the posterior's frame; by default away from the first
        sensor, along its +z
    reachable : whether the robot can bring the sensor to a pose (4, 4); asked of where it starts and of where it ends
    made : T_world_sensor (4, 4) of touches made before; what is nearly the same is left out, for it errs in the same way
    cost : of each touch
    seed : of the poses that tell the region
    """
    _check_contact(posterior)
    space = posterior.space
    poses = draw_cells(posterior, 32, np.random.default_rng(seed))[0]
    points = apply(poses, space.mesh.surface_points(64)).reshape(-1, 3)
    long_axis = np.linalg.svd(points - points.mean(0), full_matrices=False)[2][0]
    window = 2 * space.sensor.half_window
    margin = space.sensor.max_penetration
    before = [_one_pose(T) for T in made]
    out = []
    for direction in _directions(posterior, side, long_axis):
        R = _looking(-direction, long_axis, space.sensor.tall)
        seen = points @ R
        low, high = np.quantile(seen, [0.02, 0.98], axis=0)
        start, end = seen[:, 2].min() - margin, seen[:, 2].max() + margin
        columns, rows = np.clip(np.ceil(2 * (high - low)[:2] / window), 1, 3).astype(int)
        for x in low[0] + (np.arange(columns) + 0.5) / columns * (high[0] - low[0]):
            for y in low[1] + (np.arange(rows) + 0.5) / rows * (high[1] - low[1]):
                first, last = (transform(R, R @ [x, y, z]) for z in (start, end))
                again = any(_same_way(first, T, window.min() / 4) for T in before)
                if not again and (reachable is None or (reachable(first) and reachable(last))):
                    out.append(Touch(first, float(end - start), cost))
    return out


def _same_way(T: Array, other: Array, near: float) -> bool:
    """Whether sensors at ``T`` and ``other`` (4, 4) look the same way and past each other by less than ``near`` [m]."""
    apart = inverse(T) @ other
    return bool(apart[2, 2] > np.cos(_SAME_WAY) and np.hypot(*apart[:2, 3]) < near)


def _directions(posterior: Belief, side: ArrayLike | None, long_axis: Array) -> Array:
    """Directions (m, 3) from the object towards the sensor, in the posterior's frame."""
    cones = posterior.space.cones
    if cones is not None and side is None:
        R = posterior.modes(1)[0].T[:3, :3]
        return np.concatenate([sunflower(R @ v, half, 7 if half else 1) for v, half in cones])
    up = posterior.T_frame_sensor[:3, 2] if side is None else np.asarray(side, float)
    up = up / np.linalg.norm(up)
    frame = _looking(up, long_axis)
    turn = np.arange(8) * np.pi / 4
    ring = np.stack([np.cos(turn), np.sin(turn), np.zeros(8)], 1) @ frame.T
    return np.concatenate([ring, (ring + up) / np.sqrt(2), up[None]])


def _looking(z: Array, along: Array, tall: bool = False) -> Array:
    """R (3, 3) of a sensor that looks along ``z`` (3,), the long side of its window as near as may be to ``along`` (3,)."""
    side = along - (along @ z) * z
    if np.linalg.norm(side) < 0.1:
        return facing(-z).T
    long = side / np.linalg.norm(side)
    short = np.cross(z, long)
    return np.stack([-short, long, z] if tall else [long, short, z], 1)


def _advance(
    space: ContactSpace, T_sensor_object: Array, travel: float, pressed: ArrayLike
) -> tuple[Array, NDArray[np.floating]]:
    """How far (n,) [m] the sensor goes along z until the object at ``T_sensor_object`` (n, 4, 4) presses ``pressed`` [m] deep,
    at most ``travel``; and how deep the object then lies below the membrane (n, h, w) [m].

    By rays parallel to z, so that one cast serves all heights: the slant of a camera's rays moves the contacts of all poses
    alike.
    """
    sensor = _straight(space.sensor)
    below = space.caster.depths(sensor, T_sensor_object, sensor.along(_SHAPE))
    advance = np.minimum(np.asarray(pressed) - below.max((1, 2)), travel)
    return advance, below + advance[:, None, None].astype(np.float32)


def _straight(sensor: Sensor) -> Sensor:
    """``sensor`` seen by parallel rays."""
    return replace(sensor, camera_distance=0.0)


def _along_z(distance: Array) -> Array:
    """Shifts (n, 4, 4) by ``distance`` (n,) [m] along z."""
    return transform(np.eye(3), distance[:, None] * [0.0, 0.0, 1.0])


def _noise(sensor: Sensor) -> Array:
    """Standard deviation (7,) of what a touch shows."""
    blur = _BLUR / np.hypot(*sensor.half_window)
    return np.array([blur, blur, blur, *_NOISE])


def _one_pose(T: ArrayLike) -> Array:
    T = check_transforms(T, "T_world_sensor")
    if T.shape != (4, 4):
        raise UsageError(f"T_world_sensor: expected one pose (4, 4), got shape {T.shape}")
    return T


def _check_cost(cost: float) -> None:
    if not 0 < cost < np.inf:
        raise UsageError(f"cost: expected a number > 0, got {cost}")


def _check_contact(posterior: Belief) -> None:
    if not posterior.contact:
        raise InputError(
            "next touch: the posterior is of an image without contact; localize a touch of the object first"
        )
