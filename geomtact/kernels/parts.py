"""Many poses shared out among threads: compiled loops leave the interpreter to others."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import TypeVar

from geomtact.threads import thread_count

_T = TypeVar("_T")


def by_parts(work: Callable[[slice], _T], n: int, size: int) -> list[_T]:
    """``work`` done for ``n`` rows, ``size`` of them at a time, in their order."""
    parts = [slice(start, start + size) for start in range(0, max(n, 1), size)]
    return [work(parts[0])] if len(parts) == 1 else list(_pool(os.getpid()).map(work, parts))


@cache
def _pool(process: int) -> ThreadPoolExecutor:
    """The threads of a process, by its number: a process that it forks has none of them."""
    return ThreadPoolExecutor(thread_count())
