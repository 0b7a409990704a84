"""The table that answers most point queries: a grid of cells, each with its answer and whether it is certain.

A cell is certain when every point in it has the same answer: the nearest cloud point's instance, or "too far". Cells
lie in bricks of 8^3, stored only where some point is within reach. An open cell, cut by the border of two instances or
by the reach, is split into 4^3 parts if cloud points lie in it, as queries come where the cloud is. A cell or part that
stays open is marked, and holds the answer at its centre: ``og_pointcloud.nearest`` settles queries there exactly.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.cloud import UNOBSERVED, LabelledCloud
from og_pointcloud.errors import MissingExtraError
from og_pointcloud.nearest import VoxelBuckets

try:
    from numba import njit, prange
except ImportError as error:
    raise MissingExtraError("numba", "fit") from error

__all__ = ["BRICK", "CODE_OFFSET", "PARTS", "TOO_FAR_CODE", "BrickGrid", "build_brick_grid"]

BRICK = 8
"""Cells along the edge of a brick."""
PARTS = 4
"""Parts along the edge of a cell that is split."""
TOO_FAR_CODE = 0
"""Answer code of a query with no cloud point within reach; the others are instance id + CODE_OFFSET."""
CODE_OFFSET = 1 - UNOBSERVED

CELL_PER_SPACING = 1.5
"""Size of a cell in point spacings: smaller cells leave fewer queries open, and cost size with the third power."""
CELLS_PER_REACH = 3.0
"""A far reach makes cells larger, so that the layer of cells around a surface stays at most about eight deep."""
TOP_ENTRIES_PER_POINT, TOP_ENTRIES_AT_LEAST = 2, 1 << 16
BRICKS_PER_POINT, BRICKS_AT_LEAST = 1 / 16, 1 << 10
SPLIT_CELLS_PER_POINT, SPLIT_CELLS_AT_LEAST = 1 / 8, 1 << 10
"""What bounds the table whatever the extent of the scene: the rest is left to the exact search."""
BRICKS_PER_AXIS = 1 << 16
"""So long a grid still has its cell indices right to half a cell in float32."""

# Two bricks that many entries of the top level share: all too far, and all open.
_FAR_BRICK, _OPEN_BRICK = 0, 1


@dataclass(frozen=True)
class BrickGrid:
    """Cell (i, j, k) covers low + (i, j, k) * cell_size and one cell_size more, in the local frame.

    low: (3,) float32. cell_size: float32. bricks: (bx, by, bz) unsigned, rows of ``cells``; its outermost layer stands
        for everything beyond the grid.
    cells: (rows, 512) unsigned, C order within the brick. A value below ``codes`` is a certain answer; one below
        ``2 codes`` is open, and ``value - codes`` the answer at the centre; of any other, ``value - 2 codes`` is a row
        of ``parts``.
    parts: (rows, 64) unsigned, C order within the cell: certain answers, or open ones.
    codes: number of answers. An answer is TOO_FAR_CODE, or instance id + CODE_OFFSET.
    """

    low: NDArray[np.float32]
    cell_size: np.float32
    bricks: NDArray[np.unsignedinteger]
    cells: NDArray[np.unsignedinteger]
    parts: NDArray[np.unsignedinteger]
    codes: int


def build_brick_grid(cloud: LabelledCloud) -> BrickGrid:
    """The grid of a cloud. Its size is bounded by the number of points, not by the extent of the scene."""
    codes = len(cloud.instances) + CODE_OFFSET
    cell_size = np.float32(max(CELL_PER_SPACING * cloud.spacing, cloud.reach / CELLS_PER_REACH))
    low, shape, whole = _grid_box(cloud, float(cell_size))
    touched, kept = _bricks_within_reach(cloud, low, shape, float(cell_size))
    # The graph computes cell indices in float32: every box is inflated by what rounding can move a query.
    rounding = float(cell_size) * 4 * float(np.finfo(np.float32).eps) * max(shape) * BRICK
    classify = _Classifier(cloud, float(cell_size), rounding)
    corners = low.astype(np.float64) + float(cell_size) * BRICK * np.stack(np.unravel_index(kept, shape), axis=1)
    cells = classify(corners, BRICK, float(cell_size))
    brick, cell = _cells_worth_splitting(cloud, low, shape, float(cell_size), kept, cells >= codes)
    place = np.stack(np.unravel_index(cell, (BRICK,) * 3), axis=1)
    parts = classify(corners[brick] + float(cell_size) * place, PARTS, float(cell_size) / PARTS)
    cells[brick, cell] = 2 * codes + np.arange(len(parts))

    shared = np.array([[TOO_FAR_CODE], [TOO_FAR_CODE + codes]], np.int32).repeat(BRICK**3, axis=1)
    stored, row = np.unique(cells, axis=0, return_inverse=True)
    bricks = np.full(shape, _FAR_BRICK if whole else _OPEN_BRICK, np.int64)
    bricks[1:-1, 1:-1, 1:-1] = _FAR_BRICK
    bricks.flat[touched] = _OPEN_BRICK
    bricks.flat[kept] = row.ravel() + len(shared)
    parts = np.concatenate([parts, np.zeros((1, PARTS**3), np.int32)])  # never empty: the graph reads a row of it
    cells = np.concatenate([shared, stored])
    return BrickGrid(low, cell_size, _compact(bricks), _compact(cells), _compact(parts), codes)


def _compact(values: NDArray[np.integer]) -> NDArray[np.unsignedinteger]:
    return values.astype(np.min_scalar_type(int(values.max())))


def _grid_box(cloud: LabelledCloud, cell_size: float) -> tuple[NDArray[np.float32], tuple[int, int, int], bool]:
    """Low corner, bricks per axis (both with the outermost layer), and whether every point within reach lies inside.

    A scene with far outliers gets a grid around its bulk only.
    """
    if len(cloud) == 0:
        return np.zeros(3, np.float32), (3, 3, 3), True
    allowed = max(TOP_ENTRIES_PER_POINT * len(cloud), TOP_ENTRIES_AT_LEAST)
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
    # Half a cell for rounding. The box around a point is shorter than a brick, so its corners meet all its bricks.
    reach = (cloud.reach + 0.5 * cell_size) / edge
    touched = np.zeros(shape, np.int64)
    for corner in product((-reach, reach), repeat=3):
        touched[_inner(np.floor(relative + corner), shape)] = 1
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


def _cells_worth_splitting(
    cloud: LabelledCloud,
    low: NDArray[np.float32],
    shape: tuple[int, int, int],
    cell_size: float,
    kept: NDArray[np.int64],
    is_open: NDArray[np.bool_],
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Brick (an index of ``kept``) and cell of the open cells that hold points; the fullest, if they are too many."""
    cell = np.floor((cloud.xyz - low.astype(np.float64)) / cell_size)
    cell = np.stack(_inner(cell / BRICK, shape, cell), axis=1)
    brick = np.ravel_multi_index(tuple((cell // BRICK).T), shape)
    row = np.searchsorted(kept, brick)
    found = np.append(kept, -1)[row] == brick
    inside = np.ravel_multi_index(tuple((cell % BRICK).T), (BRICK,) * 3)
    address, count = np.unique((row * BRICK**3 + inside)[found], return_counts=True)
    address, count = (values[is_open.flat[address]] for values in (address, count))
    allowed = int(max(SPLIT_CELLS_PER_POINT * len(cloud), SPLIT_CELLS_AT_LEAST))
    fullest = np.sort(address[np.argsort(-count, kind="stable")[:allowed]])
    return fullest // BRICK**3, fullest % BRICK**3


class _Classifier:
    """Finds the answers of boxes in one cloud.

    size: edge of the largest box, and of the voxels that points are sorted into. rounding: length by which every box is
    inflated on all sides.
    """

    def __init__(self, cloud: LabelledCloud, size: float, rounding: float) -> None:
        self._rounding, self._reach = rounding, float(cloud.reach)
        self._codes = len(cloud.instances) + CODE_OFFSET
        # Points farther than this from a box's centre are out of reach of all of it.
        self._search = cloud.reach + np.sqrt(3) * (size / 2 + rounding)
        steps = int(np.ceil(self._search / size))
        columns = product(range(-steps, steps + 1), repeat=2)
        self._columns = np.array(sorted(columns, key=lambda step: step[0] ** 2 + step[1] ** 2))
        buckets = VoxelBuckets(cloud.xyz, size, run=2 * steps + BRICK + 2)  # a line of a brick is searched at once
        answers = cloud.instance_ids[buckets.point] + np.int32(CODE_OFFSET)
        starts = buckets.starts.astype(np.int32)  # half the memory to run through
        self._points = (buckets.x, buckets.y, buckets.z, answers, starts, buckets.mask, buckets.edge)

    def __call__(self, corners: NDArray[np.float64], per_edge: int, size: float) -> NDArray[np.int32]:
        """(m, per_edge^3) int32, values of the boxes of edge ``size`` in the cubes with these low corners (m, 3)."""
        values = np.empty((len(corners), per_edge**3), np.int32)
        half = size / 2 + self._rounding
        _classify(
            corners, per_edge, size, half, self._reach, self._search, self._columns, self._points, self._codes, values
        )
        return values


@njit(cache=True, parallel=True)
def _classify(corners, per_edge, size, half, reach, search, columns, points, codes, values):  # noqa: ANN001, ANN202
    """Fill values: the answer at each box's centre, plus ``codes`` where it is not the whole box's."""
    # Boxes in lines along z: most lines of a brick meet no point at all, and say so once for all their boxes.
    for cube in prange(len(corners)):
        for line in range(per_edge * per_edge):
            x = corners[cube, 0] + (line // per_edge + 0.5) * size
            y = corners[cube, 1] + (line % per_edge + 0.5) * size
            first = line * per_edge
            if not _line_meets_a_point(x, y, corners[cube, 2], per_edge * size, search, columns, points):
                values[cube, first : first + per_edge] = TOO_FAR_CODE
                continue
            for box in range(per_edge):
                center = (x, y, corners[cube, 2] + (box + 0.5) * size)
                values[cube, first + box] = _box_value(center, half, reach, search, columns, points, codes)


@njit(cache=True)
def _line_meets_a_point(x, y, low, length, search, columns, points):  # noqa: ANN001, ANN202
    """Whether any point is within the search radius of a line of that length upwards from (x, y, low)."""
    xs, ys, zs, _, starts, mask, edge = points
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
def _box_value(center, half, reach, search, columns, points, codes):  # noqa: ANN001, ANN202
    """Value of the box with this centre and half edge; see ``BrickGrid.parts``."""
    x, y, z, answers, _, _, _ = points
    # The point nearest to the centre, and whether any point is within reach of any corner of the box.
    nearest, nearest_squared, met = -1, np.inf, False
    limit_squared = search * search
    for column in range(len(columns)):
        first, last = _run(center, columns[column], limit_squared, points)
        for point in range(first, last):
            dx, dy, dz = abs(x[point] - center[0]), abs(y[point] - center[1]), abs(z[point] - center[2])
            squared = dx * dx + dy * dy + dz * dz
            if squared < nearest_squared:
                nearest, nearest_squared = point, squared
            gap_x, gap_y, gap_z = max(dx - half, 0.0), max(dy - half, 0.0), max(dz - half, 0.0)
            met = met or gap_x * gap_x + gap_y * gap_y + gap_z * gap_z <= reach * reach * (1 + 1e-9)
        if met:
            limit_squared = min(limit_squared, nearest_squared)
    if not met:
        return TOO_FAR_CODE

    near_x, near_y, near_z = x[nearest] - center[0], y[nearest] - center[1], z[nearest] - center[2]
    far_x, far_y, far_z = abs(near_x) + half, abs(near_y) + half, abs(near_z) + half
    certain = far_x * far_x + far_y * far_y + far_z * far_z <= reach * reach * (1 - 1e-9)
    # A point p loses to the nearest point q in the whole box if |u - p|^2 - |u - q|^2, which is linear in u, is
    # positive at the box's worst corner: |p|^2 - |q|^2 - 2 half |p - q|_1 > 0, seen from the centre. Points farther
    # than the box's diagonal behind q always lose.
    limit_squared = min(search, np.sqrt(nearest_squared) + 2 * np.sqrt(3.0) * half) ** 2
    for column in range(len(columns)):
        first, last = _run(center, columns[column], limit_squared, points) if certain else (0, 0)
        for point in range(first, last):
            if answers[point] != answers[nearest]:
                dx, dy, dz = x[point] - center[0], y[point] - center[1], z[point] - center[2]
                lead = dx * dx + dy * dy + dz * dz - nearest_squared
                spread = abs(dx - near_x) + abs(dy - near_y) + abs(dz - near_z)
                certain = certain and lead - 2 * half * spread > 1e-9 * half * half
    answer = answers[nearest] if nearest_squared <= reach * reach else TOO_FAR_CODE
    return answer if certain else answer + codes


@njit(cache=True, inline="always")
def _run(center, column, limit_squared, points):  # noqa: ANN001, ANN202
    """Range of the sorted points in that column of voxels (a step in x and y) that may lie within the limit."""
    _, _, _, _, starts, mask, edge = points
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
