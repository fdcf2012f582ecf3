"""Student's distribution of motions from a pose, by which poses are drawn about a mode."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import gammaln

from geomtact.se3 import Array

_WIDER = 1.6  # standard deviations of the draws over those of the poses before
_TAIL = 5  # degrees of freedom
_KNOWN = 3  # the covariance that is known before counts as much as so many poses


@dataclass(frozen=True, eq=False)
class Student:
    """Student's distribution about ``mean`` (d,) with a triangular ``root`` (d, d) of its scale matrix."""

    mean: Array
    root: Array

    @classmethod
    def of(cls, motions: Array, weight: Array, least: Array) -> Student:
        """That of ``motions`` (n, d) of some ``weight`` (n,), and wider."""
        weight = weight / weight.sum()
        mean = weight @ motions
        n = 1 / float(weight @ weight)
        spread = ((motions - mean) * weight[:, None]).T @ (motions - mean)
        root = np.linalg.cholesky((n * spread + _KNOWN * np.diag(least**2)) / (n + _KNOWN))
        return cls(mean, np.asarray(_WIDER * root, float))

    def draw(self, n: int, rng: np.random.Generator) -> Array:
        stretch = np.sqrt(_TAIL / rng.chisquare(_TAIL, (n, 1)))
        return np.asarray(self.mean + stretch * (rng.normal(size=(n, len(self.mean))) @ self.root.T))

    def log_density(self, motions: Array) -> Array:
        d = len(self.mean)
        off = np.square(np.linalg.solve(self.root, (motions - self.mean).T)).sum(0)
        scale = gammaln((_TAIL + d) / 2) - gammaln(_TAIL / 2) - 0.5 * d * np.log(_TAIL * np.pi)
        return np.asarray(scale - np.log(np.diag(self.root)).sum() - 0.5 * (_TAIL + d) * np.log1p(off / _TAIL), float)


def log_volume(turn: Array, axes: int) -> Array:
    """Log (n,) of the uniform measure of a small volume of motions that turn by ``turn`` (n,) [rad], about some of so many
    ``axes``, over that at no turn."""
    of_shifts = np.log(np.maximum(np.sinc(turn / (2 * np.pi)) ** 2, 1e-300))
    return np.asarray(of_shifts + log_volume_of_turns(turn, axes))


def log_volume_of_turns(turn: Array, axes: int) -> Array:
    """As :func:`log_volume`, of the turns alone."""
    volume = {2: np.sinc(turn / np.pi), 3: np.sinc(turn / (2 * np.pi)) ** 2}.get(axes, np.ones_like(turn))
    return np.asarray(np.log(np.maximum(volume, 1e-300)))
