"""A folder in which long work keeps its arrays, so that a run that was killed goes on where it was.

One file for each unit of work (a view, a tile, a stage of training), named by what it is and by a fingerprint of all
that it depends on: a file that is there is the answer, whichever run wrote it. Files are written whole or not at all
and end in a checksum; one that is damaged is made anew. There is no index beside them, and their order has no meaning.
"""

from __future__ import annotations

import itertools
import math
import mmap
import os
import shutil
import tempfile
import threading
import time
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from functools import lru_cache
from hashlib import blake2b
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.errors import OgPointcloudError
from og_pointcloud.fitting.memory import scratch_root
from og_pointcloud.formats.atomic import locked, replacing

SUFFIX = ".kept.npy"
"""Ends the names of all files of a work folder, so that files of others are left alone."""
ALIGNMENT_BYTES = 64
"""Arrays begin at multiples of this in a file. A .npy header is padded to the same, so that its numbers are aligned
too."""
BLOCK_BYTES = 1 << 25
"""Size of the blocks that arrays in memory are packed into: large enough that a freed block returns to the system."""

Arrays = tuple[NDArray[Any], ...]


def fingerprint(*parts: Any) -> str:
    """24 hexadecimal digits that tell values apart: arrays by their bytes, all else (None too) by its repr. Another
    version of the code gives other digits, so that what an older one wrote is not taken up after an upgrade."""
    digest = _of_code().copy()
    for part in parts:
        if isinstance(part, np.ndarray):
            digest.update(f"{part.dtype.str} {part.shape}".encode())
            digest.update(np.ascontiguousarray(part).data)
        else:
            digest.update(repr(part).encode())
    return digest.hexdigest()


@lru_cache(maxsize=1)
def _of_code() -> blake2b:
    """A digest begun with the source of all code that makes what is kept."""
    digest, package = blake2b(digest_size=12), Path(__file__).parents[1]
    for file in sorted([*package.glob("fitting/**/*.py"), *package.glob("rendering/*.py")]):
        digest.update(file.read_bytes())
    return digest


def kept_files(folder: Path, name: str = "") -> int:
    """How many files whose names begin with ``name`` an unfinished run has left in its work folder."""
    return len(list(folder.glob(f"{name}*{SUFFIX}")))


class WorkFolder:
    """Tuples of arrays by name and fingerprint, in files of a folder. Made by `WorkFolder.open`.

    found: how many of the arrays asked for were there already. May be used by several threads at once.
    """

    def __init__(self, folder: Path | None) -> None:
        self.folder, self.found = folder, 0
        self._temporary: Path | None = None  # made when a file is first written
        # Arrays held in memory, by the name of their file; None from when all is written at once.
        self._pending: dict[str, Arrays] | None = None
        self._bytes_pending, self._most_pending, self._pending_until = 0, 0.0, 0.0
        self._verified: set[str] = set()  # files written or checked by this run: their checksum is not read again
        self._room = np.empty(0, np.uint8)  # what is left of the block that arrays are packed into
        self._guard, self._numbers = threading.Lock(), itertools.count()

    @classmethod
    @contextmanager
    def open(cls, folder: str | os.PathLike[str] | None) -> Iterator[WorkFolder]:
        """Opens the folder for one run, which owns it meanwhile: another process that opens it gets an error.

        A run that ends well removes its files, and the folder if nothing else is in it; one that is interrupted leaves
        them. folder None: a temporary one, made when it is needed and removed in any case.
        """
        work = cls(None if folder is None else Path(folder))
        # Parents that do not exist yet are of our making, and go again with the folder.
        new = [] if work.folder is None else [path for path in work.folder.parents if not path.exists()]
        try:
            with nullcontext() if work.folder is None else locked(work.folder):
                yield work
                if work.folder is not None:
                    for path in [*work.folder.glob(f"*{SUFFIX}"), *work.folder.glob(f".*{SUFFIX}.*.tmp")]:
                        path.unlink()  # the latter of a run that was killed while it wrote
        finally:
            if work._temporary is not None:
                shutil.rmtree(work._temporary, ignore_errors=True)
            if work.folder is not None:
                with suppress(OSError):
                    for path in (work.folder, *new):
                        path.rmdir()  # fails where there is more in it

    def adopt(self, name: str, key: str) -> None:
        """Trust a file that another process of this run has written: it is neither checked nor counted as found."""
        self._verified.add(f"{name}-{key}{SUFFIX}")

    def has(self, name: str, key: str) -> bool:
        """Whether there is a file of these arrays."""
        return (self.place() / f"{name}-{key}{SUFFIX}").exists()

    def number(self) -> str:
        """A key that is given once: enough for what is not kept beyond this run."""
        return str(next(self._numbers))

    def hold(self, nbytes: float, seconds: float) -> None:
        """Write no file until arrays of more than ``nbytes`` are held, or ``seconds`` have passed: what a killed run
        loses is then made again as soon. The time counts only where the folder outlives the run."""
        self._pending, self._bytes_pending, self._most_pending = {}, 0, nbytes
        self._pending_until = time.monotonic() + seconds if self.folder is not None else np.inf

    def arrays(self, name: str, key: str, make: Callable[[], Sequence[NDArray[Any]]]) -> Arrays:
        """What ``make`` returns; not made again where the folder has it. Mapped from the file, read-only, or in memory.

        name: of the kind and number of the work, for people who look into the folder. key: a `fingerprint` of all that
        the arrays depend on, or a `number`.
        """
        label = f"{name}-{key}{SUFFIX}"
        with self._guard:
            if self._pending and label in self._pending:
                return self._pending[label]
        found = self._read(label)
        if found is not None:
            return found
        return self._keep(label, tuple(make()))

    def replace(self, name: str, key: str, arrays: Sequence[NDArray[Any]]) -> None:
        """From now on `arrays` gives these: a checkpoint of work that goes on. They must not change afterwards.

        What `arrays` gave before must be let go of first: Windows does not replace a file that is mapped.
        """
        self._keep(f"{name}-{key}{SUFFIX}", tuple(arrays))

    def _keep(self, label: str, arrays: Arrays) -> Arrays:
        """Hold the arrays, or write them and those held before; returns them as they are held."""
        with self._guard:
            if self._pending is not None:
                # A checkpoint takes the place of the one before.
                self._bytes_pending -= sum(array.nbytes for array in self._pending.get(label, ()))
                self._pending[label] = arrays = tuple(map(self._packed, arrays))
                self._bytes_pending += sum(array.nbytes for array in arrays)
                if time.monotonic() > self._pending_until or self._bytes_pending > self._most_pending:
                    for waiting, held in self._pending.items():
                        self._write(waiting, held)
                    self._pending = None
                return arrays
        self._write(label, arrays)
        return arrays

    def _packed(self, array: NDArray[Any]) -> NDArray[Any]:
        """A copy in a block of memory that returns to the system once all its arrays are freed. Small pieces of the
        heap do not return, and a table assembled from such pieces would be in memory twice."""
        if array.nbytes > len(self._room):
            self._room = np.empty(max(BLOCK_BYTES, array.nbytes), np.uint8)  # earlier arrays keep the old block alive
        copy = self._room[: array.nbytes].view(array.dtype).reshape(array.shape)
        self._room = self._room[array.nbytes + -array.nbytes % ALIGNMENT_BYTES :]
        copy[...] = array
        return copy

    def forget(self, name: str, key: str) -> None:
        """Let go of arrays that are held in memory; those in a file stay."""
        with self._guard:
            if self._pending:
                self._pending.pop(f"{name}-{key}{SUFFIX}", None)
            if not self._pending:
                self._room = np.empty(0, np.uint8)  # else the last block would stay

    def place(self) -> Path:
        """The folder itself, also where it is a temporary one."""
        if self.folder is not None:
            return self.folder
        if self._temporary is None:
            self._temporary = Path(tempfile.mkdtemp(prefix="og-pointcloud-", dir=scratch_root()))
        return self._temporary

    def _write(self, label: str, arrays: Arrays) -> None:
        path = self.place() / label
        try:
            # Not synced to the disk, which takes long: after a power cut the checksum tells what is damaged.
            with replacing(path, durable=False) as file:
                _write_arrays(file, arrays)
        except OSError as error:
            size = sum(array.nbytes for array in arrays) / 1e6
            raise OgPointcloudError(
                f"'{path}' cannot be written ({error.strerror}); expected room for {size:.1f} MB: give a work folder "
                "on a larger disk, or, without a work folder, set TMPDIR to such a disk"
            ) from error
        self._verified.add(label)

    def _read(self, label: str) -> Arrays | None:
        """The arrays of a file, mapped; None where there is none, or it is damaged."""
        folder = self.folder or self._temporary
        if folder is None:
            return None
        try:
            arrays = _read_arrays(folder / label, label in self._verified)
        except (OSError, ValueError):  # no such file, or an empty one
            return None
        if arrays is not None and label not in self._verified:  # of an earlier run
            self._verified.add(label)
            self.found += 1
        return arrays


class _Summed:
    """A file to write to that adds up a checksum of all that is written."""

    def __init__(self, file: IO[bytes]) -> None:
        self.file, self.size, self.checksum = file, 0, 0

    def write(self, data: bytes) -> None:
        self.file.write(data)
        self.size, self.checksum = self.size + len(data), zlib.crc32(data, self.checksum)


def _write_arrays(file: IO[bytes], arrays: Arrays) -> None:
    """One .npy after another, each at a multiple of ALIGNMENT_BYTES, then the checksum of all before it."""
    summed = _Summed(file)
    for array in arrays:
        np.lib.format.write_array(summed, np.ascontiguousarray(array), version=(1, 0), allow_pickle=False)
        summed.write(bytes(-summed.size % ALIGNMENT_BYTES))
    file.write(summed.checksum.to_bytes(4, "little"))


def _read_arrays(path: Path, is_verified: bool) -> Arrays | None:
    """What `_write_arrays` wrote, mapped; None if the checksum differs, unless the file is already verified. One map
    for all arrays of a file: the number of maps of a process is limited."""
    with path.open("rb") as file:
        content = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        end = len(content) - 4
        if not is_verified and zlib.crc32(memoryview(content)[: max(end, 0)]).to_bytes(4, "little") != content[end:]:
            return None
        arrays = []
        while file.tell() < end:
            np.lib.format.read_magic(file)
            shape, _, dtype = np.lib.format.read_array_header_1_0(file)
            arrays.append(np.frombuffer(content, dtype, math.prod(shape), offset=file.tell()).reshape(shape))
            place = file.tell() + arrays[-1].nbytes
            file.seek(place + -place % ALIGNMENT_BYTES)
    return tuple(arrays)
