"""Many independent tasks over the cores of one machine, or over a cluster by Ray (extra ``cluster``).

A task is a call that makes files from files and finds those that are there already. So it may be done twice, and a process that
is killed loses its own task alone, which is then done anew.
"""

from __future__ import annotations

import logging
import os
import socket
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING

from geomtact.errors import GeomtactError, UsageError

if TYPE_CHECKING:
    from geomtact.sensing.sensor import Sensor

_TRIES = 3  # of a task whose process dies
_AHEAD = 4  # tasks handed to a cluster for each of its cores
_CONNECT_TIMEOUT = 5.0  # s
_DIED = "its process died three times, twice running alone; it may need more memory"


def prepare_part(
    mesh: str, unit: str | None, sensor: str | Sensor, scorer: str, max_poses: int, cache_dir: str | Path | None
) -> None:
    """Prepare an object as ``Localizer.prepare`` does, and leave it in the cache."""
    from geomtact.localizer import Localizer

    Localizer.prepare(mesh, unit, sensor, scorer=scorer, max_poses=max_poses, cache_dir=cache_dir)


def run_all(
    work: Callable[..., object], tasks: Sequence[tuple[object, ...]], jobs: int = 1, ray: str | None = None
) -> Iterator[tuple[int, GeomtactError | None]]:
    """Call ``work(*task)`` for each task: yields its number as soon as it is done, and what was wrong with it, if anything was.

    Parameters
    ----------
    work : a function of a module, whose results are files
    jobs : processes on this machine
    ray : address of a Ray cluster, "auto" for the one that this machine belongs to; its machines need the same geomtact, and
        the files at the same paths

    Raises
    ------
    UsageError
        Ray is not installed, or there is no cluster at the address.
    """
    if ray is not None:
        yield from _by_ray(work, tasks, ray)
    elif jobs == 1:
        for number, task in enumerate(tasks):
            with _one_thread():
                wrong = _done(work, task)
            yield number, wrong
    else:
        yield from _by_processes(work, tasks, jobs)


def _done(work: Callable[..., object], task: tuple[object, ...]) -> GeomtactError | None:
    """Do a task; what was wrong with it."""
    try:
        work(*task)
    except GeomtactError as error:
        return error
    except Exception as error:  # noqa: BLE001 too little memory, a full disk: of this task, not of the others
        return GeomtactError(f"{type(error).__name__}: {error}")
    return None


@contextmanager
def _one_thread() -> Iterator[None]:
    """This process computes with one thread, as all others do: the files are the same to the last bit."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _by_processes(
    work: Callable[..., object], tasks: Sequence[tuple[object, ...]], jobs: int
) -> Iterator[tuple[int, GeomtactError | None]]:
    waiting, lost = list(range(len(tasks)))[::-1], list[int]()
    while waiting:
        yield from _in_a_pool(work, tasks, waiting, jobs, lost)
    for number in lost:  # each alone, so that none dies by another's fault
        for _ in range(_TRIES - 1):
            lost_again: list[int] = []
            yield from _in_a_pool(work, tasks, [number], 1, lost_again)
            if not lost_again:
                break
        else:
            yield number, GeomtactError(_DIED)


def _in_a_pool(
    work: Callable[..., object], tasks: Sequence[tuple[object, ...]], waiting: list[int], jobs: int, lost: list[int]
) -> Iterator[tuple[int, GeomtactError | None]]:
    """Do the tasks ``waiting``, from the last, until one's process dies: it and those under way then are added to ``lost``."""
    with _one_thread_each(), ProcessPoolExecutor(jobs, get_context("spawn")) as pool:
        running: dict[Future, int] = {}
        whole = True
        while running or (waiting and whole):
            while waiting and whole and len(running) < jobs:
                try:
                    running[pool.submit(_done, work, tasks[waiting[-1]])] = waiting[-1]
                    waiting.pop()
                except BrokenProcessPool:
                    whole = False
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                number = running.pop(future)
                try:
                    yield number, future.result()
                except BrokenProcessPool:
                    whole = False
                    lost.append(number)


@contextmanager
def _one_thread_each() -> Iterator[None]:
    """Processes that begin here have one thread each for linear algebra."""
    before = os.environ.get("OMP_NUM_THREADS")
    os.environ["OMP_NUM_THREADS"] = "1"
    try:
        yield
    finally:
        if before is None:
            del os.environ["OMP_NUM_THREADS"]
        else:
            os.environ["OMP_NUM_THREADS"] = before


def _by_ray(
    work: Callable[..., object], tasks: Sequence[tuple[object, ...]], address: str
) -> Iterator[tuple[int, GeomtactError | None]]:
    try:
        import ray
    except ImportError:
        raise UsageError("--ray needs Ray; install it with: pip install 'geomtact[cluster]'") from None
    try:
        if ":" in address.removeprefix("ray://"):  # Ray itself would try for minutes
            host, port = address.removeprefix("ray://").rsplit(":", 1)
            socket.create_connection((host, int(port)), timeout=_CONNECT_TIMEOUT).close()
        ray.init(address=address, ignore_reinit_error=True, log_to_driver=False, logging_level=logging.ERROR)
    except (OSError, ValueError, RuntimeError) as error:
        raise UsageError(
            f"--ray: no cluster at {address!r} ({str(error).splitlines()[0]}); run 'ray start --head' there, or give auto"
        ) from None
    remote = ray.remote(num_cpus=1, max_retries=_TRIES - 1)(_done)
    waiting, running = list(range(len(tasks)))[::-1], dict[object, int]()
    while waiting or running:
        while waiting and len(running) < _AHEAD * max(1, int(ray.cluster_resources().get("CPU", 1))):
            number = waiting.pop()
            running[remote.remote(work, tasks[number])] = number
        (future, *_), _ = ray.wait(list(running), num_returns=1)
        number = running.pop(future)
        try:
            yield number, ray.get(future)
        except ray.exceptions.RayError as error:
            yield number, GeomtactError(f"failed three times on the cluster: {str(error).splitlines()[0]}")
