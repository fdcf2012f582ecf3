"""Prior densities over poses that touch or not (the thesis's P(G), 6.2)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from multiprocessing.reduction import ForkingPickler
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from geomtact.errors import InputError
from geomtact.geometry.distance import PoseDistance, mode_radius
from geomtact.geometry.mesh import Mesh
from geomtact.geometry.symmetry import Symmetry, about
from geomtact.inference.gaussian_prior import GaussianPrior
from geomtact.inference.posterior import Posterior
from geomtact.log_mass import log_mean_of_counted
from geomtact.se3 import Array, hat, inverse

LogDensity = Callable[[Array], Array]

# Images at which a prior that is a function is evaluated: turns about an axis, rotations (squared) of a sphere; hand-set.
_TURNS, _ROTATIONS = 12, 5
_CLOSER = 0.125 * 0.5 ** np.arange(8)  # steps of the search along a continuous symmetry [rad]; hand-set


@dataclass(frozen=True, eq=False)
class OfAllImages:
    """Log density, not normalised, of a prior that is a function, at poses touching or not: the same for every image of a pose.

    Attributes
    ----------
    prior : a :class:`GaussianPrior` or a function of poses (n, 4, 4)
    symmetry : of the object
    """

    prior: LogDensity
    symmetry: Symmetry

    def __reduce__(self) -> tuple[Any, ...]:
        try:
            ForkingPickler.dumps(self.prior)
        except Exception as error:
            raise InputError(
                "prior: this function cannot be pickled, and a posterior without contact holds it; define it with def at the "
                "top level of a module, or pickle posteriors with contact only"
            ) from error
        return OfAllImages, (self.prior, self.symmetry)

    def __deepcopy__(self, memo: dict[int, Any]) -> OfAllImages:
        return self

    def __call__(self, T: Array) -> Array:
        """At poses (n, 4, 4)."""
        density = self.prior
        if isinstance(density, GaussianPrior):
            density = over_images(density, self.symmetry)
        return log_mean_of_counted([checked(density(T @ S), len(T)) for S in images(self.symmetry)])


@dataclass(frozen=True, eq=False)
class OfPoses:
    """Log density, not normalised, of a prior that is a pair: each pose's mass counts for all within the radius of a mode.

    Attributes
    ----------
    poses : (n, 4, 4)
    log_mass : (n,)
    mesh : of the object
    """

    poses: Array
    log_mass: Array
    mesh: Mesh

    def __call__(self, T: Array) -> Array:
        """At poses (n, 4, 4)."""
        distance, radius = PoseDistance(self.mesh), mode_radius(self.mesh)
        near = [distance.within(t, self.poses, radius) for t in T]
        return np.array([np.logaddexp.reduce(self.log_mass[each], initial=-np.inf) for each in near])


@dataclass(frozen=True, eq=False)
class NoContactDensity:
    """Log density, not normalised, where the object touches none of several sensors.

    Attributes
    ----------
    others : posteriors of all sensors but the first, all without contact
    prior : log density before these images; None for the uniform
    """

    others: Sequence[Posterior]
    prior: LogDensity | None

    def __call__(self, T: Array) -> Array:
        """At poses (n, 4, 4), touching the first sensor or not."""
        density = np.zeros(len(T)) if self.prior is None else self.prior(T)
        return density + np.sum([other.log_density(T) for other in self.others], axis=0)


def over_images(prior: GaussianPrior, symmetry: Symmetry) -> GaussianPrior:
    """``prior`` widened by the spacing of the images under a ``symmetry`` at which it is evaluated."""
    free = np.zeros((3, 3)) if symmetry.axis is None else np.outer(symmetry.axis, symmetry.axis) / _TURNS**2
    if symmetry.kind == "sphere":
        free = np.eye(3) / _ROTATIONS**2
    about_centre = np.vstack([np.eye(3), hat(symmetry.centre)])
    return GaussianPrior(prior.T, prior.covariance + about_centre @ free @ about_centre.T * (2 * np.pi) ** 2 / 12)


def checked(density: Any, n: int) -> Array:
    """The result of a user's function for ``n`` poses, as log densities (n,).

    Raises
    ------
    InputError
        Of another shape.
    """
    out = np.asarray(density, float)
    if out.shape != (n,):
        raise InputError(
            f"prior: the function was given {n} poses and returned shape {out.shape}; return one log density a pose, ({n},)"
        )
    return out


def images(symmetry: Symmetry) -> Array:
    """Elements (m, 4, 4) of ``symmetry`` at which a prior that is a function is evaluated."""
    return symmetry.sampled(_TURNS if symmetry.axis is not None else _ROTATIONS)


def likeliest_images(density: LogDensity, T: Array, posterior: Posterior) -> Array:
    """The images (n, 4, 4) under the object's symmetry of poses ``T`` (n, 4, 4), in the frame of ``posterior``, where ``density``
    is largest, of those that the approach allows; the first where several tie."""
    symmetry, space, T_sensor_frame = posterior.mesh.symmetry, posterior.space, inverse(posterior.T_frame_sensor)
    assert symmetry is not None

    def value(T: Array) -> Array:
        each = checked(density(T), len(T))
        return np.where(space.approaches(T_sensor_frame @ T) & ~np.isnan(each), each, -np.inf)

    images = T[:, None] @ symmetry.sampled()
    each = value(images.reshape(-1, 4, 4)).reshape(images.shape[:2])
    best, row = each.argmax(1), np.arange(len(T))
    images, most = images[row, best], each[row, best]
    axes = np.eye(3) if symmetry.kind == "sphere" else [] if symmetry.axis is None else [symmetry.axis]
    for step in _CLOSER:
        for rotvec in [sign * step * axis for axis in axes for sign in (-1, 1)]:
            turned = images @ about(Rotation.from_rotvec(rotvec).as_matrix(), symmetry.centre)
            found = value(turned)
            better = found > most
            images[better], most[better] = turned[better], found[better]
    return images
