"""What the geometry formats share: rows of text, columns of positions and colors, paths in errors."""

from __future__ import annotations

import csv
import io
import os
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import chain, islice
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.errors import SceneError
from og_pointcloud.scene import middle_extent

SCALE_8_TO_16_BITS = 257
"""Scales an 8-bit color to the range of 16 bits."""
MAX_FRACTION = 2.0
"""Float colors up to this are in 0..1, some a little above by rounding or sharpening; on 0..255 all would be black."""
COLOR_COLUMNS = (("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue"))
LABEL_FINITE = "save as .ply or .npz, which can store them, or label only points[np.isfinite(points).all(axis=1)]"
"""The cure if a cloud with NaN or infinity is to be saved in a format that cannot hold them."""
PACKED_COLOR_COLUMNS = ("rgb", "rgba")


def csv_text(rows: Sequence[Mapping[str, object]]) -> str:
    """Rows as CSV with the union of their names as columns; text that a spreadsheet would take for a formula is
    prefixed with a quote mark."""
    text = io.StringIO()
    writer = csv.DictWriter(text, dict.fromkeys(name for row in rows for name in row), lineterminator="\n")
    writer.writeheader()
    writer.writerows({name: _as_cell(value) for name, value in row.items()} for row in rows)
    return text.getvalue()


def _as_cell(value: object) -> object:
    return f"'{value}" if isinstance(value, str) and value[:1] in ("=", "+", "-", "@", "\t", "\r") else value


@contextmanager
def naming(place: str | Path) -> Iterator[None]:
    """Prefix errors raised inside with a file's path, or a place in it, once; disk errors become SceneError."""
    try:
        yield
    except SceneError as error:
        if str(error).startswith(f"{place}: "):
            raise
        raise SceneError(f"{place}: {error}") from error
    except OSError as error:
        cure = "check the path, its permissions, and the free space"
        raise SceneError(f"{place}: {error.strerror or error}: {cure}") from error


def read_text_rows(lines: Iterable[bytes], dtype: np.dtype, count: int, what: str) -> NDArray[np.void]:
    """The next ``count`` rows of an ascii file, one per line, blank lines skipped, as (count,) records of ``dtype``.

    Reads no line beyond the last row. SceneError where a value does not fit its type, or rows are missing.
    """
    rows_text = islice((line for line in lines if not line.isspace()), count)
    rows, first = np.empty(0, dtype), next(rows_text, None)  # numpy warns of empty input
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", DeprecationWarning)  # numpy before 2.3 would store 300 in a byte as 44
            if first is not None:
                rows = np.loadtxt(chain([first], rows_text), dtype, comments=None, ndmin=1)
    except DeprecationWarning as error:
        raise SceneError(f"{what}: a value is not a whole number of the type that the header states") from error
    except ValueError as error:
        raise SceneError(
            f"{what}: {error} (expected {len(dtype.names or ())} values per row, as the header states)"
        ) from error
    if len(rows) < count:
        raise SceneError(
            f"{what}: expected {count} rows, the file has {len(rows)}: it is truncated; copy or write it again"
        )
    return rows


def read_binary_rows(file: BinaryIO, dtype: np.dtype, count: int, what: str) -> NDArray:
    """The next ``count`` values of ``dtype`` of a binary file; SceneError, before allocation, if it has fewer."""
    left = os.fstat(file.fileno()).st_size - file.tell()
    if count * dtype.itemsize > left:
        raise SceneError(
            f"{what}: expected {count} rows of {dtype.itemsize} bytes ({count * dtype.itemsize} bytes), the file has "
            f"{left // dtype.itemsize} rows ({left} bytes): it is truncated; copy or write it again"
        )
    return np.fromfile(file, dtype, count)


def stack_columns(rows: NDArray[np.void], names: Sequence[str]) -> NDArray[np.float64]:
    """Columns side by side: (n, len(names)) float64. SceneError names the missing columns."""
    scalar = [name for name in rows.dtype.names or () if rows.dtype[name].shape == ()]
    missing = [name for name in names if name not in scalar]
    if missing:
        raise SceneError(
            f"no column {', '.join(missing)}; expected {', '.join(names)}, the file has {', '.join(scalar):.60}"
        )
    stacked = np.empty((len(rows), len(names)))
    with np.errstate(invalid="ignore"):  # widening a signalling NaN warns; NaN is left to the caller
        for column, name in enumerate(names):
            stacked[:, column] = rows[name]
    return stacked


def positions(rows: NDArray[np.void]) -> NDArray[np.float64]:
    """(n, 3) float64 of columns x, y, z."""
    return stack_columns(rows, ("x", "y", "z"))


def colors(rows: NDArray[np.void]) -> NDArray[np.uint8] | None:
    """(n, 3) uint8 RGB, or None without color columns.

    Takes uint8; uint16 (full range, or 0..255); other numbers in 0..1 or 0..255; and PCL's packed ``rgb``/``rgba``,
    0xAARRGGBB in four bytes, also if the file declares these bytes a float.
    """
    packed = _first_present(rows, tuple((name,) for name in PACKED_COLOR_COLUMNS))
    if packed and rows.dtype[packed[0]].itemsize == 4:
        # Reinterpret the bytes: as numbers, float colors would be tiny or NaN.
        bits = rows[packed[0]].view(np.uint32)
        return np.stack([(bits >> shift & 255).astype(np.uint8) for shift in (16, 8, 0)], axis=1)
    names = _first_present(rows, COLOR_COLUMNS)
    if not names:
        return None
    types = {rows.dtype[name] for name in names}
    if types == {np.dtype(np.uint8)}:
        return np.stack([rows[name] for name in names], axis=1)
    values = stack_columns(rows, names)
    low, high = values.min(initial=0.0), values.max(initial=0.0)
    if types == {np.dtype(np.uint16)}:
        values /= 1 if high <= 255 else SCALE_8_TO_16_BITS
    elif not (low >= 0 and high <= 255):
        raise SceneError(
            f"colors {', '.join(names)} span {low:.6g}..{high:.6g}; expected 0..1 or 0..255: rescale or drop them"
        )
    elif high <= MAX_FRACTION and rows.dtype[names[0]].kind == "f":
        values = 255 * np.minimum(values, 1)
    return np.rint(values).astype(np.uint8)


def storable_positions(xyz_world: NDArray[np.floating]) -> NDArray:
    """Positions as float32, or as float64 where float32 would move a point by more than 1e-6 of the cloud's extent
    without strays (`middle_extent`)."""
    world = np.asarray(xyz_world, np.float64)
    with np.errstate(over="ignore"):
        single = world.astype(np.float32)
    if len(world) == 0:
        return single
    with np.errstate(invalid="ignore", over="ignore"):
        # Not a number, as a depth camera marks what it did not measure, is the same in both.
        placed = np.isfinite(world).all(axis=1)
        loss = np.abs(single[placed].astype(np.float64) - world[placed]).max(initial=0)
        extent = middle_extent(world[placed]) if placed.any() else 0.0
    return single if loss <= 1e-6 * extent else world


def _first_present(rows: NDArray[np.void], choices: Sequence[tuple[str, ...]]) -> tuple[str, ...]:
    """The first of ``choices`` whose columns are all present, else ()."""
    present = set(rows.dtype.names or ())
    return next((names for names in choices if present.issuperset(names)), ())
