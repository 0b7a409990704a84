"""The table in query.onnx that finds the nearest cloud point's instance: boxes in boxes, each split in 4^3 at most.

    block = 4^3 bricks     brick = 4^3 cells      cell = 4^3 parts       a query reads one value a level,
    +---+---+---+---+      +---+---+---+---+      +---+---+---+---+      until it is an answer or a list:
    |far|far|far|far|      | a | a | a | a |      | a | a |L1 | b |
    +---+---+---+---+      +---+---+---+---+      +---+---+---+---+        far, a, b   certain: the nearest point's
    |L0 | # | # |far|  ->  | a | a |L0 | b |  ->  | a |L1 |L1 | b |                    answer in all of the box
    +---+---+---+---+   #  +---+---+---+---+   #  +---+---+---+---+        L0, L1      list: every cloud point that is
    |far| # | # |far|      | a | # |L0 | b |      | a |L1 | b | b |                    nearest somewhere in the box;
    +---+---+---+---+      +---+---+---+---+      +---+---+---+---+                    the query compares distances
    |far|far|far|far|      | # | # | # | # |      |L1 |L1 | b | b |        #           split: read the next level
    +---+---+---+---+      +---+---+---+---+      +---+---+---+---+

The same rule applies at every level (``lookup_boxes``). A box is certain if all of it has one answer. Else it is split
if it contains cloud points, since most queries lie near the cloud, or if it has too many candidates for a list. Else it
has a list, which it may share with boxes beside it if a few candidates suffice for several. Answers are exact, most
queries compare no distances, and empty space costs little. Boxes beyond the budget are marked open, with the answer at
their center: ``bundle.nearest`` answers queries there. Cells are 1.5 point spacings wide.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.bundle.nearest import surface_distance
from og_pointcloud.cloud import UNOBSERVED, LabelledCloud
from og_pointcloud_export.lookup_boxes import (
    CHILDREN,
    EDGE,
    MAX_LIST_LENGTH,
    MAX_SHARED_LIST_LENGTH,
    NO_CHILD,
    SPLIT,
    TOO_FAR_CODE,
    answer_children,
)

CODE_OFFSET = 1 - UNOBSERVED
"""The answer code on the surface is instance id + CODE_OFFSET; near it, (instances + CODE_OFFSET - 1) is added."""
CELL_PER_SPACING = 1.5
"""Cell size in spacings. Smaller cells need lists less often, but file size grows with the second to third power."""
CELLS_PER_REACH = 3.0
"""A large reach makes cells larger, so that the layer of cells around a surface is at most about eight deep."""
BLOCKS_PER_POINT, MIN_BLOCK_BUDGET, MAX_BLOCK_BUDGET = 16, 1 << 15, 1 << 18  # times 64^2, and as much again, fits int32
NODES_PER_POINT, MIN_NODE_BUDGET = 1, 1 << 13
LISTS_PER_POINT, MIN_LIST_BUDGET = 4, 1 << 16
"""Budgets of blocks, nodes and lists: they limit the table for any extent of the scene; the rest needs exact search."""
MAX_TABLE_BYTES = 1_800_000_000
"""Size of all tables together, as a graph must stay below 2^31 bytes: reached by clouds of about 30 million points."""
MAX_BRICKS_PER_AXIS = 1 << 13
"""Up to this length cell indices are exact to half a cell in float32, and the table of them per axis is short."""
BOXES_PER_CHUNK = 256
"""Boxes answered at once, with about 4 MB of scratch memory."""

# The first two rows of nodes, shared by bricks, and of bricks, shared by blocks: all too far, and all open.
_FAR, _OPEN = 0, 1


@dataclass(frozen=True)
class LookupGrid:
    """Cell (i, j, k) extends from low + (i, j, k) * cell_size by cell_size along each axis, in the local frame.

    low: (3,) float32. cell_size: float32. shape: bricks along each axis; the outermost ones represent all space beyond.
    blocks: (bx, by, bz) unsigned, rows of ``bricks``.
    bricks: (rows, 64) unsigned, C order within the block. A *reference*: below ``len(nodes)`` the row of ``nodes`` of a
        split brick; else, minus ``len(nodes)``, the child whose list answers the brick.
    nodes: (rows, 64) unsigned, the split boxes; C order within the box. A value below ``codes`` is a certain answer;
        one below ``2 codes`` is open, and ``value - codes`` is the answer at the center; any other is the box's child
        ``value - 2 codes``. The last row is the target of references to lists: all 2 codes.
    first_child: (rows,) int32, index of the box's first child; -1 in the last row.
    child_length: (children,) unsigned, candidates in the child's list; 0: the child is split.
    child_start: (children,) int32, start of its list in ``candidates``, or its row of ``nodes`` if it is split.
    candidates: (m,) int32, points of the cloud, ascending within a list.
    codes: number of answer codes: TOO_FAR_CODE, those on the surface, those near it; see CODE_OFFSET.
    """

    low: NDArray[np.float32]
    cell_size: np.float32
    shape: tuple[int, int, int]
    blocks: NDArray[np.unsignedinteger]
    bricks: NDArray[np.unsignedinteger]
    nodes: NDArray[np.unsignedinteger]
    first_child: NDArray[np.int32]
    child_length: NDArray[np.unsignedinteger]
    child_start: NDArray[np.int32]
    candidates: NDArray[np.int32]
    codes: int


def build_lookup_grid(cloud: LabelledCloud) -> LookupGrid:
    """The grid of a cloud. Its size is bounded by the number of points, not by the extent of the scene."""
    frame = _grid_frame(cloud)
    points, blocks = _points_by_brick(cloud, frame)
    table = _Table(cloud, frame, points)
    bricks, split_bricks = table.bricks(blocks)
    split_cells = table.nodes(split_bricks, frame.cell_size, last=False)
    table.nodes(split_cells, frame.cell_size / EDGE, last=True)
    return table.grid(blocks, bricks)


@dataclass(frozen=True)
class _Frame:
    """Placement of the grid. low: (3,) float64, its low corner, exact in float32. shape: bricks along each axis. Both
    include an outermost layer, which represents all space beyond. holds_all: every point lies inside that layer."""

    low: NDArray[np.float64]
    cell_size: float
    shape: tuple[int, int, int]
    holds_all: bool

    @property
    def brick_edge(self) -> float:
        return self.cell_size * EDGE

    @property
    def blocks(self) -> tuple[int, int, int]:
        """Blocks along each axis."""
        x, y, z = (-(-length // EDGE) for length in self.shape)
        return x, y, z


def _grid_frame(cloud: LabelledCloud) -> _Frame:
    """A grid around all points; of wider cells for a long map, around most of it only for one with far outliers."""
    cell_size = max(CELL_PER_SPACING * cloud.spacing, cloud.reach / CELLS_PER_REACH)
    if len(cloud) == 0:
        return _Frame(np.zeros(3), float(np.float32(cell_size)), (3, 3, 3), True)
    allowed = min(max(BLOCKS_PER_POINT * len(cloud), MIN_BLOCK_BUDGET), MAX_BLOCK_BUDGET)
    # The narrowest cells, then the smallest share of outliers, on each side of each axis, that make the grid small
    # enough. What is left out has no certain answer: a hundredth may be outliers, more is part of the map.
    tries = [(width, left_out) for width in (1, 2, 4, 8) for left_out in (0.0, 1e-4, 1e-3, 1e-2)]
    for width, left_out in [*tries, (8, 0.05), (8, 0.2), (8, 0.4)]:
        frame = _frame(cloud, width * cell_size, left_out)
        if math.prod(frame.blocks) <= allowed and max(frame.shape) <= MAX_BRICKS_PER_AXIS:
            return frame
    return replace(_frame(cloud, 8 * cell_size, 0.4), shape=(3, 3, 3))


def _frame(cloud: LabelledCloud, cell_size: float, left_out: float) -> _Frame:
    """A grid around the points without this share of them on each side of each axis."""
    cell_size = float(np.float32(cell_size))
    border = cloud.reach + cell_size  # the extra cell absorbs all rounding
    ends = np.quantile(cloud.xyz, [left_out, 1 - left_out], axis=0, method="nearest").astype(np.float64)
    x, y, z = (np.ceil((ends[1] - ends[0] + 2 * border) / (cell_size * EDGE)) + 2).tolist()
    low = (ends[0] - border - cell_size * EDGE).astype(np.float32)
    return _Frame(low.astype(np.float64), cell_size, (int(x), int(y), int(z)), left_out == 0)


def _points_by_brick(cloud: LabelledCloud, frame: _Frame) -> tuple[tuple, NDArray[np.int64]]:
    """The points in the grid as the kernel reads them, and (m, 3) the blocks within reach of a point, fullest first.

    The kernel's record: (low, brick edge, block_row, start, x, y, z, answer code, index in the cloud). block_row:
    (bx, by, bz) int32, row of a block in reach, else -1. Its brick p has the points ``start[row * 64 + p]`` up to
    ``start[row * 64 + p + 1]``.
    """
    position = (cloud.xyz - frame.low) / frame.brick_edge
    inside = ((position >= 0) & (position < frame.shape)).all(axis=1) & _first_of_equal(cloud.xyz)
    number, position = np.flatnonzero(inside), position[inside]

    reach = (cloud.reach + 0.5 * frame.cell_size) / frame.brick_edge  # half a cell for rounding; together below 1
    last = np.array(frame.blocks) - 1
    lower, upper = (np.clip((position + step) // EDGE, 0, last).astype(np.int64) for step in (-reach, reach))
    in_reach = np.zeros(frame.blocks, np.bool_)
    for x, y, z in itertools.product((lower, upper), repeat=3):  # at most two blocks along each axis
        in_reach[x[:, 0], y[:, 1], z[:, 2]] = True
    blocks = np.argwhere(in_reach)
    block_row = np.full(frame.blocks, -1, np.int32)

    # The fullest blocks first, so that the budget of nodes and lists serves the most points.
    brick = position.astype(np.int64)
    count = np.zeros(frame.blocks, np.int64)
    np.add.at(count, tuple((brick // EDGE).T), 1)
    blocks = blocks[np.argsort(-count[in_reach], kind="stable")]
    block_row[tuple(blocks.T)] = np.arange(len(blocks))
    # Points sorted by brick, block after block: `start` is the index of each brick's first point.
    slot = block_row[tuple((brick // EDGE).T)] * CHILDREN + brick % EDGE @ np.array([EDGE**2, EDGE, 1])
    start = np.append(0, np.cumsum(np.bincount(slot, minlength=len(blocks) * CHILDREN)))
    number = number[np.argsort(slot, kind="stable")]
    x, y, z = np.ascontiguousarray(cloud.xyz[number].T, np.float64)
    answer = cloud.instance_ids[number] + np.int32(CODE_OFFSET)
    return (frame.low, frame.brick_edge, block_row, start, x, y, z, answer, number.astype(np.int32)), blocks


def _first_of_equal(xyz: NDArray[np.float32]) -> NDArray[np.bool_]:
    """(n,) bool: False where an earlier point has the same coordinates, and so answers for both."""
    # By a 64-bit hash of each row, as np.unique by rows is slow; the last line handles hash collisions.
    bits = (xyz + np.float32(0)).view(np.uint32).astype(np.uint64)  # -0 becomes 0
    key = (bits * np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], np.uint64)).sum(axis=1)
    _, first, same = np.unique(key, return_index=True, return_inverse=True)
    first = first[same]
    return (first == np.arange(len(xyz))) | (xyz[first] != xyz).any(axis=1)


class _Table:
    """The rows of a grid as they are built, level after level, until the budgets are used up."""

    def __init__(self, cloud: LabelledCloud, frame: _Frame, points: tuple) -> None:
        self._frame, self._points = frame, points
        self._codes = 2 * (len(cloud.instances) + CODE_OFFSET) - 1
        self._limits = (float(cloud.reach), surface_distance(float(cloud.spacing), float(cloud.reach)), self._codes)
        # The graph computes cell indices in float32: every box is inflated by the most that rounding can move a query.
        self._rounding = frame.cell_size * 4 * float(np.finfo(np.float32).eps) * max(frame.shape) * EDGE
        self._nodes_allowed = max(NODES_PER_POINT * len(cloud), MIN_NODE_BUDGET)
        self._lists_allowed = max(LISTS_PER_POINT * len(cloud), MIN_LIST_BUDGET)
        shared = np.array([[TOO_FAR_CODE], [TOO_FAR_CODE + self._codes]], np.int32).repeat(CHILDREN, axis=1)
        self._nodes, self._first_child = [shared], [np.zeros(len(shared), np.int64)]
        self._child_length, self._child_start = [np.zeros(0, np.int32)], [np.zeros(0, np.int64)]
        self._candidates = [np.zeros(0, np.int32)]
        self._rows_promised, self._lists_made = len(shared), 0
        self._children_made, self._candidates_made = 0, 0

    def bricks(self, blocks: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """References of the bricks in these blocks (m, 3), with a child's list as -1 - its index; and low corners of
        the split bricks."""
        edge = self._frame.brick_edge
        references, split_low = [np.zeros((0, CHILDREN), np.int64)], [np.zeros((0, 3))]
        for boxes in self._answer(self._frame.low + blocks * (EDGE * edge), edge, MAX_SHARED_LIST_LENGTH, last=False):
            certain = np.where(boxes.answers == TOO_FAR_CODE, _FAR, _OPEN)  # no brick lies in reach of one point
            unsplit = np.where(boxes.child >= 0, -1 - boxes.child, certain)
            references.append(np.where(boxes.row >= 0, boxes.row, unsplit))
            split_low.append(boxes.split_low)
        return np.concatenate(references), np.concatenate(split_low)

    def nodes(self, low: NDArray[np.float64], size: float, *, last: bool) -> NDArray[np.float64]:
        """Add nodes for boxes with these low corners and this child size; returns low corners of the split children."""
        split_low = [np.zeros((0, 3))]
        for boxes in self._answer(low, size, MAX_LIST_LENGTH, last=last):
            child = boxes.child - boxes.first_child[:, None] + 2 * self._codes
            self._nodes.append(np.where(boxes.child >= 0, child, boxes.answers).astype(np.int32))
            self._first_child.append(boxes.first_child)
            split_low.append(boxes.split_low)
        return np.concatenate(split_low)

    @property
    def _bytes(self) -> int:
        """Upper bound of the tables' size: 4 bytes per value and list entry, 16 per point in a list, 5 per child."""
        in_lists = min(self._candidates_made, len(self._points[-1]))
        return 4 * (CHILDREN * self._rows_promised + self._candidates_made) + 16 * in_lists + 5 * self._children_made

    def _answer(self, low: NDArray[np.float64], size: float, longest: int, *, last: bool) -> Iterator[_Boxes]:
        """Answer boxes in chunks and add their children; what exceeds the budget is left open."""
        for first in range(0, len(low), BOXES_PER_CHUNK):
            corners = low[first : first + BOXES_PER_CHUNK]
            answers, child, lengths = (np.empty((len(corners), CHILDREN), np.int32) for _ in range(3))
            lists = np.empty((*child.shape, MAX_LIST_LENGTH), np.int32)
            level = (size, self._rounding, longest, last)
            answer_children(corners, level, self._limits, self._points, (answers, child, lengths, lists))
            if self._bytes > MAX_TABLE_BYTES:
                self._nodes_allowed = self._lists_allowed = 0
            if self._lists_made >= self._lists_allowed:  # no more lists: children that need one are left open
                child[child != SPLIT], lengths[:] = NO_CHILD, 0
            split = child == SPLIT
            split &= self._rows_promised + np.cumsum(split).reshape(split.shape) <= self._nodes_allowed
            child[(child == SPLIT) & ~split] = NO_CHILD
            box, place = np.nonzero(split)
            split_low = corners[box] + _CHILD_OFFSETS[place] * size
            yield _Boxes(answers, *self._add_children(child, split, lengths, lists), split_low)

    def _add_children(
        self, child: NDArray[np.int32], split: NDArray[np.bool_], lengths: NDArray[np.int32], lists: NDArray[np.int32]
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
        """Number the children of boxes, in each box its lists, then its splits. Returns first_child, child and row as
        in ``_Boxes``."""
        listed = lengths > 0
        # First child of each box, and index of each child within its box: that of its list, or after all lists.
        count_lists, count_splits = listed.sum(axis=1), split.sum(axis=1)
        first_child = self._children_made + np.cumsum(count_lists + count_splits) - (count_lists + count_splits)
        in_box = np.where(split, count_lists[:, None] + np.cumsum(split, axis=1) - 1, child)
        row = np.where(split, self._rows_promised + np.cumsum(split).reshape(split.shape) - 1, -1)
        list_start = (self._candidates_made + np.cumsum(lengths) - lengths.ravel()).reshape(lengths.shape)

        exists = np.concatenate([listed, split], axis=1)
        self._child_length.append(np.concatenate([lengths, np.zeros_like(lengths)], axis=1)[exists])
        self._child_start.append(np.concatenate([list_start, row], axis=1)[exists])
        self._candidates.append(lists[np.arange(MAX_LIST_LENGTH) < lengths[..., None]])
        self._children_made += int(exists.sum())
        self._lists_made += int(listed.sum())
        self._rows_promised += int(split.sum())
        self._candidates_made += int(lengths.sum())
        return first_child, np.where(child == NO_CHILD, -1, first_child[:, None] + in_box), row

    def grid(self, blocks: NDArray[np.int64], references: NDArray[np.int64]) -> LookupGrid:
        """The finished grid, with the references of the bricks in these blocks."""
        listed = np.full((1, CHILDREN), 2 * self._codes, np.int32)  # the last row, see `nodes`
        nodes = compact(np.concatenate([*self._nodes, listed]))
        bricks = np.where(references < 0, len(nodes) - 1 - references, references)
        block_row = np.full(self._frame.blocks, _FAR, np.int64)
        if not self._frame.holds_all:  # the outermost bricks represent the points that lie beyond
            last = np.array(self._frame.shape) - 1
            brick = blocks[:, None] * EDGE + _CHILD_OFFSETS
            bricks[((brick == 0) | (brick == last)).any(axis=2)] = _OPEN
            block_row[:] = _OPEN
            block_row[tuple(slice(1, end // EDGE) for end in last)] = _FAR
        block_row[tuple(blocks.T)] = 2 + np.arange(len(blocks))
        shared = np.array([[_FAR], [_OPEN]]).repeat(CHILDREN, axis=1)
        return LookupGrid(
            low=self._frame.low.astype(np.float32),
            cell_size=np.float32(self._frame.cell_size),
            shape=self._frame.shape,
            blocks=compact(block_row),
            bricks=compact(np.concatenate([shared, bricks])),
            nodes=nodes,
            first_child=np.append(np.concatenate(self._first_child), -1).astype(np.int32),
            child_length=compact(np.append(np.concatenate(self._child_length), 0)),  # never empty: the graph reads it
            child_start=np.append(np.concatenate(self._child_start), 0).astype(np.int32),
            candidates=np.concatenate(self._candidates),
            codes=self._codes,
        )


@dataclass(frozen=True)
class _Boxes:
    """A chunk of answered boxes: answers (m, 64) as of the kernel; first_child (m,); child (m, 64), index of each list
    or split, else -1; row (m, 64), row of nodes for a split child, else -1; split_low (s, 3), low corners of these."""

    answers: NDArray[np.int32]
    first_child: NDArray[np.int64]
    child: NDArray[np.int64]
    row: NDArray[np.int64]
    split_low: NDArray[np.float64]


_CHILD_OFFSETS = np.stack(np.unravel_index(np.arange(CHILDREN), (EDGE,) * 3), axis=1)
"""(64, 3): offsets of a box's children along each axis, in C order."""


def compact(values: NDArray[np.integer]) -> NDArray[np.unsignedinteger]:
    """Whole numbers from 0 in the smallest type that holds them."""
    return values.astype(np.min_scalar_type(int(values.max(initial=0))))
