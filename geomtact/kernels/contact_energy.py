"""How badly the contacts at many poses fit an observed one: cut from height maps and compared, in one compiled loop.

A height map shows the object along one direction. The object tilted by a few degrees from there is the same surface, seen
along a sheared map: so one map serves all poses about its direction. A rigid gel is touched where the object is below the
membrane, an elastic one nearly where it is within a share of the depth of the deepest points about it: one cut gives the contacts
at all shares.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

BLOCK = 4  # samples along each side of a block
COARSER = 4  # pixels of a height map along each side of one of its block heights
SHARES = 40  # of the depth at which contacts are compared: ((j + 1) / SHARES)^2, the last one a rigid gel's
FASTMATH = {"nsz", "arcp", "contract", "afn", "reassoc"}  # of the loops over samples; heights are never NaN
_ROUNDS = 3  # cuts at most, until the height of the membrane over the map is known
_NOTHING = -500.0  # m: lower heights mean that the object is not there
_SETTLED = 2e-5  # m: by how much a further round may move the window over the map


class Maps(NamedTuple):
    """Height maps of one object.

    Attributes
    ----------
    heights : (D, n, n) float32 [m] along each direction beyond the object's centre, which is the middle pixel
    widest : (D, m, m) float32 [m] the largest height within a block about any of ``COARSER`` by ``COARSER`` pixels
    pixel : [m]
    """

    heights: NDArray[np.float32]
    widest: NDArray[np.float32]
    pixel: float


class Samples(NamedTuple):
    """The points of the sensor's window at which contacts are compared, in blocks.

    Attributes
    ----------
    rows, columns : of blocks, B together
    block : (B, 2) centre of each block on the membrane [m]
    within : (B, S, 2) each of its S samples from there [m], row by row
    sag : (B, S) by how much the membrane lies below its apex there [m]
    weight : (B, S) energy of a sample in contact less that of one that is not
    least : [m^3] sum of the negative weights, which the observed contact itself would have
    """

    rows: int
    columns: int
    block: NDArray[np.float32]
    within: NDArray[np.float32]
    sag: NDArray[np.float32]
    weight: NDArray[np.float32]
    least: float


class Poses(NamedTuple):
    """n poses of the object.

    Attributes
    ----------
    direction : (n,) map of each pose
    tilt : (n, 3, 3) rotation from that map's frame into the sensor's
    centre : (n, 2) object's centre along x and y, sensor frame [m]
    reach : (n,) first guess of how far the object reaches beyond its centre, in the window [m]
    membrane : (n,) how far the membrane's apex is beyond the object's centre [m]; NaN where ``depth`` says how deep it is
    depth : (n,) penetration [m]
    """

    direction: NDArray[np.int32]
    tilt: NDArray[np.float32]
    centre: NDArray[np.float32]
    reach: NDArray[np.float32]
    membrane: NDArray[np.float32]
    depth: NDArray[np.float32]


class Cut(NamedTuple):
    """What n poses' contacts are, compared with the observed one.

    Attributes
    ----------
    energy : (n, SHARES) 0 for a contact that is the observed one, larger for worse ones; inf where nothing is touched
    reach : (n,) how far the object reaches beyond its centre [m]; -inf where it is not in the window
    centroid : (n, 2) of the contact [m]
    """

    energy: NDArray[np.float32]
    reach: NDArray[np.float32]
    centroid: NDArray[np.float32]


def contact_energy(maps: Maps, samples: Samples, poses: Poses, deepest: float, area: float) -> Cut:
    """Cut the contacts at n poses and compare them.

    Parameters
    ----------
    deepest : largest penetration [m]
    area : of the observed contact, in samples: centroids are those of contacts of that area, or of the rigid ones
    """
    n = len(poses.direction)
    cut = Cut(np.zeros((n, SHARES), np.float32), np.zeros(n, np.float32), np.zeros((n, 2), np.float32))
    numbers = np.float32(1 / maps.pixel), np.float32(deepest), np.float32(area)
    _contact_energy(maps.heights, maps.widest, *numbers, *samples, *poses, *cut)
    return cut


@numba.njit(fastmath=FASTMATH, nogil=True, cache=True)  # type: ignore[untyped-decorator]
def _contact_energy(  # type: ignore[no-untyped-def]
    heights,
    widest,
    per_pixel,
    deepest,
    area,
    rows,
    columns,
    block,
    within,
    sag,
    weight,
    least,
    direction,
    tilt,
    centre,
    reach,
    membrane,
    depth,
    energy,
    found,
    centroid,
):
    """The loop of :func:`contact_energy`, which writes ``energy``, ``found`` and ``centroid``."""
    n, blocks, samples = len(direction), len(block), BLOCK * BLOCK  # known when it is compiled
    size = heights.shape[1]
    half = np.float32(size // 2 + 0.5)
    one, nothing, empty = np.float32(1), np.float32(-1e3), np.float32(_NOTHING)
    middle = np.float32(0.5) * deepest
    surface = np.empty((blocks, samples), np.float32)
    highest = np.empty(blocks, np.float32)
    above, cut = np.empty(blocks, np.float32), np.empty(blocks, np.uint8)
    sums = np.empty((SHARES, 3), np.float32)
    deepest_in, deep = np.empty(blocks, np.float32), np.empty((rows, columns), np.float32)
    wide_deep, between = np.empty((rows, columns), np.float32), _between_blocks()
    about, share = np.empty(samples, np.float32), np.empty(samples, np.int32)
    # how much higher than at its centre a tilted block may be
    beside = max(np.abs(within[:, :, 0]).max(), np.abs(within[:, :, 1]).max()) + np.float32(0.5) / per_pixel
    least_sag = np.empty(blocks, np.float32)
    for k in range(blocks):
        least_sag[k] = sag[k].min()
    for i in range(n):
        height, wide = heights[direction[i]], widest[direction[i]]
        # where the map is met by the window, on the plane in the middle of the deepest contact; it is known at once where the
        # membrane is, else once the reach is
        tx, ty, lean_x, lean_y, up, a, b, c, d = onto_map(tilt[i])
        slack = (abs(lean_x) + abs(lean_y)) * beside
        guess, best = reach[i], nothing
        for _ in range(_ROUNDS):
            plane = (guess - depth[i] if np.isnan(membrane[i]) else membrane[i]) + middle
            off_x, off_y = centre[i, 0] - tx * plane / up, centre[i, 1] - ty * plane / up
            best, top = nothing, nothing
            for k in range(blocks):
                x, y = block[k, 0] - off_x, block[k, 1] - off_y
                u, v = a * x + b * y, c * x + d * y
                column, row = int(u * per_pixel + half), int(v * per_pixel + half)
                h = nothing
                if 0 <= column < size and 0 <= row < size:
                    h = up * wide[row // COARSER, column // COARSER] - lean_x * u - lean_y * v + slack - least_sag[k]
                highest[k] = h
                cut[k], above[k] = 0, nothing
                top = max(top, h)
            if top < empty:
                break
            limit = top - deepest if np.isnan(membrane[i]) else max(membrane[i], top - deepest)
            for _again in range(2):
                for k in range(blocks):
                    if cut[k] or highest[k] < limit:
                        continue
                    cut[k], peak = 1, nothing
                    x, y = block[k, 0] - off_x, block[k, 1] - off_y
                    for j in range(samples):
                        xj, yj = x + within[k, j, 0], y + within[k, j, 1]
                        u, v = a * xj + b * yj, c * xj + d * yj
                        column, row = int(u * per_pixel + half), int(v * per_pixel + half)
                        h = nothing
                        if 0 <= column < size and 0 <= row < size:
                            h = up * height[row, column] - lean_x * u - lean_y * v - sag[k, j]
                        surface[k, j] = h
                        peak = max(peak, h)
                    above[k], best = peak, max(best, peak)
                lowest = best - depth[i] if np.isnan(membrane[i]) else membrane[i]
                limit = empty if best < empty else max(lowest, best - deepest)
            if best < empty or not np.isnan(membrane[i]):
                break
            moves = abs(best - guess) * (abs(tx) + abs(ty))
            guess = best
            if moves < np.float32(_SETTLED):
                break
        lowest = best - depth[i] if np.isnan(membrane[i]) else membrane[i]
        found[i] = best if best > empty else -np.inf
        energy[i] = np.inf
        if best < empty or best <= lowest:
            continue
        energy[i] = 0
        sums[:] = 0
        for k in range(blocks):
            deepest_in[k] = max(above[k] - lowest, np.float32(0))
            deep[k // columns, k % columns] = deepest_in[k]
        _smooth_maximum(deep, wide_deep)
        for k in range(blocks):
            if deepest_in[k] <= 0:
                continue
            about[:] = 0
            for beside_k in range(9):
                y = min(max(k // columns + beside_k // 3 - 1, 0), rows - 1)
                x = min(max(k % columns + beside_k % 3 - 1, 0), columns - 1)
                for j in range(samples):
                    about[j] += between[beside_k, j] * wide_deep[y, x]
            for j in range(samples):
                pressed = surface[k, j] - lowest
                e = np.sqrt(max(one - pressed / about[j], np.float32(0))) * SHARES
                share[j] = min(int(e), SHARES - 1) if pressed > 0 else -1
            for j in range(samples):
                e = share[j]
                if e >= 0:
                    energy[i, e] += weight[k, j]
                    sums[e, 0] += one
                    sums[e, 1] += block[k, 0] + within[k, j, 0]
                    sums[e, 2] += block[k, 1] + within[k, j, 1]
        energy[i, 0] -= least
        count, sum_x, sum_y = sums[0]
        for e in range(1, SHARES):
            energy[i, e] += energy[i, e - 1]
            if count < area:
                count, sum_x, sum_y = count + sums[e, 0], sum_x + sums[e, 1], sum_y + sums[e, 2]
        centroid[i, 0], centroid[i, 1] = sum_x / count, sum_y / count


@numba.njit(fastmath=FASTMATH, nogil=True, cache=True)  # type: ignore[untyped-decorator]
def onto_map(r):  # type: ignore[no-untyped-def]
    """How a map lies under the membrane, by the rotation ``r`` (3, 3) from its frame: by how much its heights move along x and y,
    its lean along both, its share along z; and the inverse (a, b, c, d) of the shear by which the window meets it."""
    tx, ty, lean_x, lean_y, up = r[0, 2], r[1, 2], r[2, 0], r[2, 1], r[2, 2]
    a, b = r[0, 0] - tx * lean_x / up, r[0, 1] - tx * lean_y / up
    c, d = r[1, 0] - ty * lean_x / up, r[1, 1] - ty * lean_y / up
    scale = np.float32(1) / (a * d - b * c)
    return tx, ty, lean_x, lean_y, up, d * scale, -b * scale, -c * scale, a * scale


@numba.njit(nogil=True, cache=True)  # type: ignore[untyped-decorator]
def _smooth_maximum(field, out):  # type: ignore[no-untyped-def]
    """Writes the mean over three by three entries of the maximum over three by three of ``field`` (h, w) to ``out``; what lies
    beyond the border repeats it. ``field`` is overwritten."""
    h, w = field.shape
    for y in range(h):
        for x in range(w):
            out[y, x] = max(field[y, max(x - 1, 0)], field[y, x], field[y, min(x + 1, w - 1)])
    for y in range(h):
        for x in range(w):
            field[y, x] = max(out[max(y - 1, 0), x], out[y, x], out[min(y + 1, h - 1), x])
    third = np.float32(1 / 3)
    for y in range(h):
        for x in range(w):
            out[y, x] = (field[y, max(x - 1, 0)] + field[y, x] + field[y, min(x + 1, w - 1)]) * third
    for y in range(h):
        for x in range(w):
            field[y, x] = (out[max(y - 1, 0), x] + out[y, x] + out[min(y + 1, h - 1), x]) * third
    out[:] = field


@numba.njit(nogil=True, cache=True)  # type: ignore[untyped-decorator]
def _between_blocks():  # type: ignore[no-untyped-def]
    """Weights (9, S) of a block and those around it, row by row, by which a field that is known at the centres of blocks is
    interpolated at the block's samples."""
    weights, one = np.zeros((9, BLOCK * BLOCK), np.float32), np.float32(1)
    for j in range(BLOCK * BLOCK):
        y = (np.float32(j // BLOCK) + np.float32(0.5)) / BLOCK - np.float32(0.5)
        x = (np.float32(j % BLOCK) + np.float32(0.5)) / BLOCK - np.float32(0.5)
        row, column = (0 if y < 0 else 2), (0 if x < 0 else 2)
        y, x = abs(y), abs(x)
        weights[4, j] = (one - y) * (one - x)
        weights[3 + column, j] = (one - y) * x
        weights[3 * row + 1, j] = y * (one - x)
        weights[3 * row + column, j] = y * x
    return weights
