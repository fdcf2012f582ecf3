"""What a network learns from: touches of an object beside the stored contacts of the cells that hold them.

A scene is one object on one sensor with the grid that a localizer would choose, but for the disks about its faces: what is
distinguished in a wide cell is in a narrow one, too. Of its rotations a few are drawn. Their
stored contacts are what the network has to separate; the touches are drawn within the cells, tilted, turned, shifted
and pressed by up to half a grid step, rigid and elastic.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from geomtact.contact_space.build import choose_resolution, places
from geomtact.contact_space.heightmap import NOTHING, HeightMap, Lattice, Window
from geomtact.contact_space.index import pack
from geomtact.contact_space.resolution import Resolution
from geomtact.contact_space.touch import LEAST_CONTACT, MARGIN, elastic_in_window
from geomtact.geometry.approach import approach_of, facing
from geomtact.geometry.mesh import Mesh
from geomtact.geometry.rotations import Directions, level_step
from geomtact.geometry.symmetry import Symmetry
from geomtact.scoring.encoder import cell_size
from geomtact.se3 import Array
from geomtact.sensing.cast import Caster
from geomtact.sensing.sensor import Sensor

DIRECTIONS, TURNS, TILTS = 12, 4, 4  # drawn of an object; turns and tilted views of each direction
TOUCHES = 6  # of each tilted view
_PLACES = 120  # of a rotation at most
KEY_SHAPE, TOUCH_SHAPE = (24, 32), (48, 64)


@dataclass(frozen=True)
class TrainingScene:
    """Contacts of an object, masks packed into words and, for tall windows, mirrored about the diagonal to lie.

    Attributes
    ----------
    stored : (n, words) contacts of ``KEY_SHAPE`` at the poses of the grid
    weight : (n,) share of the uniform measure of each, among these
    touches : (m, words) contacts of ``TOUCH_SHAPE``, each with the least area that touches have
    elastic : (m,) whether each is on an elastic gel; such a touch follows the rigid one at the same pose
    true : (m,) the stored contact whose cell holds each touch
    pixel : of ``TOUCH_SHAPE`` [m]
    cell : (2,) the grid's, as ``scoring.encoder.cell_size`` gives it
    """

    stored: NDArray[np.uint64]
    weight: NDArray[np.float32]
    touches: NDArray[np.uint64]
    elastic: NDArray[np.bool_]
    true: NDArray[np.int64]
    pixel: float
    cell: NDArray[np.float32]


def make_scene(mesh: Mesh, sensor: Sensor, max_poses: int, rng: np.random.Generator) -> TrainingScene:
    """A scene of ``mesh`` on ``sensor``, with a grid of the level and the step that ``max_poses`` affords."""
    symmetry = Symmetry("none", np.eye(4)[None], None, np.zeros(3))
    mesh = replace(mesh, symmetry=symmetry)
    shape = sensor.along(KEY_SHAPE)
    resolution = replace(choose_resolution(mesh, sensor, None, max_poses), mask_shape=shape)
    resolution = replace(resolution, pixel=float((2 * sensor.half_window / shape[::-1]).min() / 3))
    directions = Directions.make(symmetry, None, resolution.level)
    view = _View(mesh, sensor, resolution)
    stored, weight, touches, elastic, true = [], [], [], [], []
    total = 0
    for k in rng.choice(len(directions.vectors), DIRECTIONS, replace=False):
        there = view.cast(directions.vectors[k])
        tilted = [_tilted(directions, k, rng) for _ in range(TILTS)]
        maps = [view.cast(approach_of(R)) for R in tilted]
        n_turns = int(directions.turns[k])
        for j in rng.choice(n_turns, TURNS, replace=False):
            turn = 2 * np.pi * j / n_turns
            cell, centres, share = places(there, turn, view.lattice, view.window)
            some = np.sort(rng.permutation(len(cell))[:_PLACES])
            if not len(some):
                continue
            cell, centres, share = cell[some], centres[some], share[:, some]
            masks, z = view.window.masks(there, turn, centres)
            share = share * (z > NOTHING / 2)
            stored.append(pack(view.lying(masks)).reshape(share.size, -1))
            weight.append((share * directions.weights[k]).ravel() * (len(cell) / max(len(some), 1)))
            t = int(rng.integers(TILTS))
            level, place = view.draw(share, TOUCHES * TILTS // TURNS, rng)
            for p, i in zip(level, place, strict=True):
                psi = turn + rng.uniform(-0.5, 0.5) * 2 * np.pi / n_turns
                depth = view.depth(maps[t], tilted[t], psi, int(cell[i]), int(p), rng)
                if depth is None:
                    continue
                for soft, mask in enumerate(view.contact_masks(depth)):
                    if mask.sum() * view.pixel**2 >= LEAST_CONTACT:
                        touches.append(pack(view.lying(mask[None]).reshape(1, -1))[0])
                        elastic.append(bool(soft))
                        true.append(total + int(p) * share.shape[1] + int(i))
                t = (t + 1) % TILTS
            total += share.size
    mass = np.concatenate(weight).astype(np.float64)
    return TrainingScene(
        np.concatenate(stored),
        (mass / mass.sum()).astype(np.float32),
        np.array(touches, np.uint64),
        np.array(elastic, bool),
        np.array(true, np.int64),
        view.pixel,
        cell_size(sensor, resolution.step, level_step(resolution.level) * mesh.radius_rms),
    )


class _View:
    """One object over one sensor: height maps of it, and touches cut from them."""

    def __init__(self, mesh: Mesh, sensor: Sensor, resolution: Resolution):
        self.mesh, self.sensor, self.resolution = mesh, sensor, resolution
        self.caster = Caster(mesh.vertices, mesh.faces)
        self.reach = mesh.reach
        self.lattice = Lattice.make(self.reach, sensor, resolution.step)
        self.window = Window(sensor, resolution.mask_shape, resolution.penetrations)
        self.margin = 2.1 * float(np.hypot(*sensor.half_window)) * (1 + 2 * MARGIN) + 2 * resolution.step
        h, w = sensor.along(TOUCH_SHAPE)
        self.pitch = 2 * sensor.half_window / (w, h)
        self.pixel = float(np.sqrt(self.pitch.prod()))
        self.my, self.mx = round(MARGIN * h), round(MARGIN * w)
        x = (np.arange(w + 2 * self.mx) - (w + 2 * self.mx - 1) / 2) * self.pitch[0]
        y = (np.arange(h + 2 * self.my) - (h + 2 * self.my - 1) / 2) * self.pitch[1]
        self.grid = np.stack(np.meshgrid(x, y), -1)
        self.sag = sensor.sag(self.grid[..., 0], self.grid[..., 1])

    def cast(self, a: Array) -> HeightMap:
        return HeightMap.cast(self.caster, a, self.mesh.centre, self.reach, self.margin, self.resolution.pixel)

    def draw(self, share: NDArray[np.float32], n: int, rng: np.random.Generator) -> tuple[NDArray, NDArray]:
        """Penetration bin (n,) and place (n,) of touches, as often as the cells weigh."""
        if not share.any():
            return np.zeros(0, np.int64), np.zeros(0, np.int64)
        p = share.ravel().astype(float)
        return np.unravel_index(rng.choice(p.size, n, p=p / p.sum()), share.shape)  # type: ignore[return-value]

    def depth(
        self, there: HeightMap, R: Array, psi: float, cell: int, level: int, rng: np.random.Generator
    ) -> Array | None:
        """How deep (h, w) [m] the object presses somewhere in a cell, beyond the window too; None without contact."""
        ny, nx = self.lattice.cells
        step = self.resolution.step
        centre = (np.array([cell % nx - nx // 2, cell // nx - ny // 2]) + rng.uniform(-0.5, 0.5, 2)) * step
        # the object stands turned by psi from R, and the map by what facing() makes of its direction
        Q = Rotation.from_euler("z", psi).as_matrix() @ R @ facing(approach_of(R)).T
        xy = (self.grid + centre) @ Q[:2, :2]
        half, n = len(there.heights) // 2, len(there.heights)
        ij = np.clip(np.rint(xy / there.pixel).astype(np.int64) + half, 0, n - 1)
        heights = there.heights[ij[..., 1], ij[..., 0]] - self.sag
        inside = heights[self.my : -self.my, self.mx : -self.mx]
        highest = inside.max()
        if highest < NOTHING / 2:
            return None
        bins = len(self.resolution.penetrations)
        d = (level + rng.random()) / bins * self.sensor.max_penetration
        return np.asarray(heights - highest + d, float)

    def contact_masks(self, depth: Array) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """The rigid and the elastic contact (h, w) of a depth field that reaches beyond the window."""
        pitch = (float(self.pitch[0]), float(self.pitch[1]))
        elastic = elastic_in_window(depth, pitch, (self.my, self.mx), self.sensor.max_penetration)
        return depth[self.my : -self.my, self.mx : -self.mx] > 0, elastic

    def lying(self, masks: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Flat masks (..., h w), or masks (n, h, w), of a tall window mirrored about the diagonal; others as they are."""
        if masks.shape[-1] == np.prod(self.resolution.mask_shape):
            masks = masks.reshape(*masks.shape[:-1], *self.resolution.mask_shape)
        if self.sensor.tall:
            masks = np.swapaxes(masks, -1, -2)
        return np.ascontiguousarray(masks).reshape(*masks.shape[:-2], -1)


def _tilted(directions: Directions, k: int, rng: np.random.Generator) -> Array:
    """A rotation (3, 3) uniform within the cell of direction ``k``, at turn 0."""
    first = int(directions.turns[:k].sum())
    R = directions.draw(np.array([first]), rng)[0]
    # draw() turns as well; that part is taken back, the touches turn by themselves
    a = approach_of(R)
    near = directions.vectors[k]
    axis = np.cross(near, a)
    angle = np.arctan2(np.linalg.norm(axis), near @ a)
    tilt = Rotation.from_rotvec(axis / max(np.linalg.norm(axis), 1e-12) * angle).as_matrix()
    return facing(near) @ tilt.T
