"""Which surface the points of a contact meet at many poses, and how a pose has to move: FilterReg's two steps in compiled loops.

The surface is points with normals, sorted into voxels of a few of them. The nearest ones are looked for in the voxel of a point
and in those around it, shell by shell, until none farther away can be nearer.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from geomtact.kernels.contact_energy import FASTMATH

Array = NDArray[np.float64]

_FARTHEST = 4.0  # widths of the filter beyond which it is 0
_SHELLS = 3  # of voxels, beyond which one nearest point stands for the two
_FEWER = 2  # surface points about each point that is only inside or outside


class Voxels(NamedTuple):
    """A surface's points, sorted into voxels.

    Attributes
    ----------
    points, normals : (M, 3) object frame [m], voxel by voxel
    first : (X, Y, Z) flattened, and one more: the first point of each voxel
    shape : (3,) how many voxels there are along each axis
    low : (3,) corner of the first voxel [m]
    side : of a voxel [m]
    """

    points: Array
    normals: Array
    first: NDArray[np.int64]
    shape: NDArray[np.int64]
    low: Array
    side: float


class Nearest(NamedTuple):
    """The nearest surface of places far from it.

    Attributes
    ----------
    points : (X Y Z, 3) nearest to the centre of each voxel
    normals : (X Y Z, 3) in the mean over a few that are nearest
    distance : (X Y Z,) how far away they are [m]
    shape, low, side : of the voxels, as of :class:`Voxels`
    """

    points: Array
    normals: Array
    distance: Array
    shape: NDArray[np.int64]
    low: Array
    side: float


class Outline(NamedTuple):
    """Points where the surface was met, as of ``registration.protocol.Problem``."""

    points: Array
    facing: Array
    across: Array
    sinking: Array
    noise: Array
    weight: Array
    contact: NDArray[np.int64]


class Fit(NamedTuple):
    """How points fit the surface at k poses.

    Attributes
    ----------
    information, slope : (k, 6 + c, 6 + c), (k, 6 + c) normal equations about a motion and the sinks of c contacts
    squared, inliers : (k,) sum of squared distances in units of the noise, and of how surely points lie on the surface
    support : (k,) how many points lie on it
    """

    information: Array
    slope: Array
    squared: Array
    inliers: Array
    support: NDArray[np.int64]

    def part(self, rows: slice) -> Fit:
        """That of some of the poses."""
        return Fit(self.information[rows], self.slope[rows], self.squared[rows], self.inliers[rows], self.support[rows])


@numba.njit(nogil=True, cache=True, fastmath=FASTMATH)  # type: ignore[untyped-decorator]
def _voxel(x, low, side, count):  # type: ignore[no-untyped-def]
    """The nearest of ``count`` voxels to ``x``, along one axis."""
    return min(max(int(np.floor((x - low) / side)), 0), count - 1)


@numba.njit(nogil=True, cache=True, fastmath=FASTMATH)  # type: ignore[untyped-decorator]
def _coarsely(x, distance, shape, low, side):  # type: ignore[no-untyped-def]
    """The voxel nearest to ``x`` (3,) and the distance of the surface from ``x``, at least; arguments as of :class:`Nearest`."""
    there, off2 = 0, 0.0
    for a in range(3):
        cell = _voxel(x[a], low[a], side, shape[a])
        there = there * shape[a] + cell
        off2 += (x[a] - low[a] - (cell + 0.5) * side) ** 2
    return there, distance[there] - np.sqrt(off2)


@numba.njit(nogil=True, cache=True, fastmath=FASTMATH)  # type: ignore[untyped-decorator]
def _nearest(x, facing, turn2, points, normals, first, shape, low, side, farthest, number, off):  # type: ignore[no-untyped-def]
    """Writes which points are nearest to ``x`` (3,), the nearest first, and their distances squared; -1 where there are fewer
    within the shells that ``farthest`` [m] reaches. To the square of the distance of a point whose normal differs from ``facing``
    by d, ``turn2`` d^2 is added. The surface is as of :class:`Voxels`."""
    most = len(off)
    off[:], number[:] = np.inf, -1
    x0, x1, x2 = x[0], x[1], x[2]
    home0, home1 = _voxel(x0, low[0], side, shape[0]), _voxel(x1, low[1], side, shape[1])
    home2 = _voxel(x2, low[2], side, shape[2])
    for shell in range(int(np.ceil(farthest / side)) + 1):
        if shell > 0 and off[most - 1] <= ((shell - 1) * side) ** 2:
            break
        for i in range(max(home0 - shell, 0), min(home0 + shell, shape[0] - 1) + 1):
            start = low[0] + i * side
            gap0 = max(start - x0, x0 - start - side, 0.0)
            for j in range(max(home1 - shell, 0), min(home1 + shell, shape[1] - 1) + 1):
                start = low[1] + j * side
                gap1 = max(start - x1, x1 - start - side, 0.0)
                if gap0 * gap0 + gap1 * gap1 >= off[most - 1]:
                    continue
                # the points of voxels in a row follow each other: all of the shell's side, or its two ends
                whole = abs(i - home0) == shell or abs(j - home1) == shell
                row = (i * shape[1] + j) * shape[2]
                for end in range(1 if whole else 2):
                    k0 = home2 - shell if end == 0 else home2 + shell
                    k1 = home2 + shell if whole else k0
                    k0, k1 = max(k0, 0), min(k1, shape[2] - 1)
                    if k0 > k1:
                        continue
                    for n in range(first[row + k0], first[row + k1 + 1]):
                        d2 = (x0 - points[n, 0]) ** 2 + (x1 - points[n, 1]) ** 2 + (x2 - points[n, 2]) ** 2
                        if d2 >= off[most - 1]:
                            continue
                        if turn2 > 0:
                            for a in range(3):
                                d2 += turn2 * (facing[a] - normals[n, a]) ** 2
                            if d2 >= off[most - 1]:
                                continue
                        place = most - 1
                        while place > 0 and off[place - 1] > d2:
                            off[place], number[place] = off[place - 1], number[place - 1]
                            place -= 1
                        off[place], number[place] = d2, n


@numba.njit(nogil=True, cache=True, fastmath=FASTMATH)  # type: ignore[untyped-decorator]
def _into_object(T, point, direction, out, turned):  # type: ignore[no-untyped-def]
    """Writes a ``point`` and a ``direction`` in the object's frame, of an object at ``T`` (4, 4)."""
    for a in range(3):
        out[a] = turned[a] = 0.0
        for b in range(3):
            out[a] += T[b, a] * (point[b] - T[b, 3])
            turned[a] += T[b, a] * direction[b]


@numba.njit(nogil=True, cache=True, fastmath=FASTMATH)  # type: ignore[untyped-decorator]
def _add(information, slope, row, used, error, weight):  # type: ignore[no-untyped-def]
    """Adds an ``error`` that changes along ``row`` (p,), of which the entries ``used`` (u,) are not 0, to normal equations."""
    for a in used:
        slope[a] -= weight * row[a] * error
        for b in used:
            information[a, b] += weight * row[a] * row[b]


@numba.njit(nogil=True, cache=True, fastmath=FASTMATH)  # type: ignore[untyped-decorator]
def _change(row, point, normal, centre, length):  # type: ignore[no-untyped-def]
    """Writes the first six entries of ``row``: the change of normal . (point - surface) by a motion of the object, with
    rotations about the ``centre`` times ``length``. It moves under the points: distances to its surface shrink along normals."""
    x, y, z = point[0] - centre[0], point[1] - centre[1], point[2] - centre[2]
    row[0] = -(y * normal[2] - z * normal[1]) / length
    row[1] = -(z * normal[0] - x * normal[2]) / length
    row[2] = -(x * normal[1] - y * normal[0]) / length
    row[3], row[4], row[5] = -normal[0], -normal[1], -normal[2]


@numba.njit(nogil=True, cache=True, fastmath=FASTMATH)  # type: ignore[untyped-decorator]
def meet(  # type: ignore[no-untyped-def]
    voxels, far, turn, outline, centre, length, T, sinks, sigma, neighbours, to_planes, outlier, slope_noise, flat, fit
):
    """Writes the ``fit`` of an ``outline`` to the surface at poses ``T`` (k, 4, 4), with the gel sunk by ``sinks`` (k, c) [m]:
    each point meets the mean of its nearest ``neighbours`` by a filter ``sigma`` [m] wide.

    Parameters
    ----------
    turn : how far away a point counts as whose normal differs by 1 [m]
    centre, length : of the problem
    to_planes : whether points are drawn to the surface's planes, or to its points
    outlier : sum of the filter's values at which a point counts as half an outlier
    slope_noise : noise across the membrane, as a share of that along it
    flat : sine of the slope below which a surface does not cross the membrane
    """
    most = min(neighbours, len(voxels.points))
    number, off = np.empty(most, np.int64), np.empty(most)
    surface = voxels.points, voxels.normals, voxels.first, voxels.shape, voxels.low, voxels.side
    at, facing, across = np.empty(3), np.empty(3), np.empty(3)
    point, target, normal = np.empty(3), np.empty(3), np.empty(3)
    row, used = np.zeros(fit.slope.shape[1]), np.arange(7)
    coarse = far.distance, far.shape, far.low, far.side
    points, facings, acrosses, sinkings, noises, weights, contacts = outline
    cloud, normals = voxels.points, voxels.normals
    information, slope, squared, inliers, support = fit
    for i in range(len(T)):
        pose = T[i]
        for j in range(len(points)):
            sunk = contacts[j]
            for a in range(3):
                point[a] = points[j, a] + sinks[i, sunk] * sinkings[j, a]
            _into_object(pose, point, facings[j], at, facing)
            if _coarsely(at, *coarse)[1] > _FARTHEST * sigma:
                continue
            _into_object(pose, point, acrosses[j], at, across)
            _nearest(at, facing, turn * turn, *surface, _FARTHEST * sigma, number, off)
            total = 0.0
            target[:], normal[:] = 0.0, 0.0
            for n in number:
                if n < 0:
                    continue
                face, lean, d2 = 0.0, 0.0, 0.0
                for a in range(3):
                    face += normals[n, a] * facing[a]
                    lean += normals[n, a] * across[a]
                    d2 += (at[a] - cloud[n, a]) ** 2
                # a surface that faces another way, or runs along the membrane, has not made this part of the outline
                steep = np.sqrt(face * face + lean * lean)
                if steep <= flat or face <= 0:
                    continue
                weight = min(face / steep, 1.0) * np.exp(-0.5 * d2 / (sigma * sigma))
                total += weight
                for a in range(3):
                    target[a] += weight * cloud[n, a]
                    normal[a] += weight * normals[n, a]
            size = np.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2)
            if total < 1e-300 or size < 1e-300:
                continue
            error, face = 0.0, 0.0
            for a in range(3):  # in the problem's frame
                at[a] = across[a] = 0.0
                for b in range(3):
                    at[a] += pose[a, b] * target[b] / total
                    across[a] += pose[a, b] * normal[b] / size
                at[a] += pose[a, 3]
                error += (point[a] - at[a]) * across[a]
                face += across[a] * facings[j, a]
            inlier = total / (total + outlier)
            # noise along the membrane shows along the normal only as far as the surface is steep
            noise = noises[j] * np.sqrt(face * face + slope_noise * slope_noise)
            squared[i] += inlier * (error / noise) ** 2
            inliers[i] += inlier
            support[i] += inlier > 0.5
            used[6] = 6 + sunk
            if to_planes:
                _change(row, point, across, centre, length)
                row[6 + sunk] = 0.0
                for a in range(3):
                    row[6 + sunk] += across[a] * sinkings[j, a]
                _add(information[i], slope[i], row, used, error, inlier * weights[j] / noise**2)
            else:
                weight = inlier * weights[j] / noises[j] ** 2
                for axis in range(3):
                    across[:] = 0.0
                    across[axis] = 1.0
                    _change(row, point, across, centre, length)
                    row[6 + sunk] = sinkings[j, axis]
                    _add(information[i], slope[i], row, used, point[axis] - at[axis], weight)


@numba.njit(nogil=True, cache=True, fastmath=FASTMATH)  # type: ignore[untyped-decorator]
def pull(voxels, far, around, side, each, centre, length, T, sigma, information, slope):  # type: ignore[no-untyped-def]
    """Adds the points ``around`` (m, 3), that should lie on one ``side`` (m,) of the surface and lie on the other at poses ``T``
    (k, 4, 4), to normal equations ``information`` (k, p, p), ``slope`` (k, p), with the weight ``each`` [1/m^2]."""
    number, off = np.empty(_FEWER, np.int64), np.empty(_FEWER)
    cloud, normals, far_points, far_normals = voxels.points, voxels.normals, far.points, far.normals
    surface = voxels.points, voxels.normals, voxels.first, voxels.shape, voxels.low, voxels.side
    coarse = far.distance, far.shape, far.low, far.side
    at, toward, normal, turned = np.empty(3), np.zeros(3), np.empty(3), np.empty(3)
    row, used = np.zeros(slope.shape[1]), np.arange(6)
    for i in range(len(T)):
        pose = T[i]
        for j in range(len(around)):
            _into_object(pose, around[j], toward, at, normal)
            there, least = _coarsely(at, *coarse)
            number[-1] = -1
            if least < far.side:
                _nearest(at, toward, 0.0, *surface, _SHELLS * voxels.side, number, off)
            above = 0.0
            if number[-1] >= 0:
                total = 0.0
                normal[:] = 0.0
                for n in range(_FEWER):
                    share, height = np.exp(-0.5 * (off[n] - off[0]) / (sigma * sigma)), 0.0
                    total += share
                    for a in range(3):
                        height += normals[number[n], a] * (at[a] - cloud[number[n], a])
                        normal[a] += share * normals[number[n], a]
                    above += share * height
                above /= total
            else:
                for a in range(3):
                    normal[a] = far_normals[there, a]
                    above += normal[a] * (at[a] - far_points[there, a])
            if side[j] * above <= 0:
                continue
            size = np.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2)
            for a in range(3):
                turned[a] = (pose[a, 0] * normal[0] + pose[a, 1] * normal[1] + pose[a, 2] * normal[2]) / max(
                    size, 1e-300
                )
            _change(row, around[j], turned, centre, length)
            # what is deeper on the wrong side than the filter is wide may itself be wrong
            _add(information[i], slope[i], row, used, above, each / (1 + (above / (3 * sigma)) ** 2))
