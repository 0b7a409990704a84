"""Steps of a stage as tasks of an executor, and what a task may take of the machine where it runs."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import TypeVar

from og_pointcloud.fitting.memory import free_memory
from og_pointcloud.journal import Journal
from og_pointcloud.kernels import use_threads

__all__ = ["Share", "cores_here", "run_tasks", "share_here"]

Item = TypeVar("Item")
Result = TypeVar("Result")

SHARE_OF_LIMIT = 0.6
"""Of the memory that a Dask worker may hold, what its tasks take: at 0.8 it would be paused, at 0.95 killed."""


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


def run_tasks(
    executor: Executor | None, function: Callable[[Item], Result], items: Sequence[Item], journal: Journal, name: str
) -> list[Result]:
    """The function's value of each item, in their order: made here, one after another, or by an executor's workers."""
    if executor is None:
        return [function(item) for item in journal.steps(items, name)]
    futures = [executor.submit(_with_share, function, item) for item in items]
    try:
        return [future.result() for future in journal.steps(futures, name)]
    except BaseException:
        for future in futures:
            future.cancel()
        raise


def _with_share(function: Callable[[Item], Result], item: Item) -> Result:
    if (threads := share_here(Share()).threads) is not None:
        use_threads(threads)
    return function(item)
