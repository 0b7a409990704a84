"""LAS and LAZ in and out, through laspy (extra 'las').

Out: LAS 1.4, point format 7, with labels where each kind of reader looks for them: ``classification`` for viewers, and
extra bytes og_label, og_instance, og_score, og_reason for programs. Names are JSON in a record of user og_pointcloud.

Format: ASPRS, "LAS Specification 1.4 R15".
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.errors import MissingExtraError, SceneError
from og_pointcloud.formats.atomic import replacing
from og_pointcloud.formats.las_counts import check_las_counts
from og_pointcloud.formats.tables import naming, require_finite
from og_pointcloud.scene import Points

if TYPE_CHECKING:
    from laspy import LasData

__all__ = ["labelled_las", "looks_like_las", "read_las", "read_las_positions", "write_las"]

SIGNATURE = b"LASF"
POINTS_PER_CHUNK = 1_000_000
"""Read at once: a header that promises more points than the file holds never makes room for them."""
UNLABELLED = 1
"""Class "processed, but unclassified"; also of labels beyond the last class that is free."""
FIRST_FREE_CLASS, LAST_CLASS = 64, 255
"""Classes that the format leaves to its users: label k is class 64 + k."""
STEPS_PER_EXTENT = 1e8
"""Coordinates are stored as 32-bit counts of a step: ten nanometres in a room, 10 micrometres in a city block."""
FULL_RANGE = 257
"""An 8-bit colour times this spans the format's 16 bits."""
RECORD_OWNER, NAMES_RECORD = "og_pointcloud", 1
SHORT_RECORD = 65_535
"""Bytes that a record before the points holds; a longer one goes behind them."""


def looks_like_las(path: str | os.PathLike[str]) -> bool:
    """Whether a file begins as LAS and LAZ do; False where it cannot be read."""
    try:
        with Path(path).open("rb") as file:
            return file.read(len(SIGNATURE)) == SIGNATURE
    except OSError:
        return False


def read_las_positions(path: str | os.PathLike[str]) -> NDArray[np.float64]:
    """(n, 3) float64 world coordinates, as the file's counts, step and offset give them.

    SceneError, beginning with the path, for a file that is damaged or has no points; MissingExtraError without laspy.
    """
    return _read(Path(path))[0]


def read_las(path: str | os.PathLike[str]) -> Points:
    """Positions, and colours where the point format has some, as `Points`. Errors as for `read_las_positions`."""
    xyz, rgb = _read(Path(path))
    return Points.from_world(xyz, rgb=rgb)


def labelled_las(
    xyz_world: NDArray[np.floating], rgb: NDArray[np.uint8], attributes: Mapping[str, NDArray], names: Sequence[str]
) -> LasData:
    """A laspy LasData of a labelled cloud. Arguments and errors as for `write_las`."""
    laspy = _laspy()
    require_finite(xyz_world, "LAS stores integers")
    header = laspy.LasHeader(point_format=7, version="1.4")
    header.offsets, header.scales = _grid(xyz_world)
    header.add_extra_dims([laspy.ExtraBytesParams(name, values.dtype) for name, values in attributes.items()])
    las = laspy.LasData(header)
    las.xyz = np.asarray(xyz_world, np.float64)
    for channel, values in zip(("red", "green", "blue"), np.asarray(rgb, np.uint16).T, strict=True):
        las[channel] = values * FULL_RANGE
    for name, values in attributes.items():
        las[name] = values
    las.classification = _classes(attributes["og_label"])
    las.user_data = attributes["og_reason"]
    record = json.dumps(list(names)).encode()
    names_record = laspy.VLR(RECORD_OWNER, NAMES_RECORD, "og_names", record)
    if len(record) <= SHORT_RECORD:
        las.header.vlrs.append(names_record)
    else:
        las.evlrs = laspy.vlrs.vlrlist.VLRList([names_record])
    return las


def write_las(
    path: str | os.PathLike[str],
    xyz_world: NDArray[np.floating],
    rgb: NDArray[np.uint8],
    attributes: Mapping[str, NDArray],
    names: Sequence[str],
) -> None:
    """Write a labelled cloud, compressed where the path ends in .laz; whole or not at all.

    xyz_world: (n, 3); kept to a hundred-millionth of the cloud's extent, whatever its offset. rgb: (n, 3) uint8.
    attributes: og_label, og_instance (n,) int32, og_score (n,) float32, og_reason (n,) uint8: as they are in extra
        bytes; og_label + 64 also as the classification, 1 without a label or beyond 255; og_reason also as user data.
    names: what og_label counts; JSON, in a record.
    SceneError where a coordinate is not finite; MissingExtraError without laspy.
    """
    path = Path(path)
    with naming(path):
        las = labelled_las(xyz_world, rgb, attributes, names)
        with replacing(path) as file:
            writer = _laspy().LasWriter(file, las.header, do_compress=path.suffix == ".laz", closefd=False)
            writer.write_points(las.points)
            if las.evlrs:
                writer.write_evlrs(las.evlrs)
            writer.close()


def _laspy() -> Any:
    try:
        import laspy
    except ImportError:
        raise MissingExtraError("laspy", "las") from None
    return laspy


def _read(path: Path) -> tuple[NDArray[np.float64], NDArray[np.uint8] | None]:
    laspy = _laspy()
    xyz: list[NDArray[np.float64]] = []
    rgb: list[NDArray[np.uint16]] = []
    with naming(path):
        check_las_counts(path)
        try:
            # Of the two backends this one makes no room for points that a chunk only claims to have.
            with laspy.open(path, laz_backend=laspy.LazBackend.Lazrs) as reader:
                promised = reader.header.point_count
                has_colors = "red" in reader.header.point_format.dimension_names
                for chunk in reader.chunk_iterator(POINTS_PER_CHUNK):
                    xyz.append(np.column_stack([chunk.x, chunk.y, chunk.z]))
                    if has_colors:
                        rgb.append(np.column_stack([chunk.red, chunk.green, chunk.blue]))
        except (OSError, KeyboardInterrupt, SystemExit):
            raise
        except BaseException as error:  # laspy raises types of its own; a panic of lazrs is no Exception
            raise SceneError(f"cannot be read as LAS ({error!s:.120}): copy or write it again") from error
        count = sum(map(len, xyz))
        if count != promised or not count:
            raise SceneError(
                f"expected {promised} points, the file has {count}: it is empty or truncated; copy or write it again"
            )
    return np.concatenate(xyz), _eight_bits(np.concatenate(rgb)) if rgb else None


def _eight_bits(rgb: NDArray[np.uint16]) -> NDArray[np.uint8]:
    """Colours span 16 bits, but many writers leave them at 8."""
    return (rgb if rgb.max(initial=0) <= 255 else np.rint(rgb / FULL_RANGE)).astype(np.uint8)


def _grid(xyz_world: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Offset and step, a power of ten, of the counts that stand for coordinates; no count leaves 32 bits."""
    if not len(xyz_world):
        return np.zeros(3), np.full(3, 1e-3)
    offset = np.floor(xyz_world.min(axis=0))
    extent = max(float((xyz_world - offset).max()), 1.0)
    return offset, np.full(3, 10.0 ** np.floor(np.log10(extent / STEPS_PER_EXTENT)))


def _classes(labels: NDArray[np.integer]) -> NDArray[np.uint8]:
    classes = labels.astype(np.int64) + FIRST_FREE_CLASS
    return np.where((labels >= 0) & (classes <= LAST_CLASS), classes, UNLABELLED).astype(np.uint8)
