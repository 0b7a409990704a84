"""The table that answers most point queries: a two-level grid of cells, each with its answer and whether it is certain.

A cell is certain when every point in it has the same answer: the nearest cloud point's instance, or "too far". Cells
lie in bricks of 8^3, stored only where some point is within reach. What a cell cannot promise (it is cut by the border
of two instances, or by the reach) is marked, and holds the answer at its centre: ``og_pointcloud.nearest`` settles
queries there exactly.
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

__all__ = ["BRICK", "CELLS_PER_BRICK", "CODE_OFFSET", "TOO_FAR_CODE", "BrickGrid", "build_brick_grid"]

BRICK = 8
"""Cells along the edge of a brick."""
CELLS_PER_BRICK = BRICK**3
TOO_FAR_CODE = 0
"""Answer code of a query with no cloud point within reach; the others are instance id + CODE_OFFSET."""
CODE_OFFSET = 1 - UNOBSERVED

CELL_PER_SPACING = 1.5
"""Size of a cell in point spacings: smaller cells leave fewer queries open, and cost size with the third power."""
CELLS_PER_REACH = 3.0
"""A far reach makes cells larger, so that the layer of cells around a surface stays at most about eight deep."""
TOP_ENTRIES_PER_POINT, TOP_ENTRIES_AT_LEAST = 2, 1 << 16
BRICKS_PER_POINT, BRICKS_AT_LEAST = 1 / 16, 1 << 10
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
    cells: (rows, 512) unsigned, C order within the brick. A value below ``codes`` is certain, else ``value - codes`` is
        the answer at the cell's centre. An answer is TOO_FAR_CODE, or instance id + CODE_OFFSET. codes: their number.
    """

    low: NDArray[np.float32]
    cell_size: np.float32
    bricks: NDArray[np.unsignedinteger]
    cells: NDArray[np.unsignedinteger]
    codes: int


def build_brick_grid(cloud: LabelledCloud) -> BrickGrid:
    """The grid of a cloud. Its size is bounded by the number of points, not by the extent of the scene."""
    codes = len(cloud.instances) + CODE_OFFSET
    cell_size = np.float32(max(CELL_PER_SPACING * cloud.spacing, cloud.reach / CELLS_PER_REACH))
    low, shape, whole = _grid_box(cloud, float(cell_size))
    touched, kept = _bricks_within_reach(cloud, low, shape, float(cell_size))
    cells = _classify_bricks(cloud, low, shape, float(cell_size), kept)

    shared = np.array([[TOO_FAR_CODE], [TOO_FAR_CODE + codes]], np.int32).repeat(CELLS_PER_BRICK, axis=1)
    stored, row = np.unique(cells, axis=0, return_inverse=True)
    bricks = np.full(shape, _FAR_BRICK if whole else _OPEN_BRICK, np.int64)
    bricks[1:-1, 1:-1, 1:-1] = _FAR_BRICK
    bricks.flat[touched] = _OPEN_BRICK
    bricks.flat[kept] = row.ravel() + len(shared)
    return BrickGrid(low, cell_size, _compact(bricks), _compact(np.concatenate([shared, stored])), codes)


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


def _inner(brick: NDArray[np.float64], shape: tuple[int, int, int]) -> tuple[NDArray[np.int64], ...]:
    """Indices of those bricks (n, 3) that lie in the grid and not in its outermost layer."""
    inside = ((brick >= 1) & (brick <= np.array(shape) - 2)).all(axis=1)
    return tuple(brick[inside].astype(np.int64).T)


def _classify_bricks(
    cloud: LabelledCloud, low: NDArray[np.float32], shape: tuple[int, int, int], cell_size: float, bricks: NDArray
) -> NDArray[np.int32]:
    """(len(bricks), 512) values of the cells of bricks, given as flat indices."""
    # The graph computes cell indices in float32: boxes are inflated by what rounding can move a query.
    rounding = 4 * float(np.finfo(np.float32).eps) * max(shape) * BRICK
    half = cell_size * (0.5 + rounding)
    search = cloud.reach + np.sqrt(3) * half
    steps = int(np.ceil(search / cell_size))
    columns = np.array(
        sorted(product(range(-steps, steps + 1), repeat=2), key=lambda step: step[0] ** 2 + step[1] ** 2)
    )
    buckets = VoxelBuckets(cloud.xyz, cell_size, run=2 * steps + 2)
    corners = np.stack(np.unravel_index(bricks, shape), axis=1) * (cell_size * BRICK) + low.astype(np.float64)
    values = np.empty((len(bricks), CELLS_PER_BRICK), np.int32)
    answers = cloud.instance_ids[buckets.point] + np.int32(CODE_OFFSET)
    points = (buckets.x, buckets.y, buckets.z, answers, buckets.starts, buckets.mask)
    codes = len(cloud.instances) + CODE_OFFSET
    _classify(corners, cell_size, half, cloud.reach, search, columns, points, codes, values)
    return values


@njit(cache=True, parallel=True)
def _classify(corners, cell_size, half, reach, search, columns, points, codes, values):  # noqa: ANN001, ANN202
    """Fill values (bricks, 512): the answer at each cell's centre, plus ``codes`` where it is not the whole cell's."""
    for brick in prange(len(corners)):
        for cell in range(values.shape[1]):
            center_x = corners[brick, 0] + (cell // (BRICK * BRICK) + 0.5) * cell_size
            center_y = corners[brick, 1] + (cell // BRICK % BRICK + 0.5) * cell_size
            center_z = corners[brick, 2] + (cell % BRICK + 0.5) * cell_size
            center = (center_x, center_y, center_z)
            values[brick, cell] = _cell_value(center, cell_size, half, reach, search, columns, points, codes)


@njit(cache=True)
def _cell_value(center, cell_size, half, reach, search, columns, points, codes):  # noqa: ANN001, ANN202
    """Value of the cell with this centre and half edge; see ``BrickGrid.cells``."""
    x, y, z, answers, _, _ = points
    # The point nearest to the centre, and whether any point is within reach of any part of the cell.
    nearest, nearest_squared, met = -1, np.inf, False
    limit_squared = search * search
    for column in range(len(columns)):
        first, last = _run(center, columns[column], cell_size, limit_squared, points)
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
    # A point p loses to the nearest point q in the whole cell if |u - p|^2 - |u - q|^2, which is linear in u, is
    # positive at the cell's worst corner: |p|^2 - |q|^2 - 2 half |p - q|_1 > 0, seen from the centre. Points farther
    # than the cell's diagonal behind q always lose.
    limit_squared = min(search, np.sqrt(nearest_squared) + 2 * np.sqrt(3.0) * half) ** 2
    for column in range(len(columns)):
        first, last = _run(center, columns[column], cell_size, limit_squared, points) if certain else (0, 0)
        for point in range(first, last):
            if answers[point] != answers[nearest]:
                dx, dy, dz = x[point] - center[0], y[point] - center[1], z[point] - center[2]
                lead = dx * dx + dy * dy + dz * dz - nearest_squared
                spread = abs(dx - near_x) + abs(dy - near_y) + abs(dz - near_z)
                certain = certain and lead - 2 * half * spread > 1e-9 * cell_size * cell_size
    answer = answers[nearest] if nearest_squared <= reach * reach else TOO_FAR_CODE
    return answer if certain else answer + codes


@njit(cache=True, inline="always")
def _run(center, column, cell_size, limit_squared, points):  # noqa: ANN001, ANN202
    """Range of the sorted points in that column of voxels (a step in x and y) that may lie within the limit."""
    _, _, _, _, starts, mask = points
    voxel_x = np.int64(np.floor(center[0] / cell_size)) + column[0]
    voxel_y = np.int64(np.floor(center[1] / cell_size)) + column[1]
    gap_x = max(voxel_x * cell_size - center[0], center[0] - (voxel_x + 1) * cell_size, 0.0)
    gap_y = max(voxel_y * cell_size - center[1], center[1] - (voxel_y + 1) * cell_size, 0.0)
    rest = limit_squared * (1 + 1e-9) - gap_x * gap_x - gap_y * gap_y
    if rest < 0:
        return 0, 0
    low = np.int64(np.floor((center[2] - np.sqrt(rest)) / cell_size))
    high = np.int64(np.floor((center[2] + np.sqrt(rest)) / cell_size))
    bucket = (voxel_x * 73856093 + voxel_y * 19349663 + low) & mask
    return starts[bucket], starts[bucket + high - low + 1]
