"""Each image is evidence once: one that is given for two sensors, or that the prior was made from, is found and said."""

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
    """What tells one image from another."""
    array = np.ascontiguousarray(image)
    return hashlib.blake2b(array.tobytes() + str((array.shape, array.dtype)).encode(), digest_size=8).hexdigest()


def counted_once(posterior: Posterior, prior: Any) -> Posterior:
    """``posterior`` with a warning for every image that is counted twice, and with the prior's images among its own.

    ``settings["images"]`` holds the :func:`digest` of every image with contact, None for one without.
    """
    own = posterior.settings["images"]
    warnings = [
        f"images {i + 1} and {j + 1} are the same: each sensor's own is wanted, or one touch counts twice"
        for i, j in combinations(range(len(own)), 2)
        if own[i] is not None and own[i] == own[j]
    ]
    before = prior.settings.get("images", []) if isinstance(prior, Posterior) else []
    if any(image is not None and image in before for image in own):
        warnings.append(
            "the prior was made from the same image, which so counts twice: give one of other touches alone"
        )
    if isinstance(prior, Posterior) and WITHOUT_PRIOR in prior.warnings:
        warnings.append(f"prior: {WITHOUT_PRIOR}")
    settings = posterior.settings | {"images": own + [image for image in before if image is not None]}
    return replace(posterior, settings=settings, warnings=posterior.warnings + warnings)
