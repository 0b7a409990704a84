"""What a LAS or LAZ header counts, held against the file's size before a library believes it.

laspy reads as many records as the header says there are, if need be four billion empty ones; lazrs makes room for every
chunk and layer that a LAZ file announces, and ends the process where there is none.

Format: ASPRS, "LAS Specification 1.4 R15"; Isenburg, "LASzip: lossless compression of LiDAR data", 2013; the layered
chunks of LASzip 3.
"""

from __future__ import annotations

import mmap
import struct
from pathlib import Path

from og_pointcloud.errors import SceneError

__all__ = ["check_las_counts"]

SMALLEST_HEADER, HEADER_OF_1_4 = 227, 375
RECORD_HEADER, EXTENDED_RECORD_HEADER = 54, 60
COMPRESSED = 0x80
"""Bit of the point format that says LAZ."""
LASZIP = struct.pack("<16sH", b"laszip encoded", 22204)
LAYERED = 3
LAYERS = {10: 9, 11: 1, 12: 2, 13: 1}
"""Layers of an item by its type; extra bytes, type 14, have one each."""
EXTRA_BYTES = 14


def check_las_counts(path: Path) -> None:
    """SceneError where records, points, chunks or layers would not fit into the file."""
    size = path.stat().st_size
    _require(size >= SMALLEST_HEADER, f"a file of {size} bytes has no whole header")
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        header, first_point, records, kind, point_size, count = struct.unpack_from("<HIIBHI", data, 94)
        _require(header + RECORD_HEADER * records <= first_point <= size, f"{records} records before the points")
        if data[25] >= 4:
            _require(size >= HEADER_OF_1_4, f"a file of {size} bytes has no whole header")
            start, extended, count = struct.unpack_from("<QIQ", data, 235)
            _require(not extended or start + EXTENDED_RECORD_HEADER * extended <= size, f"{extended} late records")
        if kind & COMPRESSED:
            _check_chunks(data, _item_layers(data, header, records), first_point, point_size)
        else:
            _require(count * point_size <= size - first_point, f"{count} points of {point_size} bytes")


def _require(fits: bool, what: str) -> None:
    if not fits:
        raise SceneError(f"{what}: the file is damaged or truncated; copy or write it again")


def _item_layers(data: mmap.mmap, at: int, records: int) -> int:
    """Number of layers of a point, 0 where the points are not layered."""
    for _ in range(records):
        _require(at + RECORD_HEADER <= len(data), "a record beyond the end")
        length = struct.unpack_from("<H", data, at + 20)[0]
        content = data[at + RECORD_HEADER : at + RECORD_HEADER + length]
        if data[at + 2 : at + 20] == LASZIP:
            _require(len(content) >= 34, f"a LASzip record of {len(content)} bytes")
            compressor, items = struct.unpack_from("<H30xH", content)
            _require(len(content) >= 34 + 6 * items, f"{items} items in a LASzip record of {len(content)} bytes")
            kinds = [struct.unpack_from("<HH", content, 34 + 6 * item) for item in range(items)]
            layers = sum(size if kind == EXTRA_BYTES else LAYERS.get(kind, 0) for kind, size in kinds)
            return layers if compressor == LAYERED else 0
        at += RECORD_HEADER + length
    raise SceneError("compressed points without a LASzip record: the file is damaged; copy or write it again")


def _check_chunks(data: mmap.mmap, layers: int, first_point: int, point_size: int) -> None:
    """The chunks lie one behind the other, and then comes their table, which says how many there are.

    A layered chunk: its first point, its number of points, the lengths of its layers, the layers.
    """
    _require(first_point + 8 <= len(data), "a chunk table beyond the end")
    table, at, chunks = struct.unpack_from("<q", data, first_point)[0], first_point + 8, 0
    if table == -1:  # written to a stream: its place stands at the end
        table = struct.unpack_from("<q", data, len(data) - 8)[0]
    _require(at <= table <= len(data) - 8, f"a chunk table at byte {table} of {len(data)}")
    while layers and at < table:
        sizes = at + point_size + 4
        _require(sizes + 4 * layers <= table, f"chunk {chunks} beyond the chunk table")
        at = sizes + 4 * layers + sum(struct.unpack_from(f"<{layers}I", data, sizes))
        _require(at <= table, f"layers of chunk {chunks} beyond the chunk table")
        chunks += 1
    counted = struct.unpack_from("<I", data, table + 4)[0]
    _require(counted == chunks if layers else counted <= table - at, f"a table of {counted} chunks")
