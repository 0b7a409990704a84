"""Read SPZ, Niantic's packed splats (versions 2 to 4), and write it (version 3).

A header, then the columns: positions as 24-bit fixed point, opacity, color and log scale in one byte per value,
rotations as three bytes x y z (version 2) or as the smallest three of four components in 32 bits. Versions 2 and 3 are
a single gzip; version 4 packs each column separately with zstd, which needs the extra 'spz'. SPZ's axes are OpenGL's
(y up, z back), those of a PLY and of the scene are as trained (y down, z forward): y and z change sign, as in other
converters.

Harmonics above the constant one are not read, as in PLY files, and not written.

Format: nianticlabs/spz, README, "Internals"; tests compare with SuperSplat's files.
"""

from __future__ import annotations

import gzip
import struct
import warnings
import zlib
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.errors import SceneError, naming_extra
from og_pointcloud.formats.atomic import StrPath, write_file
from og_pointcloud.formats.gaussian_ply import SH_CONSTANT, Splats, activated, from_smallest_three, unpacked_limit
from og_pointcloud.formats.tables import naming
from og_pointcloud.scene import DoubleArray, IntArray, Points

Bytes = NDArray[np.uint8]

MAGIC, GZIP = b"NGSP", b"\x1f\x8b"
HEADER = struct.Struct("<4sIIBBBB")
"""Magic, version, splats, degree of the harmonics, fraction bits, flags, and in version 4 the number of columns."""
HARMONICS = (0, 3, 8, 15, 24)
"""Coefficients per channel above the constant one, by degree."""
COLOR_SCALE, LOG_SCALE_STEPS, MIN_LOG_SCALE = 0.15, 16.0, -10.0
"""A byte encodes f_dc as byte / 255 = 0.5 + 0.15 f_dc, and a log scale in steps of 1/16 from -10."""
SIGN_BIT = 1 << 23
"""Of 24-bit integers."""
MAX_FRACTION_BITS = 23
MAX_MAGNITUDE = 511
"""Of a rotation's component: nine bits, without its sign."""
PART_SHIFTS = np.array([20, 10, 0], np.uint32)
"""Bits by which the three smaller components of a rotation, ten bits each, are shifted, in order."""
AXIS_SIGNS = np.array([1.0, -1.0, -1.0])
"""Factors of x, y, z in positions and quaternions, between the two axis conventions."""
MAX_STEP_SHARE = 1e-4
"""Largest rounding step of positions, as a share of the cloud's extent."""


def looks_like_spz(head: bytes) -> bool:
    """Whether a file with these first bytes is an SPZ, or a gzip, which no other format here uses."""
    return head.startswith((MAGIC, GZIP))


def read_spz(path: Path) -> Splats:
    """Gaussians of an SPZ file; world coordinates, the median as origin.

    SceneError for a file that is damaged, of another format, or claims more than it holds; MissingExtraError for
    version 4 without zstandard.
    """
    data = path.read_bytes()
    count, bits, columns = _columns(data) if data.startswith(MAGIC) else _unpacked(data)
    positions, opacity, color, log_scale, rotation = columns
    xyz = _fixed_point(positions.reshape(count, 3, 3)) / 2.0**bits
    base = 0.5 + SH_CONSTANT * (color.reshape(count, 3) / 255 - 0.5) / COLOR_SCALE
    scale = np.exp(log_scale.reshape(count, 3) / LOG_SCALE_STEPS + MIN_LOG_SCALE).astype(np.float32)
    xyzw = _three_bytes(rotation) if len(rotation) == 3 * count else _smallest_three(rotation.view("<u4"))
    wxyz = np.column_stack([xyzw[:, 3], xyzw[:, :3] * AXIS_SIGNS])
    return activated(xyz * AXIS_SIGNS, scale, wxyz, opacity / 255, base)


def write_spz(path: StrPath, points: Points, rgb: Bytes | None = None) -> None:
    """Write Gaussians as SPZ version 3, whole or not at all. rgb: (n, 3), instead of the points' own colors.

    Scales are written in steps of 6 % between 4.5e-5 and 379, with a warning where a Gaussian's largest scale lies
    outside; colors in steps of two of 255; positions as finely as 24 bits allow. SceneError where these are not
    Gaussians, or lie so far from 0 that this is too coarse.
    """
    path = Path(path)
    with naming(path):
        scale, rotation, opacity = points.gaussians
        positions, bits = _as_fixed_point(points.xyz_world * AXIS_SIGNS)
        color = points.rgb if rgb is None else rgb
        base = (np.full(points.xyz.shape, 127.5) if color is None else color) / 255 - 0.5
        with np.errstate(divide="ignore"):  # a scale of 0 becomes the smallest
            steps = (np.log(scale.astype(np.float64)) - MIN_LOG_SCALE) * LOG_SCALE_STEPS
        # A step below 0 or above 255; that flat Gaussians become a little thicker is no loss.
        largest = steps.max(axis=1)
        if changed := int(((largest < -0.5) | (largest > 255.5)).sum()):
            warnings.warn(
                f"{path}: {changed} of {len(scale)} Gaussians have scales that SPZ cannot hold, below 4.5e-5 or above "
                "379: written as the nearest; use another unit, or write a .ply",
                stacklevel=2,
            )
        columns = (
            positions,
            _byte(255 * opacity),
            _byte(255 * (base / SH_CONSTANT * COLOR_SCALE + 0.5)),
            _byte(steps),
            _packed_rotation(rotation.astype(np.float64)),
        )
        header = HEADER.pack(MAGIC, 3, len(points.xyz), 0, bits, 0, 0)
        write_file(path, gzip.compress(b"".join([header, *(column.tobytes() for column in columns)]), mtime=0))


# Files -------------------------------------------------------------------------------------------------------------


def _header(head: bytes, packed: int) -> tuple[int, int, int, list[int]]:
    """Number of splats, fraction bits, number of columns (version 4), and the bytes of each column, harmonics last.

    SceneError if the header cannot be right. packed: bytes of the file.
    """
    if len(head) < HEADER.size:
        raise SceneError(f"its header ends after {len(head)} bytes: copy or export it again")
    magic, version, count, degree, bits, _, columns = HEADER.unpack_from(head)
    if magic != MAGIC or version not in (2, 3, 4) or degree >= len(HARMONICS) or bits > MAX_FRACTION_BITS:
        raise SceneError(
            f"its header says {magic!r}, version {version}, degree {degree}, {bits} fraction bits; expected 'NGSP', "
            f"version 2 to 4, at most {len(HARMONICS) - 1} and {MAX_FRACTION_BITS}: export it again"
        )
    if count == 0:
        raise SceneError("it has 0 splats; expected at least one")
    # Positions, opacity, color, scale, rotation, harmonics.
    sizes = [9 * count, count, 3 * count, 3 * count, (3 if version == 2 else 4) * count, 3 * HARMONICS[degree] * count]
    if sum(sizes) > unpacked_limit(packed):
        raise SceneError(
            f"it claims {count} splats, {sum(sizes)} bytes, in a file of {packed}: it is made to fill memory"
        )
    return count, bits, columns, sizes


def _unpacked(data: bytes) -> tuple[int, int, list[Bytes]]:
    """Number of splats, fraction bits and columns of versions 2 and 3."""
    stream = zlib.decompressobj(wbits=31)  # with gzip's header
    try:
        count, bits, _, sizes = _header(stream.decompress(data, HEADER.size), len(data))
        body = stream.decompress(stream.unconsumed_tail, sum(sizes))
    except zlib.error as error:
        raise SceneError(f"not a whole gzip ({error!s:.80}): copy or export it again") from None
    if len(body) < sum(sizes):
        raise SceneError(f"{count} splats need {sum(sizes)} bytes, it unpacks to {len(body)}: it is truncated")
    return count, bits, np.split(np.frombuffer(body, np.uint8), np.cumsum(sizes)[:5])[:5]


def _columns(data: bytes) -> tuple[int, int, list[Bytes]]:
    """As `_unpacked`, for version 4: a table of packed and unpacked sizes, 64 bits each, then the columns."""
    with naming_extra("zstandard", "spz"):
        import zstandard
    count, bits, streams, sizes = _header(data, len(data))
    table = int.from_bytes(data[HEADER.size : HEADER.size + 4], "little")
    start, columns = table + 16 * streams, []
    if streams < 5 or start > len(data):
        raise SceneError(f"its table of {streams} columns at byte {table} does not fit in it: copy or export it again")
    for number, size in enumerate(sizes[:5]):  # harmonics, the sixth, stay packed
        packed, claimed = struct.unpack_from("<QQ", data, table + 16 * number)
        frame = data[start : start + packed]
        start += packed
        try:
            # Checked before unpacking: a stated size must be the one that follows from the header.
            if claimed != size or len(frame) < packed or zstandard.frame_content_size(frame) not in (size, -1):
                raise SceneError(f"column {number} claims {claimed} bytes in {packed}; expected {size}: copy it again")
            column = zstandard.ZstdDecompressor(max_window_size=1 << 27).decompress(frame, max_output_size=size)
        except zstandard.ZstdError as error:
            raise SceneError(f"column {number} is damaged ({error!s:.80}): copy or export it again") from None
        if len(column) != size:
            raise SceneError(f"column {number} unpacks to {len(column)} bytes; expected {size}: copy it again")
        columns.append(np.frombuffer(column, np.uint8))
    return count, bits, columns


# Numbers -----------------------------------------------------------------------------------------------------------


def _byte(values: NDArray[np.floating]) -> Bytes:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def _fixed_point(parts: Bytes) -> IntArray:
    """(...) signed integers from three bytes (..., 3) each, lowest first."""
    # Flipping the sign bit and subtracting it again extends the sign from 24 to 32 bits.
    low, middle, high = np.moveaxis(parts.astype(np.int32), -1, 0)
    return ((low | middle << 8 | high << 16) ^ SIGN_BIT) - SIGN_BIT


def _as_fixed_point(xyz: DoubleArray) -> tuple[Bytes, int]:
    """(n, 9) bytes, and the number of fraction bits: as many as the largest absolute coordinate allows."""
    farthest = float(np.abs(xyz).max(initial=0.0))
    bits = MAX_FRACTION_BITS if farthest < 0.5 else int(np.floor(np.log2((SIGN_BIT - 1) / farthest)))
    extent = float(np.ptp(xyz, axis=0).max(initial=0.0))
    if bits < 0 or (extent > 0 and 2.0**-bits > MAX_STEP_SHARE * extent):
        raise SceneError(
            f"positions reach {farthest:.4g} from 0 over an extent of {extent:.4g}, which SPZ's 24 bits cannot "
            "resolve: move the splats near 0, use a smaller unit, or write a .ply"
        )
    steps = np.rint(xyz * 2.0**bits).astype(np.int32)
    return np.stack([steps & 255, steps >> 8 & 255, steps >> 16 & 255], axis=-1).astype(np.uint8).reshape(-1, 9), bits


def _three_bytes(rotation: Bytes) -> DoubleArray:
    """(n, 4) quaternions x y z w of version 2, where w follows from length 1."""
    xyz = rotation.reshape(-1, 3) / 127.5 - 1
    return np.column_stack([xyz, np.sqrt(np.maximum(0.0, 1 - np.square(xyz).sum(axis=1)))])


def _smallest_three(words: NDArray[np.uint32]) -> DoubleArray:
    """(n, 4) quaternions x y z w: two bits name the largest component, which is positive. The others, at most
    1/sqrt(2), have nine bits and a sign each; the last one is in the lowest bits."""
    fields = words[:, None] >> PART_SHIFTS
    size = (fields & MAX_MAGNITUDE) / MAX_MAGNITUDE * np.sqrt(0.5)
    return from_smallest_three(words >> 30, np.where(fields >> 9 & 1, -size, size))


def _packed_rotation(wxyz: DoubleArray) -> NDArray[np.uint32]:
    """(n,) words that `_smallest_three` reads, of unit quaternions with the scene's axes."""
    xyzw = np.column_stack([wxyz[:, 1:] * AXIS_SIGNS, wxyz[:, 0]])
    largest = np.abs(xyzw).argmax(axis=1)
    xyzw *= np.where(np.take_along_axis(xyzw, largest[:, None], axis=1) < 0, -1.0, 1.0)  # -q is the same rotation as q
    others = xyzw[np.arange(4) != largest[:, None]].reshape(-1, 3)
    size = np.minimum(np.rint(np.abs(others) * np.sqrt(2) * MAX_MAGNITUDE), MAX_MAGNITUDE).astype(np.uint32)
    fields = (size | (others < 0).astype(np.uint32) << 9) << PART_SHIFTS
    return (np.bitwise_or.reduce(fields, axis=1) | largest.astype(np.uint32) << 30).astype("<u4")
