"""The pixel pitch of a sensor from one image of a board of pins a given distance apart, pressed into the gel."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geomtact.errors import ImageError, UsageError
from geomtact.se3 import Array
from geomtact.sensing.change import GRID, as_unit_rgb, background_of

_FEWEST, _MANY = 12, 36  # pins, for a cubic over the image, and for a quintic
_SMOOTH = 1 / GRID  # of the image's shorter side, as for contacts
_CLEAR = 0.25  # of the strongest pin's change of brightness that a pin shows at least
_BESIDE = 0.3  # of the way from pin to pin by which the next one may be off where it is expected
_SPACINGS = 1e-4, 2e-2  # m that pins may be apart


@dataclass(frozen=True, eq=False)
class PinBoard:
    """What an image of a pin board measures.

    Attributes
    ----------
    pixel_pitch : along x and along y in the middle of the image [m]
    std : standard deviation of each, relative
    stretch : by how much smaller, relative, the pitch is at the outermost pins than in the middle: the lens's distortion
    pins : (n, 2) where pins were found (column, row) [px]
    places : (n, 2) which of the board's each is, counted along x and along y
    """

    pixel_pitch: tuple[float, float]
    std: tuple[float, float]
    stretch: float
    pins: Array
    places: NDArray[np.int64]


def pixel_pitch_of_pins(image: Any, background: Any, spacing: float) -> PinBoard:
    """The pitch in the middle of the image, from a square board of pins whose rows run along the image's, to some degrees.

    Where each pin is in the image is a polynomial of where it is on the board, which takes up the lens's distortion; its slope in
    the middle is the pitch.

    Parameters
    ----------
    image, background : (H, W, 3) RGB, with the board pressed in and without
    spacing : from pin to pin [m]

    Raises
    ------
    UsageError, ImageError
        An impossible spacing; fewer than a dozen pins in a grid.
    """
    if not _SPACINGS[0] <= spacing <= _SPACINGS[1]:
        raise UsageError(f"spacing: expected metres, 0.0001 to 0.02, got {spacing}; 2.5 mm is 0.0025")
    image = as_unit_rgb(image, "image")
    peaks = _peaks(image - background_of(background, image))
    half = np.array(image.shape[1::-1]) / 2 - 0.5
    rows, places = _in_grid(peaks, half)
    if len(rows) < _FEWEST or (np.ptp(places, axis=0) < 3).any():
        raise ImageError(
            f"image: expected a grid of pins, four or more along each way and {_FEWEST} in all, found {len(peaks)} "
            f"spots, {len(rows)} of them in one grid; press the board in evenly, its rows along the image's"
        )
    pins = peaks[rows]
    board: Array = places / float(np.abs(places).max())
    powers = _powers(len(pins))
    terms = _terms(board, powers)
    solved: Array = np.asarray(np.linalg.lstsq(terms, pins, rcond=None)[0], float)
    # each coordinate's error carries over to its slopes by the fit's own covariance
    off, covariance = pins - terms @ solved, np.linalg.inv(terms.T @ terms)
    error = np.sqrt((off**2).sum(0) / (len(pins) - len(solved)) * np.diag(covariance)[1:3])
    middle: Array = board[np.linalg.norm(pins - half, axis=1).argmin()]
    for _ in range(10):
        off_middle = half - (_terms(middle[None], powers) @ solved)[0]
        middle = middle + np.linalg.solve(_slopes(solved, middle, powers), off_middle)
    pitch = _pitch(solved, middle, powers)
    far = np.linalg.norm(pins - half, axis=1).argsort()[-4:]
    outer = np.mean([_pitch(solved, board[i], powers) / pitch for i in far])
    std = error / np.linalg.norm(_slopes(solved, middle, powers), axis=0)
    scale = spacing * np.abs(places).max()
    return PinBoard(
        (float(scale * pitch[0]), float(scale * pitch[1])),
        (float(std[0]), float(std[1])),
        float(1 - outer),
        pins,
        places,
    )


def _pitch(solved: Array, at: Array, powers: NDArray[np.int64]) -> Array:
    """How far (2,) one moves on the board for a pixel along x and along y of the image, at (2,) on the board."""
    return np.asarray(np.linalg.norm(np.linalg.inv(_slopes(solved, at, powers)), axis=0))


def _peaks(change: Array) -> Array:
    """Where pins change the brightness most (n, 2) (column, row) [px], of a change (H, W, 3)."""
    from scipy import ndimage
    from skimage.feature import peak_local_max

    sigma = _SMOOTH * min(change.shape[:2])
    size = ndimage.gaussian_filter(change.mean(-1), sigma)
    size -= ndimage.gaussian_filter(change.mean(-1), 5 * sigma)
    # pins are darker than the gel in some sensors, brighter in others
    size *= -1 if abs(size.min()) > size.max() else 1
    rough = peak_local_max(size, min_distance=round(2 * sigma), threshold_rel=_CLEAR, exclude_border=False)
    out, reach = [], round(1.5 * sigma)
    for row, column in rough:
        top, left = max(0, row - reach), max(0, column - reach)
        weight = np.maximum(size[top : row + reach + 1, left : column + reach + 1] - 0.5 * size[row, column], 0)
        v, u = np.indices(weight.shape) + np.array([top, left])[:, None, None]
        out.append([(u * weight).sum() / weight.sum(), (v * weight).sum() / weight.sum()])
    return np.array(out).reshape(-1, 2)


def _in_grid(peaks: Array, middle: Array) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Which of ``peaks`` (n, 2) stand in one grid (m,), and where in it (m, 2): from the middle outwards, each where the last
    leads one to expect it."""
    none = np.zeros(0, np.int64), np.zeros((0, 2), np.int64)
    if len(peaks) < _FEWEST:
        return none
    start = int(np.linalg.norm(peaks - middle, axis=1).argmin())
    off = peaks - peaks[start]
    sides = []
    for direction in np.eye(2):  # the nearest peak that lies mainly along this way
        along = off @ direction
        ahead = np.flatnonzero(along > 0.9 * np.linalg.norm(off, axis=1) + 1e-9)
        if not len(ahead):
            return none
        sides.append(off[ahead[along[ahead].argmin()]])
    place, steps, todo = {start: (0, 0)}, {start: np.array(sides)}, [start]
    while todo:
        here = todo.pop(0)
        for axis, sign in ((0, 1), (0, -1), (1, 1), (1, -1)):
            step = sign * steps[here][axis]
            far = np.linalg.norm(peaks - peaks[here] - step, axis=1)
            there = int(far.argmin())
            if far[there] > _BESIDE * np.linalg.norm(step) or there in place:
                continue
            i, j = place[here]
            place[there] = (i + sign * (axis == 0), j + sign * (axis == 1))
            steps[there] = steps[here].copy()
            steps[there][axis] = sign * (peaks[there] - peaks[here])
            todo.append(there)
    return np.array(list(place), np.int64), np.array(list(place.values()), np.int64)


def _powers(n: int) -> NDArray[np.int64]:
    """Powers (m, 2) of x and y in the polynomial that ``n`` pins determine."""
    degree = 5 if n >= _MANY else 3
    return np.array([(i, k - i) for k in range(degree + 1) for i in range(k, -1, -1)])


def _terms(at: Array, powers: NDArray[np.int64]) -> Array:
    """Terms (n, m) of a polynomial at (n, 2)."""
    return np.asarray((at[:, None] ** powers).prod(-1))


def _slopes(solved: Array, at: Array, powers: NDArray[np.int64]) -> Array:
    """Slopes (2, 2) of a polynomial (m, 2) at (2,): d (column, row) by d (along x, along y) of the board."""
    slopes = []
    for axis in (0, 1):
        less = powers.copy()
        less[:, axis] = np.maximum(less[:, axis] - 1, 0)
        slopes.append((powers[:, axis] * _terms(at[None], less)[0]) @ solved)
    return np.stack(slopes, 1)
