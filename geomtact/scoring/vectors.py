"""Scores from one vector a contact: every stored contact is described once, and a touch is one pass over a matrix."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from geomtact.contact_space.index import Index
from geomtact.files import write_whole
from geomtact.progress import Progress
from geomtact.scoring.overlap import to_grid
from geomtact.sensing.contact import SoftMask
from geomtact.sensing.moments import cleaned
from geomtact.sensing.sensor import Sensor

_BATCH = 4096  # contacts described at a time


class Descriptor(Protocol):
    """Maps contact masks to vectors whose Euclidean distance measures the dissimilarity of contacts.

    What is compared by its cosine comes as unit vectors: between those, the distance grows as the cosine falls.
    """

    @property
    def name(self) -> str: ...

    def describe(self, masks: NDArray[np.bool_], sensor: Sensor) -> NDArray[np.float32]:
        """Vectors (m, d) of contact masks (m, h, w) over the window of ``sensor``."""
        ...


@dataclass(frozen=True, eq=False)
class VectorScorer:
    """Minus the squared distance between the vectors of the observed and of every stored contact.

    Attributes
    ----------
    descriptor : what makes the vectors
    stored : (N, d) vector of every pose's contact
    """

    descriptor: Descriptor
    stored: NDArray[np.float32]

    @property
    def name(self) -> str:
        return self.descriptor.name

    @cached_property
    def _squared(self) -> NDArray[np.float32]:
        return np.asarray(np.einsum("nd,nd->n", self.stored, self.stored), np.float32)

    def score(self, index: Index, mask: SoftMask) -> NDArray[np.float32]:
        """Similarity (P, n) of ``mask`` (h, w) to the mask of every pose: minus the squared distance of the vectors."""
        seen = self.seen(index, mask)
        out = self.stored @ (2 * seen)
        out -= self._squared
        out -= np.float32(seen @ seen)
        return out.reshape(index.height.shape)

    def seen(self, index: Index, mask: SoftMask) -> NDArray[np.float32]:
        """Vector (d,) of the observed ``mask`` (h, w)."""
        small = to_grid(cleaned(mask, index.sensor), index.resolution.mask_shape)
        return self.descriptor.describe(small[None], index.sensor)[0]


def describe_index(
    index: Index, descriptor: Descriptor, path: Path | None = None, progress: Progress | None = None
) -> NDArray[np.float32]:
    """The vectors (N, d) of all stored contacts, read from ``path`` where they were computed before, and kept there.

    They are rounded to half precision, which the file has: that changes the log mass of the true pose by 0.0001 nats in the mean.
    """
    if path is not None:
        with contextlib.suppress(OSError, ValueError):
            stored = np.load(path, allow_pickle=False)
            if stored.ndim == 2 and len(stored) == len(index):
                return stored.astype(np.float32)
    stored = np.concatenate(list(_batches(index, descriptor, progress)))
    if path is not None:
        with contextlib.suppress(OSError):  # a read-only cache costs the pass each time, no more
            write_whole(path, lambda temporary: np.save(temporary, stored, allow_pickle=False))
    return stored.astype(np.float32)


def _batches(index: Index, descriptor: Descriptor, progress: Progress | None) -> Iterator[NDArray[np.float16]]:
    for start in range(0, len(index), _BATCH):
        ids = np.arange(start, min(start + _BATCH, len(index)))
        yield descriptor.describe(index.masks(ids), index.sensor).astype(np.float16)
        if progress:
            progress(float(ids[-1] + 1) / len(index), f"describing contacts by {descriptor.name}")
