"""Read clouds in text, one point a line: .xyz, .txt, .csv, .asc, .pts, told by their content.

Numbers are separated by spaces, tabs, commas or semicolons; lines that begin with # or // are comments. A line of
names, which may be a comment (CloudCompare's //X Y Z R G B), says where x, y and z are, and colors if they have one of
the names that they have in a PLY. Without names, the first three columns are x y z, and the next three are colors if
there are six, seven or nine columns and these hold whole numbers from 0 to 255, or numbers from 0 to 1. A file that
begins with the number of its points, as Leica's .pts do, has an intensity before the colors.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.errors import SceneError
from og_pointcloud.formats.ply import join_columns
from og_pointcloud.formats.tables import COLOR_COLUMNS

AXES = ("x", "y", "z")
COMMENTS = ("#", "//")
WITH_COLORS = (6, 7, 9)
"""Numbers of columns without names that may have colors; in nine, normals follow."""


@dataclass(frozen=True)
class _Layout:
    """row: the first, as text. names: of its columns; empty if not known. count: of rows, if stated."""

    row: str
    delimiter: str | None
    names: list[str]
    count: int | None

    @property
    def axes(self) -> list[int]:
        """The columns of x, y and z."""
        return [self.names.index(axis) for axis in AXES] if self.names else [0, 1, 2]

    @property
    def colors(self) -> list[int]:
        """The columns that hold red, green and blue, or may hold them; none if the file cannot have colors."""
        if self.names:
            named = next((triple for triple in COLOR_COLUMNS if set(triple) <= set(self.names)), ())
            return [self.names.index(name) for name in named]
        columns = len(self.row.split(self.delimiter))
        first = 4 if columns == 7 and self.count is not None else 3
        return [first, first + 1, first + 2] if columns in WITH_COLORS else []


def looks_like_text_cloud(head: bytes) -> bool:
    """Whether a file with these first bytes is text with three numbers in its first row."""
    return _layout(head.decode("utf-8-sig", "replace").splitlines()) is not None


def read_text_cloud(path: Path) -> NDArray[np.void]:
    """(n,) rows of float64 x y z and, where the file has colors, red green blue.

    SceneError where a row lacks columns, a value is no number, or there are fewer rows than the file states.
    """
    with path.open(encoding="utf-8-sig", errors="replace") as file:  # editors on Windows write a byte order mark
        layout = _layout(file)
        if layout is None:
            raise SceneError("no row of three numbers; expected x y z in each line")
        columns = layout.axes + layout.colors
        try:
            values = np.loadtxt(chain([layout.row], file), delimiter=layout.delimiter, usecols=columns, ndmin=2)
        except ValueError as error:
            raise SceneError(
                f"{error!s:.120} (rows count from the first point); expected {max(columns) + 1} or more columns, with "
                "numbers such as 1.5 for coordinates and colors: repair that row"
            ) from None
    if layout.count is not None and len(values) < layout.count:
        raise SceneError(f"its first line says {layout.count} points, {len(values)} follow: it is truncated")
    has_colors = bool(layout.colors) and (bool(layout.names) or _are_colors(values[:, 3:]))
    names = AXES + COLOR_COLUMNS[0] if has_colors else AXES
    return join_columns({name: values[:, column] for column, name in enumerate(names)})


def _are_colors(values: NDArray[np.float64]) -> bool:
    """Whether unnamed columns can be colors: normals have numbers below 0, intensities above 255."""
    low, high = values.min(), values.max()
    return bool(low >= 0 and (high <= 1 or (high <= 255 and (values % 1 == 0).all())))


def _layout(lines: Iterable[str]) -> _Layout | None:
    """What the lines up to the first row say, which are taken; None if that is no row of a cloud."""
    header, count = "", None
    for line in lines:
        text, is_comment = line.strip(), line.lstrip().startswith(COMMENTS)
        if set(AXES) <= set(re.split(r"[\s,;\"']+", text.lower().lstrip("#/ "))):
            header = text
        elif text.isascii() and text.isdecimal() and count is None:
            count = int(text[:15])
        elif text and not is_comment:
            break
    else:
        return None
    delimiter = next((mark for mark in ",;" if mark in text), None)
    names = [name.strip(" \"'") for name in re.split(delimiter or r"[\s,;]+", header.lower().lstrip("#/ "))]
    words = text.split(delimiter)
    # A comment that names x, y and z elsewhere, for another number of columns, may be a remark or what it seems.
    is_doubtful = header.startswith(COMMENTS) and len(names) != len(words) and tuple(names[:3]) != AXES
    layout = _Layout(text, delimiter, [] if is_doubtful or not set(AXES) <= set(names) else names, count)
    try:
        [float(words[column]) for column in layout.axes]
    except (ValueError, IndexError):
        return None
    if is_doubtful:
        raise SceneError(
            f"the comment {header!r:.60} names {len(names)} columns, the first row has {len(words)}; expected one name "
            "a column: correct or remove it"
        )
    return layout
