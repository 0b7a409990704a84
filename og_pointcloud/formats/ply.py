"""Read and write PLY, ascii or binary in either byte order, as one structured array per element.

Format: Greg Turk, "The PLY Polygon File Format", 1994; also type names with bit widths (``float32``), as later tools
write them.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import takewhile
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.errors import SceneError
from og_pointcloud.formats.atomic import StrPath, replacing
from og_pointcloud.formats.tables import naming, read_binary_rows, read_text_rows, storable_positions

HEADER_LIMIT = 1 << 18
"""Bytes within which a header must end; the longest known (a 3DGS file with its training record) has 4 kB."""

MAX_PROPERTIES = 1024
MAX_NAME_LENGTH = 80
"""Bounds on what a header may declare, far above what any writer produces."""

NUMPY_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float32": "f4", "float64": "f8",
}  # fmt: skip
PLY_TYPES = {numpy_type: name for name, numpy_type in reversed(NUMPY_TYPES.items())}
"""The names of 1994, which every reader knows: in reverse order, the first name of each type is set last."""
BYTE_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


@dataclass
class _Element:
    name: str
    count: int
    columns: dict[str, str] = field(default_factory=dict)
    """Property -> numpy type code without byte order."""
    lists: list[tuple[int, str, str]] = field(default_factory=list)
    """For each list: the number of plain properties before it, and the names of the types of its length and values."""

    @property
    def has_readable_rows(self) -> bool:
        """Whether it has no lists, or is that of the vertices with lists beside the plain properties."""
        kinds = [(NUMPY_TYPES.get(length, "f")[0] in "iu", value in NUMPY_TYPES) for _, length, value in self.lists]
        return not kinds or (self.name == "vertex" and bool(self.columns) and all(map(all, kinds)))

    def dtype(self, byte_order: str) -> np.dtype:
        return np.dtype([(name, byte_order + numpy_type) for name, numpy_type in self.columns.items()])


@dataclass(frozen=True)
class _Header:
    byte_order: str
    """``<`` or ``>``; empty for ascii."""
    elements: list[_Element]
    data_offset: int


def looks_like_ply(head: bytes) -> bool:
    """Whether a file with these first bytes is a PLY."""
    return head.startswith((b"ply\n", b"ply\r", b"ply "))


def read_ply(path: StrPath) -> dict[str, NDArray[np.void]]:
    """Element name -> (count,) structured array, one field per property, native byte order.

    Elements are read up to the first other than 'vertex' with a list property (the faces of a mesh, which follow the
    vertices); lists of vertices, such as the views that saw each, are left out. SceneError, beginning with the path,
    for a file that is missing, truncated, of another format, or whose header does not fit its size; nothing is
    allocated before that check.
    """
    path = Path(path)
    with naming(path), path.open("rb") as file:
        header = _parse_header(file.read(HEADER_LIMIT))
        file.seek(header.data_offset)
        # Rows with lists have no fixed length, so elements after them cannot be located without reading them.
        plain = takewhile(lambda element: element.has_readable_rows, header.elements)
        return {element.name: _rows(file, element, header.byte_order) for element in plain}


def write_ply(path: StrPath, elements: Mapping[str, NDArray[np.void]], comments: Sequence[str] = ()) -> None:
    """Write structured arrays as a binary little-endian PLY, whole or not at all.

    elements: name -> (n,) structured array of scalar fields, int8 to int32 or float32, float64. comments: a line each.
    SceneError where PLY lacks the type of a field, or the folder cannot be written.
    """
    path = Path(path)
    with naming(path):
        # Everything is converted before the file is opened: an unsupported type leaves no file behind.
        packed = {name: _packed(name, rows) for name, rows in elements.items()}
        header = ["ply", "format binary_little_endian 1.0", *(f"comment {comment}" for comment in comments)]
        for name, rows in packed.items():
            header.append(f"element {name} {len(rows)}")
            header += [f"property {PLY_TYPES[_numpy_type(rows, field)]} {field}" for field in rows.dtype.names or ()]
        if any("\n" in line or "\r" in line for line in header):
            raise SceneError("a comment or name contains a line break; expected one line: split the comment")
        with replacing(path) as file:
            file.write("\n".join([*header, "end_header", ""]).encode())
            for rows in packed.values():
                file.write(rows.data)


def join_columns(columns: Mapping[str, NDArray]) -> NDArray[np.void]:
    """One-dimensional arrays of equal length -> (n,) structured array with one field each, types kept."""
    lengths = {name: column.shape for name, column in columns.items()}
    if len(set(lengths.values())) != 1 or any(len(shape) != 1 for shape in lengths.values()):
        raise SceneError(f"columns have shapes {lengths}; expected one-dimensional arrays of one length")
    rows = np.empty(next(iter(lengths.values())), [(name, column.dtype) for name, column in columns.items()])
    for name, column in columns.items():
        rows[name] = column
    return rows


def plain_rows(
    xyz_world: NDArray[np.floating], rgb: NDArray[np.uint8] | None, attributes: Mapping[str, NDArray] | None = None
) -> NDArray[np.void]:
    """A cloud as vertices: x y z, double where float would move a point by more than 1e-6 of the cloud's extent, red
    green blue, and other columns."""
    columns = dict(zip("xyz", storable_positions(xyz_world).T, strict=True))
    if rgb is not None:
        columns |= dict(zip(("red", "green", "blue"), rgb.T, strict=True))
    return join_columns(columns | dict(attributes or {}))


def _parse_header(head: bytes) -> _Header:
    if not re.match(rb"ply[ \t]*\r?\n", head):
        raise SceneError(f"not a PLY file: it starts with {head[:16]!r}; expected a line 'ply'")
    end = re.search(rb"\nend_header[ \t]*\r?(\n|\Z)", head)
    if end is None:
        raise SceneError(f"no line 'end_header' within {len(head)} bytes: the PLY header is truncated or damaged")
    byte_order: str | None = None
    elements: list[_Element] = []
    # Not splitlines(): it would also split a comment at the odd control characters that Unicode counts as line ends.
    for number, line in enumerate(head[: end.start()].decode("utf-8", "replace").split("\n")[1:], start=2):
        match line.split():
            case [] | ["comment" | "obj_info", *_]:
                continue
            case ["format", encoding, "1.0"] if encoding in BYTE_ORDERS and byte_order is None:
                byte_order = BYTE_ORDERS[encoding]
            case ["element", name, count] if re.fullmatch("[0-9]{1,15}", count) and len(name) <= MAX_NAME_LENGTH:
                if any(name == element.name for element in elements):
                    raise SceneError(f"header line {number}: element '{name}' is declared twice")
                elements.append(_Element(name, int(count)))
            case ["property", *words] if words and elements and all(len(word) <= MAX_NAME_LENGTH for word in words):
                _add_property(elements[-1], words, number)
            case _:
                raise SceneError(
                    f"header line {number} is {line.strip()[:40]!r}; expected 'format <encoding> 1.0' (once), 'element "
                    "<name> <count>', or a 'property' below an element: the file is damaged or not a PLY"
                )
    if byte_order is None:
        raise SceneError(f"the PLY header has no 'format' line; expected one of {', '.join(BYTE_ORDERS)}")
    for element in elements:
        if not (element.columns or element.lists):
            raise SceneError(f"element '{element.name}' has no properties: the PLY header is damaged")
    return _Header(byte_order, elements, end.end())


def _add_property(element: _Element, words: list[str], number: int) -> None:
    """Append the property that ``words``, the rest of a header line, declares."""
    if words[0] == "list" and len(words) == 4:
        element.lists.append((len(element.columns), words[1], words[2]))
        return
    if len(words) != 2:
        raise SceneError(f"header line {number}: property {' '.join(words)[:80]!r}; expected a type and a name")
    kind, name = words
    if kind not in NUMPY_TYPES:
        raise SceneError(f"header line {number}: unknown type {kind!r:.60}; expected one of {', '.join(NUMPY_TYPES)}")
    if len(element.columns) >= MAX_PROPERTIES:
        raise SceneError(f"header line {number}: element '{element.name}' has more than {MAX_PROPERTIES} properties")
    if name in element.columns:
        raise SceneError(f"header line {number}: element '{element.name}' has property '{name}' twice")
    element.columns[name] = NUMPY_TYPES[kind]


def _rows(file: BinaryIO, element: _Element, byte_order: str) -> NDArray[np.void]:
    """The rows of an element, without their lists, from the file's current position."""
    what = f"element '{element.name}'"
    if not byte_order:
        lines = (_without_lists(line, element) for line in file) if element.lists else file
        return read_text_rows(lines, element.dtype("="), element.count, what)
    if element.lists:
        rows = _rows_without_lists(file, element, byte_order)
    else:
        rows = read_binary_rows(file, element.dtype(byte_order), element.count, what)
    # To native byte order, which all later computation expects.
    return rows.astype(rows.dtype.newbyteorder("="), copy=False)


def _without_lists(line: bytes, element: _Element) -> bytes:
    values = line.split()
    try:
        for place, *_ in element.lists if values else ():
            del values[place : place + 1 + int(values[place])]
    except (IndexError, ValueError):
        raise SceneError(f"element '{element.name}': a row is {line[:60]!r}; expected the length of a list") from None
    return b" ".join(values) + b"\n"


def _rows_without_lists(file: BinaryIO, element: _Element, byte_order: str) -> NDArray[np.void]:
    """Binary rows, each of which begins where the lists of the one before it end: some microseconds per row."""
    dtype, start, data = element.dtype(byte_order), file.tell(), file.read()
    ends = np.cumsum([0, *(np.dtype(kind).itemsize for kind in element.columns.values())])
    *before, after = np.diff([0, *(ends[place] for place, *_ in element.lists), ends[-1]]).tolist()
    lists = [
        (plain, struct.Struct(byte_order + np.dtype(NUMPY_TYPES[length]).char), np.dtype(NUMPY_TYPES[value]).itemsize)
        for plain, (_, length, value) in zip(before, element.lists, strict=True)
    ]
    rows, at = bytearray(), 0
    try:
        for _ in range(element.count):
            for plain, length, size in lists:
                rows += data[at : at + plain]
                at += plain + length.size + size * max(length.unpack_from(data, at + plain)[0], 0)
            rows += data[at : at + after]
            at += after
    except struct.error:  # a length beyond the end
        at = len(data) + 1
    if at > len(data):
        raise SceneError(f"element '{element.name}': expected {element.count} rows with lists: the file is truncated")
    file.seek(start + at)
    return np.frombuffer(rows, dtype)


def _packed(element: str, rows: NDArray[np.void]) -> NDArray[np.void]:
    """The same rows, little endian and without padding; SceneError where PLY lacks the type of a field."""
    names = rows.dtype.names
    if not names or rows.ndim != 1:
        raise SceneError(f"element '{element}' is {rows.dtype} {rows.shape}; expected a 1-D structured array")
    for name in (element, *names):
        if not re.fullmatch(r"\S+", name):
            raise SceneError(f"element '{element}': the name {name!r} is empty or has a space; PLY names are one word")
    for name in names:
        if _numpy_type(rows, name) not in PLY_TYPES:
            raise SceneError(
                f"property '{name}' of element '{element}' is {rows.dtype[name]}; PLY has int8 to int32, uint8 to "
                "uint32, float32, float64: convert it first"
            )
    little_endian = np.dtype([(name, rows.dtype[name].newbyteorder("<")) for name in names])
    return rows.astype(little_endian, copy=False)


def _numpy_type(rows: NDArray[np.void], field: str) -> str:
    """Type code of a field without its byte order, e.g. ``f4``."""
    return rows.dtype[field].str.lstrip("<>|=")
