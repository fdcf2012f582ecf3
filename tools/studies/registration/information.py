"""The information of a contact about the pose, by the exact simulator: the bound that no registration can beat.

The outline of a contact is displaced by sensor noise along its normal. How far it moves with the pose is measured by moving
the object a little in each direction and casting, or solving the gel, again. So no method's own idea of what it sees enters.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geomtact.contact_space.space import ContactSpace
from geomtact.contact_space.touch import simulate_mask
from geomtact.registration.contact_problem import make_problem
from geomtact.registration.observability import GAIN, Spread, moved, observable_subspace
from geomtact.registration.protocol import Problem
from geomtact.se3 import Array
from geomtact.sensing.noise import Noise

_STEP = 0.2e-3  # m that the contact is moved, in each direction
_BLUR = 3.0  # px
_POINTS = 400  # of the outline, at most


def fisher_information(
    space: ContactSpace, T: ArrayLike, elastic: bool, problem: Problem, noise: Noise, pixel_noise: float = 0.3
) -> Array:
    """Fisher information (6, 6) [1/m^2] of a contact's outline about zeta (see ``registration.observability``) at the true
    pose ``T`` (4, 4): rotations about the contact's centre times its length, then translations, in sensor axes.

    Parameters
    ----------
    elastic : whether the gel is elastic
    problem : gives the centre and the length that zeta is measured by
    noise : of the outline: ``outline_rms`` along its normal, alike over the middle of ``correlation``
    pixel_noise : of the outline's place in a pixel, standard deviation [px]
    """
    T = np.asarray(T, float)
    mask = simulate_mask(space, T, elastic)
    pitch = np.sqrt(space.sensor.pixel_area(mask.shape))
    outline = make_problem(mask, space.sensor, max_points=_POINTS, correlation=float(np.mean(noise.correlation)))
    at = space.sensor.to_pixels(space.sensor.project(outline.points))
    slope = np.zeros((len(at), 6))
    for i, axis in enumerate(np.eye(6)):
        ahead, behind = (simulate_mask(space, moved(T, way * _STEP * axis, problem), elastic) for way in (1, -1))
        # the outline moves outwards by what its signed distance grows
        slope[:, i] = (_inside(ahead, at) - _inside(behind, at)) * pitch / (2 * _STEP)
    rms = np.hypot(noise.outline_rms, pixel_noise * pitch)
    return np.asarray((slope.T * (outline.weight / rms**2)) @ slope)


def split(information: Array, spread: Spread, length: float) -> tuple[Array, Array]:
    """Matrices (6, 6) that take from a motion zeta its observable component, and the rest; they add up to one.

    A direction is observable that ``information`` (6, 6) fixes to a standard deviation under a quarter of the grid's
    step, which is one length for shifts and another for turns: ``spread`` holds both.
    """
    measure, move, _ = observable_subspace(information, spread, length)
    kept = move @ measure
    return kept, np.eye(6) - kept


def agreement(information: Array, rows: Array, spread: Spread, length: float) -> float:
    """In how many of six directions, as a share, a method and ``information`` (6, 6) agree on whether they are observable.

    The directions are those on which ``information`` is independent; ``rows`` (r, 6) measure in zeta what the
    method calls observable.
    """
    known = spread.metres(length)
    gain, axes = np.linalg.eigh(known[:, None] * information * known)
    basis = np.linalg.qr((rows * known).T)[0]  # (6, r), in units of the prior
    said = ((basis.T @ axes) ** 2).sum(0) > 0.5
    return float(np.mean((gain > GAIN) == said))


def _inside(mask: NDArray[np.bool_], at: Array) -> Array:
    """Distance [px] from the outline of a mask (h, w), positive inside, at ``at`` (n, 2), (column, row): (n,).

    It is read off the blurred mask, in which the stairs of the pixels are gone: they would pass for information.
    """
    from scipy.ndimage import gaussian_filter, map_coordinates
    from scipy.special import erfinv

    blurred = map_coordinates(gaussian_filter(mask.astype(float), _BLUR), at.T[::-1], order=1, mode="nearest")
    return np.asarray(_BLUR * np.sqrt(2) * erfinv(np.clip(2 * blurred - 1, -0.999, 0.999)))
