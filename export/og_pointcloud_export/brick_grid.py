"""The table that answers point queries: a grid of cells, each with its answer, or with the points that settle it.

A cell is certain when every place in it has the same answer: the nearest cloud point's instance, or "too far". An open
cell, cut by the border of two instances or by the reach, has a list of candidates: every cloud point that is nearest
somewhere in it. Cells of a brick share lists where few candidates do for several. If cloud points lie in an open cell
it is split into 4^3 parts as well, as queries come where the cloud is, and only its open parts need the list.

Cells lie in bricks of 4^3 and bricks in blocks of 4^3, both stored only where some point is within reach: so a street
with little in it costs little. A brick that holds no point itself, and few candidates for all of it, is its list alone,
as about lone points of a sparse scene. So answers are exact, and few queries compare distances at all. What the budget
leaves without a list is marked, and holds the answer at its centre: ``bundle.nearest`` settles queries there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.bundle.nearest import surface_distance
from og_pointcloud.cloud import UNOBSERVED, LabelledCloud
from og_pointcloud_export.brick_cells import (
    BLOCK,
    BRICK,
    LIST_ALONE,
    NO_LIST,
    PARTS,
    TOO_FAR_CODE,
    answer_bricks,
    mark_bricks,
)

__all__ = [
    "CELLS", "CODE_OFFSET", "LONGEST_LIST", "PLACES", "SHORT_LIST", "BrickGrid", "GridSettings", "build_brick_grid",
]  # fmt: skip

CODE_OFFSET = 1 - UNOBSERVED
"""Answer code of instance id + CODE_OFFSET on the surface; (instances + CODE_OFFSET - 1) more near it."""
SHORT_LIST = 8
"""So many candidates are compared at once: cells share a list up to this length, as it costs no time."""
LONGEST_LIST = 64
"""Candidates of a cell; of a cell with more, each open part has a list; if even that has more, as where points
coincide, there is none."""
LISTS_PER_BRICK = 192
"""One for each cell, and for the parts of a cell or two with very many points."""

CELLS_PER_REACH = 3.0
"""A far reach makes cells larger, so that the layer of cells around a surface stays at most about eight deep."""
BLOCKS_PER_POINT, BLOCKS_AT_LEAST, BLOCKS_AT_MOST = 16, 1 << 15, 1 << 18  # times 64^2, and as much again, fits int32
BRICKS_PER_POINT, BRICKS_AT_LEAST = 16, 1 << 13
ROWS_PER_POINT, ROWS_AT_LEAST = 1 / 2, 1 << 13
SPLIT_CELLS_PER_POINT, SPLIT_CELLS_AT_LEAST = 1 / 8, 1 << 10
LISTS_PER_POINT, LISTS_AT_LEAST = 4, 1 << 16
"""What bounds the table whatever the extent of the scene: the rest is left to the exact search."""
BRICKS_PER_AXIS = 1 << 13
"""So long a grid still has its cell indices right to half a cell in float32, and a short table of them per axis."""
BRICKS_PER_CHUNK = 256
"""Answered at once, with about 16 MB of scratch."""

CELLS, PLACES = BRICK**3, BLOCK**3
# Rows of cells that bricks share, and rows of bricks that blocks share: all too far, and all open.
_FAR, _OPEN = 0, 1


@dataclass(frozen=True)
class GridSettings:
    """What trades the size of the file against time; answers are exact with any of these, if ``lists`` are kept.

    cell_per_spacing: size of a cell in point spacings; smaller cells need lists less often, and cost size with the
        second to third power. split, lists: whether open cells are split into parts, and have lists.
    """

    cell_per_spacing: float = 1.5
    split: bool = True
    lists: bool = True


@dataclass(frozen=True)
class BrickGrid:
    """Cell (i, j, k) covers low + (i, j, k) * cell_size and one cell_size more, in the local frame.

    low: (3,) float32. cell_size: float32. shape: bricks along each axis; the outermost ones stand for all
        beyond.
    blocks: (bx, by, bz) unsigned, rows of ``bricks``.
    bricks: (rows, 64) unsigned, C order within the block: a row of ``cells``, or, less the number of those rows, the
        list that settles the whole brick.
    cells: (rows, 64) unsigned, C order within the brick. A value below ``codes`` is a certain answer; one below
        ``2 codes`` is open, and ``value - codes`` the answer at the centre; of any other, ``value - 2 codes`` plus the
        row's ``first_list`` is its list.
    first_list: (rows,) int32. list_start: (lists + 1,) int32, where each list begins in ``candidates``.
    candidates: (m,) int32, points of the cloud, ascending within a list.
    list_parts: (lists,) unsigned, row of ``parts`` of the list's cell; row 0, all open, for a cell that is not split.
    parts: (rows, 64) unsigned, C order within the cell: certain answers, or ``codes`` + how many lists after the cell's
        is the one that settles the part.
    codes: number of answer codes: TOO_FAR_CODE, those on the surface, those near it; see CODE_OFFSET.
    """

    low: NDArray[np.float32]
    cell_size: np.float32
    shape: tuple[int, int, int]
    blocks: NDArray[np.unsignedinteger]
    bricks: NDArray[np.unsignedinteger]
    cells: NDArray[np.unsignedinteger]
    first_list: NDArray[np.int32]
    list_start: NDArray[np.int32]
    candidates: NDArray[np.int32]
    list_parts: NDArray[np.unsignedinteger]
    parts: NDArray[np.unsignedinteger]
    codes: int

    @property
    def nbytes(self) -> int:
        """Bytes of the table."""
        places = (self.blocks, self.bricks, self.cells, self.first_list)
        lists = (self.list_start, self.candidates, self.list_parts, self.parts)
        return sum(table.nbytes for table in (*places, *lists))


def build_brick_grid(cloud: LabelledCloud, settings: GridSettings | None = None) -> BrickGrid:
    """The grid of a cloud. Its size is bounded by the number of points, not by the extent of the scene."""
    settings = settings or GridSettings()
    cell_size = np.float32(max(settings.cell_per_spacing * cloud.spacing, cloud.reach / CELLS_PER_REACH))
    low, shape, whole = _grid_box(cloud, float(cell_size))
    bricks = _Bricks(cloud, low, float(cell_size), shape)
    table = _Table(cloud, bricks, settings)
    for first in range(0, len(bricks.kept), BRICKS_PER_CHUNK):
        table.answer(bricks.kept[first : first + BRICKS_PER_CHUNK])
    return table.grid(whole)


def _compact(values: NDArray[np.integer]) -> NDArray[np.unsignedinteger]:
    return values.astype(np.min_scalar_type(int(values.max(initial=0))))


def _grid_box(cloud: LabelledCloud, cell_size: float) -> tuple[NDArray[np.float32], tuple[int, int, int], bool]:
    """Low corner, bricks per axis (both with the outermost layer), and whether every point within reach lies inside.

    A scene with far outliers gets a grid around its bulk only.
    """
    if len(cloud) == 0:
        return np.zeros(3, np.float32), (3, 3, 3), True
    allowed = min(max(BLOCKS_PER_POINT * len(cloud), BLOCKS_AT_LEAST), BLOCKS_AT_MOST)
    border = cloud.reach + cell_size  # the cell more takes up all rounding
    for left_out in (0.0, 1e-4, 1e-3, 1e-2, 0.05, 0.2, 0.4):
        ends = np.quantile(cloud.xyz, [left_out, 1 - left_out], axis=0, method="nearest").astype(np.float64)
        shape = np.ceil((ends[1] - ends[0] + 2 * border) / (cell_size * BRICK)) + 2
        if np.ceil(shape / BLOCK).prod() <= allowed and shape.max() <= BRICKS_PER_AXIS:
            break
    else:
        shape = np.full(3, 3.0)
    low = (ends[0] - border - cell_size * BRICK).astype(np.float32)
    return low, (int(shape[0]), int(shape[1]), int(shape[2])), bool(left_out == 0)


class _Bricks:
    """The bricks within reach of points, and the points sorted by the brick in which they lie.

    top: (bx, by, bz) int32, per block its row, -1 for one that nothing touches. A brick's slot is its row * 64 + its
    place in the block. touched: (slots,) bool, inner bricks within reach of some point. start: (slots + 1,), where a
    brick's points begin in ``order``. kept: (m, 3) int32, the bricks that are worth a table, the fullest first.
    """

    def __init__(
        self, cloud: LabelledCloud, low: NDArray[np.float32], cell_size: float, shape: tuple[int, int, int]
    ) -> None:
        self.low, self.cell_size, self.shape = low.astype(np.float64), cell_size, shape
        edge = cell_size * BRICK
        position = (cloud.xyz - self.low) / edge
        reach = (cloud.reach + 0.5 * cell_size) / edge  # half a cell for rounding
        inside = ((position >= -reach) & (position < np.array(shape) + reach)).all(axis=1)
        index, position = np.flatnonzero(inside), position[inside]
        last = np.array(shape) - 1
        lower, own, upper = (
            np.clip(np.floor(position + step), 0, last).astype(np.int32) for step in (-reach, 0.0, reach)
        )
        self.top = np.full([-(-length // BLOCK) for length in shape], -1, np.int32)
        mark_bricks(lower, upper, self.top, np.zeros((0, PLACES), np.bool_))
        blocks = np.flatnonzero(self.top == 0)
        self.top.flat[blocks] = np.arange(len(blocks))
        slots = np.zeros((len(blocks), PLACES), np.bool_)
        if len(blocks):
            mark_bricks(lower, upper, self.top, slots)

        within = (np.floor(position) == own).all(axis=1)  # the others lie beyond the grid
        within &= _first_of_equal(cloud.xyz[index])
        own, index = own[within], index[within]
        slot = self.top[tuple((own // BLOCK).T)].astype(np.int64) * PLACES + (
            own % BLOCK @ np.array([BLOCK**2, BLOCK, 1])
        )
        self.order = index[np.argsort(slot, kind="stable")]
        count = np.bincount(slot, minlength=slots.size)
        self.start = np.append(0, np.cumsum(count))
        self.coordinates = self._coordinates_of_slots(blocks)
        self.touched = slots.ravel() & ((self.coordinates > 0) & (self.coordinates < last)).all(axis=1)
        fullest_first = np.flatnonzero(self.touched)[np.argsort(-count[self.touched], kind="stable")]
        self.kept = fullest_first[: int(max(BRICKS_PER_POINT * len(cloud), BRICKS_AT_LEAST))]

    def _coordinates_of_slots(self, blocks: NDArray[np.int64]) -> NDArray[np.int32]:
        """(slots, 3): the brick of each slot."""
        block = np.stack(np.unravel_index(blocks, self.top.shape), axis=1)
        place = np.stack(np.unravel_index(np.arange(PLACES), (BLOCK,) * 3), axis=1)
        return (block[:, None] * BLOCK + place).reshape(-1, 3).astype(np.int32)


def _first_of_equal(xyz: NDArray[np.float32]) -> NDArray[np.bool_]:
    """(n,) bool: False where a point before it has the same coordinates, and so answers for both."""
    bits = (xyz + np.float32(0)).view(np.uint32).astype(np.uint64)  # -0 becomes 0
    key = (bits * np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], np.uint64)).sum(axis=1)
    _, first, same = np.unique(key, return_index=True, return_inverse=True)
    first = first[same]
    return (first == np.arange(len(xyz))) | (xyz[first] != xyz).any(axis=1)


class _Table:
    """The rows of a grid as they are made, chunk after chunk of bricks, until what is allowed is used up."""

    def __init__(self, cloud: LabelledCloud, bricks: _Bricks, settings: GridSettings) -> None:
        self._bricks = bricks
        self.codes = 2 * (len(cloud.instances) + CODE_OFFSET) - 1
        # The graph computes cell indices in float32: every box is inflated by what rounding can move a query.
        rounding = bricks.cell_size * 4 * float(np.finfo(np.float32).eps) * max(bricks.shape) * BRICK
        self._lattice = (bricks.low, bricks.cell_size, rounding)
        surface = surface_distance(cloud.spacing, cloud.reach)
        self._limits = (float(cloud.reach), float(surface), self.codes)
        xyz = cloud.xyz[bricks.order].astype(np.float64)
        answers = cloud.instance_ids[bricks.order] + np.int32(CODE_OFFSET)
        index = bricks.order.astype(np.int32)
        x, y, z = (np.ascontiguousarray(xyz[:, axis]) for axis in range(3))
        self._points = (x, y, z, answers, index, bricks.start)

        def allowed(per_point: float, at_least: int) -> int:
            return int(max(per_point * len(cloud), at_least))

        self._rows_allowed = allowed(ROWS_PER_POINT, ROWS_AT_LEAST)
        self._lists_allowed = allowed(LISTS_PER_POINT, LISTS_AT_LEAST) if settings.lists else 0
        self._parts_allowed = allowed(SPLIT_CELLS_PER_POINT, SPLIT_CELLS_AT_LEAST) if settings.split else 0
        shared = np.array([[TOO_FAR_CODE], [TOO_FAR_CODE + self.codes]], np.int32).repeat(CELLS, axis=1)
        self._cells, self._first_list = [shared], [np.zeros(len(shared), np.int32)]
        self._lengths, self._candidates = [np.zeros(0, np.int32)], [np.zeros(0, np.int32)]
        self._list_parts, self._parts = [np.zeros(0, np.int64)], [np.full((1, CELLS), self.codes, np.int32)]
        self._rows_made, self._lists_made, self._parts_made = len(shared), 0, 1
        # By slot: its row of cells, or -1 - its list.
        self._brick_rows = np.where(bricks.touched, _OPEN, _FAR)

    def answer(self, slots: NDArray[np.int64]) -> None:
        """Add the bricks in these slots."""
        count = len(slots)
        values, lengths = np.empty((count, CELLS), np.int32), np.empty((count, LISTS_PER_BRICK), np.int32)
        lists = np.empty((count, LISTS_PER_BRICK, LONGEST_LIST), np.int32)
        first_part, parts = np.empty((count, LISTS_PER_BRICK), np.int32), np.empty((count, CELLS, PARTS**3), np.int32)
        room_for = (self._lists_allowed > self._lists_made, self._parts_allowed > self._parts_made)
        alone = self._rows_made >= self._rows_allowed
        answer_bricks(
            self._bricks.coordinates[slots], self._lattice, self._limits, self._points, self._bricks.top,
            (min(SHORT_LIST, LONGEST_LIST), *room_for, alone), values, lengths, lists, first_part, parts,
        )  # fmt: skip
        is_list, is_far = values[:, 0] == LIST_ALONE, (values == TOO_FAR_CODE).all(axis=1)
        is_row = ~is_list & ~is_far
        is_row &= self._rows_made + np.cumsum(is_row) <= self._rows_allowed
        lengths[~is_list & ~is_row] = NO_LIST

        exists = lengths != NO_LIST
        first_list = (self._lists_made + np.cumsum(exists.sum(axis=1)) - exists.sum(axis=1)).astype(np.int32)
        self._brick_rows[slots[is_far]] = _FAR
        self._brick_rows[slots[is_list]] = -1 - first_list[is_list]
        self._brick_rows[slots[is_row]] = self._rows_made + np.arange(is_row.sum())
        self._add_rows(values[is_row], first_list[is_row])
        self._add_lists(lengths[exists], lists[exists], first_part[exists], parts, np.nonzero(exists)[0])

    def _add_rows(self, values: NDArray[np.int32], first_list: NDArray[np.int32]) -> None:
        self._cells.append(values)
        self._first_list.append(first_list)
        self._rows_made += len(values)

    def _add_lists(
        self,
        lengths: NDArray[np.int32],
        lists: NDArray[np.int32],
        first_part: NDArray[np.int32],
        parts: NDArray[np.int32],
        brick: NDArray[np.int64],
    ) -> None:
        is_split = first_part >= 0
        row = np.zeros(len(lengths), np.int64)
        row[is_split] = self._parts_made + np.arange(is_split.sum())
        self._lengths.append(lengths)
        self._candidates.append(lists[np.arange(LONGEST_LIST) < lengths[:, None]])
        self._list_parts.append(row)
        self._parts.append(parts[brick[is_split], first_part[is_split]])
        self._lists_made += len(lengths)
        self._parts_made += int(is_split.sum())

    def grid(self, whole: bool) -> BrickGrid:
        """All that was added. whole: whether no point lies beyond the grid."""
        listed = np.full((1, CELLS), 2 * self.codes, np.int32)
        cells = _compact(np.concatenate([*self._cells, listed]))
        bricks = np.where(self._brick_rows < 0, len(cells) - 1 - self._brick_rows, self._brick_rows)
        blocks = np.where(self._bricks.top < 0, _FAR, self._bricks.top + 2)
        if not whole:
            last = np.array(self._bricks.shape) - 1
            outermost = ((self._bricks.coordinates == 0) | (self._bricks.coordinates == last)).any(axis=1)
            bricks[outermost] = _OPEN
            untouched = self._bricks.top < 0
            untouched[tuple(slice(1, (length - 1) // BLOCK) for length in self._bricks.shape)] = False
            blocks[untouched] = _OPEN
        shared = np.array([[_FAR], [_OPEN]]).repeat(PLACES, axis=1)
        return BrickGrid(
            self._bricks.low.astype(np.float32),
            np.float32(self._bricks.cell_size),
            self._bricks.shape,
            _compact(blocks),
            _compact(np.concatenate([shared, bricks.reshape(-1, PLACES)])),
            cells,
            np.concatenate([*self._first_list, np.full(1, -1, np.int32)]),
            np.append(0, np.cumsum(np.concatenate(self._lengths))).astype(np.int32),
            np.concatenate(self._candidates),
            _compact(np.append(np.concatenate(self._list_parts), 0)),  # never empty: the graph reads it
            _compact(np.concatenate(self._parts)),
            self.codes,
        )
