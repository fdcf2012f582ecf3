"""What a repair did to the surface, measured: how far each lies from the other, what was filled, and whether it is a solid."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pymeshlab
import trimesh
from meshprep import polygons
from meshprep.repair import Work
from meshprep.surface import Array, Surface

from geomtact.geometry.mesh import Mesh

SAMPLES = 60_000  # points on each surface, besides its corners and the middles of its faces


@dataclass(frozen=True, eq=False)
class Proof:
    """How two surfaces differ. Lengths in their unit.

    Attributes
    ----------
    to_input, to_output : largest and mean distance of the output from the input, away from filled holes; and the other
        way, but for what lies inside the output, where no sensor gets
    worst : (3,) where the larger of both is
    buried : share of the input's area that lies inside the output
    kept, new : vertices of the output that are the input's to the last bit, and all others
    deviation : (F,) of the output's faces from the input, for the picture
    """

    to_input: tuple[float, float]
    to_output: tuple[float, float]
    worst: list[float]
    buried: float
    kept: int
    new: int
    deviation: Array

    @property
    def largest(self) -> float:
        return max(self.to_input[0], self.to_output[0])


def prove(before: Surface, work: Work) -> Proof:
    """How ``work.surface`` differs from ``before``, and from the polygons of the file where ``before`` has them."""
    after = Surface(work.surface.vertices, work.surface.faces)  # as it is written: triangles
    ours, theirs = _points(after), _left_of(_points(before), work.dropped, before.size)
    off = _distance(before, ours)
    patches = Surface(work.patches.reshape(-1, 3), np.arange(3 * len(work.patches)).reshape(-1, 3))
    filled = _distance(patches, ours) < 1e-6 * after.size if len(work.patches) else np.zeros(len(ours), bool)
    back = _distance(after, theirs)
    inside = (back > 1e-5 * after.size) & after.encloses(theirs)
    off, back = np.where(filled, 0.0, off), np.where(inside, 0.0, back)
    worst = ours[off.argmax()] if off.max() >= back.max() else theirs[back.argmax()]
    exact = {tuple(v) for v in before.vertices.tolist()}
    kept = sum(tuple(v) in exact for v in after.vertices.tolist())
    deviation = _distance(before, after.corners.mean(1))
    return Proof(
        (float(off.max()), float(off.mean())),
        (float(back.max()), float(back.mean())),
        worst.tolist(),
        float(inside.mean()),
        kept,
        len(after.vertices) - kept,
        deviation,
    )


def distances(a: Surface, b: Surface) -> Array:
    """Distance (n,) of points all over ``a`` from the surface of ``b``."""
    return _distance(b, _points(a))


def is_solid(path: Path) -> str | None:
    """What trimesh's own checks, of the file as any program reads it, find wrong; None where they pass."""
    with open(path, "rb") as file:
        mesh = trimesh.load_mesh(file, file_type=path.suffix[1:])
    for passed, what in (
        (mesh.is_watertight, "not watertight"),
        (mesh.is_winding_consistent, "its faces do not agree about the outside"),
        (mesh.volume > 0 and mesh.is_volume, "it encloses no volume"),
    ):
        if not passed:
            return what
    return None


def _points(surface: Surface) -> Array:
    """Corners, the middles of faces, and points spread evenly (n, 3), but where there is no area; of the polygons where there
    are some."""
    if _has_polygons(surface):
        return polygons.points_on(surface.polygons, SAMPLES)
    spread = Mesh(surface.vertices, surface.faces, "", "").surface_points(SAMPLES)
    corners = surface.corners[surface.areas > polygons.NO_AREA * surface.size**2]
    return np.concatenate([corners.reshape(-1, 3), corners.mean(1), spread])


def _has_polygons(surface: Surface) -> bool:
    return surface.polygons is not None and int(surface.polygons.sizes.max()) > 3


def _left_of(points: Array, dropped: list[Surface], size: float) -> Array:
    """``points`` (n, 3) without those of bodies that were dropped on purpose."""
    for body in dropped:
        points = points[_distance(body, points) > 1e-6 * size]
    return points


def _distance(surface: Surface, points: Array) -> Array:
    """Distance (n,) of ``points`` (n, 3) from ``surface``: from the polygons where there are some, else by pymeshlab, in double
    precision: exact on long thin faces too."""
    if _has_polygons(surface):
        return polygons.distance(surface, points)
    meshes = pymeshlab.MeshSet(verbose=False)
    meshes.add_mesh(pymeshlab.Mesh(points - surface.middle))
    meshes.add_mesh(pymeshlab.Mesh(surface.vertices - surface.middle, surface.faces))
    far = pymeshlab.PureValue(2 * surface.size + float(np.ptp(points, axis=0).max()))
    meshes.compute_scalar_by_distance_from_another_mesh_per_vertex(
        measuremesh=0, refmesh=1, signeddist=False, maxdist=far
    )
    return np.array(meshes.mesh(0).vertex_scalar_array(), float)
