"""A map on disk while it grows: kill -9 at any moment loses at most the frame in work.

A folder with two files. ``frames.log`` is append-only: each integrated frame as length, checksum, arrays; a torn last
one is cut off. ``map.state`` is the whole map at some frame, replaced in one step; the log then begins anew. A start
with the folder reads the state and integrates the frames of the log again: the map is the one that was left, and disk
follows the map and not the time. Nothing is pickled.
"""

from __future__ import annotations

import io
import json
import os
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.bundle.format import cameras_of_rows, rows_of_cameras
from og_pointcloud.errors import OgPointcloudError
from og_pointcloud.formats.atomic import replacing
from og_pointcloud.formats.npy import array_from_npy, npy_bytes
from og_pointcloud.mapping.frame import Frame

__all__ = ["MapJournal"]

HEAD = struct.Struct("<4sQI")
MAGIC = b"OGF1"
LOG_BYTES = 1 << 27
"""Bytes of frames after which the whole map is written and the log begins anew."""
MOST_BYTES = 1 << 31

Arrays = dict[str, NDArray[Any]]


class MapJournal:
    """The folder of one map. OgPointcloudError where it cannot be written, or holds the map of something else.

    origin: what the map began with, in words; a folder that was begun with something else is refused.
    """

    def __init__(self, folder: str | os.PathLike[str], origin: str) -> None:
        self.folder = Path(folder)
        self.folder.mkdir(parents=True, exist_ok=True)
        self._log, self._state, self._origin = self.folder / "frames.log", self.folder / "map.state", origin
        self._file: io.BufferedWriter | None = None

    def state(self) -> tuple[Arrays, dict[str, Any]] | None:
        """The arrays and the values of the last whole map; None where there is none yet."""
        if not self._state.is_file():
            return None
        arrays = _unpacked(self._state.read_bytes(), str(self._state))
        values = json.loads(arrays.pop("values").tobytes())
        if values["began_with"] != self._origin:
            raise OgPointcloudError(
                f"{self.folder} holds a map that began with {values['began_with']}, not with {self._origin}: give "
                "that, or another folder"
            )
        return arrays, values

    def frames(self) -> Iterator[Frame]:
        """The frames since then, in their order. A torn one at the end is cut off, and work goes on behind it."""
        if not self._log.is_file():
            return
        whole = 0
        with self._log.open("rb") as file:
            while record := _next_record(file):
                whole = file.tell()
                yield _frame(_unpacked(record, str(self._log)))
        if whole < self._log.stat().st_size:
            os.truncate(self._log, whole)

    def append(self, frame: Frame) -> bool:
        """Write a frame behind the others. Returns whether the log is so long that the map should be written."""
        if self._file is None:
            self._file = self._log.open("ab")
        record = _packed(_arrays(frame))
        self._file.write(HEAD.pack(MAGIC, len(record), zlib.crc32(record)) + record)
        self._file.flush()
        return self._file.tell() > LOG_BYTES

    def write(self, arrays: Arrays, values: dict[str, Any]) -> None:
        """The whole map; the log begins anew. A kill in between leaves frames that the state has: their sequence
        numbers say so."""
        text = json.dumps({**values, "began_with": self._origin}).encode()
        with replacing(self._state) as file:
            file.write(_packed({**arrays, "values": np.frombuffer(text, np.uint8)}))
        if self._file is not None:
            self._file.close()
        self._file = self._log.open("wb")


def _next_record(file: io.BufferedReader) -> bytes | None:
    """A whole record, None at the end or where the rest is torn."""
    head = file.read(HEAD.size)
    if len(head) < HEAD.size:
        return None
    magic, length, checksum = HEAD.unpack(head)
    if magic != MAGIC or length > MOST_BYTES:
        return None
    record = file.read(length)
    return record if len(record) == length and zlib.crc32(record) == checksum else None


def _packed(arrays: Arrays) -> bytes:
    """Arrays, each as its name and .npy, one behind the other."""
    parts = []
    for name, array in arrays.items():
        data = npy_bytes(array)
        parts += [struct.pack("<HQ", len(name), len(data)), name.encode(), data]
    return b"".join(parts)


def _unpacked(data: bytes, source: str) -> Arrays:
    arrays, at = {}, 0
    try:
        while at < len(data):
            name_length, length = struct.unpack_from("<HQ", data, at)
            at += 10
            name = data[at : at + name_length].decode()
            at += name_length
            arrays[name] = array_from_npy(data[at : at + length])
            at += length
    except (ValueError, struct.error, UnicodeError) as error:
        raise OgPointcloudError(f"{source} is damaged ({error!s:.80}): remove the folder and map again") from None
    return arrays


FRAME_ARRAYS = ("masks", "features", "depth", "cloud", "rgb")


def _arrays(frame: Frame) -> Arrays:
    arrays = {name: np.asarray(value) for name in FRAME_ARRAYS if (value := getattr(frame, name)) is not None}
    if "masks" in arrays:
        arrays["masks"] = arrays["masks"].astype(np.int16 if arrays["masks"].max(initial=0) < 1 << 15 else np.int32)
    assert frame.camera is not None
    assert frame.stamp is not None
    return {**arrays, "camera": rows_of_cameras([frame.camera]), "stamp": np.array([frame.stamp])}


def _frame(arrays: Arrays) -> Frame:
    camera = cameras_of_rows(arrays["camera"])[0]
    given: dict[str, Any] = {name: arrays.get(name) for name in FRAME_ARRAYS}
    return Frame(camera, stamp=float(arrays["stamp"][0]), **given)
