"""Where tasks run: processes of this machine, or a Dask cluster. Both are executors of `concurrent.futures`."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import get_context
from typing import Any

from og_pointcloud.errors import MissingExtraError, OgPointcloudError
from og_pointcloud.fitting.memory import free_memory
from og_pointcloud.fitting.tasks import Share, cores_here

__all__ = ["LocalWorkers", "dask_executor"]

THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
LEAST_BYTES = 10**9
"""Memory that a fit is given at least, if need be by fewer workers."""
TRIES = 2
"""Processes that a task may kill before it is given up."""
PATIENCE_S = 20


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
