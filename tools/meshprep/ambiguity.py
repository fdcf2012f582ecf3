"""How ambiguous a touch is, all over a part: at how many other places a sensor would show the same contact."""

from __future__ import annotations

import numpy as np
from meshprep import Refused
from meshprep.picture import draw_values
from meshprep.surface import Array, Surface
from scipy.spatial import cKDTree

from geomtact import Localizer
from geomtact.contact_space.space import ContactSpace
from geomtact.geometry.approach import facing
from geomtact.geometry.mesh import Mesh
from geomtact.se3 import transform

_POSES = 150_000  # of the index
_TOUCHES = 400  # all over the object


def draw_ambiguity(mesh: Mesh, sensor: str) -> bytes:
    """A PNG: the object from two sides, coloured by what a touch there, straight onto the surface, is expected to gain [nats]."""
    where, told = ambiguity(mesh, sensor)
    if not len(where):
        raise Refused(f"{mesh.name}: no touch straight onto its surface has contact on {sensor}")
    surface = Surface(1e3 * mesh.vertices, mesh.faces.astype(np.int64))
    tree = cKDTree(1e3 * where)

    def value(points: Array) -> Array:
        """Of the touches around, the nearer the more."""
        distance, index = tree.query(points, k=range(1, min(4, len(where)) + 1))
        near = 1 / (distance + 0.01 * surface.size)
        return np.asarray((near * told[index]).sum(1) / near.sum(1))

    words = "information of a touch there [nats]"
    return draw_values(mesh.name, "mm", surface, value, float(told.min()), float(told.max()), words)


def ambiguity(mesh: Mesh, sensor: str, touches: int = _TOUCHES, max_poses: int = _POSES) -> tuple[Array, Array]:
    """Points (n, 3) [m] all over ``mesh`` where a sensor that comes straight onto the surface touches it, and the nats (n,) its
    posterior then expects to gain: the fewer, the more other places show the same contact."""
    localizer = Localizer.prepare(mesh, sensor=sensor, max_poses=max_poses)
    space: ContactSpace = localizer.space
    points, normals = mesh.sample_surface(touches, seed=0)
    R = facing(normals)
    T, ok = space.settle(transform(R, -(R @ points[..., None])[..., 0]), 0.5 * space.sensor.max_penetration)
    told = np.full(touches, np.nan)
    for i in np.flatnonzero(ok):
        mask = localizer.simulate(T[i]).mask
        if mask.any():
            told[i] = -localizer.localize(mask, "mask", effort="fast").entropy_nats
    felt = np.isfinite(told)
    return points[felt], told[felt]
