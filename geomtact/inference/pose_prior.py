"""The density of the pose before an image, at any pose that touches the sensor."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from geomtact.contact_space.contact_maps import ContactMaps, Placements, centring_std, located
from geomtact.contact_space.index import Index
from geomtact.geometry.symmetry import Symmetry
from geomtact.inference.gaussian_prior import GaussianPrior, given_turns
from geomtact.inference.student import log_volume_of_turns
from geomtact.scoring.contact_likelihood import ContactQuery
from geomtact.se3 import Array, exp, inverse, left_jacobian, log, transform

ALIGNED = 0.7  # share of the draws whose centre is aligned


@dataclass(frozen=True, eq=False)
class CellPrior:
    """A prior that is known in the cells of ``index``, by its log density (N,), normalised."""

    index: Index
    in_cells: NDArray[np.floating]

    def log_density(self, poses: Placements, depth: Array) -> Array:
        """Log density (n,), relative to the uniform, at ``poses`` (n,) that press ``depth`` (n,) [m] deep."""
        rows = self.index.level_of(poses.place, depth) * self.index.places + poses.place
        return np.asarray(self.in_cells[rows], float)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """All that makes it again, beside the index."""
        return {"log_prior": self.in_cells}


@dataclass(frozen=True, eq=False)
class NormalPrior:
    """A Gaussian prior of the pose of the object of ``index``, in the sensor's frame.

    All images of a pose under the object's symmetry count alike that the approach allows. Of a turn about an axis of symmetry its
    marginal distribution counts, which is exact while shifts are small against the object.

    Attributes
    ----------
    in_cells : log density (N,) in the cells, normalised
    """

    index: Index
    in_cells: NDArray[np.floating]
    gaussian: GaussianPrior

    def log_density(self, T: Array) -> Array:
        """Log density (n,), relative to the uniform, at poses ``T_sensor_object`` (n, 4, 4), up to a constant."""
        allowed, images = self._images(T)
        each = np.stack(
            [np.where(ok, self.of_image(image), -np.inf) for ok, image in zip(allowed, images, strict=True)]
        )
        return np.asarray(np.logaddexp.reduce(each, 0) - np.log(np.maximum(allowed.sum(0), 1)))

    def own_density(self, T: Array) -> Array:
        """The part (n,) of :meth:`log_density` that images ``T`` (n, 4, 4) themselves have, not those under the symmetry."""
        allowed, _ = self._images(T)
        return np.where(allowed[0], self.of_image(T) - np.log(np.maximum(allowed.sum(0), 1)), -np.inf)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """All that makes it again, beside the index."""
        return {"log_prior": self.in_cells, "prior_T": self.gaussian.T, "prior_covariance": self.gaussian.covariance}

    def draw(self, n: int, query: ContactQuery, rng: np.random.Generator) -> tuple[Placements, Array, Array, Array]:
        """``n`` poses, how deep they press (n,) [m], the log of the uniform density over that by which they were drawn (n,), and
        their rotations (n, 3, 3) as they were drawn, for which those of the poses may be images.

        Turns are the prior's. So are some of the object's centres; the others are near where the contact's centroid is that of
        ``query``. Depths are uniform. A contact is cut for each.
        """
        index, deepest = self.index, self.index.sensor.max_penetration
        rotation, expected, spread, log_ratio = self._turned(n, rng)
        root = np.linalg.cholesky(spread)
        # where the contact is cut; given that, centres have a known density
        middle = expected + np.einsum("nij,nj->ni", root, rng.normal(size=(n, 2)))
        at = transform(rotation, np.column_stack([middle, np.zeros(n)]) - rotation @ index.mesh.centre)
        poses, _ = located(index, at)
        poses = replace(poses, reach=index.height[0, poses.place].astype(float) + index.resolution.penetrations[0])
        found = ContactMaps.of(index).compare(query.samples, query.area, poses)
        touches = np.isfinite(found.reach)
        # normal about what the prior and the observed contact say together
        width = centring_std(index.sensor)
        share = spread @ np.linalg.inv(spread + width**2 * np.eye(2))
        observed = middle + np.where(touches[:, None], query.centroid[:2] - found.centroid, 0.0)
        about = expected + np.einsum("nij,nj->ni", share, observed - expected)
        narrow = np.linalg.cholesky(width**2 * share)
        known = np.where(touches, ALIGNED, 0.0)
        aligned = rng.random(n) < known
        off = np.einsum("nij,nj->ni", np.where(aligned[:, None, None], narrow, root), rng.normal(size=(n, 2)))
        centre = np.where(aligned[:, None], about, expected) + off
        density = (1 - known) * _normal(centre - expected, root) + known * _normal(centre - about, narrow)
        log_ratio -= np.log(np.maximum(density, 1e-300)) - np.log(deepest)
        turn = index.rotation[poses.place].astype(np.int64)
        poses = replace(poses, centre=centre, place=index.place_of(turn, centre))
        log_ratio += np.log(np.maximum(index.uniform_density(at), 1e-300))
        return poses, deepest * rng.random(n), log_ratio, rotation

    def _turned(self, n: int, rng: np.random.Generator) -> tuple[Array, Array, Array, Array]:
        """``n`` rotations (n, 3, 3) from the prior; where over the sensor the centre is expected then (n, 2) [m], and its
        covariance (n, 2, 2); and minus the log density (n,) of the rotations per rad, -inf of turns by more than half a turn."""
        k, base = len(self._axes), self._centred
        turns = self._covariance[:k, :k]
        y = rng.normal(size=(n, k)) @ np.linalg.cholesky(turns).T
        log_ratio = 0.5 * np.einsum("ni,ni->n", y, np.linalg.solve(turns, y.T).T)
        angle = np.linalg.norm(y, axis=1)
        log_ratio += 0.5 * np.linalg.slogdet(2 * np.pi * turns)[1] + log_volume_of_turns(angle, k)
        gain, left = given_turns(self._covariance, k)
        moved = base @ exp(np.concatenate([y @ self._axes, y @ gain.T], 1))
        along = base[:3, :3] @ left_jacobian(y @ self._axes)
        spread = (along @ left @ np.swapaxes(along, 1, 2))[:, :2, :2]
        return moved[:, :3, :3], moved[:, :2, 3], spread, np.where(angle <= np.pi, log_ratio, -np.inf)

    def of_image(self, T: Array) -> Array:
        """Log density (n,) of the Gaussian at ``T`` (n, 4, 4), without the images under the symmetry."""
        middle = self.index.mesh.centre
        moved = inverse(self._centred) @ transform(T[:, :3, :3], T[:, :3, :3] @ middle + T[:, :3, 3])
        if self._symmetry.axis is not None:
            # without the turn about the axis
            turn, axis = Rotation.from_matrix(moved[:, :3, :3]).as_quat(), self._symmetry.axis
            angle = 2 * np.arctan2(turn[:, :3] @ axis, turn[:, 3])
            moved[:, :3, :3] = moved[:, :3, :3] @ Rotation.from_rotvec(-angle[:, None] * axis).as_matrix()
        elif not len(self._axes):
            moved[:, :3, :3] = np.eye(3)
        xi = log(moved)
        x = np.concatenate([xi[:, :3] @ self._axes.T, xi[:, 3:]], 1)
        return np.asarray(-0.5 * np.einsum("ni,ni->n", x, np.linalg.solve(self._covariance, x.T).T))

    def _images(self, T: Array) -> tuple[NDArray[np.bool_], Array]:
        """Whether the approach allows each image (g, n) of ``T`` (n, 4, 4), itself first, and the images (g, n, 4, 4)."""
        images = T @ self._symmetry.elements[:, None]
        if self.index.space.cones is None:
            return np.ones(images.shape[:2], bool), images
        return np.stack([self.index.space.approaches(image) for image in images]), images

    @property
    def _symmetry(self) -> Symmetry:
        assert self.index.mesh.symmetry is not None
        return self.index.mesh.symmetry

    @property
    def _centred(self) -> Array:
        """The prior's pose (4, 4) of the object with its centre as the origin."""
        return transform(
            self.gaussian.T[:3, :3], self.gaussian.T[:3, :3] @ self.index.mesh.centre + self.gaussian.T[:3, 3]
        )

    @cached_property
    def _axes(self) -> Array:
        """Axes (k, 3), object frame, of turns that are no symmetries."""
        return self._symmetry.motions[:-3, :3]

    @cached_property
    def _covariance(self) -> Array:
        """(k + 3, k + 3) of turns about these axes and of shifts of the object's centre, object frame [rad, m]."""
        k = len(self._axes)
        along = np.zeros((k + 3, 6))
        along[:k, :3], along[k:, 3:] = self._axes, np.eye(3)
        return np.asarray(along @ self.gaussian.covariance_about(self.index.mesh.centre) @ along.T)


PosePrior = CellPrior | NormalPrior


def prior_at_poses(index: Index, in_cells: NDArray[np.floating], prior: Any, T_frame_sensor: Array) -> PosePrior:
    """``prior``, as of ``Localizer.localize``, which is known in the cells: as it is at any pose where it is a Gaussian. On known
    faces, whose rotations no Gaussian has, it is that of the cells."""
    if isinstance(prior, GaussianPrior) and not index.space.on_known_faces:
        return NormalPrior(index, in_cells, GaussianPrior(inverse(T_frame_sensor) @ prior.T, prior.covariance))
    return CellPrior(index, in_cells)


def pose_prior_of(index: Index, arrays: Mapping[str, NDArray[Any]]) -> PosePrior | None:
    """Inverse of ``arrays``; None where they hold none.

    Raises
    ------
    KeyError, ValueError, GeomtactError
        They are not what it gives, or of another grid.
    """
    if "log_prior" not in arrays:
        return None
    if len(arrays["log_prior"]) != len(index):
        raise ValueError("a prior that is not of its grid")
    if "prior_T" not in arrays:
        return CellPrior(index, arrays["log_prior"])
    return NormalPrior(index, arrays["log_prior"], GaussianPrior(arrays["prior_T"], arrays["prior_covariance"]))


def _normal(off: Array, root: NDArray[Any]) -> Array:
    """Density (n,) of shifts (n, 2) of covariance ``root root^T`` (n, 2, 2)."""
    x = np.linalg.solve(root, off[..., None])[..., 0]
    return np.asarray(np.exp(-0.5 * np.square(x).sum(1)) / (2 * np.pi * root[:, 0, 0] * root[:, 1, 1]))
