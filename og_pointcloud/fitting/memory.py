"""How much memory a fit may take, and arrays in mapped files for what would not fit.

Mapped arrays are read and written like any other; the system keeps in memory what it can of them and needs no swap for
the rest. Their files have no name, so that nothing is left behind however a fit ends.
"""

from __future__ import annotations

import mmap
import os
import re
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from og_pointcloud.errors import OgPointcloudError

UNITS = {"": 1, "K": 10**3, "M": 10**6, "G": 10**9, "T": 10**12}
MIN_MEMORY_BYTES = 64 * 10**6
"""Less memory than this is treated as a mistyped unit: importing the libraries of a fit takes more."""
CGROUPS = (
    ("/sys/fs/cgroup", "memory.max", "memory.current", "inactive_file "),
    ("/sys/fs/cgroup/memory", "memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file "),
)
"""Of control groups version 2, and version 1: the folder, its files with a container's limit and use of memory, in
bytes, and the entry of its memory.stat with the cached files among these, which are given up when memory is needed."""


def parse_memory(text: str) -> int:
    """ "4GB", "500M" or "2.5e9" in bytes (powers of 1000); OgPointcloudError for anything else, or less than 64 MB."""
    # "GiB" is read as GB: a limit that is a little low does no harm.
    match = re.fullmatch(r"\s*([0-9.]+(?:e[0-9]+)?)\s*([KMGT]?)i?B?\s*", text, re.IGNORECASE)
    try:
        value = int(float(match[1]) * UNITS[match[2].upper()]) if match else 0
    except (ValueError, OverflowError):
        value = 0
    if value < MIN_MEMORY_BYTES:
        least = MIN_MEMORY_BYTES // 10**6
        raise OgPointcloudError(f"memory is '{text}'; expected a size of at least {least}MB, such as 4GB")
    return value


def free_memory() -> int:
    """Bytes that this process could still take: what the machine has free, or what its container allows."""
    free = [_available()]
    for folder, limit, used, cached in CGROUPS:
        try:
            most, taken = (int(Path(folder, name).read_text()) for name in (limit, used))
        except (OSError, ValueError):  # no such container, or no limit ("max")
            continue
        free.append(max(0, most - max(0, taken - _entry(f"{folder}/memory.stat", cached))))
    return min(free)


def _available() -> int:
    """Bytes available without swapping, as far as the system reports them."""
    if available := 1024 * _entry("/proc/meminfo", "MemAvailable:"):
        return available
    try:  # no Linux: assume most of the installed memory
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") * 3 // 4
    except (AttributeError, ValueError, OSError):  # Windows: a cautious guess
        return 4 * 10**9


def _entry(file: str, entry: str) -> int:
    """The number after an entry of a file of the system; 0 where there is none."""
    try:
        lines = Path(file).read_text().splitlines()
    except OSError:
        return 0
    return next((int(line.split()[1]) for line in lines if line.startswith(entry)), 0)


def memory_in_use() -> int:
    """Bytes of memory that this process holds now; 0 where the system does not tell."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * mmap.PAGESIZE  # resident pages
    except (OSError, ValueError):
        return 0


def peak_memory() -> int:
    """The most memory that this process has held, in bytes; 0 where the system does not tell."""
    return 1024 * _entry("/proc/self/status", "VmHWM:")


def memory_left(limit: int | None) -> int:
    """Bytes that this process may still take: up to the limit; without a limit, half of what is free."""
    return max(0, limit - memory_in_use()) if limit is not None else free_memory() // 2


def scratch_root() -> str | None:
    """Where large temporary files go: TMPDIR if that is set, else /var/tmp, which is not kept in memory as /tmp may be.
    None: the system's own choice."""
    large = "/var/tmp"
    return None if os.environ.get("TMPDIR") or not os.access(large, os.W_OK) else large


def scratch_array(size: int, dtype: DTypeLike) -> NDArray[Any]:
    """An array with undefined values in a file that vanishes with it. OgPointcloudError where there is no room."""
    dtype = np.dtype(dtype)
    if size == 0:
        return np.empty(0, dtype)
    with tempfile.TemporaryFile(dir=scratch_root()) as file:
        try:
            _reserve(file.fileno(), size * dtype.itemsize)
        except OSError as error:
            raise OgPointcloudError(
                f"no room for {size * dtype.itemsize / 1e9:.1f} GB in '{scratch_root() or tempfile.gettempdir()}' "
                f"({error.strerror}): set TMPDIR to a folder on a larger disk, or give the fit more memory"
            ) from error
        return np.asarray(np.memmap(file, dtype, "r+", shape=(size,)))  # the map outlives the file object


def _reserve(file: int, size: int) -> None:
    """Take the room on the disk now: writing to a mapped file that has none left ends the process (SIGBUS)."""
    if hasattr(os, "posix_fallocate"):
        os.posix_fallocate(file, 0, size)
    else:
        os.ftruncate(file, size)


def in_file(array: NDArray[Any]) -> bool:
    """Whether an array, or what it is a view of, is a mapped file."""
    base: object = array
    while base is not None:
        if isinstance(base, (np.memmap, mmap.mmap)):
            return True
        base = getattr(base, "base", None)
    return False


def scratch_like(array: NDArray[Any], dtype: DTypeLike) -> NDArray[Any]:
    """An array of the same length with undefined values, in a file if that one is."""
    return scratch_array(len(array), dtype) if in_file(array) else np.empty(len(array), dtype)
