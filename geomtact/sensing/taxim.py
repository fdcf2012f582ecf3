"""The colour tables of Taxim (Si and Yuan, RA-L 2022), read as the colours of a sensor.

A table says by how much each channel gets brighter for a slope of the gel, in bins of its steepness (0 to 90 degrees) and its
direction (-180 to 180, from along the columns towards along the rows), as a polynomial of second degree in the pixel's column
and row. That is the other way round than that of :class:`ColourTable`, which is fitted to what the table shows.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from geomtact.errors import SensorError
from geomtact.se3 import Array
from geomtact.sensing.colour import ColourTable, fit_weights, terms

_NAMES = ("bins", "grad_r", "grad_g", "grad_b")
_STEEPEST = np.radians(30)  # that is fitted: beyond, colours hardly change any more
_PLACES = 60_000  # all over the image, half of them fitted to and half held out


def read_table(path: str | Path) -> Array:
    """The table (bins, bins, 3, 6) of a file ``polycalib.npz``: RGB for each steepness and direction, in 255ths.

    Taxim reads images by OpenCV, blue first: what it names ``grad_r`` is the blue channel.

    Raises
    ------
    SensorError
        It is no such file.
    """
    try:
        with np.load(path, allow_pickle=False) as data:
            bins, *channels = (data[name] for name in _NAMES)
    except (OSError, ValueError, KeyError, EOFError) as error:
        raise SensorError(f"{path}: expected a colour table of Taxim with {', '.join(_NAMES)} ({error})") from None
    table = np.stack([np.asarray(each, float) for each in reversed(channels)], -2)
    if table.shape != (int(bins), int(bins), 3, 6) or int(bins) < 2 or not np.isfinite(table).all():
        raise SensorError(
            f"{path}: expected three finite tables ({int(bins)}, {int(bins)}, 6), got {channels[0].shape}"
        )
    return table


def change_of(table: Array, slope: Array, u: NDArray, v: NDArray) -> Array:
    """The change of colour (n, 3), 0..1, that a table gives for slopes (n, 2), of depth along columns and along rows, at columns
    ``u`` (n,) and rows ``v`` (n,)."""
    last = len(table) - 1
    steep = np.arctan(np.hypot(*slope.T)) / (0.5 * np.pi) * last
    towards = (np.arctan2(slope[:, 1], slope[:, 0]) + np.pi) / (2 * np.pi) * last
    place = np.stack([u * u, v * v, u * v, u, v, np.ones_like(u)], 1)
    weights = table[steep.astype(int), towards.astype(int)]  # (n, 3, 6)
    return np.asarray(np.einsum("nck,nk->nc", weights, place) / 255)


def colours_of_taxim(path: str | Path, shape: tuple[int, int]) -> ColourTable:
    """The colours of a sensor whose images are ``shape`` = (H, W), the same as those that the table was made from.

    Raises
    ------
    SensorError
        As of :func:`read_table`.
    """
    table, rng = read_table(path), np.random.default_rng(0)
    h, w = shape
    u, v = rng.uniform(0, w, _PLACES), rng.uniform(0, h, _PLACES)
    steep, towards = np.tan(rng.uniform(0, _STEEPEST, _PLACES)), rng.uniform(-np.pi, np.pi, _PLACES)
    slope = steep[:, None] * np.stack([np.cos(towards), np.sin(towards)], 1)
    # what is no slope in a tactile image has the background's colour, and so has it here
    change = change_of(table, slope, u, v) - change_of(table, 0 * slope, u, v)
    features, fitted = terms(change, u, v, shape), np.arange(_PLACES) % 2 == 0
    weights = fit_weights(features[fitted], slope[fitted])
    off = features[~fitted] @ weights.T - slope[~fitted]
    x, y = (tuple(map(float, row)) for row in weights)
    return ColourTable((x, y), float(np.sqrt((off**2).mean())), 0.0, 0.0)
