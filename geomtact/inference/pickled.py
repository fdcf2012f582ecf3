"""A fitted score by reference: pickled by what it was fitted on, and read from the cache once in each process."""

from __future__ import annotations

from functools import lru_cache
from typing import Any, TypeVar

from geomtact.contact_space.index import Index
from geomtact.errors import CacheError
from geomtact.scoring.fitted import fitted_scorer
from geomtact.scoring.probability import Calibration

_Kind = TypeVar("_Kind")


@lru_cache(4)
def reopened(kind: type[_Kind], index: Index, scorer: str, calibration: Calibration, *rest: Any) -> _Kind:
    """``kind(index, scorer, *rest)`` with the score of that name, read from the cache entry of ``index``.

    Raises
    ------
    CacheError
        The score there has another ``calibration``.
    """
    fitted = fitted_scorer(scorer, index, index.folder)
    if fitted.calibration != calibration:
        raise CacheError(
            f"cache entry {index.folder}: its score {scorer!r} is not the one that was pickled; prepare the object again, and "
            "pickle it again"
        )
    return kind(index, fitted, *rest)  # type: ignore[call-arg]
