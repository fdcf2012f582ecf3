"""The input and output of a refiner, and the protocol that every refiner follows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from geomtact.se3 import Array, unit


@dataclass(frozen=True, eq=False)
class Problem:
    """What was observed, of one contact or of several, ready for registration: all in one frame, metres.

    Attributes
    ----------
    points : (n, 3) where the object's surface was met: contact outlines on the membrane, and where depths are measured the gel
    facing : (n, 3) unit vectors that the surface looks along there: out of the contact, parallel to the membrane, on an
        outline; towards the camera within a contact
    across : (n, 3) unit vectors along which it may lean freely: along the membrane and along the outline; 0 within a contact
    sinking : (n, 3) how a point moves for each metre that the gel sinks around the object; 0 where depths are measured
    noise : (n,) standard deviation of each point along ``facing``
    weight : (n,) share of each point that is independent: neighbours err alike
    contact : (n,) which contact it belongs to
    around : (m, 3) points of the membranes that lie inside the object where ``side`` (m,) is 1, outside where it is -1
    outwards : (3,) unit vector from the camera out of the membrane, in the mean over all contacts
    centre : (3,) of the contacts
    length : size of the contacts (rms distance from the centre); rotations are scaled by it
    pitch : of the images' pixels
    sink_std : by how much a whole outline may lie above the surface because an elastic gel sinks around the object
    """

    points: Array
    facing: Array
    across: Array
    sinking: Array
    noise: Array
    weight: Array
    contact: NDArray[np.int64]
    around: Array
    side: NDArray[np.int64]
    outwards: Array
    centre: Array
    length: float
    pitch: float
    sink_std: float

    @property
    def contacts(self) -> int:
        """How many contacts there are."""
        return int(self.contact.max(initial=0)) + 1

    @property
    def middle_noise(self) -> float:
        """Of the points, in the median; the pixels' pitch where there are none."""
        return float(np.median(self.noise)) if len(self.noise) else self.pitch

    @staticmethod
    def joined(problems: list[Problem], T_world_sensor: Array) -> Problem:
        """All contacts as one, from the frames of their sensors (c, 4, 4) in the world."""

        def along(name: str) -> Array:
            turned = (getattr(p, name) @ T[:3, :3].T for p, T in zip(problems, T_world_sensor, strict=True))
            return np.concatenate(list(turned))

        def placed(name: str) -> Array:
            moved = (getattr(p, name) @ T[:3, :3].T + T[:3, 3] for p, T in zip(problems, T_world_sensor, strict=True))
            return np.concatenate(list(moved))

        def strung(name: str) -> Array:
            return np.concatenate([getattr(p, name) for p in problems])

        points = placed("points")
        centre = points.mean(0) if len(points) else np.zeros(3)
        spread = np.sqrt(((points - centre) ** 2).sum(1).mean()) if len(points) else 0.0
        first = np.cumsum([0] + [p.contacts for p in problems])
        return Problem(
            points=points,
            facing=along("facing"),
            across=along("across"),
            sinking=along("sinking"),
            noise=strung("noise"),
            weight=strung("weight"),
            contact=np.concatenate([p.contact + i for p, i in zip(problems, first, strict=False)]),
            around=placed("around"),
            side=strung("side").astype(np.int64),
            outwards=unit(
                np.mean([T[:3, :3] @ p.outwards for p, T in zip(problems, T_world_sensor, strict=True)], axis=0)
            ),
            centre=centre,
            length=max(float(spread), *(p.pitch for p in problems)),
            pitch=max(p.pitch for p in problems),
            sink_std=max(p.sink_std for p in problems),
        )


@dataclass(frozen=True, eq=False)
class Refinement:
    """Refined poses with their uncertainty. Where ``converged`` is False, ``T`` is the start.

    Attributes
    ----------
    T : (k, 4, 4) of the object in the problem's frame
    converged : (k,) bool: enough of what was observed lies on the surface, and the pose has stopped moving
    covariance : (k, 6, 6) of xi = (rx, ry, rz, tx, ty, tz) in T exp(xi^), radians and metres
    observable : k arrays (r, 6) of orthonormal rows: the observable directions of xi, rotations times length
    residual : (k,) rms distance of the points from the surface, in units of their noise; inf without support
    support : (k,) how many points lie on the surface
    length : by which rotations are scaled in ``observable`` [m]
    """

    T: Array
    converged: NDArray[np.bool_]
    covariance: Array
    observable: list[Array]
    residual: Array
    support: NDArray[np.int64]
    length: float


class Refiner(Protocol):
    """Moves poses so that the object's surface meets what was observed."""

    @property
    def name(self) -> str: ...

    def refine(self, problem: Problem, T: Array) -> Refinement:
        """Refine the poses ``T`` (k, 4, 4) of the object in the problem's frame."""
        ...
