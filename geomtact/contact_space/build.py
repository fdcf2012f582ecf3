"""Builds the index: every touch of the object, simulated before the first real one (thesis 6.1)."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from geomtact.contact_space import resolution as res
from geomtact.contact_space.heightmap import CELL_PIXELS, NOTHING, HeightMap, Lattice, Window, allowed
from geomtact.contact_space.index import deflate, pack
from geomtact.contact_space.resolution import MAX_POSES, Resolution
from geomtact.errors import MeshError
from geomtact.geometry.approach import Approach
from geomtact.geometry.mesh import Mesh
from geomtact.geometry.rotations import Directions
from geomtact.progress import Progress
from geomtact.se3 import Array
from geomtact.sensing.cast import Caster
from geomtact.sensing.moments import moments
from geomtact.sensing.sensor import Sensor
from geomtact.threads import thread_count


@dataclass(frozen=True)
class _Turn:
    """The places of one rotation, arrays as in ``Index``; ``cell`` is the flat index of each place's lattice cell."""

    cell: NDArray[np.int64]
    shift: Array
    height: Array
    weight: NDArray[np.float32]
    bits: NDArray[np.uint64]
    area: NDArray[np.int64]
    moments: NDArray[np.float32]


def build(
    mesh: Mesh,
    sensor: Sensor,
    approach: Approach | None,
    resolution: Resolution,
    progress: Progress | None = None,
) -> dict[str, NDArray]:
    """Simulate every pose of the contact pose space.

    Returns
    -------
    dict of the arrays named in ``Index.ARRAYS``

    Raises
    ------
    MeshError
        No pose of the object touches the sensor as the approach and the housing allow.
    """
    assert mesh.symmetry is not None
    directions = resolution.directions(mesh.symmetry, approach)
    caster = Caster(mesh.vertices, mesh.faces)
    reach = mesh.reach
    lattice = Lattice.make(reach, sensor, resolution.step)
    window = Window(sensor, resolution.mask_shape, resolution.penetrations)
    margin = 2.1 * float(np.hypot(*sensor.half_window)) + resolution.step

    def one(k: int) -> list[_Turn]:
        there = HeightMap.cast(caster, directions.vectors[k], mesh.centre, reach, margin, resolution.pixel)
        turns = np.arange(directions.turns[k]) * directions.periods[k] / directions.turns[k]
        return [_touches(there, turn, lattice, window) for turn in turns]

    turns: list[_Turn] = []
    with ThreadPoolExecutor(thread_count()) as pool:
        try:
            for k, some in enumerate(pool.map(one, range(len(directions.vectors)))):
                turns += some
                if progress:
                    progress((k + 1) / len(directions.vectors), "simulating touches")
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    if not any(len(t.cell) for t in turns):
        raise MeshError(
            f"{mesh.name}: no pose touches the sensor {sensor.name!r} as the approach and the housing allow; "
            "widen the approach or check the object's unit"
        )
    return _join(turns, directions, lattice)


def choose_resolution(
    mesh: Mesh,
    sensor: Sensor,
    approach: Approach | None = None,
    max_poses: int = MAX_POSES,
    progress: Progress | None = None,
) -> Resolution:
    """The finest grid that ``max_poses`` affords for this object (see ``resolution.choose``)."""
    assert mesh.symmetry is not None
    directions = Directions.make(mesh.symmetry, approach, 1, 0.5)
    caster, reach = Caster(mesh.vertices, mesh.faces), mesh.reach
    lattice = Lattice.make(reach, sensor, step=float(sensor.half_window.min()))
    area = 0.0
    for k, weight in enumerate(directions.weights):
        there = HeightMap.cast(caster, directions.vectors[k], mesh.centre, reach, 0.0, lattice.pixel / 2)
        turn = 2.4 * k  # the golden angle, in short: every direction at another turn
        area += weight * allowed(there.turned(turn, lattice), lattice, sensor, [0.0]).sum() * lattice.pixel**2
        if progress:
            progress((k + 1) / len(directions.weights), "choosing the grid")
    return res.choose(mesh, float(area), sensor, approach, max_poses)


def places(
    there: HeightMap, turn: float, lattice: Lattice, window: Window
) -> tuple[NDArray[np.int64], Array, NDArray[np.float32]]:
    """The lattice cells (n,) of one rotation in which the object touches, a window centre (n, 2) [m] that stands for
    each, from the object's centre, and the share (P, n) of each that touches at every penetration."""
    ok = lattice.blocks(allowed(there.turned(turn, lattice), lattice, window.sensor, window.penetrations))
    share = ok.mean(2, dtype=np.float32)
    cell = np.flatnonzero(share.any(0))
    # a place is represented by one of the pixels that touch at most depths, the nearest to their mean
    depths = ok[:, cell].sum(0)
    inside = depths == depths.max(1, keepdims=True)
    i, j = np.divmod(np.arange(CELL_PIXELS**2), CELL_PIXELS)
    n = inside.sum(1)
    far = (i - (inside @ i / n)[:, None]) ** 2 + (j - (inside @ j / n)[:, None]) ** 2
    return cell, lattice.positions(cell, np.where(inside, far, np.inf).argmin(1)), share[:, cell]


def _touches(there: HeightMap, turn: float, lattice: Lattice, window: Window) -> _Turn:
    """All places of one rotation."""
    cell, centres, share = places(there, turn, lattice, window)
    masks, z = window.masks(there, turn, centres)
    # a sliver at the window's edge may fall between the finer pixels of the height map
    seen = z > NOTHING / 2
    share = share * seen
    z = np.where(seen, z, z.max(0))
    kept = share.any(0)
    cell, centres, masks, z, share = cell[kept], centres[kept], masks[:, kept], z[:, kept], share[:, kept]
    summed = moments(masks.reshape(-1, *window.mask_shape), window.sensor)
    summed = summed.reshape(*masks.shape[:2], summed.shape[-1])  # there may be no place at all
    packed = pack(masks).swapaxes(1, 2)
    return _Turn(cell, -centres, z, share, packed, masks.sum(2), np.moveaxis(summed, 2, 0))


def _join(turns: list[_Turn], directions: Directions, lattice: Lattice) -> dict[str, NDArray]:
    """One array of each kind for all rotations; the weights made a share of the whole."""
    first = np.concatenate([[0], np.cumsum([len(t.cell) for t in turns])])
    some, n = turns[0], int(first[-1])
    p, words = some.bits.shape[:2]
    bits = np.zeros((p, words, n), np.uint64)
    out: dict[str, NDArray] = {
        "rotation": np.zeros(n, np.int32),
        "shift": np.zeros((n, 2), np.float32),
        "height": np.zeros((p, n), np.float32),
        "weight": np.zeros((p, n), np.float32),
        "area": np.zeros((p, n), np.uint16),
        "moments": np.zeros((some.moments.shape[0], p, n), np.float32),
        "table": np.zeros((len(turns), *lattice.cells), np.int32),
    }
    share = np.repeat(directions.weights / directions.turns, directions.turns)
    for r, turn in enumerate(turns):
        part = slice(first[r], first[r + 1])
        out["rotation"][part] = r
        out["shift"][part] = turn.shift
        out["height"][:, part] = turn.height
        out["weight"][:, part] = turn.weight * share[r]
        bits[:, :, part] = turn.bits
        out["area"][:, part] = turn.area
        out["moments"][:, :, part] = turn.moments
        table = np.full(lattice.cells, -1)
        table.flat[turn.cell] = np.arange(first[r], first[r + 1])
        out["table"][r] = _fill(table) if len(turn.cell) else -1
    out["deflated"] = deflate(bits)
    out["weight"] /= out["weight"].sum(dtype=np.float64)
    out["moments"] = out["moments"].reshape(some.moments.shape[0], p * n)
    # a rotation that cannot touch at all borrows the places of the nearest one before it that can
    for r in np.flatnonzero(out["table"][:, 0, 0] < 0).tolist():
        out["table"][r] = out["table"][r - 1] if r else 0
    return out


def _fill(table: NDArray[np.int64]) -> NDArray[np.int64]:
    """Empty cells (-1) given the place of the nearest cell that has one."""
    nearest = distance_transform_edt(table < 0, return_distances=False, return_indices=True)
    return table[tuple(nearest)]
