"""How badly the contacts at many poses fit an observed one: cut from height maps and compared, in one compiled loop.

A height map shows the object along one direction. The object tilted by a few degrees from there is the same surface, seen
along a sheared map: so one map serves all poses about its direction. The contact at a pose holds the points that reach at
most an *effective depth* less far than the object's deepest point in the window. So one cut gives the contacts at every
depth, of a rigid gel and of one that is touched only from a share of the depth on.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

DEPTHS = 17  # effective depths at which contacts are compared, evenly from 0 to the deepest penetration
_ROUNDS = 3  # cuts at most, until the height of the membrane over the map is known
_NOTHING = -500.0  # m: lower heights mean that the object is not there
_SETTLED = 1e-4  # m: by how much a further round may move the window over the map


class Maps(NamedTuple):
    """Height maps of one object.

    Attributes
    ----------
    heights : (D, n, n) float32 [m] along each direction beyond the object's centre, which is the middle pixel
    widest : (D, n, n) float32 [m] the largest height within a block about each pixel
    pixel : [m]
    """

    heights: NDArray[np.float32]
    widest: NDArray[np.float32]
    pixel: float


class Samples(NamedTuple):
    """The points of the sensor's window at which contacts are compared, in blocks.

    Attributes
    ----------
    block : (B, 2) centre of each block on the membrane [m]
    within : (S, 2) each sample from its block's centre [m]
    sag : (B, S) by how much the membrane lies below its apex there [m]
    weight : (B, S) energy of a sample in contact less that of one that is not
    least : sum of the negative weights, which the observed contact itself would have
    """

    block: NDArray[np.float32]
    within: NDArray[np.float32]
    sag: NDArray[np.float32]
    weight: NDArray[np.float32]
    least: float


def contact_energy(
    maps: Maps,
    samples: Samples,
    direction: NDArray[np.int32],
    tilt: NDArray[np.float32],
    centre: NDArray[np.float32],
    reach: NDArray[np.float32],
    deepest: float,
    area: float,
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Energies of the contacts at n poses: 0 for a contact that is the observed one, larger for worse ones.

    Parameters
    ----------
    direction : (n,) map of each pose
    tilt : (n, 3, 3) rotation from that map's frame into the sensor's
    centre : (n, 2) object's centre along x and y, sensor frame [m]
    reach : (n,) first guess of how far the object reaches beyond its centre, in the window [m]
    deepest : largest effective depth [m]
    area : of the observed contact, in samples: centroids are those of contacts of that area, or of the deepest ones

    Returns
    -------
    energy : (n, DEPTHS); inf where the object is not in the window
    reach : (n,) how far the object reaches beyond its centre [m]; -inf where it is not in the window
    centroid : (n, 2) of the contact [m]
    """
    n = len(direction)
    energy = np.zeros((n, DEPTHS), np.float32)
    found = np.zeros(n, np.float32)
    centroid = np.zeros((n, 2), np.float32)
    _contact_energy(
        maps.heights,
        maps.widest,
        np.float32(1 / maps.pixel),
        samples.block,
        samples.within,
        samples.sag,
        samples.weight,
        np.float32(samples.least),
        direction,
        tilt,
        centre,
        reach,
        np.float32(deepest),
        np.float32(area),
        energy,
        found,
        centroid,
    )
    return energy, found, centroid


@numba.njit(fastmath={"nsz", "arcp", "contract", "afn", "reassoc"}, nogil=True, cache=True)  # type: ignore[untyped-decorator]
def _contact_energy(  # type: ignore[no-untyped-def]
    heights,
    widest,
    per_pixel,
    block,
    within,
    sag,
    weight,
    least,
    direction,
    tilt,
    centre,
    reach,
    deepest,
    area,
    energy,
    found,
    centroid,
):
    """The loop of :func:`contact_energy`, which writes ``energy``, ``found`` and ``centroid``."""
    n, blocks, samples = len(direction), len(block), len(within)
    size = heights.shape[1]
    half = np.float32(size // 2 + 0.5)
    one, nothing, empty = np.float32(1), np.float32(-1e3), np.float32(_NOTHING)
    bins = DEPTHS - 1
    per_depth, middle = np.float32(bins / deepest), np.float32(0.5) * deepest
    surface = np.empty((blocks, samples), np.float32)
    highest = np.empty(blocks, np.float32)
    cut = np.empty(blocks, np.uint8)
    sums = np.empty((DEPTHS, 3), np.float32)
    # how much higher than at its centre a tilted block may be
    beside = max(np.abs(within[:, 0]).max(), np.abs(within[:, 1]).max()) + np.float32(0.5) / per_pixel
    for i in range(n):
        height, wide, r = heights[direction[i]], widest[direction[i]], tilt[i]
        tx, ty, lean_x, lean_y, up = r[0, 2], r[1, 2], r[2, 0], r[2, 1], r[2, 2]
        # where the map is met by the window, on the plane in the middle of the deepest contact
        a, b = r[0, 0] - tx * lean_x / up, r[0, 1] - tx * lean_y / up
        c, d = r[1, 0] - ty * lean_x / up, r[1, 1] - ty * lean_y / up
        scale = one / (a * d - b * c)
        a, b, c, d = d * scale, -b * scale, -c * scale, a * scale
        slack = (abs(lean_x) + abs(lean_y)) * beside
        guess, best = reach[i], nothing
        for _ in range(_ROUNDS):
            off_x, off_y = centre[i, 0] - tx * (guess - middle) / up, centre[i, 1] - ty * (guess - middle) / up
            best, top = nothing, nothing
            for k in range(blocks):
                x, y = block[k, 0] - off_x, block[k, 1] - off_y
                u, v = a * x + b * y, c * x + d * y
                column, row = int(u * per_pixel + half), int(v * per_pixel + half)
                h = nothing
                if 0 <= column < size and 0 <= row < size:
                    h = up * wide[row, column] - lean_x * u - lean_y * v + slack - sag[k].min()
                highest[k] = h
                cut[k] = 0
                top = max(top, h)
            if top < empty:
                break
            limit = top - deepest
            for _again in range(2):
                for k in range(blocks):
                    if cut[k] or highest[k] < limit:
                        continue
                    cut[k] = 1
                    x, y = block[k, 0] - off_x, block[k, 1] - off_y
                    for j in range(samples):
                        xj, yj = x + within[j, 0], y + within[j, 1]
                        u, v = a * xj + b * yj, c * xj + d * yj
                        column, row = int(u * per_pixel + half), int(v * per_pixel + half)
                        h = nothing
                        if 0 <= column < size and 0 <= row < size:
                            h = up * height[row, column] - lean_x * u - lean_y * v - sag[k, j]
                        surface[k, j] = h
                        best = max(best, h)
                limit = empty if best < empty else best - deepest
            if best < empty:
                break
            moves = abs(best - guess) * (abs(tx) + abs(ty))
            guess = best
            if moves < np.float32(_SETTLED):
                break
        if best < empty:
            found[i] = -np.inf
            energy[i] = np.inf
            continue
        found[i] = best
        sums[:] = 0
        for k in range(blocks):
            if not cut[k]:
                continue
            for j in range(samples):
                depth = (best - surface[k, j]) * per_depth
                if depth < bins:
                    e = int(depth)
                    share = depth - np.float32(e)
                    energy[i, e + 1] += weight[k, j] * (one - share)
                    if e + 2 < DEPTHS:
                        energy[i, e + 2] += weight[k, j] * share
                    sums[e + 1, 0] += one
                    sums[e + 1, 1] += block[k, 0] + within[j, 0]
                    sums[e + 1, 2] += block[k, 1] + within[j, 1]
        energy[i, 0] = -least
        count, sum_x, sum_y = sums[0]
        for e in range(1, DEPTHS):
            energy[i, e] += energy[i, e - 1]
            if count < area:
                count, sum_x, sum_y = count + sums[e, 0], sum_x + sums[e, 1], sum_y + sums[e, 2]
        centroid[i, 0], centroid[i, 1] = sum_x / count, sum_y / count
