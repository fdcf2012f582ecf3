"""How many threads share compiled work. Results do not depend on it, because rows of the work do not depend on one another."""

from __future__ import annotations

import os

_MOST = 8  # beyond, parts are too few to keep them busy


def thread_count() -> int:
    """As many as ``OMP_NUM_THREADS`` says, or as this process may use processors, 8 at most."""
    stated = os.environ.get("OMP_NUM_THREADS", "")
    if stated.isdigit() and int(stated):
        return min(int(stated), _MOST)
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min(cores, _MOST)
