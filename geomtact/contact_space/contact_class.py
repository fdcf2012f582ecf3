"""What kind of contact a touch is, by the directions in which the surface faces where it lies below the membrane.

flat: one direction. edge: two, with a ridge or a step between them. corner: three or more. cylinder: a smooth curve, round
one axis or two. texture: three patches or more. The directions are those of the mesh's faces that the camera's rays meet,
joined wherever two of them differ by less than a tessellated curve's facets do.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse.csgraph import connected_components

from geomtact.contact_space.space import ContactSpace
from geomtact.se3 import Array
from geomtact.sensing.patches import patches

CLASSES = ("flat", "edge", "corner", "cylinder", "texture")
_SHAPE = 96  # rays along the window's longer side
_FACET = np.radians(20)  # between neighbouring facets of one smooth surface, at most
_FLAT = np.radians(6)  # by which the directions of a flat contact spread, rms
_SHARE = 0.02  # of the contact that a direction has to hold to count


def contact_class(space: ContactSpace, T: ArrayLike) -> str:
    """One of ``CLASSES`` for the rigid contact at ``T`` (4, 4)."""
    sensor = space.sensor
    wide, high = sensor.half_window
    scale = _SHAPE / max(wide, high)
    shape = (max(8, round(high * scale)), max(8, round(wide * scale)))
    depth = space.caster.depths(sensor, np.asarray(T, float)[None], shape)[0]
    touched = depth > 0
    if len(patches(touched, sensor.pixel_area(shape))) >= 3:
        return "texture"
    normal, count = _directions(space, np.asarray(T, float), shape, touched)
    return _of_directions(normal, count)


def _of_directions(normal: Array, count: NDArray[np.int64]) -> str:
    """The class of a contact whose faces have directions ``normal`` (n, 3), met by ``count`` (n,) rays each."""
    near = np.arccos(np.clip(normal @ normal.T, -1, 1)) < _FACET
    n, label = connected_components(near, directed=False)
    held = np.bincount(label, count, minlength=n) / max(count.sum(), 1)
    large = np.flatnonzero(held >= _SHARE)
    if len(large) >= 3:
        return "corner"
    if len(large) == 2:
        return "edge"
    mean = count @ normal
    mean /= max(float(np.linalg.norm(mean)), 1e-12)
    spread = np.sqrt(np.average(np.arccos(np.clip(normal @ mean, -1, 1)) ** 2, weights=count)) if count.sum() else 0.0
    return "flat" if spread < _FLAT else "cylinder"


def _directions(
    space: ContactSpace, T: Array, shape: tuple[int, int], touched: NDArray[np.bool_]
) -> tuple[Array, NDArray[np.int64]]:
    """Directions (n, 3) of the faces met where ``touched`` (h, w), and how many rays met each direction (n,)."""
    face = space.caster.faces_met(space.sensor, T, shape)[touched]
    face = face[face >= 0]
    mesh = space.mesh
    corners = mesh.vertices[mesh.faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal = cross / np.maximum(np.linalg.norm(cross, axis=1, keepdims=True), 1e-30)
    # facets of one plane are one direction
    unique, inverse = np.unique(np.round(normal[face], 3), axis=0, return_inverse=True)
    return unique / np.maximum(np.linalg.norm(unique, axis=1, keepdims=True), 1e-30), np.bincount(inverse.ravel())
