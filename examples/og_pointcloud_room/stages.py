"""What a demo prints while it runs: its stages with the seconds that each took."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def stage(name: str, seconds: dict[str, float]) -> Iterator[None]:
    """Time the block into ``seconds`` and print it when done."""
    start = time.perf_counter()
    yield
    seconds[name] = time.perf_counter() - start
    print(f"{name:<22} {seconds[name]:6.1f} s", flush=True)
