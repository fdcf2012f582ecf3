"""Sequences of touches with true poses, to judge filters on: an object that creeps over the sensor, pressed all the while."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geomtact.contact_space.contact_class import contact_class
from geomtact.contact_space.space import ContactSpace
from geomtact.contact_space.touch import simulate_mask, spoilt
from geomtact.contact_space.touches import counts, penetrations
from geomtact.errors import MeshError
from geomtact.geometry.symmetry import about
from geomtact.se3 import Array, exp, inverse
from geomtact.sensing.noise import MODERATE, Noise

FEATURELESS = ("flat", "cylinder")  # classes of contact that look alike at many poses
_KEEPS = 0.9  # how much of a frame's motion goes on in the next
_TRIES = 20  # other directions that are tried where an object would lose contact
_STARTS = 200
_POINTS = 64  # of the surface, by which motion is measured


@dataclass(frozen=True)
class Trajectory:
    """``n`` frames: the true poses (n, 4, 4) and what the sensor reports, n masks (H, W) bool."""

    T_sensor_object: Array
    masks: list[NDArray[np.bool_]]
    elastic: bool

    @property
    def T_world_sensor(self) -> Array:
        """Where the sensor is (n, 4, 4) if it is the sensor that moves, and the object rests at the world's origin."""
        return inverse(self.T_sensor_object)


def random_trajectory(
    space: ContactSpace,
    n: int,
    seed: int,
    speed: float = 1e-3,
    featureless: int = 0,
    slips: tuple[int, ...] = (),
    elastic: bool = False,
    noise: Noise = MODERATE,
) -> Trajectory:
    """``n`` frames of the object of ``space`` creeping over its sensor in a slowly turning direction.

    Parameters
    ----------
    speed : mean point distance from one frame to the next [m]; 0 stands still
    featureless : number of frames, the first ones, in which the contact is flat or a cylinder's
    slips : frames at which the object is suddenly at another pose of the contact pose space
    elastic : True for an elastic gel, False for the thesis's threshold; its noise is drawn anew in every frame

    Raises
    ------
    MeshError
        The object has no such contacts.
    """
    rng = np.random.default_rng(seed)
    poses: list[Array] = []
    ends = [*slips, n]
    for first, end in zip([0, *slips], ends, strict=True):
        poses += _stretch(space, end - first, speed, max(0, min(featureless, end) - first), rng)
    masks = [spoilt(simulate_mask(space, T, elastic), space, noise, rng) for T in poses]
    return Trajectory(np.array(poses), masks, elastic)


def _stretch(space: ContactSpace, n: int, speed: float, featureless: int, rng: np.random.Generator) -> list[Array]:
    """Poses of one unbroken motion of ``n`` frames, the first ``featureless`` of them without features."""
    for _ in range(_STARTS):
        T, _ = space.sample(1, rng, penetrations(space))
        if not _fits(space, T[0], featureless > 0):
            continue
        out, xi = [T[0]], _motion(space, speed, rng)
        while len(out) < n:
            found = None
            for _ in range(_TRIES):
                found = _moved(space, out[-1], xi, speed, len(out) < featureless)
                if found is not None:
                    break
                xi = _motion(space, speed, rng)
            if found is None:
                break
            out.append(found)
            xi = _scaled(space, _KEEPS * xi + np.sqrt(1 - _KEEPS**2) * _motion(space, speed, rng), speed)
        else:
            return out
    raise MeshError(f"{space.mesh.name}: hardly any motion of {n} frames keeps such a contact; ask for fewer frames")


def _fits(space: ContactSpace, T: Array, featureless: bool) -> bool:
    mask = space.caster.contact(space.sensor, T).mask
    return counts(space, mask) and (not featureless or contact_class(space, T) in FEATURELESS)


def _moved(space: ContactSpace, T: Array, xi: Array, speed: float, featureless: bool) -> Array | None:
    """``T`` moved by the twist ``xi`` (6,) about the object's centre and settled as deep as it was; None if it jumps or
    loses contact."""
    if speed == 0:
        return T
    centre = about(np.eye(3), space.mesh.centre)
    centre[:3, 3] = space.mesh.centre
    new, ok = space.settle((T @ centre @ exp(xi) @ inverse(centre))[None], space.penetration(T))
    if not (ok[0] and np.isfinite(space.penetration(new)[0])):
        return None
    points = space.mesh.surface_points(_POINTS)
    far = np.linalg.norm(points @ (new[0] - T)[:3, :3].T + (new[0] - T)[:3, 3], axis=1).mean()
    return new[0] if far <= 2 * speed and _fits(space, new[0], featureless) else None


def _motion(space: ContactSpace, speed: float, rng: np.random.Generator) -> Array:
    """A twist (6,) about the object's centre, of a random direction that the approach allows."""
    turn = rng.normal(size=3) / space.mesh.radius_rms
    if space.cones is not None and space.cones[0][1] == 0:
        face = space.cones[0][0]
        turn = (turn @ face) * face
    return _scaled(space, np.concatenate([turn, rng.normal(size=3)]), speed)


def _scaled(space: ContactSpace, xi: Array, speed: float) -> Array:
    """``xi`` (6,) made as long as ``speed`` [m], in the mean over the surface."""
    points = space.mesh.surface_points(_POINTS) - space.mesh.centre
    return np.asarray(xi * speed / np.linalg.norm(np.cross(xi[:3], points) + xi[3:], axis=1).mean())
