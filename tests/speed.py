"""Which instances of a law run in the fast suite."""

from collections.abc import Iterable
from typing import Any

import pytest


def slow_but(params: Iterable[Any], *fast: Any) -> list[Any]:
    """All of ``params``, those that are not among ``fast`` marked slow: `sh tools/test.sh --all` alone runs them."""
    params = list(params)
    assert fast and all(each in params for each in fast), f"expected some of {params}, got {fast}"
    return [each if each in fast else pytest.param(each, marks=pytest.mark.slow) for each in params]
