"""Scores from overlaps of bit-packed masks: a pass over a million masks is a pass over a hundred megabytes."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from geomtact.contact_space.index import Index, pack
from geomtact.sensing.contact import SoftMask
from geomtact.threads import thread_count

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

    with ThreadPoolExecutor(thread_count()) as pool:
        list(pool.map(work, [(level, start) for level in range(levels) for start in range(0, n, _CHUNK)]))
    return out


@dataclass(frozen=True)
class Overlap:
    """A score of how many pixels two masks share.

    The stored masks and their areas: 98 bytes per pose at 32 x 24 pixels, 386 at 64 x 48; a count of bits a word to compare.

    Attributes
    ----------
    name : "iou" for the intersection over the union, "l1" for the share of pixels on which the masks agree, which is one minus
        the thesis's pixel distance (its baseline that fails, Fig. 8)
    """

    name: str

    def score(self, index: Index, mask: SoftMask) -> NDArray[np.float32]:
        """Similarity (P, n) of ``mask`` (h, w) to the mask of every pose, 0 to 1."""
        mask = to_grid(mask, index.resolution.mask_shape)
        shared = overlaps(index.bits, mask)
        both = index.area.astype(np.int32) + int(mask.sum())
        if self.name == "l1":
            return np.float32(1) - (both - 2 * shared).astype(np.float32) / np.float32(mask.size)
        ratio: NDArray[np.float32] = shared.astype(np.float32)
        ratio /= np.maximum(both - shared, 1)
        return ratio


def to_grid(mask: SoftMask, shape: Sequence[int]) -> NDArray[np.bool_]:
    """``mask`` (H, W) on another grid (h, w) over the same window: contact where most of the pixel's area is."""
    small = cv2.resize(np.asarray(mask, np.float32), (shape[1], shape[0]), interpolation=cv2.INTER_AREA)
    return small >= 0.5


OVERLAPS = {name: Overlap(name) for name in ("l1", "iou")}
