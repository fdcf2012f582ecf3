"""The evidence of a touch for an object, and whether the touch is an outlier for it.

The network's score compares poses of one object only. Between objects, the moments' likelihood is compared: a density over
the moments of a touch, which integrates to one for every object.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geomtact.contact_space.index import Index
from geomtact.scoring.moments import Moments
from geomtact.sensing.contact import SoftMask

_SMALL = 60_000  # number of poses up to which the mean is over all of them; hand-set, for speed


@dataclass(frozen=True, eq=False)
class EvidenceModel:
    """The moments' likelihood under the uniform distribution, or under a prior.

    Attributes
    ----------
    moments : fitted to the index
    limits : (evidence, likelihood of the best pose): log values that 99 % of the object's touches reach
    """

    moments: Moments
    limits: tuple[float, float] = (-np.inf, -np.inf)

    def evidence(
        self, index: Index, mask: SoftMask, log_prior: NDArray[np.floating] | None = None, above: float = 0.0
    ) -> tuple[float, float]:
        """Log evidence of ``mask`` (h, w), and the log likelihood of the best pose.

        Under the uniform distribution on a large grid the mean is over poses drawn once for all; ``log_prior`` (N,) are
        log masses, and ``above`` as of :meth:`FittedScorer.cells`: without a prior all depths are alike.
        """
        if log_prior is None and len(index) <= _SMALL:
            log_prior = index.log_weight
        if log_prior is None:
            likelihood = self.moments.of_drawn(index, mask).astype(float)
            log_mass: NDArray[np.floating] = np.full(len(likelihood), -np.log(len(likelihood)))
        else:
            likelihood = index.deeper(self.moments.score(index, mask), above).ravel().astype(float)
            log_mass = log_prior
        return float(np.logaddexp.reduce(likelihood + log_mass)), float(likelihood.max())

    def is_outlier(self, evidence: float, best: float) -> bool:
        """Whether hardly any touch of the object is so unlikely under the uniform distribution: as a whole, or at its best
        pose."""
        return evidence < self.limits[0] or best < self.limits[1]
