"""Log likelihood of a contact's outline on rigid and elastic gels, and a search for likelier poses.

The grid stores, and registration casts, where the object lies below the membrane. A real gel sinks beside what presses and
touches less of it, by an amount that follows from its pressure.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geomtact.contact_space.space import ContactSpace
from geomtact.contact_space.touch import sinking
from geomtact.registration.observability import moved
from geomtact.registration.protocol import Problem
from geomtact.scoring.outline import OutlineLikelihood
from geomtact.se3 import Array

SHAPE = (60, 80)  # of the casts
GELS = (0.0, 0.5, 1.0)  # share of an elastic half-space's sinking: rigid, thin and thick gels, equally likely; hand-set
# Per round: poses kept, poses tried around each, and their width as a share of the first; hand-set
ROUNDS = ((200, 8, 1.0), (60, 10, 0.6), (25, 12, 0.35))


@dataclass(frozen=True, eq=False)
class Gel:
    """What the sensor shows.

    Attributes
    ----------
    space : of the object on it
    outline : of its contact, to be compared with fields of :attr:`shape`
    """

    space: ContactSpace
    outline: OutlineLikelihood

    @classmethod
    def showing(cls, mask: NDArray[np.bool_], space: ContactSpace) -> Gel:
        """The contact ``mask`` (H, W)."""
        return cls(space, OutlineLikelihood.of(mask, space.sensor, space.sensor.along(SHAPE)))

    @property
    def shape(self) -> tuple[int, int]:
        return self.space.sensor.along(SHAPE)

    def sinking(self, T: Array) -> NDArray[np.float32]:
        """As of ``touch.sinking`` (n, h, w), with the object at ``T`` (n, 4, 4)."""
        return np.stack([sinking(self.space, pose, self.shape) for pose in T])

    def log_likelihood(self, T: Array, sinking: NDArray[np.float32]) -> Array:
        """Natural log of the likelihood (n, g), up to a constant, for each of ``GELS`` at poses ``T`` (n, 4, 4) in the sensor
        frame, near which a half-space sinks so (n, h, w);
        -inf where the object does not touch, or is too deep."""
        sensor = self.space.sensor
        depths = self.space.caster.depths(sensor, T, self.shape)
        deepest = depths.max((1, 2))
        level = np.maximum(deepest, 0)[:, None, None] * sinking
        logs = np.stack([self.outline.log_likelihood(depths - np.float32(share) * level) for share in GELS], 1)
        logs[deepest > sensor.max_penetration] = -np.inf
        return logs

    def search(self, T: Array, width: Array, problem: Problem, rng: np.random.Generator) -> tuple[Array, Array]:
        """Poses (n, 4, 4) around ``T`` at which the outline is likelier, and how likely (n,), whatever the gel.

        Parameters
        ----------
        T : (n, 4, 4), the most hopeful first
        width : (6,) standard deviation of the motions that are tried first [m], in the axes of ``problem``
        """
        T, likely = T.copy(), np.full(len(T), -np.inf)
        left = np.arange(len(T))
        for most, around, share in ROUNDS:
            left = left[np.argsort(-likely[left], kind="stable")][:most]
            motion = rng.normal(size=(len(left), around, 6)) * share * width
            tried = np.concatenate([T[left, None], moved(T[left, None], motion, problem)], 1)
            sinks = np.repeat(self.sinking(T[left]), around + 1, 0)
            logs = self.log_likelihood(tried.reshape(-1, 4, 4), sinks)
            log_likelihood = (np.logaddexp.reduce(logs, 1) - np.log(len(GELS))).reshape(tried.shape[:2])
            best = np.arange(len(left)), log_likelihood.argmax(1)
            T[left], likely[left] = tried[best], log_likelihood[best]
        return T, likely
