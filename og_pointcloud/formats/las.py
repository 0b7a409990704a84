"""Read and write LAS and LAZ, through laspy (extra 'las').

Written as LAS 1.4, with labels where each kind of reader looks for them: ``classification`` for viewers, and extra
bytes og_label, og_instance, og_score, og_reason for programs. Names are JSON in a record of user og_pointcloud. Points
of a LAS file keep their attributes and coordinate system; others are written in point format 7.

Before a file is read, the counts in its header are checked against its size: laspy reads as many records as the header
states, even four billion empty ones, and lazrs allocates memory for every chunk and layer that a LAZ file declares,
and ends the process if there is not enough.

Format: ASPRS, "LAS Specification 1.4 R15"; Isenburg, "LASzip: lossless compression of LiDAR data", 2013.
"""

from __future__ import annotations

import json
import mmap
import struct
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.errors import SceneError, naming_extra
from og_pointcloud.formats.atomic import StrPath, replacing
from og_pointcloud.formats.tables import LABEL_FINITE, SCALE_8_TO_16_BITS, naming
from og_pointcloud.scene import DoubleArray, Points, require_finite

if TYPE_CHECKING:
    from laspy import LasData

SIGNATURE = b"LASF"
POINTS_PER_CHUNK, CHUNK_BYTES = 1_000_000, 1 << 26
"""Read at once, at most, so that memory use depends on the points in the file, not on the count in its header."""
UNLABELLED = 1
"""Class "processed, but unclassified"; also used for labels beyond the last free class."""
FIRST_FREE_CLASS, LAST_CLASS = 64, 255
"""Classes that the format leaves to its users: label k is class 64 + k."""
STEPS_PER_EXTENT = 1e8
"""Coordinates are stored as 32-bit multiples of a step: ten nanometers in a room, 10 micrometers in a city block."""
EIGHT_BIT_CLASSES = {0: 6, 1: 6, 2: 7, 3: 7, 4: 9, 5: 10}
"""Point formats before LAS 1.4 have only 32 classes: each is mapped to the later format that has all its fields."""
DEGREES_PER_STEP = 0.006
"""Unit of scan angles since LAS 1.4; earlier versions store whole degrees."""
OWN_DIMENSIONS = ("og_label", "og_instance", "og_score", "og_reason")
RECORD_OWNER, NAMES_RECORD = "og_pointcloud", 1
MAX_RECORD_BYTES = 65_535
MIN_HEADER_BYTES, RECORD_HEADER, LAST_RECORD_HEADER = 227, 54, 60
"""Bytes: the header of LAS 1.0 to 1.2; the header of a variable length record before the points, and after them."""
LAYERED = 3
"""LASzip's compressor whose chunks hold each field in a separate layer."""
LAYERS = {10: 9, 11: 1, 12: 2, 13: 1}
"""Number of layers by type of item; extra bytes, type 14, have one layer per byte."""
EXTRA_BYTES = 14


def looks_like_las(head: bytes) -> bool:
    """Whether a file with these first bytes is a LAS or LAZ."""
    return head.startswith(SIGNATURE)


def read_las(path: StrPath) -> Points:
    """Positions, and colors where the point format has them.

    SceneError, beginning with the path, for a file that is damaged or has no points; MissingExtraError without laspy.
    """
    xyz: list[DoubleArray] = []
    rgb: list[NDArray[np.uint16]] = []
    with _opened(Path(path)) as reader:
        promised, scales = reader.header.point_count, np.asarray(reader.header.scales)
        if not (scales > 0).all():  # 0 puts all points in one place; a negative scale mirrors them
            raise SceneError(f"its scale factors are {scales.tolist()}; expected 3 numbers above 0: export it again")
        has_colors = "red" in reader.header.point_format.dimension_names
        at_once = max(1, min(POINTS_PER_CHUNK, CHUNK_BYTES // reader.header.point_format.size))
        for chunk in reader.chunk_iterator(at_once):
            xyz.append(np.column_stack([chunk.x, chunk.y, chunk.z]))
            if has_colors:
                rgb.append(np.column_stack([chunk.red, chunk.green, chunk.blue]))
        count = sum(map(len, xyz))
        if count != promised or not count:
            raise SceneError(
                f"expected {promised} points, the file has {count}: it is empty or truncated; copy or write it again"
            )
    return Points.from_world(np.concatenate(xyz), rgb=_eight_bits(np.concatenate(rgb)) if rgb else None)


def write_las(
    path: StrPath,
    xyz_world: NDArray[np.floating],
    rgb: NDArray[np.uint8],
    attributes: Mapping[str, NDArray],
    names: Sequence[str],
    source: StrPath | None = None,
) -> None:
    """Write a labelled cloud, compressed where the path ends in .laz; whole or not at all.

    xyz_world: (n, 3); precise to a hundred-millionth of the cloud's extent, whatever its offset. rgb: (n, 3) uint8.
    attributes: og_label, og_instance (n,) int32, og_score (n,) float32, og_reason (n,) uint8: unchanged in extra
        bytes; og_label + 64 also as the classification, 1 without a label or beyond 255; og_reason also as user data.
    names: those that og_label indexes; stored as JSON in a record.
    source: the file that the points come from, in its order. If it is LAS, positions, colors, intensity, returns,
        times, other extra bytes and the coordinate system are kept, and so are user data and the classes of points
        without a label (1 for those that an earlier run labelled).
    SceneError where a coordinate is not finite, the names are too long or the source has other points;
    MissingExtraError without laspy.
    """
    path = Path(path)
    with naming(path):
        survey = None if source is None or not _is_las(source) else _points_of(Path(source), xyz_world)
        las = _new(xyz_world, rgb, attributes["og_reason"]) if survey is None else survey
        _add_labels(las, attributes, names, keep_classes=survey is not None)
        with replacing(path) as file:
            try:
                las.write(file, do_compress=path.suffix == ".laz")
            except OSError:
                raise
            except Exception as error:  # such as lazrs's error for a full disk
                raise SceneError(f"it cannot be written ({error!s:.120}): check the free space") from error


def _is_las(path: StrPath) -> bool:
    with naming(Path(path)), open(path, "rb") as file:
        return looks_like_las(file.read(len(SIGNATURE)))


def _new(xyz_world: NDArray[np.floating], rgb: NDArray[np.uint8], reason: NDArray[np.uint8]) -> LasData:
    laspy = _laspy()
    require_finite(xyz_world, LABEL_FINITE)
    header = laspy.LasHeader(point_format=7, version="1.4")
    header.offsets, header.scales = _grid(xyz_world)
    las = laspy.LasData(header)
    las.xyz = np.asarray(xyz_world, np.float64)
    for channel, values in zip(("red", "green", "blue"), np.asarray(rgb, np.uint16).T, strict=True):
        las[channel] = values * SCALE_8_TO_16_BITS
    las.user_data = reason
    return las


def _points_of(source: Path, xyz_world: NDArray[np.floating]) -> LasData:
    """A file's points in a point format with 8-bit classes, without the labels of an earlier run. xyz_world: (n, 3),
    where they must be."""
    with _opened(source) as reader:
        stated, count = reader.header.point_count, len(xyz_world)
        las = reader.read() if stated == count else None  # it allocates memory for as many as are stated
        if las is None or len(las.points) != count:
            raise SceneError(f"it has {stated} points, {count} were labelled; expected the labelled file")
        apart = max(float(np.abs(las[axis] - at).max(initial=0)) for axis, at in zip("xyz", xyz_world.T, strict=True))
        rounding = np.spacing(np.float32(np.abs(xyz_world).max(initial=0)))  # other libraries' clouds are float32
        if not apart <= rounding + max(las.header.scales):
            raise SceneError(
                f"its points lie up to {apart:.4g} from those that were labelled; expected the labelled file, in its "
                "order and without a pose"
            )
    degrees = getattr(las, "scan_angle_rank", None)
    las = _laspy().convert(las, point_format_id=EIGHT_BIT_CLASSES.get(las.point_format.id, las.point_format.id))
    if degrees is not None:  # laspy drops it: its name and unit differ in the new format
        las.scan_angle = np.rint(np.asarray(degrees) / DEGREES_PER_STEP).astype(np.int16)
    own = [name for name in las.point_format.extra_dimension_names if name in OWN_DIMENSIONS]
    if "og_label" in own:  # an earlier run's classes would pass for new labels
        las.classification = np.where(np.asarray(las["og_label"]) >= 0, UNLABELLED, np.asarray(las["classification"]))
    las.remove_extra_dims(own)
    for records in (las.vlrs, las.evlrs or []):  # COPC's records locate its chunks, which now lie elsewhere
        records[:] = [record for record in records if record.user_id not in (RECORD_OWNER, "copc")]
    return las


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """A laspy reader of a file whose counts fit its size. SceneError, beginning with the path, if it cannot be read."""
    laspy = _laspy()
    with naming(path):
        try:
            _check_counts(path)
            # Of laspy's two backends, this one allocates no memory for points that a chunk declares but does not have.
            with laspy.open(path, laz_backend=laspy.LazBackend.Lazrs, read_evlrs=False) as reader:
                yield reader
        except (SceneError, OSError, KeyboardInterrupt, SystemExit):
            raise
        except BaseException as error:  # laspy has its own types; a panic of lazrs is not an Exception
            raise SceneError(f"cannot be read as LAS ({error!s:.120}): copy or write it again") from error


def _add_labels(las: LasData, attributes: Mapping[str, NDArray], names: Sequence[str], keep_classes: bool) -> None:
    laspy = _laspy()
    record = json.dumps(list(names)).encode()
    if len(record) > MAX_RECORD_BYTES:
        raise SceneError(f"{len(names)} names take {len(record)} bytes; LAS stores {MAX_RECORD_BYTES}: ask for fewer")
    las.vlrs.append(laspy.VLR(RECORD_OWNER, NAMES_RECORD, "og_names", record))
    # All at once: laspy copies the points for each call.
    las.add_extra_dims([laspy.ExtraBytesParams(name, values.dtype) for name, values in attributes.items()])
    for name, values in attributes.items():
        las[name] = values
    classes = _classes(attributes["og_label"])
    if keep_classes:
        classes = np.where(classes == UNLABELLED, np.asarray(las["classification"]), classes)
    las.classification = classes


def _laspy() -> Any:
    with naming_extra("laspy", "las"):
        import laspy
    return laspy


def _check_counts(path: Path) -> None:
    """SceneError where the records, points, chunks or layers that a file declares would not fit into it."""
    size = path.stat().st_size
    _require(size >= MIN_HEADER_BYTES, f"a file of {size} bytes has no whole header")
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        # Before laspy parses the header: it reads as many records as this states.
        header_size, first_point, records, _, point_size = struct.unpack_from("<HIIBH", data, 94)
        _require(header_size + RECORD_HEADER * records <= first_point <= size, f"{records} records before the points")
        header = _laspy().LasHeader.read_from(file)
        _check_last_records(data, header.start_of_first_evlr, header.number_of_evlrs)
        if header.are_points_compressed:
            _check_chunks(data, _layers(header.vlrs.get("LasZipVlr")), first_point, point_size)
        else:
            room = size - first_point
            _require(header.point_count * point_size <= room, f"{header.point_count} points of {point_size} bytes")


def _require(fits: bool, what: str) -> None:
    if not fits:
        raise SceneError(f"{what}: the file is damaged or truncated; copy or write it again")


def _layers(laszip_records: Sequence[Any]) -> int:
    """Number of layers of a point, 0 where the points are not layered. The LASzip record: the compressor (uint16), 30
    bytes of versions and sizes, the number of items (uint16), and the type, size and version of each item."""
    _require(bool(laszip_records), "compressed points without a LASzip record")
    content = laszip_records[0].record_data
    _require(len(content) >= 34, f"a LASzip record of {len(content)} bytes")
    compressor, items = struct.unpack_from("<H30xH", content)
    _require(len(content) >= 34 + 6 * items, f"{items} items in a LASzip record of {len(content)} bytes")
    kinds = [struct.unpack_from("<HH", content, 34 + 6 * item) for item in range(items)]
    layers = sum(size if kind == EXTRA_BYTES else LAYERS.get(kind, 0) for kind, size in kinds)
    return layers if compressor == LAYERED else 0


def _check_last_records(data: mmap.mmap, at: int, records: int) -> None:
    """Check that the records after the points, whose headers state their lengths, lie within the file."""
    for record in range(records):
        length = struct.unpack_from("<Q", data, at + 20)[0] if at + LAST_RECORD_HEADER <= len(data) else 0
        at += LAST_RECORD_HEADER + length
        _require(at <= len(data), f"record {record} of {records} behind the points")


def _check_chunks(data: mmap.mmap, layers: int, first_point: int, point_size: int) -> None:
    """SceneError where chunks reach beyond the file. First comes the offset of their table, then the chunks in
    sequence, then the table, which states their number.

    A layered chunk holds its first point, its number of points, the lengths of its layers, and the layers.
    """
    _require(first_point + 8 <= len(data), "a chunk table beyond the end")
    table, at, chunks = struct.unpack_from("<q", data, first_point)[0], first_point + 8, 0
    if table == -1:  # written to a stream: the offset is at the end of the file
        table = struct.unpack_from("<q", data, len(data) - 8)[0]
    _require(at <= table <= len(data) - 8, f"a chunk table at byte {table} of {len(data)}")
    while layers and at < table:
        sizes = at + point_size + 4
        _require(sizes + 4 * layers <= table, f"chunk {chunks} beyond the chunk table")
        at = sizes + 4 * layers + sum(struct.unpack_from(f"<{layers}I", data, sizes))
        _require(at <= table, f"layers of chunk {chunks} beyond the chunk table")
        chunks += 1
    # Chunks without layers do not state their length: there is at most one per byte.
    counted = struct.unpack_from("<I", data, table + 4)[0]
    _require(counted == chunks if layers else counted <= table - at, f"a table of {counted} chunks")


def _eight_bits(rgb: NDArray[np.uint16]) -> NDArray[np.uint8]:
    """Colors should span 16 bits, but many writers leave them at 8."""
    return (rgb if rgb.max(initial=0) <= 255 else np.rint(rgb / SCALE_8_TO_16_BITS)).astype(np.uint8)


def _grid(xyz_world: NDArray[np.floating]) -> tuple[DoubleArray, DoubleArray]:
    """Offset and step, a power of ten, of integer coordinates: at most 10^9 steps, which fit 32 bits."""
    if not len(xyz_world):
        return np.zeros(3), np.full(3, 1e-3)
    widest = float(np.ptp(xyz_world, axis=0).max())
    # A whole unit, or a decimal part of one for a small cloud: else most steps would lie between offset and cloud.
    unit = 10.0 ** min(0.0, np.floor(np.log10(widest))) if widest > 0 else 1.0
    offset = np.floor(xyz_world.min(axis=0) / unit) * unit
    extent = max(float((xyz_world - offset).max()), unit)
    return offset, np.full(3, 10.0 ** np.floor(np.log10(extent / STEPS_PER_EXTENT)))


def _classes(labels: NDArray[np.integer]) -> NDArray[np.uint8]:
    classes = labels.astype(np.int64) + FIRST_FREE_CLASS
    return np.where((labels >= 0) & (classes <= LAST_CLASS), classes, UNLABELLED).astype(np.uint8)
