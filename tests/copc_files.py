"""A COPC file made to its specification (copc.io, version 1.0), which neither laspy nor lazrs writes; LAS labels."""

from __future__ import annotations

import io
import struct
from pathlib import Path

import numpy as np

HEADER, RECORD_HEADER, INFO = 375, 54, 160
POINT_FORMAT, POINT_BYTES = 7, 36
"""Three 32-bit counts to a point, times, and colors of 16 bits."""


def attributes_of(labels: list[int] | np.ndarray) -> dict[str, np.ndarray]:
    """What `write_las` stores of points of these labels, each an instance of its number."""
    labels = np.asarray(labels, np.int32)
    scores, reasons = np.ones(len(labels), np.float32), (labels < 0).astype(np.uint8)
    return {"og_label": labels, "og_instance": labels, "og_score": scores, "og_reason": reasons}


def write_copc(path: Path, xyz: np.ndarray, rgb: np.ndarray) -> None:
    """Two nodes of an octree, half of the points in each: a LAZ of chunks of any size, and a record that finds them."""
    import laspy
    import lazrs

    header = laspy.LasHeader(point_format=POINT_FORMAT, version="1.4")
    header.offsets, header.scales = xyz.min(axis=0), np.full(3, 1e-4)
    las = laspy.LasData(header)
    las.xyz = xyz
    las.red, las.green, las.blue = (rgb.astype(np.uint16) * 257).T
    stream = io.BytesIO()
    las.write(stream)
    plain = stream.getvalue()
    first_point = struct.unpack_from("<I", plain, 96)[0]
    rows = np.frombuffer(plain[first_point : first_point + len(xyz) * POINT_BYTES], np.uint8)
    laszip = lazrs.LazVlr.new_for_compression(POINT_FORMAT, 0, True)
    record = bytes(laszip.record_data())
    at = HEADER + RECORD_HEADER + INFO + RECORD_HEADER + len(record)
    points = io.BytesIO(bytes(at))
    points.seek(at)
    compressor = lazrs.LasZipCompressor(points, laszip)
    compressor.compress_many(rows[: len(xyz) // 2 * POINT_BYTES])
    compressor.finish_current_chunk()
    compressor.compress_many(rows[len(xyz) // 2 * POINT_BYTES :])
    compressor.done()
    points.seek(at)
    nodes, begin = b"", at + 8
    for level, (count, size) in enumerate(lazrs.read_chunk_table(points, laszip)):
        nodes += struct.pack("<4iQ2i", level, 0, 0, 0, begin, size, count)
        begin += size
    end = len(points.getvalue())
    place = end + 60, len(nodes)
    info = struct.pack("<5d2Q2d11Q", *xyz.mean(axis=0), 10.0, 1.0, *place, 0.0, 0.0, *[0] * 11)
    records = b"".join(
        struct.pack("<H16sHH32s", 0, owner, number, len(data), b"") + data
        for owner, number, data in ((b"copc", 1, info), (b"laszip encoded", 22204, record))
    )
    head = bytearray(plain[:HEADER])
    struct.pack_into("<II", head, 96, at, 2)
    head[104] = POINT_FORMAT | 0x80
    struct.pack_into("<QI", head, 235, end, 1)
    tail = struct.pack("<H16sHQ32s", 0, b"copc", 1000, len(nodes), b"") + nodes
    path.write_bytes(bytes(head) + records + points.getvalue()[at:] + tail)
