"""Errors that a whole contact has in common: of the object's scale, of where the contact was found, and of where its sensor is.

The object is a little larger or smaller than its mesh, so that its centre is farther from the contact or nearer than the mesh
says. And the contact lies beside where it was found: pixels are larger than stated, or the gel shows contact where the object is
still above it, or only deeper. Neither changes the shape of a contact of some millimetres by much. So a pose with errors has the
contact that the pose without them has. How large the errors are is not known either, so they follow heavy-tailed distributions
(Cauchy's, up to a limit).

Of several sensors, all but the first are not quite where they are said to be, which adds to these errors of their contacts and
is larger. Unless it is stated how well their poses are known, standard deviations of 0.2 to 3 mm and degrees are equally probable
by their logarithm.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from scipy.special import ndtri
from scipy.stats import qmc

from geomtact.contact_space.cell_transfer import ExtrinsicsStd
from geomtact.scoring.contact_likelihood import SCALE_ERROR, SHIFT_ERROR
from geomtact.se3 import Array, exp

NODES = 32  # errors over which a density is averaged, a power of two
NODES_BESIDE = 256  # those of a sensor beside the first
ERRORS = (
    7  # of a contact: four of the first one; of any other how well its sensor's pose is known, and six of where that is
)
_WIDTHS = np.array([SCALE_ERROR, SHIFT_ERROR, SHIFT_ERROR, SHIFT_ERROR])
_LIMIT = 40 * _WIDTHS
_UNITS = np.array([np.deg2rad(1)] * 3 + [1e-3] * 3)  # [rad, m] of what a sensor may be off by
_LEAST, _MOST = 0.2, 3.0  # standard deviations, in these units, that are equally probable by their logarithm
_CONTACT = 0.1  # standard deviation, in these units, of where a contact is, were its sensor's pose exactly known
_WIDER = np.array([4.0, 1.0, 1.0, 1.0])  # distribution of the nodes, so that some lie where errors are large


def random_errors(n: int, rng: np.random.Generator) -> Array:
    """Errors (n, 4): the log of how much larger the object is than its mesh, and by how much the contact lies beside where it
    was found along x, y and z, sensor frame [m]."""
    return errors_of(rng.random((n, 4)))


def errors_of(shares: Array) -> Array:
    """Errors (..., 4) as of :func:`random_errors`: the quantiles at the first four of ``shares`` (..., ERRORS); 0.5 is none."""
    return _quantiles(shares[..., :4], _WIDTHS)


def stand_of(shares: Array, extrinsics_std: ExtrinsicsStd | None = None) -> Array:
    """Motions (..., 4, 4) from where a sensor beside the first is said to be to where it would show the contact that it does, by
    ``shares`` (..., ERRORS); none at 0.5.

    They are normal. Their standard deviation is ``extrinsics_std`` and what the contact's own place is uncertain by; or, where
    that is not stated, any from ``_LEAST`` to ``_MOST``.
    """
    if extrinsics_std is None:
        std = _UNITS * _LEAST * (_MOST / _LEAST) ** shares[..., :1]
    else:
        std = np.hypot([extrinsics_std.rotation] * 3 + [extrinsics_std.translation] * 3, _CONTACT * _UNITS)
    return exp(std * ndtri(np.clip(shares[..., 1:], 1e-9, 1 - 1e-9)))


@cache
def nodes() -> tuple[Array, Array]:
    """Errors (NODES, 4) spread evenly, and the log of their weights (NODES,), by which they have the distribution of
    :func:`random_errors`."""
    share = qmc.Sobol(4, scramble=False).random(NODES) + 0.5 / NODES
    errors = _quantiles(share, _WIDER * _WIDTHS)
    log_weight = (_log_density(errors, _WIDTHS) - _log_density(errors, _WIDER * _WIDTHS)).sum(1)
    return errors, log_weight - np.log(np.exp(log_weight).sum())


@cache
def nodes_beside(extrinsics_std: ExtrinsicsStd | None) -> Array:
    """Motions (NODES_BESIDE, 4, 4) as of :func:`stand_of`, spread evenly."""
    return stand_of(qmc.Sobol(ERRORS, scramble=False).random(NODES_BESIDE) + 0.5 / NODES_BESIDE, extrinsics_std)


def displaced(centre: Array, errors: Array, about: Array) -> Array:
    """Where the object's ``centre`` (..., 3) is with ``errors`` (..., 4), of a contact found ``about`` (3,) [m]."""
    return about + np.exp(errors[..., :1]) * (centre - about) + errors[..., 1:]


def undisplaced(centre: Array, errors: Array, about: Array) -> Array:
    """Inverse of :func:`displaced`."""
    return about + np.exp(-errors[..., :1]) * (centre - errors[..., 1:] - about)


def _quantiles(share: Array, width: Array) -> Array:
    """Quantiles (..., 4) at ``share`` (..., 4) of the distributions of ``width`` (4,)."""
    return np.asarray(width * np.tan((2 * share - 1) * np.arctan(_LIMIT / width)))


def _log_density(errors: Array, width: Array) -> Array:
    """Log density (n, 4) of ``errors`` (n, 4) along each axis."""
    return np.asarray(-np.log(2 * width * np.arctan(_LIMIT / width)) - np.log1p((errors / width) ** 2))
