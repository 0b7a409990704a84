"""numba for all kernels of the library: imported from here, so that its threading is configured before it starts."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from og_pointcloud.errors import naming_extra
from og_pointcloud.journal import Journal

with naming_extra("numba", "fit"):
    import numba
    from numba import get_num_threads, prange
    from numba.core.event import TimingListener, install_listener

__all__ = ["get_num_threads", "njit", "prange", "timed_compiling", "use_threads"]

# Waiting threads sleep: spinning ones double the time of a fit if another program occupies a core.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")
# OpenMP first: else numba tries TBB, and warns if it finds an old one. A user's own choice is kept.
if "NUMBA_THREADING_LAYER_PRIORITY" not in os.environ:
    numba.config.THREADING_LAYER_PRIORITY = ["omp", "tbb", "workqueue"]  # pyright: ignore


def use_threads(count: int) -> None:
    """Run kernels called by this Python thread on ``count`` threads, at most as many as numba was started with."""
    numba.set_num_threads(max(1, min(count, numba.config.NUMBA_NUM_THREADS)))  # pyright: ignore


def njit(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """`numba.njit`; if numba finds no folder for compiled code, each process compiles anew."""

    def compiled(function: Callable[..., Any]) -> Any:
        try:
            return numba.njit(**options)(function)
        except RuntimeError:  # "cannot cache function: no locator available"
            return numba.njit(**{**options, "cache": False})(function)  # pyright: ignore

    return compiled


@contextmanager
def timed_compiling(journal: Journal) -> Iterator[None]:
    """Note the seconds spent on compiling kernels, if any: the first fits after an installation seem slow, and their
    bars stand still, for a reason. It is said on a terminal when it begins."""
    with install_listener("numba:compile", _Compiling(journal)):
        yield


class _Compiling(TimingListener):
    def __init__(self, journal: Journal) -> None:
        super().__init__()
        self._journal = journal

    def on_start(self, event: Any) -> None:
        if "compiling" not in self._journal.notes and self._journal.progress and sys.stderr.isatty():
            print("compiling, which only first fits need: up to a minute or two", file=sys.stderr)
        super().on_start(event)
        self._journal.notes.setdefault("compiling", 0.0)

    def on_end(self, event: Any) -> None:
        super().on_end(event)
        if self.done:
            self._journal.notes["compiling"] = round(self.duration, 2)
