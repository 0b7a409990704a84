"""Read PCD version 0.7, with ascii, binary or binary_compressed data, as one structured array.

Format: the Point Cloud Library's page "The PCD (Point Cloud Data) file format"; compressed data is Marc Lehmann's LZF.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.errors import SceneError
from og_pointcloud.formats.atomic import StrPath
from og_pointcloud.formats.tables import naming, read_binary_rows, read_text_rows

HEADER_LIMIT = 1 << 16
POINT_SIZE_LIMIT = 1 << 20
"""Bytes of a point, descriptors and padding included; the largest type in PCL has about 8 kB."""

NUMPY_KINDS = {"F": "f", "I": "i", "U": "u"}
SIZES = {"F": (4, 8), "I": (1, 2, 4, 8), "U": (1, 2, 4, 8)}
ENCODINGS = ("ascii", "binary", "binary_compressed")


@dataclass(frozen=True)
class _Header:
    dtype: np.dtype
    points: int
    encoding: str
    data_offset: int


def looks_like_pcd(head: bytes) -> bool:
    """Whether the first bytes of a file are a PCD header: comments, then VERSION, or FIELDS if there is no VERSION."""
    return re.match(rb"(?:\s|#[^\n]*\n)*(?:VERSION|FIELDS)[ \t]", head) is not None


def read_pcd(path: StrPath) -> NDArray[np.void]:
    """(points,) structured array, one field per FIELDS entry (a sub-array where COUNT > 1), little endian.

    Padding fields, all called ``_`` in the file, become ``_0``, ``_1``. The VIEWPOINT (pose of the sensor) is not
    applied: points stay in the frame in which they are stored, as in PCL and Open3D. SceneError, beginning with the
    path, for a file that is missing, truncated, damaged, of another format, or whose header does not fit its size.
    """
    path = Path(path)
    with naming(path), path.open("rb") as file:
        header = _parse_header(file.read(HEADER_LIMIT))
        file.seek(header.data_offset)
        if header.encoding == "ascii":
            return read_text_rows(file, header.dtype, header.points, "PCD data")
        if header.encoding == "binary":
            return read_binary_rows(file, header.dtype, header.points, "PCD data")
        return _read_compressed(file, header)


def _parse_header(head: bytes) -> _Header:
    if not looks_like_pcd(head):
        raise SceneError(f"not a PCD file: it starts with {head[:16]!r}; expected comments and a line 'VERSION'")
    last_line = re.search(rb"^DATA[ \t]+(\w+)[ \t]*\r?(\n|\Z)", head, re.MULTILINE)
    if last_line is None:
        raise SceneError(f"no line 'DATA' within {len(head)} bytes: the PCD header is truncated or damaged")
    encoding = last_line[1].decode("ascii", "replace")
    if encoding not in ENCODINGS:
        raise SceneError(f"PCD data is {encoding!r:.40}; expected one of {', '.join(ENCODINGS)}")
    # The header has one line per keyword, in any order, and ends with DATA.
    entries: dict[str, list[str]] = {}
    for line in head[: last_line.start()].decode("utf-8", "replace").split("\n"):
        keyword, *values = line.split() or ["#"]  # blank lines count as comments
        if keyword.startswith("#"):
            continue
        if keyword in entries:
            raise SceneError(f"the PCD header has two lines {keyword!r:.40}; expected one: the file is damaged")
        entries[keyword] = values
    width, height = _whole_numbers(entries, "WIDTH", 1)[0], _whole_numbers(entries, "HEIGHT", 1)[0]
    points = _whole_numbers(entries, "POINTS", 1)[0] if "POINTS" in entries else width * height
    if points != width * height:
        raise SceneError(f"the PCD header has POINTS {points}, but WIDTH {width} x HEIGHT {height}; expected the same")
    return _Header(_dtype(entries), points, encoding, last_line.end())


def _dtype(entries: dict[str, list[str]]) -> np.dtype:
    names = [f"_{i}" if name == "_" else name for i, name in enumerate(entries.get("FIELDS", []))]
    if not names or len(set(names)) < len(names):
        raise SceneError(f"PCD FIELDS are {' '.join(names)[:80]!r}; expected at least one name, none twice")
    # COUNT may be left out; it is then 1 for all fields.
    sizes = _whole_numbers(entries, "SIZE", len(names))
    counts = _whole_numbers(entries, "COUNT", len(names)) if "COUNT" in entries else [1] * len(names)
    types = entries.get("TYPE", [])
    if len(types) != len(names):
        raise SceneError(f"PCD TYPE has {len(types)} entries; expected one for each of the {len(names)} FIELDS")
    for name, kind, size, count in zip(names, types, sizes, counts, strict=True):
        if size not in SIZES.get(kind, ()) or count < 1:
            raise SceneError(
                f"PCD field '{name:.40}' has TYPE {kind:.20} SIZE {size} COUNT {count}; expected F with 4 or 8, I or U "
                "with 1, 2, 4 or 8, and a count of 1 or more"
            )
    if sum(size * count for size, count in zip(sizes, counts, strict=True)) > POINT_SIZE_LIMIT:
        raise SceneError(f"a PCD point has more than {POINT_SIZE_LIMIT} bytes: the file is damaged")
    numpy_types = [f"<{NUMPY_KINDS[kind]}{size}" for kind, size in zip(types, sizes, strict=True)]
    return np.dtype(
        [
            (name, numpy_type) if count == 1 else (name, numpy_type, (count,))
            for name, numpy_type, count in zip(names, numpy_types, counts, strict=True)
        ]
    )


def _whole_numbers(entries: dict[str, list[str]], keyword: str, expected: int) -> list[int]:
    values = entries.get(keyword, [])
    if len(values) != expected or not all(re.fullmatch("[0-9]{1,15}", value) for value in values):
        raise SceneError(f"PCD {keyword} is {' '.join(values)[:80]!r}; expected {expected} whole numbers, 0 or more")
    return [int(value) for value in values]


def _read_compressed(file: BinaryIO, header: _Header) -> NDArray[np.void]:
    """Two sizes, packed and unpacked, then the packed data. The unpacked data is stored by column: all values of the
    first field, then all of the second."""
    sizes = read_binary_rows(file, np.dtype("<u4"), 2, "sizes of the compressed PCD data")
    compressed_size, size = sizes.tolist()
    compressed = read_binary_rows(file, np.dtype("u1"), compressed_size, "compressed PCD data").tobytes()
    expected = header.points * header.dtype.itemsize
    if size != expected:
        raise SceneError(
            f"PCD data claims to unpack to {size} bytes; the header's {header.points} points need {expected}: the file "
            "is damaged"
        )
    data = _lzf_decompress(compressed, size)
    rows = np.empty(header.points, header.dtype)
    at = 0
    for name in header.dtype.names or ():
        field = header.dtype[name]
        values = np.frombuffer(data, field.base, header.points * (field.itemsize // field.base.itemsize), at)
        rows[name] = values.reshape(header.points, *field.shape)
        at += header.points * field.itemsize
    return rows


def _lzf_decompress(data: bytes, size: int) -> bytearray:
    """LZF: a control byte below 32 is the number of literal bytes that follow, less one; any other starts a copy of
    earlier output.

    The upper three bits of a copy's control byte hold its length less two (if they are 7, the next byte is added); the
    lower five and one more byte hold how far back it starts, less one. A copy may overlap its own output, which repeats
    a pattern.
    """
    out = bytearray()
    at = 0
    try:
        while at < len(data) and len(out) <= size:
            control = data[at]
            at += 1
            if control < 32:
                out += data[at : at + control + 1]
                at += control + 1
                continue
            length = (control >> 5) + 2
            if length == 9:  # 7 + 2: longer than three bits can hold
                length += data[at]
                at += 1
            distance = ((control & 31) << 8 | data[at]) + 1
            at += 1
            start = len(out) - distance
            if start < 0:
                raise SceneError("the compressed PCD data points before its beginning: the file is damaged")
            if distance >= length:
                out += out[start : start + length]
            else:  # it overlaps its own output: repeat the last bytes
                out += (out[start:] * (length // distance + 1))[:length]
    except IndexError:
        raise SceneError("the compressed PCD data ends within a copy: the file is damaged") from None
    if len(out) != size:
        raise SceneError(f"the compressed PCD data unpacks to {len(out)} bytes or more; expected {size}: it is damaged")
    return out
