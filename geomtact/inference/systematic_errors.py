"""Errors that a whole contact has in common: of the object's scale, and of where the contact was found.

The object is a little larger or smaller than its mesh, so that its centre is farther from the contact or nearer than the mesh
says. And the contact lies beside where it was found: pixels are larger than stated, or the gel shows contact where the object is
still above it, or only deeper. Neither changes the shape of a contact of some millimetres by much. So a pose with errors has the
contact that the pose without them has. How large the errors are is not known either, so they follow heavy-tailed distributions
(Cauchy's, up to a limit).
"""

from __future__ import annotations

from functools import cache

import numpy as np
from scipy.stats import qmc

from geomtact.scoring.contact_likelihood import SCALE_ERROR, SHIFT_ERROR
from geomtact.se3 import Array

NODES = 32  # errors over which a density is averaged, a power of two
_WIDTHS = np.array([SCALE_ERROR, SHIFT_ERROR, SHIFT_ERROR, SHIFT_ERROR])
_LIMIT = 40 * _WIDTHS
_WIDER = np.array([4.0, 1.0, 1.0, 1.0])  # distribution of the nodes, so that some lie where errors are large


def random_errors(n: int, rng: np.random.Generator) -> Array:
    """Errors (n, 4): the log of how much larger the object is than its mesh, and by how much the contact lies beside where it
    was found along x, y and z, sensor frame [m]."""
    return errors_of(rng.random((n, 4)))


def errors_of(shares: Array) -> Array:
    """Errors (..., 4) as of :func:`random_errors`, below which ``shares`` (..., 4) of them lie along each axis; none at 0.5."""
    return _quantiles(shares, _WIDTHS)


@cache
def nodes() -> tuple[Array, Array]:
    """Errors (NODES, 4) spread evenly, and the log of their weights (NODES,), by which they have the distribution of
    :func:`random_errors`."""
    share = qmc.Sobol(4, scramble=False).random(NODES) + 0.5 / NODES
    errors = _quantiles(share, _WIDER * _WIDTHS)
    log_weight = (_log_density(errors, _WIDTHS) - _log_density(errors, _WIDER * _WIDTHS)).sum(1)
    return errors, log_weight - np.log(np.exp(log_weight).sum())


def displaced(centre: Array, errors: Array, about: Array) -> Array:
    """Where the object's ``centre`` (..., 3) is with ``errors`` (..., 4), of a contact found ``about`` (3,) [m]."""
    return about + np.exp(errors[..., :1]) * (centre - about) + errors[..., 1:]


def undisplaced(centre: Array, errors: Array, about: Array) -> Array:
    """Inverse of :func:`displaced`."""
    return about + np.exp(-errors[..., :1]) * (centre - errors[..., 1:] - about)


def _quantiles(share: Array, width: Array) -> Array:
    """Errors (..., 4) below which ``share`` (..., 4) of the distributions of ``width`` (4,) lie."""
    return np.asarray(width * np.tan((2 * share - 1) * np.arctan(_LIMIT / width)))


def _log_density(errors: Array, width: Array) -> Array:
    """Log density (n, 4) of ``errors`` (n, 4) along each axis."""
    return np.asarray(-np.log(2 * width * np.arctan(_LIMIT / width)) - np.log1p((errors / width) ** 2))
