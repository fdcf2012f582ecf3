"""Worlds in which an object is touched otherwise than a localizer expects: another mesh, sensor or noise, and chosen contacts."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from geomtact.contact_space.contact_class import contact_class
from geomtact.contact_space.space import ContactSpace
from geomtact.contact_space.touch import LEAST_CONTACT, simulate_mask, spoilt
from geomtact.geometry.mesh import Mesh
from geomtact.se3 import Array
from geomtact.sensing.noise import Noise
from geomtact.sensing.patches import patches
from geomtact.sensing.sensor import Sensor

TRIED = 500  # touches, at most, for each one that is wanted
_KNOBS = 12  # that an object has and its mesh lacks
_BUMP = 3e-3  # m over which a scanned surface is off alike


@dataclass(frozen=True)
class World:
    """What is touched and how, unknown to the localizer.

    Attributes
    ----------
    pressed : (least, largest) penetration [m]
    threshold : a rigid gel feels what is so deep [m], below 0 what is still above it; None for rigid and elastic gels in turn
    area : (least, largest) area of contact [m^2], without noise
    border : (least, largest) share of the contact's outline that the window's border cuts off
    kind : one of ``contact_class.CLASSES`` that contacts are of; any, if None
    shows : (least, most) patches that masks show, with their noise
    """

    mesh: Mesh
    sensor: Sensor
    noise: Noise
    pressed: tuple[float, float]
    threshold: float | None = None
    area: tuple[float, float] = (LEAST_CONTACT, np.inf)
    border: tuple[float, float] = (0.0, 1.0)
    kind: str | None = None
    shows: tuple[float, float] = (0, np.inf)


def larger(mesh: Mesh, percent: float) -> Mesh:
    """The mesh grown by so much about its centre."""
    if percent == 0:
        return mesh
    return replace(mesh, vertices=mesh.centre + (1 + percent / 100) * (mesh.vertices - mesh.centre))


def scanned(mesh: Mesh, rms: float) -> Mesh:
    """The mesh as a scanner might give it: divided finely, and its surface displaced by a smooth random field of ``rms`` [m]."""
    import trimesh

    if rms == 0:
        return mesh
    fine = trimesh.Trimesh(*trimesh.remesh.subdivide_to_size(mesh.vertices, mesh.faces, _BUMP / 2))
    rng = np.random.default_rng(0)
    # plane waves of random directions and lengths: smooth, and nowhere special
    waves = rng.normal(size=(64, 3)) / _BUMP
    phase = fine.vertices @ waves.T + rng.uniform(0, 2 * np.pi, 64)
    off = rms * np.sqrt(2 / 64) * np.cos(phase).sum(1)
    return replace(mesh, vertices=fine.vertices + off[:, None] * fine.vertex_normals, faces=fine.faces)


def knobbed(mesh: Mesh, radius: float) -> Mesh:
    """The mesh with ``_KNOBS`` balls of ``radius`` [m] sunk by half into its surface, at random."""
    import trimesh

    if radius == 0:
        return mesh
    points, _ = mesh.sample_surface(_KNOBS, seed=0)
    ball = trimesh.creation.icosphere(subdivisions=3, radius=radius)
    vertices = [mesh.vertices, *(ball.vertices + point for point in points)]
    first = len(mesh.vertices) + len(ball.vertices) * np.arange(_KNOBS)
    return replace(
        mesh, vertices=np.concatenate(vertices), faces=np.concatenate([mesh.faces, *(ball.faces + i for i in first)])
    )


def touches(world: World, n: int, seed: int) -> Iterator[tuple[Array, NDArray[np.bool_]]]:
    """Up to ``n`` touches of a world, uniform over its contact pose space: the true pose (4, 4), and what is felt (H, W).

    Fewer where hardly any touch is as the world wants it.
    """
    rng, space = np.random.default_rng(seed), ContactSpace(world.mesh, world.sensor)
    pixel = float(np.prod(world.sensor.pixel_pitch))
    found = 0
    for _ in range(TRIED * n // 32):
        for T in space.sample(32, rng, world.pressed)[0]:
            if world.kind and contact_class(space, T) != world.kind:
                continue
            mask = _felt(space, T, world.threshold, found % 2 == 1)
            if not (world.area[0] <= mask.sum() * pixel <= world.area[1]):
                continue
            if not (world.border[0] <= cut_off(mask) <= world.border[1]):
                continue
            noisy = spoilt(mask, space, world.noise, rng)
            if not (world.shows[0] <= len(patches(noisy, pixel)) <= world.shows[1]):
                continue
            yield T, noisy
            found += 1
            if found == n:
                return


def _felt(space: ContactSpace, T: Array, threshold: float | None, elastic: bool) -> NDArray[np.bool_]:
    if threshold is None:
        return simulate_mask(space, T, elastic)
    return np.asarray(space.caster.depths(space.sensor, T[None])[0] > threshold)


def cut_off(mask: NDArray[np.bool_]) -> float:
    """Share of the outline of ``mask`` (H, W) that lies on the image's border, by pixel edges."""
    inner = np.count_nonzero(mask[1:] != mask[:-1]) + np.count_nonzero(mask[:, 1:] != mask[:, :-1])
    outer = mask[0].sum() + mask[-1].sum() + mask[:, 0].sum() + mask[:, -1].sum()
    return float(outer / max(1, inner + outer))
