"""Where tasks run: processes of this machine, or a Dask cluster. Both are executors of `concurrent.futures`."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import get_context
from typing import Any

from og_pointcloud.errors import MissingExtraError, OgPointcloudError
from og_pointcloud.fitting.memory import free_memory

__all__ = ["LocalWorkers", "Share", "dask_executor", "share_here"]

THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
SHARE_OF_LIMIT = 0.6
"""Of the memory that a Dask worker may hold, what its tasks take: at 0.8 it would be paused, at 0.95 killed."""
LEAST_BYTES = 10**9
"""Memory that a fit is given at least, if need be by fewer workers."""
TRIES = 2
"""Processes that a task may kill before it is given up."""
PATIENCE_S = 20


@dataclass(frozen=True)
class Share:
    """What a task may take. threads: None for as many as there are; memory: bytes, None for what the fit decides."""

    threads: int | None = None
    memory: int | None = None

    @classmethod
    def of_machine(cls, workers: int) -> Share:
        """What each of so many workers may take of this machine: its cores, and half of its free memory."""
        return cls(max(1, cores_here() // workers), free_memory() // 2 // workers)


def cores_here() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def share_here(otherwise: Share) -> Share:
    """What a task may take where it runs: in a Dask worker one thread, and of the worker's memory what is left for each
    of its threads; elsewhere what it was given."""
    if "distributed" not in sys.modules:
        return otherwise
    from distributed import get_worker

    try:
        worker = get_worker()
    except ValueError:  # this process is no worker
        return otherwise
    limit = worker.memory_manager.memory_limit
    return Share(1, int(SHARE_OF_LIMIT * limit / worker.state.nthreads) if limit else None)


class LocalWorkers(Executor):
    """Processes of this machine, each with its share of cores and memory.

    Each works on one task at a time, so that where one dies (killed, out of memory, a crash in a library) it is known
    which task it was: that is tried once more in a new process, and the others go on.
    """

    def __init__(self, tasks: int) -> None:
        """tasks: how many there will be; there are as many processes at most, and as cores."""
        self.workers = max(1, min(tasks, cores_here(), free_memory() // 2 // LEAST_BYTES))
        self.share = Share.of_machine(self.workers)
        self._threads = ThreadPoolExecutor(self.workers)
        self._own, self._pools, self._guard = threading.local(), set[ProcessPoolExecutor](), threading.Lock()
        self._before = {name: os.environ.get(name) for name in THREAD_VARIABLES}
        # Read when a library starts, which may be before a task could say so: hence inherited.
        os.environ.update(dict.fromkeys(THREAD_VARIABLES, str(self.share.threads)))

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """As `concurrent.futures.Executor` has it."""
        return self._threads.submit(self._run, fn, args, kwargs)

    def _run(self, fn: Callable[..., Any], args: Any, kwargs: Any) -> Any:
        for attempt in range(1, TRIES + 1):
            if (pool := getattr(self._own, "pool", None)) is None:
                pool = self._own.pool = ProcessPoolExecutor(1, get_context("spawn"))
                with self._guard:
                    self._pools.add(pool)
            try:
                return pool.submit(fn, *args, **kwargs).result()
            except BrokenProcessPool:
                self._own.pool = None
                if attempt == TRIES:
                    raise
        raise AssertionError

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """As `concurrent.futures.Executor` has it; with cancel_futures, tasks that run are ended too."""
        self._threads.shutdown(wait=False, cancel_futures=cancel_futures)
        with self._guard:
            pools = list(self._pools)
        if cancel_futures:
            for process in (process for pool in pools for process in (pool._processes or {}).values()):
                process.terminate()
        self._threads.shutdown(wait=wait)
        for pool in pools:
            pool.shutdown(wait=wait, cancel_futures=cancel_futures)
        for name, value in self._before.items():
            os.environ.pop(name, None) if value is None else os.environ.__setitem__(name, value)


@contextmanager
def dask_executor(address: str) -> Iterator[Executor]:
    """An executor of the Dask cluster whose scheduler has this address, as `dask scheduler` prints it.

    Its workers see the same files by the same paths. MissingExtraError without the extra 'cluster'; OgPointcloudError
    where no scheduler answers, or it has no workers.
    """
    try:
        from distributed import Client
    except ImportError:
        raise MissingExtraError("distributed", "cluster") from None
    try:
        client = Client(address, timeout=PATIENCE_S)
    except (OSError, ValueError) as error:
        raise OgPointcloudError(
            f"no scheduler answers at '{address}' ({error!s:.100}); expected the address that `dask scheduler` prints, "
            "such as tcp://10.0.0.1:8786"
        ) from None
    with client:
        if not client.scheduler_info()["workers"]:
            raise OgPointcloudError(f"the scheduler at '{address}' has no workers: start some (dask worker {address})")
        yield client.get_executor(pure=False)
