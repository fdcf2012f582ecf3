"""Bare shapes whose contacts leave given directions unobservable, which registration must not invent."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import trimesh

from geomtact.geometry.mesh import Mesh

MM = 1e-3


def _plate() -> trimesh.Trimesh:
    return trimesh.creation.box((60 * MM, 45 * MM, 20 * MM))


def _rod() -> trimesh.Trimesh:
    return trimesh.creation.cylinder(8 * MM, 60 * MM, sections=128)


def _sphere() -> trimesh.Trimesh:
    return trimesh.creation.icosphere(5, 12 * MM)


def _groove() -> trimesh.Trimesh:
    """A block whose top is cut along its length by a groove 5 mm wide and 8 mm deep."""
    outer, inner, low, floor, top = 14.5, 2.5, -10.0, 2.0, 10.0
    profile = np.array(
        [(-outer, low), (-inner, low), (inner, low), (outer, low)]
        + [(outer, floor), (outer, top), (inner, top), (inner, floor)]
        + [(-inner, floor), (-inner, top), (-outer, top), (-outer, floor)]
    )
    quads = [(0, 1, 8, 11), (1, 2, 7, 8), (2, 3, 4, 7), (7, 4, 5, 6), (11, 8, 9, 10)]
    cap = np.array([(q[0], q[i], q[i + 1]) for q in quads for i in (1, 2)])
    n = len(profile)
    ends = np.repeat([-30.0, 30.0], n)
    vertices = np.column_stack([ends, np.tile(profile, (2, 1))])
    along = [(i, i + n, (i + 1) % n) for i in range(n)] + [((i + 1) % n, i + n, (i + 1) % n + n) for i in range(n)]
    faces = np.concatenate([cap[:, ::-1], cap + n, np.array(along)[:, ::-1]])
    return trimesh.Trimesh(vertices * MM, faces, process=False)


def _cone() -> trimesh.Trimesh:
    return trimesh.creation.cone(15 * MM, 40 * MM, sections=128)


SHAPES: dict[str, Callable[[], trimesh.Trimesh]] = {
    "plate": _plate,
    "rod": _rod,
    "sphere": _sphere,
    "groove": _groove,
    "cone": _cone,
}


def shape(name: str) -> Mesh:
    """One of ``SHAPES`` as a mesh."""
    made = SHAPES[name]()
    return Mesh(np.asarray(made.vertices), np.asarray(made.faces), name, "m")
