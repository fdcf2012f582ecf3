"""Touches from all around the object, the default actions to choose from."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
from numpy.typing import ArrayLike

from geomtact.geometry.approach import facing, sunflower
from geomtact.inference.posterior import Posterior
from geomtact.planning.actions import Touch
from geomtact.planning.draws import check_contact, draw_places
from geomtact.se3 import Array, apply, check_pose, inverse, transform

_SAME_DIRECTION = np.radians(15)  # angle [rad] within which touches at one place count as the same; hand-set
_POSES = 128  # poses drawn from the posterior to find the region of the object; hand-set


def grid_of_touches(
    posterior: Posterior,
    side: ArrayLike | None = None,
    reachable: Callable[[Array], bool] | None = None,
    made: Iterable[ArrayLike] = (),
    seed: int = 0,
) -> list[Touch]:
    """Touches from round about, aimed all over the region in which the object may be.

    The sensor comes from 17 directions of a half-sphere, or from those that the posterior's approach allows at its first
    mode, and starts clear of the object. Where the region is wide, up to 3 x 3 touches lie side by side. That the sensor's
    body may strike the first sensor, or a robot its own elbow, is for ``reachable`` to decide.

    Parameters
    ----------
    side : (3,) middle of the half-sphere, towards the sensor, in the posterior's frame; by default away from the first
        sensor, along its +z
    reachable : whether the robot can bring the sensor to a pose (4, 4); asked of where it starts and of where it ends
    made : T_world_sensor (4, 4) of touches made before; touches near these are left out, because they err alike
    seed : of the poses that give the region
    """
    check_contact(posterior)
    space = posterior.space
    poses = draw_places(posterior, _POSES, np.random.default_rng(seed))[0]
    points = apply(poses, space.mesh.surface_points(64)).reshape(-1, 3)
    long_axis = np.linalg.svd(points - points.mean(0), full_matrices=False)[2][0]
    window = 2 * space.sensor.half_window
    margin = space.sensor.max_penetration
    before = [check_pose(T, "T_world_sensor") for T in made]
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
                again = any(_repeats(first, T, window.min() / 4) for T in before)
                if not again and (reachable is None or (reachable(first) and reachable(last))):
                    out.append(Touch(first, float(end - start)))
    return out


def _repeats(T: Array, other: Array, near: float) -> bool:
    """Whether sensors at ``T`` and ``other`` (4, 4) look the same way and past each other by less than ``near`` [m]."""
    apart = inverse(T) @ other
    return bool(apart[2, 2] > np.cos(_SAME_DIRECTION) and np.hypot(*apart[:2, 3]) < near)


def _directions(posterior: Posterior, side: ArrayLike | None, long_axis: Array) -> Array:
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
