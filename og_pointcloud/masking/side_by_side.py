"""Images worked on in one process or several; one broken image stops no other."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import get_context
from pathlib import Path

from og_pointcloud.errors import OgPointcloudError, SceneError
from og_pointcloud.formats.images import require_cv2
from og_pointcloud.masking.image_worker import ImageTask, ImageWorker
from og_pointcloud.masking.settings import MaskSettings

__all__ = ["results"]

THREAD_VARIABLES = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")

_worker: ImageWorker | str = "not opened"
"""This process's own, where there are several, or why it could not be opened."""


def _open_worker(capture: Path, settings: MaskSettings) -> None:
    global _worker
    require_cv2().setNumThreads(1)
    try:
        _worker = ImageWorker(capture, settings)
    except (OgPointcloudError, ImportError, OSError) as error:  # the pool would only say that it is broken
        _worker = str(error)


def _work_on(task: ImageTask) -> str | None:
    """What is wrong with the image, or None: one broken image stops no other."""
    if isinstance(_worker, str):
        raise OgPointcloudError(_worker)
    return _tried(_worker, task)


def _tried(worker: ImageWorker, task: ImageTask) -> str | None:
    try:
        worker(task)
    except SceneError as error:
        return str(error)
    return None


@contextmanager
def one_thread_each() -> Iterator[None]:
    """Processes started within multiply matrices on one thread: two that take two threads each on two cores are slower
    than one alone. Read when a process imports numpy, so it must stand in the environment before."""
    before = {name: os.environ.get(name) for name in THREAD_VARIABLES}
    os.environ.update(dict.fromkeys(THREAD_VARIABLES, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def results(
    capture: Path, settings: MaskSettings, tasks: Sequence[ImageTask], processes: int
) -> Iterator[tuple[ImageTask, str | None]]:
    """Each task when it is done, and what went wrong."""
    if processes <= 1 or len(tasks) == 1:
        worker = ImageWorker(capture, settings)
        for task in tasks:
            yield task, _tried(worker, task)
        return
    pool = ProcessPoolExecutor(
        min(processes, len(tasks)), get_context("spawn"), initializer=_open_worker, initargs=(capture, settings)
    )
    try:
        with one_thread_each():
            futures = {pool.submit(_work_on, task): task for task in tasks}  # which starts the processes
        for future in as_completed(futures):
            yield futures[future], future.result()
    except BrokenProcessPool:
        raise OgPointcloudError(
            "a process that makes masks ended without a word (out of memory?); the images that are done are kept: the "
            "same command with --processes 1 goes on behind them, and says what is wrong"
        ) from None
    finally:
        pool.shutdown(cancel_futures=True)
