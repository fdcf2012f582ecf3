"""Numbered files of a folder, each made once, by several processes: a stopped run goes on with those that are missing."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path

from geomtact.progress import Progress


def write_all(
    folder: Path,
    n: int,
    write: Callable[[Path, int], None],
    whole: Callable[[Path], bool],
    doing: str,
    progress: Progress | None = None,
    processes: int = 2,
) -> None:
    """Have ``write`` make 0.npz to ``n`` - 1.npz in ``folder``, all but those that are ``whole``."""
    folder.mkdir(parents=True, exist_ok=True)
    todo = [i for i in range(n) if not whole(folder / f"{i}.npz")]
    done = n - len(todo)
    # processes, because much of the work holds the interpreter; spawned, because Embree and OpenMP do not survive a fork
    with ProcessPoolExecutor(processes, get_context("spawn"), _one_thread) as pool:
        futures = [pool.submit(write, folder / f"{i}.npz", i) for i in todo]
        try:
            for future in as_completed(futures):
                future.result()
                done += 1
                if progress:
                    progress(done / n, doing)
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


def _one_thread() -> None:
    import cv2

    os.environ["OMP_NUM_THREADS"] = "1"
    cv2.setNumThreads(1)
