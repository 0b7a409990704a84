"""A map on disk while it grows: a kill -9 at any moment loses at most the frame being integrated.

The folder holds two files of records, each record with its length and checksum. Each change is appended to
``frames.log`` with its number: a frame, a correction, or what a snapshot chose; a torn last one is cut off.
``map.state`` is the whole map at some number, replaced atomically; the log then starts empty. Both begin with what the
map began with. A mapper that is started with the folder reads the state and replays the log: this restores the map
exactly, and the space on disk grows with the map, not with time. Nothing is pickled: a record is a tree of plain values
and of the dataclasses in RECORD_TYPES as JSON, with its arrays as .npy.
"""

from __future__ import annotations

import errno
import io
import json
import os
import struct
import warnings
import zlib
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any
from weakref import WeakValueDictionary

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.cloud import FeatureSpace
from og_pointcloud.errors import OgPointcloudError
from og_pointcloud.formats.atomic import LOCK, locked, replacing
from og_pointcloud.formats.npy import array_from_npy, npy_bytes
from og_pointcloud.formats.tables import naming
from og_pointcloud.mapping.frame import Frame, in_arrays
from og_pointcloud.mapping.growing_map import GrowingMap
from og_pointcloud.mapping.kept_views import KeptView, KeptViews
from og_pointcloud.mapping.likeness import Look
from og_pointcloud.mapping.presence import Presence
from og_pointcloud.mapping.tracks import PointVotes, Track, Tracks
from og_pointcloud.mapping.voxels import Packets, VoxelHash, VoxelPoints
from og_pointcloud.scene import Camera

RECORD_TYPES = {
    kind.__name__: kind
    for kind in (
        Camera, FeatureSpace, Frame, GrowingMap, KeptView, KeptViews, Look, Packets, PointVotes, Presence, Track,
        Tracks, VoxelHash, VoxelPoints,
    )
}  # fmt: skip
"""Dataclasses that a record may hold, by name: nothing else is ever constructed from a file."""
RECORD_HEADER = struct.Struct("<4sQI")
"""MAGIC, number of bytes that follow, and their CRC-32."""
MAGIC = b"OGF4"
LOG, STATE = "frames.log", "map.state"
MAX_LOG_BYTES = 1 << 27
"""Size of the log above which the whole map is written and the log starts empty."""


Poses = dict[float, NDArray[np.float64]]
"""A correction: stamp -> world_to_camera (4, 4)."""
Chosen = tuple[int, float | None, int]
"""By a snapshot: the next id after those that it gave, and `GrowingMap.scale` and ``drawn``."""


_OPEN_JOURNALS: WeakValueDictionary[Path, MapJournal] = WeakValueDictionary()
"""The journals of this process."""


def holds_map(folder: Path) -> bool:
    """Whether a path is a folder with nothing but files of a journal, including one that was killed."""
    ours = LOG, STATE, f".{LOG}", f".{STATE}", LOCK  # with a dot: being written
    return folder.is_dir() and all(file.name.startswith(ours) for file in folder.iterdir())


class MapJournal:
    """The folder of one map. OgPointcloudError if it cannot be written, holds a map of something else, or is in use by
    another process; within one process, the last one to open it owns it.

    origin: description of what the map began with; a folder that began with something else is refused.
    """

    def __init__(self, folder: str | os.PathLike[str], origin: str) -> None:
        self.folder = Path(folder)
        self._log, self._state, self._origin = self.folder / LOG, self.folder / STATE, origin
        self._file: io.FileIO | None = None
        if earlier := _OPEN_JOURNALS.get(self.folder.resolve()):
            earlier.close()
        self._lock = ExitStack()
        self._lock.enter_context(locked(self.folder))
        _OPEN_JOURNALS[self.folder.resolve()] = self

    def close(self) -> None:
        """End writing, and let others in."""
        if _OPEN_JOURNALS.get(self.folder.resolve()) is self:
            del _OPEN_JOURNALS[self.folder.resolve()]
        if self._file is not None:
            self._file.close()
        self._lock.close()

    def state(self) -> GrowingMap | None:
        """The last whole map; None if there is none yet."""
        if not self._state.is_file():
            return None
        with self._state.open("rb") as file:
            record = _next_record(file)
        content = None if record is None else unpacked(record, str(self._state))
        if not (isinstance(content, tuple) and len(content) == 2 and isinstance(content[1], GrowingMap)):
            raise OgPointcloudError(f"{self._state} is damaged or of another version: remove the folder and map again")
        began_with, map_ = content
        self._require_origin(began_with)
        return map_

    def changes(self) -> Iterator[tuple[int, Frame | Poses | Chosen]]:
        """The changes in the log, in order, with their numbers: those below the map's own are in it already, if it was
        killed between the two writes. A torn one at the end is cut off with a warning, so that new ones follow whole
        ones."""
        if not self._log.is_file():
            return
        intact, size = 0, self._log.stat().st_size  # intact: bytes of whole records
        with self._log.open("rb") as file:
            # The file is about to be truncated and written: refuse a link, or a file of something else.
            if self._log.is_symlink() or file.peek(4)[:4] != MAGIC[:size]:
                raise OgPointcloudError(
                    f"{self._log} was not written by this version and is left as it is: give another folder"
                )
            while record := _next_record(file):
                entry = unpacked(record, str(self._log))
                if intact == 0:
                    self._require_origin(entry)
                elif isinstance(entry, tuple) and len(entry) == 2 and isinstance(entry[0], int):
                    yield entry
                else:
                    raise OgPointcloudError(f"{self._log} is damaged: remove the folder and map again")
                intact = file.tell()
            file.seek(intact)
            head = file.read(RECORD_HEADER.size)
        if not head:
            return
        # A record that was being written when the process was killed reaches the end of the file; whole ones follow one
        # that is damaged, and would be lost with it.
        if len(head) == RECORD_HEADER.size and intact + len(head) + RECORD_HEADER.unpack(head)[1] < size:
            raise OgPointcloudError(
                f"{self._log} is damaged at byte {intact} of {size}: remove the folder and map again, or cut the file "
                "there to lose only the frames from there on"
            )
        os.truncate(self._log, intact)
        what = f"{self._log} ends in the middle of a change: its last {size - intact} bytes were cut off"
        warnings.warn(what, stacklevel=4)

    def _require_origin(self, began_with: Any) -> None:
        if began_with != self._origin:
            raise OgPointcloudError(
                f"{self.folder} has a map that began with {began_with!s:.300}, not with {self._origin}: begin with "
                "that, or give another folder"
            )

    def append(self, number: int, change: Frame | Poses | Chosen) -> None:
        """Append a change. If that fails, as on a full disk, the log stays as it was."""
        if isinstance(change, Frame):
            change = in_arrays(change)
            if change.masks is not None and change.masks.max(initial=0) < 1 << 15:
                change = replace(change, masks=change.masks.astype(np.int16))
        if _OPEN_JOURNALS.get(self.folder.resolve()) is not self:
            raise OgPointcloudError(
                f"'{self.folder}' was closed, or another mapper now writes to it: this one no longer can"
            )
        record = _record((number, change))
        with naming(self.folder):
            self._file = self._file or self._log.open("ab", buffering=0)
            intact = self._file.seek(0, os.SEEK_END)  # a failed write has moved the position
            record = record if intact else _record(self._origin) + record
            try:
                if self._file.write(record) < len(record):
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            except OSError:
                self._file.truncate(intact)  # later records behind a torn one would be lost with it
                raise

    def compact(self, map_: GrowingMap) -> None:
        """Once the log is long, write the map that it led to and empty the log. If that fails, as on a full disk, the
        log keeps growing: it has all changes."""
        if self._file is None or self._file.tell() <= MAX_LOG_BYTES:
            return
        try:
            with replacing(self._state) as file:
                file.write(_record((self._origin, map_)))
        except OSError as error:
            what = f"{self._state} cannot be written ({error.strerror}): its log of changes keeps growing"
            warnings.warn(what, stacklevel=4)
            return
        with naming(self.folder):
            self._file.truncate(0)


def _record(value: Any) -> bytes:
    data = packed(value)
    return RECORD_HEADER.pack(MAGIC, len(data), zlib.crc32(data)) + data


def _next_record(file: io.BufferedReader) -> bytes | None:
    """The bytes of the next whole record; None at the end, or if the rest is torn."""
    head = file.read(RECORD_HEADER.size)
    if len(head) < RECORD_HEADER.size:
        return None
    magic, length, checksum = RECORD_HEADER.unpack(head)
    # A torn length may be any number: no more is allocated than the file holds.
    if magic != MAGIC or length > os.fstat(file.fileno()).st_size:
        return None
    record = file.read(length)
    return record if len(record) == length and zlib.crc32(record) == checksum else None


def packed(value: Any) -> bytes:
    """A tree of plain values, lists, tuples, dictionaries, arrays and dataclasses of RECORD_TYPES as bytes: parts, each
    preceded by its length (8 bytes), first the tree as JSON, then its arrays.

    In the JSON, only lists and plain values represent themselves. Everything else is an object with one entry, which
    names its type: {"array": its number}, {"tuple": [...]}, {"dict": [[key, value], ...]}, {"Camera": [its fields]}.
    """
    arrays: list[NDArray[Any]] = []

    def tree(value: Any) -> Any:
        if isinstance(value, np.ndarray):
            arrays.append(value)
            return {"array": len(arrays) - 1}
        if is_dataclass(value):
            return {type(value).__name__: [tree(getattr(value, entry.name)) for entry in fields(value)]}
        if isinstance(value, dict):
            return {"dict": [[tree(key), tree(of)] for key, of in value.items()]}
        if isinstance(value, tuple):
            return {"tuple": [tree(entry) for entry in value]}
        return [tree(entry) for entry in value] if isinstance(value, list) else value

    text = json.dumps(tree(value), default=lambda number: number.item()).encode()  # numpy scalars
    parts = [text, *map(npy_bytes, arrays)]
    return b"".join(piece for part in parts for piece in (struct.pack("<Q", len(part)), part))


def unpacked(data: bytes, source: str) -> Any:
    """The value that was `packed`. OgPointcloudError, naming the source, for any other bytes."""
    parts, at = [], 0

    def value(tree: Any) -> Any:
        if isinstance(tree, list):
            return [value(entry) for entry in tree]
        if not isinstance(tree, dict):
            return tree
        ((kind, of),) = tree.items()
        if kind == "array":
            return array_from_npy(parts[1 + of]).copy()  # writable: the map goes on growing
        entries = [value(entry) for entry in of]
        return dict(entries) if kind == "dict" else tuple(entries) if kind == "tuple" else RECORD_TYPES[kind](*entries)

    try:
        while at < len(data):
            (length,) = struct.unpack_from("<Q", data, at)
            parts.append(data[at + 8 : at + 8 + length])
            at += 8 + length
        return value(json.loads(parts[0]))
    except (ValueError, struct.error, TypeError, KeyError, IndexError, AttributeError, RecursionError) as error:
        raise OgPointcloudError(f"{source} is damaged ({error!r:.80}): remove the folder and map again") from None
