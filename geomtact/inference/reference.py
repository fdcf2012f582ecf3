"""Which image of a pose under the object's symmetry is reported: the one nearest to the prior, or to the frame before."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from geomtact.contact_space.space import ContactSpace
from geomtact.geometry.distance import PoseDistance, mode_radius
from geomtact.se3 import Array, inverse, transform


@dataclass(frozen=True, eq=False)
class Reference:
    """Poses that a prior or the frame before holds likely.

    All images of a pose under the object's symmetry are one placement, which no contact distinguishes. But a program that follows
    the object needs the image that agrees with the pose that it had before.

    Attributes
    ----------
    poses : (m, 4, 4) in the posterior's frame
    log_mass : (m,) of each, up to a constant
    """

    poses: Array
    log_mass: Array

    def nearest(self, T: Array, space: ContactSpace, T_frame_sensor: Array) -> Array:
        """The images (n, 4, 4) of poses ``T`` (n, 4, 4), in the sensor frame, that are nearest to the reference.

        That is, to its poses within the radius of a mode, or to the nearest one where there are none. The distance is the mean
        square over the surface, and over these poses by their mass. Images that the approach rules out do not count.
        """
        symmetry = space.mesh.symmetry
        if symmetry is None or symmetry.kind == "none" or not len(T):
            return T
        distance, radius = PoseDistance(space.mesh), mode_radius(space.mesh)
        expected = inverse(T_frame_sensor) @ self.poses
        rotations = np.stack([self._mean(t, expected, distance, radius, symmetry.kind == "sphere") for t in T])
        images = np.concatenate([distance.aligned(R, t[None]) for R, t in zip(rotations, T, strict=True)])
        for i in np.flatnonzero(~space.approaches(images)):
            every = T[i] @ symmetry.sampled()
            every = every[space.approaches(every)]
            turned = (every - rotations[i])[:, :3, :3] @ (distance.points - space.mesh.centre).T
            images[i] = every[np.square(turned).sum((1, 2)).argmin()]
        return _touching(images, T, space)

    def _mean(self, T: Array, expected: Array, distance: PoseDistance, radius: float, project: bool) -> Array:
        """The mean (4, 4) of the rotations that are expected of the pose ``T`` (4, 4), by mass.

        Mean square distances to the poses differ from those to this mean by a constant, unless it is projected onto a rotation.
        """
        near = distance.within(T, expected, radius)
        if not near.any():
            near[distance.mean(T, expected).argmin()] = True
        mass = np.exp(self.log_mass[near] - self.log_mass[near].max())
        R = np.average(expected[near, :3, :3], axis=0, weights=mass)
        return transform(Rotation.from_matrix(R).as_matrix() if project else R, np.zeros(3))


def _touching(images: Array, T: Array, space: ContactSpace) -> Array:
    """``images`` (n, 4, 4) moved along z to where they touch as ``T`` (n, 4, 4) do: a mesh is as symmetric as it is fine."""
    depth = space.penetration(T)
    lost = np.isfinite(depth) & ~np.isfinite(space.penetration(images))
    if lost.any():
        images[lost] = space.settle(images[lost], depth[lost])[0]
        lost[lost] = ~np.isfinite(space.penetration(images[lost]))
    return np.where(lost[:, None, None], T, images)
