"""Scores from overlaps of bit-packed masks: a pass over a million masks is a pass over a hundred megabytes."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from geomtact.contact_space.index import Index, pack
from geomtact.sensing.contact import Shown

_THREADS = 2
_CHUNK = 1 << 15  # poses a step: the words of one chunk stay in the processor's cache


def overlaps(bits: NDArray[np.uint64], mask: NDArray[np.bool_]) -> NDArray[np.int32]:
    """Number of pixels (P, n) that each of the packed masks ``bits`` (P, words, n) shares with ``mask`` (h, w)."""
    words = pack(mask.ravel())
    levels, n_words, n = bits.shape
    out = np.zeros((levels, n), np.int32)

    def work(task: tuple[int, int]) -> None:
        level, start = task
        part = bits[level, :, start : start + _CHUNK]
        count = np.zeros(part.shape[1], np.uint16)
        for w in range(n_words):
            if words[w]:
                count += np.bitwise_count(part[w] & words[w])
        out[level, start : start + _CHUNK] = count

    with ThreadPoolExecutor(_THREADS) as pool:
        list(pool.map(work, [(level, start) for level in range(levels) for start in range(0, n, _CHUNK)]))
    return out


@dataclass(frozen=True)
class PixelL1:
    """Share of pixels on which two masks agree: one minus the thesis's pixel distance (its baseline that fails, Fig. 8).

    The stored masks and their areas: 98 bytes per pose at 32 x 24 pixels, 386 at 64 x 48; a count of bits a word to compare.
    """

    name: str = "l1"

    def score(self, index: Index, mask: Shown) -> NDArray[np.float32]:
        mask = to_grid(mask, index.resolution.mask_shape)
        shared = overlaps(index.bits, mask)
        differing = index.area.astype(np.int32) + int(mask.sum()) - 2 * shared
        return np.float32(1) - differing.astype(np.float32) / np.float32(mask.size)


@dataclass(frozen=True)
class IoU:
    """Intersection over union.

    The stored masks and their areas: 98 bytes per pose at 32 x 24 pixels, 386 at 64 x 48; a count of bits a word to compare.
    """

    name: str = "iou"

    def score(self, index: Index, mask: Shown) -> NDArray[np.float32]:
        mask = to_grid(mask, index.resolution.mask_shape)
        shared = overlaps(index.bits, mask)
        union = index.area.astype(np.int32) + int(mask.sum()) - shared
        ratio: NDArray[np.float32] = shared.astype(np.float32)
        ratio /= np.maximum(union, 1)
        return ratio


def to_grid(mask: Shown, shape: Sequence[int]) -> NDArray[np.bool_]:
    """``mask`` (H, W) on another grid (h, w) over the same window: contact where most of the pixel's area is."""
    small = cv2.resize(np.asarray(mask, np.float32), (shape[1], shape[0]), interpolation=cv2.INTER_AREA)
    return small >= 0.5


OVERLAPS = {s.name: s for s in (PixelL1(), IoU())}
