"""numba for all kernels of the library: imported from here, so that its threading is configured before it starts."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any

from og_pointcloud.errors import naming_extra

with naming_extra("numba", "fit"):
    import numba
    from numba import get_num_threads, prange

__all__ = ["get_num_threads", "njit", "prange", "use_threads"]

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
