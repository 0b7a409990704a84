"""The rows of a mask table while views are added: in memory, on disk, or in a work folder that outlives a killed fit.

One mechanism serves all three. Rows are appended to columns; a column lives in memory, or in a file when the table
outgrows its share of it, and is a mapped array in the end. Given a work folder, columns move into it once the views
have taken some time, and ``progress.json`` beside them says whose views the first so many rows are: a fit that was
killed goes on behind the last of them. The files are of no use to anyone else, and removed by a fit that ends well.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_array

from og_pointcloud.errors import OgPointcloudError
from og_pointcloud.fitting.memory import Column, scratch_file
from og_pointcloud.formats.atomic import replacing

__all__ = ["Rows", "TableStore", "kept_views", "remove_work"]

MATRICES = ("weights", "outside", "exposure")
PARTS = {"lengths": np.int32, "indices": np.int32, "data": np.float32}
PROGRESS = "progress.json"
CHECKPOINT_S = 10.0
"""Seconds between the moments when progress is put on disk."""
BLOCK = 1 << 22
"""Entries checked at a time."""


class Rows:
    """Sparse rows (int32 columns, float32 entries) that grow at their end, in memory or on disk."""

    def __init__(self, on_disk: bool = False) -> None:
        self.columns = {part: Column(dtype) for part, dtype in PARTS.items()}
        if on_disk:
            self.move_to({part: scratch_file() for part in PARTS})

    @property
    def nbytes(self) -> int:
        """Bytes of all columns."""
        return sum(column.nbytes for column in self.columns.values())

    def append(self, lengths: ArrayLike, indices: NDArray[np.int32], data: NDArray[np.float32]) -> None:
        """Add rows of these lengths, their entries one row after the other."""
        for column, values in zip(self.columns.values(), (np.asarray(lengths), indices, data), strict=True):
            column.append(values)

    def move_to(self, files: Mapping[str, BinaryIO]) -> None:
        """Go on in a file for each of PARTS."""
        for part, file in files.items():
            self.columns[part].move_to(file)

    def keep(self, rows: int) -> None:
        """Drop all but the first rows."""
        entries = int(self.columns["lengths"].array()[:rows].sum(dtype=np.int64))
        for part, column in self.columns.items():
            column.cut(rows if part == "lengths" else entries)

    def matrix(self, width: int) -> csr_array:
        """(rows, width); nothing may be added any more."""
        lengths, indices, data = (column.array() for column in self.columns.values())
        if len(data) > np.iinfo(np.int32).max:
            raise OgPointcloudError(
                f"the mask table has {len(data):,} entries; expected fewer than 2^31: use fewer views, larger pixels, "
                "or parts of the cloud"
            )
        start = np.concatenate([[0], np.cumsum(lengths)]).astype(np.int32)
        return csr_array((data, indices, start), shape=(len(lengths), width))


@dataclass
class TableStore:
    """Rows of a table of ``width`` Gaussians, view by view.

    memory: bytes of entries beyond which the table moves to files. folder: where to keep the views of a long fit, None
    nowhere. key: tells the geometry and settings that the table is of. keep_after_s: seconds after which it is long.
    """

    width: int
    memory: float = np.inf
    folder: Path | None = None
    key: str = ""
    keep_after_s: float = 20.0
    marks: list[str] = field(default_factory=list)
    """What was given for each view added, or found in the folder."""
    on_disk: bool = False
    resumed: int = 0
    """Views that were taken from the folder."""
    _masks: list[int] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._rows = {name: Rows() for name in MATRICES}
        self._start = self._last = time.monotonic()
        if self.folder is not None:
            self._resume(self.folder)

    @property
    def nbytes(self) -> int:
        """Bytes of all rows."""
        return sum(rows.nbytes for rows in self._rows.values())

    @property
    def entries(self) -> int:
        """Entries of all rows."""
        return sum(rows.columns["data"].size for rows in self._rows.values())

    def add(self, mark: str, rows: csr_array, exposure: csr_array) -> None:
        """The next view: rows (masks + 1, width), the last one of pixels without a mask, and exposure (1, width)."""
        masks = rows.shape[0] - 1
        border = rows.indptr[masks]
        lengths = np.diff(rows.indptr)
        with self._room_on_disk():
            self._rows["weights"].append(lengths[:masks], rows.indices[:border], rows.data[:border])
            self._rows["outside"].append(lengths[masks:], rows.indices[border:], rows.data[border:])
            self._rows["exposure"].append(np.diff(exposure.indptr), exposure.indices, exposure.data)
            self.marks.append(mark)
            self._masks.append(masks)
            long = self.folder is not None and time.monotonic() - self._start > self.keep_after_s
            if not self.on_disk and (long or self.nbytes > self.memory):
                self._move()
            if self.on_disk and time.monotonic() - self._last > CHECKPOINT_S:
                self.checkpoint()

    def keep(self, views: int) -> None:
        """Forget all views found in the folder but the first so many."""
        self.resumed = views
        if views == len(self.marks):
            return
        del self.marks[views:], self._masks[views:]
        for name, rows in self._rows.items():
            rows.keep(sum(self._masks) if name == "weights" else views)

    def checkpoint(self) -> None:
        """Have all views so far survive this process, where they are in the work folder."""
        if self.folder is None or not self.on_disk:
            return
        for rows in self._rows.values():
            for column in rows.columns.values():
                column.sync()
        progress = {"key": self.key, "views": self.marks, "masks": self._masks}
        with replacing(self.folder / PROGRESS) as file:
            file.write(json.dumps(progress).encode())
        self._last = time.monotonic()

    def matrix(self, name: str) -> csr_array:
        """One of the table's matrices; nothing may be added any more."""
        return self._rows[name].matrix(self.width)

    def _move(self) -> None:
        if self.folder is not None:
            self.folder.mkdir(parents=True, exist_ok=True)
            (self.folder / PROGRESS).unlink(missing_ok=True)
        for name, rows in self._rows.items():
            rows.move_to({part: self._open(name, part, "w+b") if self.folder else scratch_file() for part in PARTS})
        self.on_disk = True
        self.checkpoint()

    def _open(self, name: str, part: str, mode: str) -> BinaryIO:
        assert self.folder is not None
        return (self.folder / f"{name}.{part}").open(mode)  # type: ignore[return-value]

    def _resume(self, folder: Path) -> None:
        """Take up what a killed fit left in the folder, if it is of the same key and whole."""
        try:
            progress = json.loads((folder / PROGRESS).read_bytes())
            key, marks, masks = progress["key"], progress["views"], progress["masks"]
            if key != self.key or len(marks) != len(masks):
                return
            sizes = {name: self._sizes(name, sum(masks) if name == "weights" else len(masks)) for name in MATRICES}
            for name, rows in self._rows.items():
                for part, column in rows.columns.items():
                    column.continue_in(self._open(name, part, "r+b"), sizes[name][part])
        except (OSError, ValueError, KeyError, TypeError):
            self._rows = {name: Rows() for name in MATRICES}
            return
        self.marks, self._masks, self.on_disk = [str(mark) for mark in marks], masks, True

    def _sizes(self, name: str, rows: int) -> dict[str, int]:
        """Values of so many rows in each file; ValueError where it holds fewer, or some that cannot be."""
        assert self.folder is not None
        lengths = np.fromfile(self.folder / f"{name}.lengths", PARTS["lengths"], rows)
        entries = int(lengths.sum(dtype=np.int64))
        whole = len(lengths) == rows and bool((lengths >= 0).all())
        for part in ("indices", "data"):
            for begin in range(0, entries, BLOCK):
                count = min(BLOCK, entries - begin)
                values = np.fromfile(self.folder / f"{name}.{part}", PARTS[part], count, offset=4 * begin)
                valid = np.isfinite(values) if part == "data" else (values >= 0) & (values < self.width)
                whole &= len(values) == count and bool(valid.all())
        if not whole:
            raise ValueError(f"the kept {name} are damaged")
        return {"lengths": rows, "indices": entries, "data": entries}

    @contextmanager
    def _room_on_disk(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            where = f"'{self.folder}'" if self.folder else "the folder for temporary files (TMPDIR)"
            raise OgPointcloudError(
                f"no room for the mask table, {self.nbytes / 1e9:.1f} GB so far, in {where} ({error.strerror}); give "
                "the fit more memory, or a work folder on a larger disk"
            ) from error


def kept_views(folder: Path) -> int:
    """How many views a fit that did not end keeps in its work folder."""
    try:
        return len(json.loads((folder / PROGRESS).read_bytes())["views"])
    except (OSError, ValueError, KeyError, TypeError):
        return 0


def remove_work(folder: Path) -> None:
    """Remove the files of a store from its folder, and the folder if nothing else is in it."""
    for name in [PROGRESS, *(f"{name}.{part}" for name in MATRICES for part in PARTS)]:
        with suppress(OSError):
            os.unlink(folder / name)
    with suppress(OSError):
        folder.rmdir()
