"""How finely to discretise: the finest grid that a budget of poses affords."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from geomtact.errors import UsageError
from geomtact.geometry.approach import Approach, Cones, allowed, check_approach
from geomtact.geometry.cells import middle_angle, within_any
from geomtact.geometry.faces import plane_faces
from geomtact.geometry.mesh import Mesh
from geomtact.geometry.orbits import images_of
from geomtact.geometry.rotations import Directions, level_step
from geomtact.geometry.symmetry import Symmetry
from geomtact.se3 import Array
from geomtact.sensing.sensor import Sensor

MAX_POSES = 300_000  # by default
LEVELS = (1, 2, 3, 4)
PIXELS_PER_MASK_PIXEL = 3  # of the height maps, along each side
_BYTES_FOR_FINE_MASKS = 120e6
_BORDER = 1.3
_MOST_POSES = 100_000_000
_FACES = 6  # at most, about which there are disks
_MOST_MORE = 1.25  # times ``max_poses`` that there may be before the lattice grows coarser for the disks' sake
_DISK = 0.41  # steps, half angle of a disk: its cells are then a third of a step across, the tilt at which a whole face touches


@dataclass(frozen=True)
class Resolution:
    """The grid's resolved settings, written next to every result.

    Attributes
    ----------
    level : HEALPix level of the approach directions
    turn_step : spacing of the turns of exact faces [rad]
    step : lattice step along x and y [m]
    pixel : pixel of the height maps [m]
    penetrations : depths of the deepest point at the centres of the penetration bins [m]
    mask_shape : (h, w) of the stored masks
    disks : (x, y, z, half angle [rad]) of each disk about a direction, object frame, in which directions are finer
    """

    level: int
    turn_step: float
    step: float
    pixel: float
    penetrations: tuple[float, ...]
    mask_shape: tuple[int, int]
    disks: tuple[tuple[float, ...], ...] = ()

    def directions(self, symmetry: Symmetry, approach: Approach | None) -> Directions:
        """The approach directions of the grid."""
        disks = [(np.array(disk[:3]), disk[3]) for disk in self.disks]
        return Directions.make(symmetry, approach, self.level, self.turn_step, disks)

    def to_json(self) -> dict[str, Any]:
        return asdict(self)

    @classmethod
    def from_json(cls, data: dict[str, Any]) -> Resolution:
        values: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in data.items()}
        return cls(**values | {"disks": tuple(tuple(disk) for disk in data.get("disks", ()))})


def disks_about_faces(mesh: Mesh, sensor: Sensor, cones: Cones | None, level: int) -> Cones:
    """Disks (direction (3,), half angle [rad]) about the plane faces for which the directions of ``level`` are too far apart.

    A pixel's corner lies 0.7 steps off its middle. Tilted so far about its middle, a face that is long enough, as far as the
    window sees it, has one end off the gel at the mean penetration: none of the stored contacts need be the whole face's. What is
    narrower than that penetration, to either side, is an edge. One disk stands for all faces that symmetry makes equal, and for
    those within its middle cell; there are six at most, about the largest of the faces that ``cones`` leave.
    """
    assert mesh.symmetry is not None
    step = level_step(level)
    half = _DISK * step
    deep = 0.5 * sensor.max_penetration
    long = deep / np.tan(np.sqrt(0.5) * step)
    disks: Cones = []
    for face in plane_faces(mesh):
        images = images_of(face.normal[None], mesh.symmetry)[0]
        left = cones is None or allowed(images, [(v, angle + half) for v, angle in cones]).any()
        wide = min(face.half_length, sensor.half_window.max()) > long and face.half_width > deep
        if wide and left and len(disks) < _FACES and not within_any(images, disks, middle_angle(half)):
            disks.append((face.normal, half))
    return disks


def choose(
    mesh: Mesh,
    footprint: float,
    sensor: Sensor,
    approach: Approach | None = None,
    max_poses: int = MAX_POSES,
) -> Resolution:
    """The resolution whose cells are smallest, in mean point distance, outside of disks about faces, at no more than about
    ``max_poses`` poses, or a quarter more where there are such disks.

    Parameters
    ----------
    mesh : with its symmetry
    footprint : mean area of window positions that touch, over rotations [m^2]
    sensor, approach, max_poses : as of ``Localizer.prepare``

    Raises
    ------
    UsageError
        ``max_poses`` out of range, or an approach that makes no sense.
    """
    if not 1000 <= max_poses <= _MOST_POSES:
        raise UsageError(
            f"max_poses: expected 1000 to {_MOST_POSES:,}, got {max_poses:,}; a million take 200 MB of disk, and more memory"
        )
    assert mesh.symmetry is not None
    radius_rms = mesh.radius_rms  # what a rotation moves
    coarse, fine = sensor.along((24, 32)), sensor.along((48, 64))
    finest = float(_mask_pitch(sensor, fine).max())
    bins, best = 4, None
    # a level on which the symmetry or the approach leaves only points is the same at every level
    directions = Directions.make(mesh.symmetry, approach, LEVELS[0])
    levels = LEVELS if directions.level is not None else LEVELS[:1]
    cones = check_approach(approach)
    for level in levels:
        disks: Cones = []
        if directions.level is None:
            rotating = float((directions.periods > 0).sum())
            if rotating:
                turn_length = rotating * float(directions.periods.max()) * radius_rms
                step = max(finest, (turn_length * footprint * bins / max_poses) ** (1 / 3))
                n, turn_step = turn_length / step, step / max(radius_rms, 1e-9)
            else:
                n, turn_step = len(directions.vectors), 2 * np.pi
                step = max(finest, _lattice_step(footprint, max_poses / (n * bins)))
        else:
            if level > LEVELS[0]:
                directions = Directions.make(mesh.symmetry, approach, level)
            even = n = float(directions.turns.sum())
            disks, turn_step = disks_about_faces(mesh, sensor, cones, level), level_step(level)
            if disks:
                n = float(Directions.make(mesh.symmetry, approach, level, disks=disks).turns.sum())
            step = max(finest, _lattice_step(footprint, max_poses / (max(even, n / _MOST_MORE) * bins)))
        size = np.hypot(turn_step * radius_rms if n > 1 else 0.0, step)
        if best is None or size < best[0]:
            best = (size, level, turn_step, step, n * footprint / step**2, disks)
    assert best is not None
    _, level, turn_step, step, places, disks = best
    if places * bins * 4 < max_poses:
        bins = 8
    shape = fine if places * bins * fine[0] * fine[1] / 8 < _BYTES_FOR_FINE_MASKS else coarse
    pixel = float(_mask_pitch(sensor, shape).min()) / PIXELS_PER_MASK_PIXEL
    depths = tuple(float(d) for d in (np.arange(bins) + 0.5) / bins * sensor.max_penetration)
    found = tuple((*map(float, v), float(half)) for v, half in disks)
    return Resolution(level, float(turn_step), float(step), pixel, depths, shape, found)


def _lattice_step(footprint: float, cells: float) -> float:
    """Step [m] of the square lattice of which about ``cells`` cells meet a footprint [m^2].

    Cells on its border meet it too: in units of the footprint's width their number was found to be 1.3 to a step, for
    objects of many shapes.
    """
    width_in_steps = 0.5 * (np.sqrt(_BORDER**2 + 4 * cells) - _BORDER)
    return float(np.sqrt(footprint) / width_in_steps)


def _mask_pitch(sensor: Sensor, shape: tuple[int, int]) -> Array:
    return 2 * sensor.half_window / np.array(shape[::-1])
