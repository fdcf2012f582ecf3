"""How badly a measured depth map fits the object at many poses: height maps and the gel's depth compared in one compiled loop.

Where the gel surely lies on the object, both are as deep. Elsewhere the gel may sink beside it, but the object is not in the gel.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from geomtact.kernels.contact_energy import FASTMATH, Maps, Poses, onto_map

MOST = 4.0  # nats that one sample counts at most: an outlier, such as dust or glare; hand-set


class Indentation(NamedTuple):
    """A measured depth map, at the samples of a window, in blocks.

    Attributes
    ----------
    depths : (B, S) how deep the gel is pressed in [m]
    lying : (B, S) whether the gel surely lies on the object
    weight : (B, S) one over the variance of the depth [1/m^2]; 0 where it was not measured
    place : (B, S, 2) where the gel is that is seen there, at its depth, along x and y [m]
    sag : (B, S) by how much the membrane lies below its apex there [m]
    """

    depths: NDArray[np.float32]
    lying: NDArray[np.bool_]
    weight: NDArray[np.float32]
    place: NDArray[np.float32]
    sag: NDArray[np.float32]


def depth_loss(maps: Maps, poses: Poses, indentation: Indentation, deepest: float) -> NDArray[np.float32]:
    """Half the sum of squared deviations (n,) of the depth, in standard deviations, at n poses whose ``membrane`` is known.

    Parameters
    ----------
    deepest : largest penetration [m]
    """
    out = np.zeros(len(poses.direction), np.float32)
    numbers = np.float32(1 / maps.pixel), np.float32(deepest), np.float32(MOST)
    _depth_loss(maps.heights, *numbers, poses.direction, poses.tilt, poses.centre, poses.membrane, *indentation, out)
    return out


@numba.njit(fastmath=FASTMATH, nogil=True, cache=True)  # type: ignore[untyped-decorator]
def _depth_loss(  # type: ignore[no-untyped-def]
    heights,
    per_pixel,
    deepest,
    most,
    direction,
    tilt,
    centre,
    membrane,
    depths,
    lying,
    weight,
    place,
    sag,
    out,
):
    """The loop of :func:`depth_loss`, which writes ``out``; the window meets a map as in ``contact_energy``."""
    blocks, samples = depths.shape
    size = heights.shape[1]
    half, one, none = np.float32(size // 2 + 0.5), np.float32(1), np.float32(0)
    for i in range(len(direction)):
        height = heights[direction[i]]
        tx, ty, lean_x, lean_y, up, a, b, c, d = onto_map(tilt[i])
        plane = membrane[i] + np.float32(0.5) * deepest
        off_x, off_y = centre[i, 0] - tx * plane / up, centre[i, 1] - ty * plane / up
        total = none
        for k in range(blocks):
            for j in range(samples):
                if weight[k, j] == 0:
                    continue
                x, y = place[k, j, 0] - off_x, place[k, j, 1] - off_y
                u, v = a * x + b * y, c * x + d * y
                column, row = int(u * per_pixel + half), int(v * per_pixel + half)
                pressed = -one
                if 0 <= column < size and 0 <= row < size:
                    pressed = up * height[row, column] - lean_x * u - lean_y * v - sag[k, j] - membrane[i]
                off = depths[k, j] - pressed
                if not lying[k, j]:
                    off = min(off, none)
                total += min(np.float32(0.5) * off * off * weight[k, j], most)
        out[i] = total
