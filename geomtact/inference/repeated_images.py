"""Each image is evidence once: of one that is given for two sensors, or that the prior was made from, the user is warned."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from geomtact.inference.files import WITHOUT_PRIOR
from geomtact.inference.posterior import Posterior


def digest(image: ArrayLike) -> str:
    """A hash that distinguishes images."""
    array = np.ascontiguousarray(image)
    return hashlib.blake2b(array.tobytes() + str((array.shape, array.dtype)).encode(), digest_size=8).hexdigest()


def counted_once(posterior: Posterior, prior: Any) -> Posterior:
    """``posterior`` with a warning for every image that counts twice, and with the prior's images in its provenance."""
    own = [view.digest for view in posterior.provenance.views]
    warnings = [
        f"images {i + 1} and {j + 1} are the same: give each sensor its own, or one touch counts twice"
        for i, j in combinations(range(len(own)), 2)
        if own[i] is not None and own[i] == own[j]
    ]
    before = prior.provenance.images if isinstance(prior, Posterior) else ()
    if set(before) & set(own):
        warnings.append(
            "the prior was made from the same image, which so counts twice: give one of other touches alone"
        )
    if isinstance(prior, Posterior) and prior.provenance.lacks_prior:
        warnings.append(f"prior: {WITHOUT_PRIOR}")
    provenance = replace(posterior.provenance, earlier_images=before)
    return replace(posterior, provenance=provenance, warnings=posterior.warnings + warnings)
