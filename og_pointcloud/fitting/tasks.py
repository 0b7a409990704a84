"""Where tasks run (processes of this machine or a Dask cluster, both executors of `concurrent.futures`), what a task
may take of the machine where it runs, and the steps of a stage as tasks."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import get_context, parent_process
from typing import Any, TypeVar

from og_pointcloud.errors import OgPointcloudError, naming_extra
from og_pointcloud.fitting.memory import free_memory
from og_pointcloud.journal import Journal
from og_pointcloud.kernels import use_threads

Item = TypeVar("Item")
Result = TypeVar("Result")

DASK_MEMORY_SHARE = 0.6
"""Share of a Dask worker's memory limit that its tasks take: at 0.8 Dask pauses the worker, at 0.95 it kills it."""

THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
MIN_WORKER_BYTES = 10**9
"""A worker of this machine has at least this much memory; where there is not enough, there are fewer workers."""
CONNECT_TIMEOUT_S = 20
"""How long a scheduler may take to answer, seconds."""


@dataclass(frozen=True)
class Share:
    """What a task may take. threads: None for as many as there are. memory: bytes; None: what the fit decides."""

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
    """What a task may take where it runs: in a Dask worker one thread and that thread's part of the worker's memory;
    elsewhere what it was given."""
    # A process that has not imported distributed is no Dask worker; importing it takes long.
    if "distributed" not in sys.modules:
        return otherwise
    from distributed import get_worker

    try:
        worker = get_worker()
    except ValueError:  # this process is no worker
        return otherwise
    limit = worker.memory_manager.memory_limit
    return Share(1, int(DASK_MEMORY_SHARE * limit / worker.state.nthreads) if limit else None)


def run_tasks(
    executor: Executor | None, journal: Journal, function: Callable[[Item], Result], items: Sequence[Item], name: str
) -> list[Result]:
    """The function's value for each item, in order: computed here, one after another, or by an executor's workers.
    OgPointcloudError if a worker dies."""
    if executor is None:
        return [function(item) for item in journal.steps(items, name)]
    futures = [executor.submit(_with_share, function, item) for item in items]
    try:
        return [future.result() for future in journal.steps(futures, name)]
    except BaseException as error:  # Ctrl-C too: cancel what has not begun
        for future in futures:
            future.cancel()
        if not isinstance(error, BrokenExecutor) and type(error).__name__ != "KilledWorker":  # of Dask
            raise
        raise OgPointcloudError(
            "a worker died, as one does that runs out of memory; expected workers that finish their tasks: take fewer "
            "workers or more memory (with a work folder, the next run goes on after the tasks that were finished)"
        ) from error


def _with_share(function: Callable[[Item], Result], item: Item) -> Result:
    """The function's value, on as many threads as the task may take where it runs."""
    if (threads := share_here(Share()).threads) is not None:
        use_threads(threads)
    return function(item)


def _begin() -> None:
    """Run in each worker: ends it, and releases its locks, when its parent was killed. Otherwise it would wait for
    tasks forever. Without a task, Ctrl-C ends it silently."""

    def watch() -> None:
        if (parent := parent_process()) is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:  # ignored in what a shell starts in the background
        signal.signal(signal.SIGINT, _end)
    _hold_interrupts(False)


def _end(*_: object) -> None:
    os._exit(130)


def _hold_interrupts(held: bool) -> None:
    """Blocks Ctrl-C in this thread, and in processes that it starts from then on, or unblocks it."""
    if hasattr(signal, "pthread_sigmask"):  # not on Windows
        from multiprocessing import resource_tracker

        resource_tracker.ensure_running()  # as it starts, with the first process, it would let them through
        signal.pthread_sigmask(signal.SIG_BLOCK if held else signal.SIG_UNBLOCK, {signal.SIGINT})


def _interruptible(fn: Callable[..., Result], *args: Any, **kwargs: Any) -> Result:
    """A task in a worker: Ctrl-C raises KeyboardInterrupt in it, so that it can clean up."""
    if signal.getsignal(signal.SIGINT) is not _end:
        return fn(*args, **kwargs)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        return fn(*args, **kwargs)
    finally:
        signal.signal(signal.SIGINT, _end)


class LocalWorkers(ThreadPoolExecutor):
    """Processes of this machine, each with its share of cores and memory, and a thread here that waits for each.

    A process has one task at a time: where one dies (killed, out of memory, a crash in a library), that task fails with
    BrokenProcessPool, the others go on, and the thread's next task gets a new process. One pool of several processes
    would fail all of its tasks.
    """

    def __init__(self, tasks: int) -> None:
        """tasks: how many there will be; there are as many processes at most, and as cores."""
        workers = max(1, min(tasks, cores_here(), free_memory() // 2 // MIN_WORKER_BYTES))
        # Python, as it starts, would print where Ctrl-C met it: until `_begin` it is held back.
        super().__init__(workers, initializer=_hold_interrupts, initargs=(True,))
        self.share, self._process_of = Share.of_machine(workers), threading.local()
        self._before = {name: os.environ.get(name) for name in THREAD_VARIABLES}
        # Libraries read these as they are imported, before a task could set them: so processes inherit them.
        os.environ.update(dict.fromkeys(THREAD_VARIABLES, str(self.share.threads)))

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """As `concurrent.futures.Executor` has it."""
        return super().submit(self._in_process, fn, *args, **kwargs)

    def _in_process(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Any:
        process = getattr(self._process_of, "thread", None)
        process = process or ProcessPoolExecutor(1, get_context("spawn"), _begin)
        self._process_of.thread = None  # if this fails, the next task begins with a new one
        result = process.submit(_interruptible, fn, *args, **kwargs).result()
        self._process_of.thread = process
        return result

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """As `concurrent.futures.Executor` has it. The processes end with the threads."""
        super().shutdown(wait, cancel_futures=cancel_futures)
        for name, value in self._before.items():
            os.environ.pop(name, None) if value is None else os.environ.__setitem__(name, value)


@contextmanager
def dask_executor(address: str) -> Iterator[Executor]:
    """An executor of the Dask cluster whose scheduler has this address, as `dask scheduler` prints it.

    Its workers see the same files by the same paths. MissingExtraError without the extra 'cluster'; OgPointcloudError
    where no scheduler answers, or it has no workers.
    """
    with naming_extra("distributed", "cluster"):
        from distributed import Client
    try:
        client = Client(address, timeout=CONNECT_TIMEOUT_S)
    except (OSError, ValueError) as error:
        raise OgPointcloudError(
            f"no scheduler answers at '{address}' ({error!s:.100}); expected the address that `dask scheduler` prints, "
            "such as tcp://10.0.0.1:8786"
        ) from None
    with client:
        if not client.scheduler_info()["workers"]:
            raise OgPointcloudError(f"the scheduler at '{address}' has no workers: start some (dask worker {address})")
        yield client.get_executor(pure=False)
