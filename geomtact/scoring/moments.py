"""Contacts compared by their moments: where the contact lies, how large it is, and how it is stretched.

On a grid whose cells are larger than a contact, two touches in one cell share hardly a pixel, so overlap constrains little.
Their moments still agree: centroid, area, size, elongation along and across. How far they may differ within a cell,
through the gel's elasticity and through the sensor's noise is learned from simulated touches as the mean and the
covariance of the difference, and a Student t makes it a likelihood that outliers do not upset.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln

from geomtact.contact_space.index import Index
from geomtact.se3 import Array
from geomtact.sensing.contact import SoftMask
from geomtact.sensing.moments import moments_of

_CHUNK = 1 << 15


@dataclass(frozen=True)
class Moments:
    """Student t likelihood of the observed contact's moments, given those stored for a pose.

    6 numbers: 24 bytes per pose, 42 multiplications to compare.

    Attributes
    ----------
    bias : (6,) mean of observed minus stored
    covariance : (6, 6) of observed minus stored
    freedom : degrees of freedom of the t distribution; the heavier the tails, the fewer
    """

    bias: Array
    covariance: Array
    freedom: float = 5.0
    name: str = "moments"

    @classmethod
    def fit(cls, index: Index, masks: list[NDArray[np.bool_]], ids: NDArray[np.int64], freedom: float = 5.0) -> Moments:
        """The difference between touches ``masks`` (h, w) and the poses ``ids`` (n,) whose cells hold them.

        Maximum likelihood for a t distribution by iterated reweighting (Lange, Little and Taylor, 1989).
        """
        seen = np.stack([moments_of(m, index.sensor) for m in masks])
        difference = (seen - index.moments[:, ids].T).astype(float)
        bias, covariance = difference.mean(0), np.cov(difference.T)
        d = difference.shape[1]
        for _ in range(30):
            off = difference - bias
            weight = (freedom + d) / (freedom + np.einsum("ni,ij,nj->n", off, np.linalg.inv(covariance), off))
            bias = weight @ difference / weight.sum()
            off = difference - bias
            covariance = (weight[:, None] * off).T @ off / len(off) + 1e-6 * np.eye(d)
        return cls(bias, covariance, freedom)

    @cached_property
    def _whiten(self) -> Array:
        return np.linalg.cholesky(np.linalg.inv(self.covariance)).T

    def score(self, index: Index, mask: SoftMask) -> NDArray[np.float32]:
        """Log likelihood (P, n) of the moments of ``mask``."""
        return self._of(index, mask, index.moments).reshape(index.height.shape)

    def of_drawn(self, index: Index, mask: SoftMask) -> NDArray[np.float32]:
        """As :meth:`score`, at the poses of ``index.drawn_moments`` alone: (m,)."""
        return self._of(index, mask, index.drawn_moments)

    def _of(self, index: Index, mask: SoftMask, stored: NDArray[np.float32]) -> NDArray[np.float32]:
        seen = moments_of(mask, index.sensor) - self.bias
        W = self._whiten.astype(np.float32)
        target = (W @ seen).astype(np.float32)
        d, nu = len(seen), self.freedom
        norm = (
            gammaln((nu + d) / 2)
            - gammaln(nu / 2)
            - 0.5 * (d * np.log(nu * np.pi) + np.linalg.slogdet(self.covariance)[1])
        )
        out = np.zeros(stored.shape[1], np.float32)
        for start in range(0, len(out), _CHUNK):
            part = slice(start, start + _CHUNK)
            off = W @ stored[:, part]
            off -= target[:, None]
            out[part] = np.log1p(np.einsum("in,in->n", off, off) / np.float32(nu))
        return np.float32(norm) - np.float32((nu + d) / 2) * out
