"""Many poses shared out among threads: compiled loops leave the interpreter to others."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from itertools import pairwise
from typing import TypeVar

from geomtact.threads import thread_count

_LEAST = 32  # rows that are worth a thread
_T = TypeVar("_T")


def by_parts(work: Callable[[slice], _T], n: int, size: int) -> list[_T]:
    """``work`` done for ``n`` rows in their order, by parts of about equal size: of ``size`` rows at most, and smaller ones where
    threads had none else."""
    count = max(-(-n // size), min(n // _LEAST, thread_count()), 1)
    ends = [n * k // count for k in range(count + 1)]
    parts = [slice(start, end) for start, end in pairwise(ends)]
    return [work(parts[0])] if len(parts) == 1 else list(_pool(os.getpid()).map(work, parts))


@cache
def _pool(process: int) -> ThreadPoolExecutor:
    """The threads of a process, by its number: a process that it forks has none of them."""
    return ThreadPoolExecutor(thread_count())
