"""How long each stage of a localization takes."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def timed(timing_ms: dict[str, float], stage: str) -> Iterator[None]:
    """Write the time that the block takes into ``timing_ms`` under ``stage``."""
    start = time.perf_counter()
    yield
    timing_ms[stage] = 1e3 * (time.perf_counter() - start)
