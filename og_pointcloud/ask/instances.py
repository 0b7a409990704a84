"""The instances of a scene as a table: position, size, evidence and best words of each.

Centroids and boxes are those of an instance's main part, without strays (`boxes.main_part`). Each row computes them on
first access, so a table costs nothing until then.
"""

from __future__ import annotations

import json
import operator
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from numbers import Integral
from typing import Any, SupportsIndex, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from og_pointcloud.ask.boxes import Box, axis_aligned_box, main_part, oriented_box, unit_up
from og_pointcloud.ask.choosing import Chooser
from og_pointcloud.cloud import LabelledCloud, Vocabulary
from og_pointcloud.errors import OgPointcloudError, coordinate, counted, printable
from og_pointcloud.formats.atomic import StrPath, write_file
from og_pointcloud.formats.tables import csv_text

LABELLED = "labelled"
"""State of an instance that can be compared with words."""
NO_FEATURE = "no feature"
"""State of an instance that no mask gave a feature: every word is answered with unknown."""
EMPTY = "empty"
"""State of an instance without points."""

WORDS_PER_ROW = 3
"""Best words listed in a row."""
MAX_ROWS_SHOWN = 12
"""Rows of a printed table; the rest are only counted."""


@dataclass(frozen=True, eq=False)
class Instance:
    """What is known about one instance. Coordinates and lengths in the scene's world frame and unit, float64.

    id: row in the scene's table. point_indices: (n,) int64, its points in the scene, ascending.
    views, masks: number of views that saw it, and of masks joined in it. agreement: mean cosine of its masks' features
    with their descriptor, -1 to 1. reliability: how well half of the views reproduce its points and its masks its name,
    0 to 1, None if not known. visible_area: pixels that its masks put on it, over all views. part_of: the instance that
    it is a part of, -1 none. coarse: the codebook's coarse cluster that it lies in, -1 none.
    state: "labelled", "no feature" or "empty". words: (word, score), best first; a score is the probability that the
    instance is what the word says if the scene has a word bank, else a cosine.

    >>> chair = og.instance_table(cloud)[0]  # of `LabelledCloud`'s example
    >>> chair.point_indices, chair.state, chair.words[0]
    (array([0, 1]), 'labelled', ('chair', 1.0))
    >>> chair.axis_aligned_box.size.round(2)
    array([0.1, 0. , 0. ])
    """

    id: int
    point_indices: NDArray[np.int64] = field(repr=False)
    views: int
    masks: int
    agreement: float
    reliability: float | None
    visible_area: float
    part_of: int
    coarse: int
    state: str
    words: tuple[tuple[str, float], ...]
    _cloud: LabelledCloud = field(repr=False)
    _up: ArrayLike | None = field(repr=False)

    @property
    def points(self) -> int:
        """Number of its points."""
        return len(self.point_indices)

    @property
    def xyz(self) -> NDArray[np.float64]:
        """(n, 3) float64, its points in world coordinates, including strays."""
        return self._cloud.xyz[self.point_indices].astype(np.float64) + self._cloud.origin

    @cached_property
    def main_part(self) -> NDArray[np.bool_]:
        """(n,) bool, which of its points are not strays."""
        return main_part(self.xyz, self._cloud.spacing) if self.points else np.zeros(0, bool)

    @cached_property
    def centroid(self) -> NDArray[np.float64] | None:
        """(3,) mean of its main part; None without points."""
        if not self.points:
            return None
        # Relative to one of the points: sums of map coordinates of 1e6 would lose digits.
        main = self.xyz[self.main_part]
        return main[0] + (main - main[0]).mean(axis=0)

    @cached_property
    def axis_aligned_box(self) -> Box | None:
        """The box of its main part along the world's axes; None without points."""
        return axis_aligned_box(self.xyz[self.main_part]) if self.points else None

    @cached_property
    def oriented_box(self) -> Box | None:
        """A box of nearly minimal volume around its main part (`boxes.oriented_box`); None without points."""
        return oriented_box(self.xyz[self.main_part], self._up) if self.points else None

    def to_dict(self) -> dict[str, Any]:
        """JSON-able: everything but the points; instead of them their number, and the number of strays."""
        columns = (
            "id", "state", "points", "views", "masks", "agreement", "reliability", "visible_area", "part_of", "coarse",
        )  # fmt: skip
        aligned, oriented = self.axis_aligned_box, self.oriented_box
        return {name: getattr(self, name) for name in columns} | {
            "strays": int((~self.main_part).sum()),
            "centroid": None if self.centroid is None else self.centroid.tolist(),
            "axis_aligned_box": aligned and {"low": aligned.low.tolist(), "high": aligned.high.tolist()},
            "oriented_box": oriented and oriented.to_dict(),
            "words": [{"name": name, "score": score} for name, score in self.words],
        }


class Instances(Sequence[Instance]):
    """Row k is instance id k. ``scene.instances`` is one; `instance_table` makes others, with other words.

    Unlike a list's, its indices do not count from the end: -1 is background, not the last instance.

    >>> table = og.instance_table(cloud)  # of `LabelledCloud`'s example
    >>> [row.id for row in table.largest(1)], len(table.to_records())
    ([0], 2)
    >>> table.to_csv().splitlines()[1][:13]
    '0,labelled,2,'
    """

    def __init__(self, rows: Sequence[Instance]) -> None:
        self._rows = tuple(rows)

    def __len__(self) -> int:
        return len(self._rows)

    @overload
    def __getitem__(self, index: SupportsIndex) -> Instance: ...
    @overload
    def __getitem__(self, index: slice) -> Instances: ...
    def __getitem__(self, index: SupportsIndex | slice) -> Instance | Instances:
        """The instance with this id, or a table of a slice. IndexError for an id without an instance."""
        if isinstance(index, slice):
            return Instances(self._rows[index])
        row = operator.index(index)
        if not 0 <= row < len(self):
            raise IndexError(
                f"{index} is not one of {len(self)} instance ids; expected 0 to {len(self) - 1}: -1 is background, "
                "-2 unobserved, -3 too far from the scene"
            )
        return self._rows[row]

    def largest(self, count: int | None = None) -> Instances:
        """Sorted by falling number of points, ties by id; only the first ``count``, 0 or more."""
        if count is not None and count < 0:
            raise OgPointcloudError(f"count is {count}; expected 0 or more, or None for all")
        return Instances(sorted(self._rows, key=lambda row: (-row.points, row.id))[:count])

    def to_records(self) -> list[dict[str, Any]]:
        """A JSON-able dictionary per row (`Instance.to_dict`)."""
        return [row.to_dict() for row in self]

    def to_json(self, path: StrPath | None = None) -> str:
        """The records as JSON text; also written to path, atomically, if one is given."""
        text = json.dumps(self.to_records(), indent=2, ensure_ascii=False) + "\n"
        _write(path, text)
        return text

    def to_csv(self, path: StrPath | None = None) -> str:
        """The records as CSV text, one column per number; also written to path, atomically, if one is given."""
        text = csv_text([_flat(record) for record in self.to_records()])
        _write(path, text)
        return text

    def __repr__(self) -> str:
        header = (
            "id", "points", "views", "agreement", "reliability", "state", "centroid", "size along x, y, z",
            "best words",
        )  # fmt: skip
        shown = self.largest(MAX_ROWS_SHOWN)
        rows = [header, *(_cells(row) for row in shown)]
        widths = [max(len(row[column]) for row in rows) for column in range(len(header))]
        lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]
        if len(self) > len(shown):
            lines.append(f"and {len(self) - len(shown)} smaller ones")
        return "\n".join([counted(len(self), "instance"), *lines])


def list_instances(
    cloud: LabelledCloud,
    chooser: Chooser,
    labels: Vocabulary | None = None,
    *,
    up: ArrayLike | None = None,
    words: int = WORDS_PER_ROW,
) -> Instances:
    """The instances of a cloud as a table (`instance_table` also takes a scene or a path).

    chooser: of the same cloud. labels: the words to choose among, None for none. up: (3,) upward direction of the
    oriented boxes, if known. words: number of words per row.
    """
    if not isinstance(words, Integral) or isinstance(words, bool) or words < 0:
        raise OgPointcloudError(f"words is {words!r}; expected a number of words per row, from 0")
    if up is not None:
        unit_up(up)  # raises now, not at the first box
    # Points sorted by id, in their own order within an id: each instance's points are one slice. Negative ids come
    # first.
    table, order = cloud.instances, np.argsort(cloud.instance_ids, kind="stable")
    bounds = np.searchsorted(cloud.instance_ids[order], np.arange(len(table) + 1))
    described = np.zeros(len(table), bool)
    described[table.descriptor_instance] = True
    states = np.where(np.diff(bounds) == 0, EMPTY, np.where(described, LABELLED, NO_FEATURE)).tolist()
    choice = None if labels is None else chooser.choose(labels.vectors)
    return Instances(
        [
            Instance(
                id=k,
                point_indices=order[bounds[k] : bounds[k + 1]],
                views=int(table.views[k]),
                masks=int(table.masks[k]),
                agreement=float(table.agreement[k]),
                reliability=float(table.reliability[k]) if np.isfinite(table.reliability[k]) else None,
                visible_area=float(table.visible_area[k]),
                part_of=int(table.part_of[k]),
                coarse=int(table.coarse[k]),
                state=states[k],
                words=tuple(choice.words(k, labels.names, words)) if choice and labels else (),
                _cloud=cloud,
                _up=up,
            )
            for k in range(len(table))
        ]
    )


def _cells(row: Instance) -> tuple[str, ...]:
    box = row.axis_aligned_box
    return (
        str(row.id),
        f"{row.points:,}",
        str(row.views),
        f"{row.agreement:.2f}",
        "-" if row.reliability is None else f"{row.reliability:.2f}",
        row.state,
        "-" if row.centroid is None else " ".join(map(coordinate, row.centroid)),
        "-" if box is None else " x ".join(f"{value:.3g}" for value in box.size),
        ", ".join(f"{printable(name, 40)} {score:.2f}" for name, score in row.words) or "-",
    )


def _flat(value: Any, name: str = "") -> dict[str, Any]:
    """A record without nesting: one column per number, e.g. centroid_0; unknown values are left out."""
    if isinstance(value, dict):
        parts = value.items()
    elif isinstance(value, list):
        parts = enumerate(value)
    else:
        return {} if value is None else {name: value}
    flat: dict[str, Any] = {}
    for key, part in parts:
        flat |= _flat(part, f"{name}_{key}".strip("_"))
    return flat


def _write(path: StrPath | None, text: str) -> None:
    if path is not None:
        write_file(path, text.encode())
