"""Procedural objects to learn from: random machine-like solids that no evaluation uses."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from geomtact.geometry.mesh import Mesh

if TYPE_CHECKING:
    from manifold3d import Manifold

_SIDES = (32, 64)  # of a circle
_TRIES = 20


def random_object(seed: int, size: float) -> Mesh:
    """The procedural object of ``seed``: a body with features added, cut away and repeated; the same for the same seed.

    ``size`` is its longest side [m].
    """
    for attempt in range(_TRIES):
        rng = np.random.default_rng([seed, attempt])
        solid = _body(rng)
        for _ in range(rng.integers(1, 6)):
            solid = _feature(solid, rng)
        low, high = np.reshape(solid.bounding_box(), (2, 3))
        if solid.is_empty() or solid.num_tri() > 30_000 or len(solid.decompose()) != 1:
            continue
        mesh = solid.to_mesh()
        vertices = np.asarray(mesh.vert_properties[:, :3], float)
        vertices = (vertices - (low + high) / 2) * (size / (high - low).max())
        turned = vertices @ Rotation.random(random_state=int(rng.integers(1 << 31))).as_matrix().T
        return Mesh(turned, np.asarray(mesh.tri_verts, np.int32), f"procedural {seed}", "m")
    raise RuntimeError(f"no connected object came of seed {seed} in {_TRIES} tries; use another seed")


def _body(rng: np.random.Generator) -> Manifold:
    """What an object starts from, about 1 in size: turned, extruded, a block, or a chain of blocks and rods."""
    makers: list[Callable[[np.random.Generator], Manifold]] = [_turned, _extruded, _block, _rod]
    solid = makers[rng.integers(4)](rng)
    if rng.random() < 0.35:  # two bodies that meet, as in elbows and brackets
        other = makers[rng.integers(4)](rng)
        solid = solid + _placed(other.scale([rng.uniform(0.3, 1)] * 3), solid, rng)
    return solid


def _feature(solid: Manifold, rng: np.random.Generator) -> Manifold:
    """``solid`` with a boss, a hole, a slot, a dent or a cut, perhaps repeated in a row or a ring."""
    from manifold3d import Manifold

    low, high = np.reshape(solid.bounding_box(), (2, 3))
    size = (high - low).max()
    makers = [_block, _rod, _ball, _extruded]
    tool = makers[rng.integers(4)](rng).scale([size * np.exp(rng.uniform(np.log(0.05), np.log(0.4)))] * 3)
    if rng.random() < 0.3:  # long: through holes, keyways, ribs
        tool = tool.scale([1, 1, rng.uniform(2, 8)])
    tool = _placed(tool, solid, rng)
    if rng.random() < 0.3:
        n = int(rng.integers(2, 7))
        if rng.random() < 0.5:
            tool = Manifold.batch_boolean([tool.rotate((0, 0, 360 * i / n)) for i in range(n)], _add())
        else:
            step = rng.normal(size=3)
            step *= 0.15 * size / np.linalg.norm(step)
            tool = Manifold.batch_boolean([tool.translate(tuple(i * step)) for i in range(n)], _add())
    changed = solid - tool if rng.random() < 0.6 else solid + tool
    return changed if changed.volume() > 0.3 * solid.volume() else solid


def _placed(tool: Manifold, solid: Manifold, rng: np.random.Generator) -> Manifold:
    """``tool`` at a random place of the surface of ``solid``, most often along an axis."""
    angles = 90.0 * rng.integers(0, 4, 3) if rng.random() < 0.7 else rng.uniform(0, 360, 3)
    mesh = solid.to_mesh()
    points = np.asarray(mesh.vert_properties[:, :3], float)
    corners = points[np.asarray(mesh.tri_verts)[rng.integers(solid.num_tri())]]
    return tool.rotate(tuple(angles)).translate(tuple(rng.dirichlet(np.ones(3)) @ corners))


def _turned(rng: np.random.Generator) -> Manifold:
    """A shaft with shoulders, cones and grooves."""
    from manifold3d import CrossSection, Manifold

    n = int(rng.integers(1, 6))
    z = np.concatenate([[0], np.cumsum(rng.uniform(0.1, 1, n))]) / n * rng.uniform(0.5, 3)
    profile: list[tuple[float, float]] = [(0.0, 0.0)]
    for i in range(n):
        r = rng.uniform(0.1, 0.5)
        profile += [(r, z[i]), (r * (rng.uniform(0.6, 1.4) if rng.random() < 0.3 else 1), z[i + 1])]
    profile.append((0.0, z[-1]))
    return Manifold.revolve(CrossSection([profile]), int(rng.choice(_SIDES)))


def _extruded(rng: np.random.Generator) -> Manifold:
    """A prism or a plate of random outline: polygon, star or gear."""
    from manifold3d import CrossSection, Manifold

    n = int(rng.integers(3, 13))
    angle = 2 * np.pi * (np.arange(n) + rng.uniform(-0.3, 0.3, n) * (rng.random() < 0.5)) / n
    radius = np.full(n, 0.5)
    if rng.random() < 0.5:
        radius = radius * rng.uniform(0.4, 1, n)
    elif rng.random() < 0.5:
        radius[::2] *= rng.uniform(0.5, 0.9)
    outline = np.stack([radius * np.cos(angle), radius * np.sin(angle)], 1) * [1, rng.uniform(0.4, 1)]
    taper = rng.uniform(0.5, 1) if rng.random() < 0.3 else 1.0
    return Manifold.extrude(CrossSection([outline]), float(np.exp(rng.uniform(-2, 1))), scale_top=(taper, taper))


def _block(rng: np.random.Generator) -> Manifold:
    from manifold3d import Manifold

    solid = Manifold.cube(tuple(np.exp(rng.uniform(-1.5, 0, 3))), True)
    if rng.random() < 0.3:  # rounded
        solid = (solid.scale([0.8] * 3)).minkowski_sum(Manifold.sphere(rng.uniform(0.02, 0.08), 12))
    return solid


def _rod(rng: np.random.Generator) -> Manifold:
    from manifold3d import Manifold

    r = rng.uniform(0.08, 0.5)
    top = r * rng.uniform(0.2, 1) if rng.random() < 0.3 else r
    sides = int(rng.choice([*_SIDES, 6]))
    solid = Manifold.cylinder(float(np.exp(rng.uniform(-1, 0.5))), r, top, sides, True)
    if rng.random() < 0.25:
        solid = solid - Manifold.cylinder(9, r * rng.uniform(0.3, 0.8), circular_segments=sides, center=True)
    return solid


def _ball(rng: np.random.Generator) -> Manifold:
    from manifold3d import Manifold

    return Manifold.sphere(0.5, 32).scale((1, rng.uniform(0.5, 1), rng.uniform(0.5, 1)))


def _add():
    from manifold3d import OpType

    return OpType.Add
