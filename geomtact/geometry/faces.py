"""Plane faces that an object can be put down on: the directions about which a little tilt changes much of the contact.

Triangles are gathered by their normals (the extended Gaussian image, Horn 1984), then by the plane in which they lie.
"""

from __future__ import annotations

from dataclasses import dataclass

import healpix
import numpy as np
from numpy.typing import NDArray

from geomtact.geometry.mesh import Mesh
from geomtact.se3 import Array

_NSIDE = 64  # HEALPix pixels of normals, about a degree wide
_SAME_NORMAL = np.cos(np.deg2rad(0.5))
_SAME_PLANE = 2e-5  # m: what lies no higher or lower touches as one face
_LEAST = 0.002  # share of the surface from which a face counts


@dataclass(frozen=True, eq=False)
class Face:
    """One plane face of an object, or several in one plane.

    Attributes
    ----------
    normal : (3,) outward unit vector, object frame
    area : [m^2]
    half_width, half_length : half the sides of a rectangle whose area is spread alike, the shorter and the longer [m]: of its
        standard deviations along its two main directions sqrt(3) times each
    """

    normal: Array
    area: float
    half_width: float
    half_length: float


def plane_faces(mesh: Mesh) -> list[Face]:
    """The plane faces of ``mesh`` that make up a share of its surface that counts, the largest first."""
    areas, normals = mesh.areas, mesh.normals
    least = _LEAST * areas.sum()
    some = np.flatnonzero(areas > 0)
    pixel = np.full(len(areas), -1)
    pixel[some] = healpix.vec2pix(_NSIDE, *normals[some].T, nest=True)
    total = np.bincount(pixel[some], areas[some])
    found: list[Face] = []
    met: list[Array] = []
    for p in np.flatnonzero(total >= least):
        mine = np.flatnonzero(pixel == p)
        normal = normals[mine[areas[mine].argmax()]]
        # faces whose normals straddle pixels are met once
        if any(normal @ other > _SAME_NORMAL for other in met):
            continue
        met.append(normal)
        flat = np.flatnonzero(normals @ normal > _SAME_NORMAL)
        height = mesh.vertices[mesh.faces[flat]].mean(1) @ normal
        order = np.argsort(height, kind="stable")
        planes = np.split(flat[order], np.flatnonzero(np.diff(height[order]) > _SAME_PLANE) + 1)
        found += [_face(mesh, plane) for plane in planes if areas[plane].sum() >= least]
    return sorted(found, key=lambda face: -face.area)


def _face(mesh: Mesh, plane: NDArray[np.integer]) -> Face:
    """The face that triangles ``plane`` (n,) make up."""
    corners, areas = mesh.vertices[mesh.faces[plane]], mesh.areas[plane]
    middles = corners.mean(1)
    normal = areas @ mesh.normals[plane]
    normal /= np.linalg.norm(normal)
    along = np.linalg.svd(normal[None])[2][1:].T
    origin = np.average(middles, axis=0, weights=areas)
    x, m = (corners - origin) @ along, (middles - origin) @ along
    # the mean of x x^T over a triangle of corners a, b, c is (a a^T + b b^T + c c^T + 9 m m^T) / 12, m its centroid
    square = (np.einsum("tki,tkj->tij", x, x) + 9 * np.einsum("ti,tj->tij", m, m)) / 12
    width, length = np.sqrt(3 * np.maximum(np.linalg.eigvalsh(np.average(square, axis=0, weights=areas)), 0))
    return Face(normal, float(areas.sum()), float(width), float(length))
