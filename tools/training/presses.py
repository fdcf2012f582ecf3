"""What the mask network learns from: random objects pressed into gels of any thickness, with the contact known."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from geomtact.geometry.mesh import Mesh
from geomtact.progress import Progress
from geomtact.se3 import transform
from geomtact.sensing.cast import Caster
from geomtact.sensing.elastic import elastic_contact
from geomtact.sensing.mask_network import CHANNELS, side_shape, to_side
from geomtact.sensing.sensor import Sensor
from geomtact.training.dataset import made_once
from tools.training.procedural import random_object
from tools.training.tactile_images import random_sight

SHAPE = (120, 160)  # of what the camera shows
READINGS = 4  # of each press
PITCH = 0.125e-3  # m
PRESSES = 12  # of each object
SIZES = (0.5, 4.0)  # longest side of an object, in long sides of the window
BALLS, RADII = 0.3, (1.5e-3, 12e-3)  # share of balls among the objects, and their radius [m]
FLAT, TILT = 0.35, 0.05  # share of presses on a face, and by how much that is tilted [rad]
EDGES, SHARP = 0.35, 0.3  # share of presses on a sharp edge, and by how much its faces turn there, at least [rad]
DEPTHS = (0.3e-3, 3.5e-3)  # m
THICKNESS = (0.5e-3, 30e-3)  # of the gel [m]; a thin one hardly sinks beside the object
CURVED, BULGES = (
    0.5,
    (25e-3, 120e-3),
)  # share of gels that bulge towards the object, and the radius of their membrane [m]
_AROUND = 30  # px beyond what is shown, in which an object goes on
_TRIES = 6
_LEAST = 60  # px of contact


@dataclass(frozen=True)
class Presses:
    """Presses of one object.

    Attributes
    ----------
    seen : (n, ``READINGS``, ``CHANNELS``, h, w) float16, what the network sees of tactile images under different lamps
    contact : (n, h, w) float16, share of each pixel in contact
    """

    seen: NDArray[np.float16]
    contact: NDArray[np.float16]


def make_presses(
    folder: Path, n: int, seed: int, progress: Progress | None = None, processes: int = 2
) -> list[Presses]:
    """Of ``n`` objects, in order; those that ``folder`` holds already are read."""
    found = made_once(folder, n, partial(press_part, seed=seed), Presses, "pressing parts", progress, processes)
    return [presses for presses in found if len(presses.seen)]


def press_part(i: int, seed: int) -> Presses:
    """Presses of the object number ``i``: turned any way, anywhere in the window, log-uniform in depth, in the gel's thickness
    and in the radius of those that bulge; those that lamps do not show are left out."""
    rng = np.random.default_rng([seed, 31, i])
    h, w = (n + 2 * _AROUND for n in SHAPE)
    sensor = Sensor(f"{w} x {h}", (w, h), (PITCH, PITCH), 0.0, DEPTHS[1])
    part = _part(rng, w * PITCH)
    caster = Caster(part.vertices, part.faces, threads=1)
    y, x = ((np.arange(n) - (n - 1) / 2) * PITCH for n in (h, w))
    shown = np.s_[_AROUND:-_AROUND, _AROUND:-_AROUND]
    sights: list[list[Any]] = []
    contacts: list[NDArray[np.float32]] = []
    for _ in range(_TRIES * PRESSES):
        if len(sights) == PRESSES:
            break
        at = rng.uniform(-0.5, 0.5, 2) * PITCH * SHAPE[::-1]
        T = transform(_turned(part, rng), [*at, w * PITCH * SIZES[1]])
        bulge = (x**2 + y[:, None] ** 2) / (2 * np.exp(rng.uniform(*np.log(BULGES)))) * (rng.random() < CURVED)
        depth = caster.depths(sensor, T[None], (h, w))[0] - bulge
        deepest = float(depth.max())
        if not np.isfinite(deepest):
            continue
        depth = depth - deepest + np.exp(rng.uniform(*np.log(DEPTHS)))
        contact, height = elastic_contact(depth, (PITCH, PITCH), float(np.exp(rng.uniform(*np.log(THICKNESS)))))
        if contact[shown].sum() < _LEAST:
            continue
        readings = [random_sight(height[shown] / PITCH, rng, bulge[shown] / PITCH) for _ in range(READINGS)]
        if all(reading is not None for reading in readings):
            sights.append(readings)
            contacts.append(to_side(contact[shown].astype(np.float32)))
    h, w = side_shape(SHAPE)
    return Presses(
        np.reshape(sights, (len(sights), READINGS, CHANNELS, h, w)).astype(np.float16),
        np.reshape(contacts, (len(sights), h, w)).astype(np.float16),
    )


def _turned(part: Mesh, rng: np.random.Generator) -> NDArray[np.float64]:
    """A rotation (3, 3): any, or with a face or a sharp edge of the object nearly flat on the membrane."""
    on = rng.random()
    if on < FLAT:
        towards = _face_normal(part, rng)
    elif on < FLAT + EDGES:
        towards = _edge_normal(part, rng)
    else:
        return Rotation.random(random_state=int(rng.integers(1 << 31))).as_matrix()
    down = Rotation.align_vectors([[0.0, 0.0, -1.0]], [towards])[0]
    tilt = Rotation.from_rotvec([*(rng.normal(size=2) * TILT), 0.0])
    return (tilt * Rotation.from_rotvec([0.0, 0.0, rng.uniform(0, 2 * np.pi)]) * down).as_matrix()


def _face_normal(part: Mesh, rng: np.random.Generator) -> NDArray[np.float64]:
    """The outward normal (3,) of a face, drawn by area."""
    a, b, c = np.asarray(part.vertices, float)[np.asarray(part.faces).T]
    normals = np.cross(b - a, c - a)
    area = np.linalg.norm(normals, axis=1)
    return np.asarray(normals[rng.choice(len(area), p=area / area.sum())])


def _edge_normal(part: Mesh, rng: np.random.Generator) -> NDArray[np.float64]:
    """A direction (3,) between the normals of the two faces at a sharp edge, drawn by length; a face's normal without any."""
    mesh = trimesh.Trimesh(part.vertices, part.faces)
    sharp = mesh.face_adjacency_convex & (mesh.face_adjacency_angles > SHARP)
    if not sharp.any():
        return _face_normal(part, rng)
    ends = mesh.vertices[mesh.face_adjacency_edges[sharp]]
    length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    one, other = mesh.face_normals[mesh.face_adjacency[sharp][rng.choice(len(length), p=length / length.sum())]]
    share = rng.random()
    return np.asarray(share * one + (1 - share) * other)


def _part(rng: np.random.Generator, window: float) -> Mesh:
    """A ball, or a random object, of a size that suits a window so long [m]."""
    if rng.random() < BALLS:
        ball = trimesh.creation.icosphere(subdivisions=5, radius=np.exp(rng.uniform(*np.log(RADII))))
        return Mesh(ball.vertices, ball.faces, "ball", "m")
    return random_object(int(rng.integers(1 << 31)), window * float(np.exp(rng.uniform(*np.log(SIZES)))))
