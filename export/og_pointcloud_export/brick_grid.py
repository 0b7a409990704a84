"""The table that answers point queries: a grid of cells, each with its answer, or with the points that settle it.

A cell is certain when every place in it has the same answer: the nearest cloud point's instance, or "too far". Cells
lie in bricks of 4^3, stored only where some point is within reach. An open cell, cut by the border of two instances or
by the reach, has a list of candidates: every cloud point that is nearest somewhere in it, a handful. If cloud points
lie in it, it is split into 4^3 parts as well, as queries come where the cloud is, and only its open parts need the
list. So answers are exact, and few queries compare distances at all. What the budget leaves without a list is marked,
and holds the answer at its centre: ``og_pointcloud.nearest`` settles queries there.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.cloud import UNOBSERVED, LabelledCloud
from og_pointcloud.errors import MissingExtraError
from og_pointcloud.nearest import VoxelBuckets, surface_distance

try:
    from numba import njit, prange
except ImportError as error:
    raise MissingExtraError("numba", "fit") from error

__all__ = [
    "BRICK", "CODE_OFFSET", "LONGEST_LIST", "PARTS", "TOO_FAR_CODE", "BrickGrid", "GridSettings", "build_brick_grid",
]  # fmt: skip

BRICK = 4
"""Cells along the edge of a brick."""
PARTS = 4
"""Parts along the edge of a cell that is split."""
TOO_FAR_CODE = 0
"""Answer code of a query with no cloud point within reach; instance id + CODE_OFFSET on the surface, and that plus
(instances + CODE_OFFSET - 1) near it."""
CODE_OFFSET = 1 - UNOBSERVED
LONGEST_LIST = 32
"""Candidates of a cell; a cell with more, as where points coincide, has no list."""
TOO_LONG = -1

CELLS_PER_REACH = 3.0
"""A far reach makes cells larger, so that the layer of cells around a surface stays at most about eight deep."""
TOP_ENTRIES_PER_POINT, TOP_ENTRIES_AT_LEAST, TOP_ENTRIES_AT_MOST = 4, 1 << 18, 1 << 24  # times 64 fits int32
BRICKS_PER_POINT, BRICKS_AT_LEAST = 1 / 2, 1 << 13
SPLIT_CELLS_PER_POINT, SPLIT_CELLS_AT_LEAST = 1 / 8, 1 << 10
LISTS_PER_POINT, LISTS_AT_LEAST = 1, 1 << 16
"""What bounds the table whatever the extent of the scene: the rest is left to the exact search."""
BRICKS_PER_AXIS = 1 << 13
"""So long a grid still has its cell indices right to half a cell in float32, and a short table of them per axis."""
SUBDIVISION = 2
"""A cell's list is put together from those of so many boxes along its edge, which are shorter than the cell's own."""

# Two bricks that many entries of the top level share: all too far, and all open.
_FAR_BRICK, _OPEN_BRICK = 0, 1


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

    low: (3,) float32. cell_size: float32.
    bricks: (bx, by, bz) unsigned, rows of ``cells``; its outermost layer stands for everything beyond the grid.
    cells: (rows, 64) unsigned, C order within the brick. A value below ``codes`` is a certain answer; one below
        ``2 codes`` is open, and ``value - codes`` the answer at the centre; of any other, ``value - 2 codes`` plus the
        brick's ``first_list`` is its list.
    first_list: (rows,) int32. list_start: (lists + 1,) int32, where each list begins in ``candidates``.
    candidates: (m,) int32, points of the cloud, ascending within a list.
    list_parts: (lists,) unsigned, row of ``parts`` of the list's cell; row 0, all open, for a cell that is not split.
    parts: (rows, 64) unsigned, C order within the cell: certain answers, or ``codes`` where the list settles it.
    codes: number of answer codes, see TOO_FAR_CODE.
    """

    low: NDArray[np.float32]
    cell_size: np.float32
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
        tables = (self.bricks, self.cells, self.first_list, self.list_start, self.candidates, self.list_parts)
        return sum(table.nbytes for table in (*tables, self.parts))


def build_brick_grid(cloud: LabelledCloud, settings: GridSettings | None = None) -> BrickGrid:
    """The grid of a cloud. Its size is bounded by the number of points, not by the extent of the scene."""
    settings = settings or GridSettings()
    codes = 2 * (len(cloud.instances) + CODE_OFFSET) - 1
    cell_size = np.float32(max(settings.cell_per_spacing * cloud.spacing, cloud.reach / CELLS_PER_REACH))
    low, shape, whole = _grid_box(cloud, float(cell_size))
    touched, kept = _bricks_within_reach(cloud, low, shape, float(cell_size))
    # The graph computes cell indices in float32: every box is inflated by what rounding can move a query.
    rounding = float(cell_size) * 4 * float(np.finfo(np.float32).eps) * max(shape) * BRICK
    boxes = _Boxes(cloud, float(cell_size), rounding, codes)
    corners = low.astype(np.float64) + float(cell_size) * BRICK * np.stack(np.unravel_index(kept, shape), axis=1)
    cells = boxes.classify(corners)
    lists = _Lists.none(len(cells), codes)
    if settings.lists:
        full = _cells_that_hold_points(cloud, low, shape, float(cell_size), kept, cells >= codes)
        lists = _settle_open_cells(cloud, boxes, corners, cells, full if settings.split else full[:0])

    shared = np.array([[TOO_FAR_CODE], [TOO_FAR_CODE + codes]], np.int32).repeat(BRICK**3, axis=1)
    bricks = np.full(shape, _FAR_BRICK if whole else _OPEN_BRICK, np.int64)
    bricks[1:-1, 1:-1, 1:-1] = _FAR_BRICK
    bricks.flat[touched] = _OPEN_BRICK
    bricks.flat[kept] = np.arange(len(cells)) + len(shared)
    return BrickGrid(
        low,
        cell_size,
        _compact(bricks),
        _compact(np.concatenate([shared, cells])),
        np.concatenate([np.zeros(len(shared), np.int32), lists.first]),
        lists.start,
        lists.candidates,
        _compact(lists.parts_row),
        _compact(lists.parts),
        codes,
    )


def _compact(values: NDArray[np.integer]) -> NDArray[np.unsignedinteger]:
    return values.astype(np.min_scalar_type(int(values.max())))


def _grid_box(cloud: LabelledCloud, cell_size: float) -> tuple[NDArray[np.float32], tuple[int, int, int], bool]:
    """Low corner, bricks per axis (both with the outermost layer), and whether every point within reach lies inside.

    A scene with far outliers gets a grid around its bulk only.
    """
    if len(cloud) == 0:
        return np.zeros(3, np.float32), (3, 3, 3), True
    allowed = min(max(TOP_ENTRIES_PER_POINT * len(cloud), TOP_ENTRIES_AT_LEAST), TOP_ENTRIES_AT_MOST)
    border = cloud.reach + cell_size  # the cell more takes up all rounding
    for left_out in (0.0, 1e-4, 1e-3, 1e-2, 0.05, 0.2, 0.4):
        ends = np.quantile(cloud.xyz, [left_out, 1 - left_out], axis=0, method="nearest").astype(np.float64)
        shape = np.ceil((ends[1] - ends[0] + 2 * border) / (cell_size * BRICK)) + 2
        if shape.prod() <= allowed and shape.max() <= BRICKS_PER_AXIS:
            break
    else:
        shape = np.full(3, 3.0)
    low = (ends[0] - border - cell_size * BRICK).astype(np.float32)
    return low, (int(shape[0]), int(shape[1]), int(shape[2])), bool(left_out == 0)


def _bricks_within_reach(
    cloud: LabelledCloud, low: NDArray[np.float32], shape: tuple[int, int, int], cell_size: float
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Flat indices of the inner bricks that some point's reach touches, and of those that are worth a table."""
    edge = cell_size * BRICK
    relative = (cloud.xyz - low.astype(np.float64)) / edge
    # Half a cell for rounding. Half the box around a point is shorter than a brick: these places meet all its bricks.
    reach = (cloud.reach + 0.5 * cell_size) / edge
    touched = np.zeros(shape, np.int64)
    for step in product((-reach, 0.0, reach), repeat=3):
        touched[_inner(np.floor(relative + step), shape)] = 1
    own, count = np.unique(np.ravel_multi_index(_inner(np.floor(relative), shape), shape), return_counts=True)
    touched.flat[own] = 1 + count

    indices = np.flatnonzero(touched)
    allowed = int(max(BRICKS_PER_POINT * len(cloud), BRICKS_AT_LEAST))
    fullest_first = np.argsort(-touched.flat[indices], kind="stable")
    return indices, np.sort(indices[fullest_first[:allowed]])


def _inner(
    brick: NDArray[np.float64], shape: tuple[int, int, int], rows: NDArray[np.float64] | None = None
) -> tuple[NDArray[np.int64], ...]:
    """Three index arrays: of those bricks (n, 3), or of other rows, whose brick lies within the outermost layer."""
    inside = ((brick >= 1) & (brick < np.array(shape) - 1)).all(axis=1)
    return tuple((brick if rows is None else rows)[inside].astype(np.int64).T)


def _cells_that_hold_points(
    cloud: LabelledCloud,
    low: NDArray[np.float32],
    shape: tuple[int, int, int],
    cell_size: float,
    kept: NDArray[np.int64],
    is_open: NDArray[np.bool_],
) -> NDArray[np.int64]:
    """Flat indices (brick of ``kept``, cell) of the open cells that hold points, the fullest first."""
    cell = np.floor((cloud.xyz - low.astype(np.float64)) / cell_size)
    cell = np.stack(_inner(cell / BRICK, shape, cell), axis=1)
    brick = np.ravel_multi_index(tuple((cell // BRICK).T), shape)
    row = np.searchsorted(kept, brick)
    found = np.append(kept, -1)[row] == brick
    inside = np.ravel_multi_index(tuple((cell % BRICK).T), (BRICK,) * 3)
    address, count = np.unique((row * BRICK**3 + inside)[found], return_counts=True)
    address, count = (values[is_open.flat[address]] for values in (address, count))
    return address[np.argsort(-count, kind="stable")]


@dataclass(frozen=True)
class _Lists:
    """The lists of all open cells, brick after brick; see ``BrickGrid``. first: (bricks,) int32."""

    first: NDArray[np.int32]
    start: NDArray[np.int32]
    candidates: NDArray[np.int32]
    parts_row: NDArray[np.int64]
    parts: NDArray[np.int32]

    @classmethod
    def none(cls, bricks: int, codes: int) -> _Lists:
        """No list, and nothing in a table that is never empty: the graph reads a row of it."""
        empty = np.zeros(0, np.int32)
        return cls(np.zeros(bricks, np.int32), np.zeros(1, np.int32), empty, np.zeros(1, np.int64), _all_open(codes))


def _all_open(codes: int) -> NDArray[np.int32]:
    return np.full((1, PARTS**3), codes, np.int32)


def _settle_open_cells(
    cloud: LabelledCloud,
    boxes: _Boxes,
    corners: NDArray[np.float64],
    cells: NDArray[np.int32],
    holding_points: NDArray[np.int64],
) -> _Lists:
    """Give open cells their lists, and write into ``cells`` which list is theirs; those that hold points come first."""
    codes = boxes.codes
    is_open = cells >= codes
    is_open.flat[holding_points] = False
    # Then those where a cloud point is within reach of the centre, and last the far side of the reach.
    between, outside = np.flatnonzero(is_open & (cells > codes)), np.flatnonzero(is_open & (cells == codes))
    allowed = int(max(LISTS_PER_POINT * len(cloud), LISTS_AT_LEAST))
    split_allowed = int(max(SPLIT_CELLS_PER_POINT * len(cloud), SPLIT_CELLS_AT_LEAST))
    address = np.concatenate([holding_points, between, outside])[:allowed]
    is_split = np.arange(len(address)) < min(split_allowed, len(holding_points))
    order = np.argsort(address)
    address, is_split = address[order], is_split[order]

    brick, cell = address // BRICK**3, address % BRICK**3
    low = corners[brick] + boxes.cell_size * np.stack(np.unravel_index(cell, (BRICK,) * 3), axis=1)
    length = np.zeros(len(address), np.int32)
    candidates = np.empty((len(address), LONGEST_LIST), np.int32)
    length[~is_split], candidates[~is_split], _ = boxes.settle(low[~is_split], SUBDIVISION, only_open=False)
    length[is_split], candidates[is_split], parts = boxes.settle(low[is_split], PARTS, only_open=True)

    settled = length != TOO_LONG
    parts_row = np.zeros(len(address), np.int64)
    parts_row[is_split] = 1 + np.arange(len(parts))
    brick, cell, length, candidates, parts_row = (
        values[settled] for values in (brick, cell, length, candidates, parts_row)
    )
    first = np.searchsorted(brick, np.arange(len(cells))).astype(np.int32)
    cells[brick, cell] = 2 * codes + np.arange(len(brick)) - first[brick]
    return _Lists(
        first,
        np.append(0, np.cumsum(length)).astype(np.int32),
        candidates[np.arange(LONGEST_LIST) < length[:, None]],
        np.append(parts_row, 0),
        np.concatenate([_all_open(codes), parts]),
    )


class _Boxes:
    """Finds the answers of boxes in one cloud.

    cell_size: edge of the largest box, and of the voxels that points are sorted into. rounding: length by which every
    box is inflated on all sides.
    """

    def __init__(self, cloud: LabelledCloud, cell_size: float, rounding: float, codes: int) -> None:
        self.cell_size, self.codes = cell_size, codes
        self._rounding = rounding
        # Points farther than this from a box's centre are out of reach of all of it.
        search = cloud.reach + np.sqrt(3) * (cell_size / 2 + rounding)
        surface = surface_distance(cloud.spacing, cloud.reach)
        self._limits = (float(cloud.reach), float(search), float(surface))
        steps = int(np.ceil(search / cell_size))
        columns = product(range(-steps, steps + 1), repeat=2)
        self._columns = np.array(sorted(columns, key=lambda step: step[0] ** 2 + step[1] ** 2))
        buckets = VoxelBuckets(cloud.xyz, cell_size, run=2 * steps + BRICK + 2)  # a brick's line is searched at once
        answers = cloud.instance_ids[buckets.point] + np.int32(CODE_OFFSET)
        starts = buckets.starts.astype(np.int32)  # half the memory to run through
        index = buckets.point.astype(np.int32)
        self._points = (buckets.x, buckets.y, buckets.z, answers, starts, buckets.mask, buckets.edge, index)

    def classify(self, corners: NDArray[np.float64]) -> NDArray[np.int32]:
        """(m, 64) int32, values of the cells of the bricks with these low corners (m, 3): answers, or open ones."""
        values = np.empty((len(corners), BRICK**3), np.int32)
        half = self.cell_size / 2 + self._rounding
        _classify(corners, self.cell_size, half, self._limits, self._columns, self._points, self.codes, values)
        return values

    def settle(
        self, corners: NDArray[np.float64], per_edge: int, *, only_open: bool
    ) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int32]]:
        """Lists of the cells with these low corners (m, 3), looked at in per_edge^3 boxes each.

        Returns their lengths (m,), or TOO_LONG; the candidates (m, LONGEST_LIST), ascending; and the boxes' values
        (m, per_edge^3): a certain answer, or ``codes``. only_open: the list need not hold in boxes that are certain.
        """
        lengths = np.full(len(corners), TOO_LONG, np.int32)
        lists = np.empty((len(corners), LONGEST_LIST), np.int32)
        values = np.empty((len(corners), per_edge**3), np.int32)
        edges = (self.cell_size, self._rounding)
        _settle(
            corners, per_edge, only_open, edges, self._limits, self._columns, self._points, self.codes, lengths, lists,
            values,
        )  # fmt: skip
        return lengths, lists, values


@njit(cache=True, parallel=True)
def _classify(corners, size, half, limits, columns, points, codes, values):  # noqa: ANN001, ANN202
    """Fill values: the answer at each cell's centre, plus ``codes`` where it is not the whole cell's."""
    # Cells in lines along z: most lines of a brick meet no point at all, and say so once for all their cells.
    for brick in prange(len(corners)):
        for line in range(BRICK * BRICK):
            x = corners[brick, 0] + (line // BRICK + 0.5) * size
            y = corners[brick, 1] + (line % BRICK + 0.5) * size
            first = line * BRICK
            if not _line_meets_a_point(x, y, corners[brick, 2], BRICK * size, limits[1], columns, points):
                values[brick, first : first + BRICK] = TOO_FAR_CODE
                continue
            for cell in range(BRICK):
                center = (x, y, corners[brick, 2] + (cell + 0.5) * size)
                values[brick, first + cell] = _cell_value(center, half, limits, columns, points, codes)


@njit(cache=True)
def _line_meets_a_point(x, y, low, length, search, columns, points):  # noqa: ANN001, ANN202
    """Whether any point is within the search radius of a line of that length upwards from (x, y, low)."""
    xs, ys, zs, _, starts, mask, edge, _ = points
    bottom = np.int64(np.floor((low - search) / edge))
    top = np.int64(np.floor((low + length + search) / edge))
    for column in range(len(columns)):
        voxel_x = np.int64(np.floor(x / edge)) + columns[column, 0]
        voxel_y = np.int64(np.floor(y / edge)) + columns[column, 1]
        bucket = (voxel_x * 73856093 + voxel_y * 19349663 + bottom) & mask
        for point in range(starts[bucket], starts[bucket + top - bottom + 1]):
            dx, dy = xs[point] - x, ys[point] - y
            dz = max(low - zs[point], 0.0, zs[point] - low - length)
            if dx * dx + dy * dy + dz * dz <= search * search:
                return True
    return False


@njit(cache=True)
def _cell_value(center, half, limits, columns, points, codes):  # noqa: ANN001, ANN202
    """Value of the cell with this centre and half edge; see ``BrickGrid.cells``."""
    x, y, z, answers = points[:4]
    reach, search, _ = limits
    # The point nearest to the centre, and whether any point is within reach of any corner of the cell.
    nearest, nearest_squared, met = -1, np.inf, False
    limit_squared = search * search
    for column in range(len(columns)):
        first, last = _run(center, columns[column], limit_squared, points)
        for point in range(first, last):
            dx, dy, dz = x[point] - center[0], y[point] - center[1], z[point] - center[2]
            squared = dx * dx + dy * dy + dz * dz
            if squared < nearest_squared:
                nearest, nearest_squared = point, squared
            met = met or _gap_squared(dx, dy, dz, half) <= reach * reach * (1 + 1e-9)
        if met:
            limit_squared = min(limit_squared, nearest_squared)
    if not met:
        return TOO_FAR_CODE

    near = (x[nearest] - center[0], y[nearest] - center[1], z[nearest] - center[2])
    certain = _within_reach(near, half, reach)
    limit_squared = _rival_limit_squared(nearest_squared, half, search)
    for column in range(len(columns)):
        first, last = _run(center, columns[column], limit_squared, points) if certain else (0, 0)
        for point in range(first, last):
            if answers[point] != answers[nearest]:
                rival = (x[point] - center[0], y[point] - center[1], z[point] - center[2])
                certain = certain and _loses(rival, near, nearest_squared, half)
    code = _code(answers[nearest], nearest_squared, limits, codes)
    return code if certain else code + codes


@njit(cache=True, parallel=True)
def _settle(corners, per_edge, only_open, edges, limits, columns, points, codes, lengths, lists, values):  # noqa: ANN001, ANN202
    """Fill lengths, lists and values; see ``_Boxes.settle``."""
    cell_size, rounding = edges
    size = cell_size / per_edge
    for cell in prange(len(corners)):
        center = (
            corners[cell, 0] + cell_size / 2, corners[cell, 1] + cell_size / 2, corners[cell, 2] + cell_size / 2,
        )  # fmt: skip
        rivals = _rivals(center, cell_size / 2 + rounding, limits, columns, points)
        needed = np.zeros(len(rivals), np.bool_)
        for box in range(per_edge**3):
            middle = (
                corners[cell, 0] + (box // per_edge**2 + 0.5) * size,
                corners[cell, 1] + (box // per_edge % per_edge + 0.5) * size,
                corners[cell, 2] + (box % per_edge + 0.5) * size,
            )
            values[cell, box] = _settle_box(
                middle, size / 2 + rounding, only_open, limits, points, codes, rivals, needed
            )
        chosen = np.sort(points[7][rivals[needed]])
        if len(chosen) <= lists.shape[1]:
            lengths[cell] = len(chosen)
            lists[cell, : len(chosen)] = chosen


@njit(cache=True)
def _rivals(center, half, limits, columns, points):  # noqa: ANN001, ANN202
    """Sorted points that may be the nearest one, and within reach, somewhere in the box."""
    x, y, z = points[:3]
    reach, search, _ = limits
    nearest, nearest_squared = -1, np.inf
    for column in range(len(columns)):
        first, last = _run(center, columns[column], min(search * search, nearest_squared), points)
        for point in range(first, last):
            dx, dy, dz = x[point] - center[0], y[point] - center[1], z[point] - center[2]
            squared = dx * dx + dy * dy + dz * dz
            if squared < nearest_squared:
                nearest, nearest_squared = point, squared
    near = (x[nearest] - center[0], y[nearest] - center[1], z[nearest] - center[2])
    limit_squared = _rival_limit_squared(nearest_squared, half, search)
    found = np.empty(256, np.int64)
    count = 0
    for column in range(len(columns)):
        first, last = _run(center, columns[column], limit_squared, points)
        for point in range(first, last):
            rival = (x[point] - center[0], y[point] - center[1], z[point] - center[2])
            in_reach = _gap_squared(rival[0], rival[1], rival[2], half) <= reach * reach * (1 + 1e-9)
            if in_reach and not _loses(rival, near, nearest_squared, half):
                if count == len(found):
                    found = np.append(found, np.empty(count, np.int64))
                found[count] = point
                count += 1
    return found[:count]


@njit(cache=True)
def _settle_box(center, half, only_open, limits, points, codes, rivals, needed):  # noqa: ANN001, ANN202
    """The box's answer if certain, else ``codes``; marks those of a cell's rivals that are nearest somewhere in it."""
    x, y, z, answers = points[:4]
    reach = limits[0]
    nearest, nearest_squared, met = -1, np.inf, False
    for point in rivals:
        dx, dy, dz = x[point] - center[0], y[point] - center[1], z[point] - center[2]
        squared = dx * dx + dy * dy + dz * dz
        if squared < nearest_squared:
            nearest, nearest_squared = point, squared
        met = met or _gap_squared(dx, dy, dz, half) <= reach * reach * (1 + 1e-9)
    if not met:
        return TOO_FAR_CODE
    near = (x[nearest] - center[0], y[nearest] - center[1], z[nearest] - center[2])
    certain = _within_reach(near, half, reach)
    wins = np.empty(len(rivals), np.bool_)
    for row, point in enumerate(rivals):
        rival = (x[point] - center[0], y[point] - center[1], z[point] - center[2])
        in_reach = _gap_squared(rival[0], rival[1], rival[2], half) <= reach * reach * (1 + 1e-9)
        wins[row] = in_reach and not _loses(rival, near, nearest_squared, half)
    for row, point in enumerate(rivals):
        rival = (x[point] - center[0], y[point] - center[1], z[point] - center[2])
        for other, winner in enumerate(rivals):
            if wins[row] and wins[other] and other != row:
                better = (x[winner] - center[0], y[winner] - center[1], z[winner] - center[2])
                better_squared = better[0] * better[0] + better[1] * better[1] + better[2] * better[2]
                wins[row] = not _loses(rival, better, better_squared, half)
        certain = certain and not (wins[row] and answers[point] != answers[nearest])
    if not (certain and only_open):
        needed |= wins
    return _code(answers[nearest], nearest_squared, limits, codes) if certain else codes


@njit(cache=True, inline="always")
def _code(answer, squared, limits, codes):  # noqa: ANN001, ANN202
    """Code of an answer at that distance: too far, near, or on the surface."""
    reach, _, surface = limits
    if squared > reach * reach:
        return TOO_FAR_CODE
    return answer if squared <= surface * surface else answer + codes // 2


@njit(cache=True, inline="always")
def _gap_squared(dx, dy, dz, half):  # noqa: ANN001, ANN202
    """Squared distance of a point, seen from a box's centre, to the box."""
    gap_x, gap_y, gap_z = max(abs(dx) - half, 0.0), max(abs(dy) - half, 0.0), max(abs(dz) - half, 0.0)
    return gap_x * gap_x + gap_y * gap_y + gap_z * gap_z


@njit(cache=True, inline="always")
def _within_reach(near, half, reach):  # noqa: ANN001, ANN202
    """Whether that point, seen from the centre, is within reach of every place in the box."""
    far_x, far_y, far_z = abs(near[0]) + half, abs(near[1]) + half, abs(near[2]) + half
    return far_x * far_x + far_y * far_y + far_z * far_z <= reach * reach * (1 - 1e-9)


@njit(cache=True, inline="always")
def _loses(p, q, q_squared, half):  # noqa: ANN001, ANN202
    """Whether a point p is farther than a point q everywhere in the box.

    |u - p|^2 - |u - q|^2 is linear in u, so the box's worst corner decides: |p|^2 - |q|^2 - 2 half |p - q|_1 > 0, seen
    from the centre. A tie does not lose.
    """
    lead = p[0] * p[0] + p[1] * p[1] + p[2] * p[2] - q_squared
    spread = abs(p[0] - q[0]) + abs(p[1] - q[1]) + abs(p[2] - q[2])
    return lead - 2 * half * spread > 1e-9 * half * half


@njit(cache=True, inline="always")
def _rival_limit_squared(nearest_squared, half, search):  # noqa: ANN001, ANN202
    """Points farther than the box's diagonal behind the nearest one always lose."""
    return min(search, np.sqrt(nearest_squared) + 2 * np.sqrt(3.0) * half) ** 2


@njit(cache=True, inline="always")
def _run(center, column, limit_squared, points):  # noqa: ANN001, ANN202
    """Range of the sorted points in that column of voxels (a step in x and y) that may lie within the limit."""
    starts, mask, edge = points[4:7]
    voxel_x = np.int64(np.floor(center[0] / edge)) + column[0]
    voxel_y = np.int64(np.floor(center[1] / edge)) + column[1]
    gap_x = max(voxel_x * edge - center[0], center[0] - (voxel_x + 1) * edge, 0.0)
    gap_y = max(voxel_y * edge - center[1], center[1] - (voxel_y + 1) * edge, 0.0)
    rest = limit_squared * (1 + 1e-9) - gap_x * gap_x - gap_y * gap_y
    if rest < 0:
        return 0, 0
    low = np.int64(np.floor((center[2] - np.sqrt(rest)) / edge))
    high = np.int64(np.floor((center[2] + np.sqrt(rest)) / edge))
    bucket = (voxel_x * 73856093 + voxel_y * 19349663 + low) & mask
    return starts[bucket], starts[bucket + high - low + 1]
