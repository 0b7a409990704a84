"""How much memory a fit may take, and arrays that do without: on disk, mapped, where they would not fit.

Mapped arrays are read and written like any other; the system keeps of them in memory what it can and needs no swap for
the rest. Files without a name hold them, so that nothing is left behind however a fit ends.
"""

from __future__ import annotations

import mmap
import os
import re
import tempfile
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import DTypeLike, NDArray

from og_pointcloud.errors import OgPointcloudError

__all__ = ["Column", "free_memory", "in_file", "memory_in_use", "parse_memory", "scratch_file", "scratch_like"]

UNITS = {"": 1, "K": 10**3, "M": 10**6, "G": 10**9, "T": 10**12}
LEAST = 64 * 10**6
"""Less memory than this is a mistyped unit."""
CGROUPS = (
    ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory.current"),
    ("/sys/fs/cgroup/memory/memory.limit_in_bytes", "/sys/fs/cgroup/memory/memory.usage_in_bytes"),
)
"""Limit and use of a container, version 2 and 1."""


def parse_memory(text: str) -> int:
    """ "4GB", "500M" or "2.5e9" in bytes (powers of 1000); OgPointcloudError for anything else, or less than 64 MB."""
    match = re.fullmatch(r"\s*([0-9.]+(?:e[0-9]+)?)\s*([KMGT]?)i?B?\s*", text, re.IGNORECASE)
    try:
        value = int(float(match[1]) * UNITS[match[2].upper()]) if match else 0
    except (ValueError, OverflowError):
        value = 0
    if value < LEAST:
        raise OgPointcloudError(f"memory is '{text}'; expected a size of at least {LEAST // 10**6}MB, such as 4GB")
    return value


def free_memory() -> int:
    """Bytes that this process could still take: what the machine has free, or what its container leaves it."""
    free = [_meminfo()]
    for limit, used in CGROUPS:
        try:
            free.append(max(0, int(Path(limit).read_text()) - int(Path(used).read_text())))
        except (OSError, ValueError):  # no such container, or no limit ("max")
            continue
    return min(free)


def _meminfo() -> int:
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
        return next(1024 * int(line.split()[1]) for line in lines if line.startswith("MemAvailable:"))
    except (OSError, StopIteration):  # no Linux: count on most of what is built in
        try:
            return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") * 3 // 4
        except (AttributeError, ValueError, OSError):
            return 4 * 10**9


def memory_in_use() -> int:
    """Bytes of memory that this process holds now; 0 where the system does not tell."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * mmap.PAGESIZE
    except (OSError, ValueError):
        return 0


def scratch_file() -> BinaryIO:
    """A file that vanishes when it is closed. In TMPDIR if that is set, else /var/tmp, which is not kept in memory."""
    large = "/var/tmp"
    folder = None if os.environ.get("TMPDIR") or not os.access(large, os.W_OK) else large
    return tempfile.TemporaryFile(dir=folder)  # type: ignore[return-value]


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
    if not in_file(array):
        return np.empty(len(array), dtype)
    file = scratch_file()
    file.truncate(len(array) * np.dtype(dtype).itemsize)
    return _mapped(file, np.dtype(dtype), len(array))


def _mapped(file: BinaryIO, dtype: np.dtype[Any], size: int) -> NDArray[Any]:
    """A file's first values; the mapping outlives the file object."""
    file.flush()
    return np.asarray(np.memmap(file, dtype, "r+", shape=(size,))) if size else np.empty(0, dtype)


class Column:
    """A one-dimensional array that grows at its end: in memory, until it is given a file to live in."""

    def __init__(self, dtype: DTypeLike) -> None:
        self.dtype, self.size = np.dtype(dtype), 0
        self._values = np.empty(0, dtype)
        self._file: BinaryIO | None = None

    @property
    def nbytes(self) -> int:
        """Bytes of its values."""
        return self.size * self.dtype.itemsize

    def append(self, values: NDArray[Any]) -> None:
        """Add values at the end."""
        end = self.size + len(values)
        if self._file is not None:
            self._file.write(np.ascontiguousarray(values, self.dtype).data)
        else:
            if end > len(self._values):
                # In place: the system moves the pages of a large array, where concatenating would hold it twice.
                self._values.resize(max(end, len(self._values) * 9 // 8), refcheck=False)
            self._values[self.size : end] = values
        self.size = end

    def move_to(self, file: BinaryIO) -> None:
        """Write what there is to an empty file, and go on there."""
        file.write(self._values[: self.size].data)
        self._values, self._file = np.empty(0, self.dtype), file

    def continue_in(self, file: BinaryIO, size: int) -> None:
        """Take the first ``size`` values of a file for its own; the rest is cut off."""
        file.truncate(size * self.dtype.itemsize)
        file.seek(0, os.SEEK_END)
        self._values, self._file, self.size = np.empty(0, self.dtype), file, size

    def cut(self, size: int) -> None:
        """Drop all values but the first ``size``."""
        if self._file is not None:
            self.continue_in(self._file, size)
        self.size = size

    def sync(self) -> None:
        """Have what was written on the disk itself, where there is a file."""
        if self._file is not None:
            self._file.flush()
            os.fsync(self._file.fileno())

    def array(self) -> NDArray[Any]:
        """All values; nothing may be appended while this array is in use."""
        if self._file is not None:
            return _mapped(self._file, self.dtype, self.size)
        self._values.resize(self.size, refcheck=False)
        return self._values
