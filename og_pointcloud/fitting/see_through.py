"""What a mask shows behind its object: removed before anything is decided."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from og_pointcloud.fitting.holes import seen_through_holes
from og_pointcloud.fitting.mask_table import MaskTable
from og_pointcloud.fitting.memory import scratch_like
from og_pointcloud.kernels import get_num_threads, njit
from og_pointcloud.rendering.splatting import Gaussians, depth_and_slopes
from og_pointcloud.scene import Camera
from og_pointcloud.settings import MembershipSettings

SEEN_THROUGH_SHARE = 0.1
"""Share of a weight seen through a hole that counts. Not 0, so that points that are only ever seen through holes are
still decided by the views that see them."""


def without_see_through(
    table: MaskTable,
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    settings: MembershipSettings,
) -> tuple[MaskTable, float]:
    """Remove from each mask what does not lie at its object's depth, mostly behind it. The view is then blind to that:
    it says neither "in the mask" nor "not". What shows through holes of the object keeps SEEN_THROUGH_SHARE of its
    weight (holes.py).

    A mask shows a front surface. Sorted by depth, its points fall into runs, separated by gaps wider than a share of
    the object's apparent size. The nearest run with a fair part of the mask's weight is the object. What lies behind it
    was seen through windows, past edges, between the sparse points of the object, or, with a LiDAR that looks over a
    camera's foreground, not seen by the camera at all. Other views do not always contradict such a mask: a camera that
    moves straight ahead, or stands still, looks past the same edges in all of them. A smaller run in front of the
    object is the edge of something that stands there.

    cameras: of the table's views.
    Returns the table without those weights and with its exposure reduced as much (what came through holes is kept as
    doubted), and their share of all weight. It replaces the given one, whose weights and exposure are overwritten.
    """
    weights, views = table.weights, len(cameras)
    first_mask, kept = np.searchsorted(table.mask_view, np.arange(views + 1)), np.ones(weights.nnz, np.float32)

    def removed_in(view: int) -> float:
        camera, removed = cameras[view], 0.0
        focal = np.sqrt(camera.fx * camera.fy)
        for mask in range(first_mask[view], first_mask[view + 1]):
            entries = slice(weights.indptr[mask], weights.indptr[mask + 1])
            depth, xy = _rays(gaussians.xyz, weights.indices[entries], camera.world_to_camera)
            area = table.mask_pixels[mask] / focal**2
            kept[entries] = _weight_factors(depth, xy, weights.data[entries], area, settings)
            removed += float(((1 - kept[entries]) * weights.data[entries]).sum(dtype=np.float64))
        return removed

    with ThreadPoolExecutor(get_num_threads()) as pool:
        removed = sum(pool.map(removed_in, range(views)))
    if removed == 0:
        return table, 0.0
    share = removed / float(weights.data.sum(dtype=np.float64))
    exposure_factor = scratch_like(table.exposure.data, np.float32)
    through = _exposure_factors(
        first_mask,
        *((matrix.indptr, matrix.indices, matrix.data) for matrix in (weights, table.outside, table.exposure)),
        kept,
        weights.shape[1],
        exposure_factor,
    )
    exposure = _scaled(table.exposure, exposure_factor)
    through = csr_array(through, shape=exposure.shape)
    return replace(table, weights=_scaled(weights, kept), exposure=exposure, doubted=through), share


@njit(cache=True, nogil=True, error_model="numpy")
def _rays(xyz, points, pose):  # noqa: ANN001, ANN202
    """(n,) depths of these points, and (n, 2) their places in an image at depth 1."""
    depth, xy = np.empty(len(points)), np.empty((len(points), 2))
    for i, g in enumerate(points):
        depth[i], xy[i, 0], xy[i, 1] = depth_and_slopes(xyz[g, 0], xyz[g, 1], xyz[g, 2], pose)
    return depth, xy


def _weight_factors(
    depth: NDArray[np.float64],
    xy: NDArray[np.float64],
    weight: NDArray[np.float32],
    area: float,
    settings: MembershipSettings,
) -> NDArray[np.float32]:
    """(n,) float32, the share of each point's weight in a mask that counts. depth, xy: from `_rays`. area: of the mask,
    in an image at depth 1."""
    kept, size, share = np.zeros(len(depth), np.float32), np.sqrt(area), settings.front_share
    if len(depth):
        order = np.argsort(depth)
        depth, weight = depth[order], weight[order]
        # First the object as a whole, by large gaps; then, within it, what shows through its holes, by small ones.
        front = slice(*_front_run(depth, weight, settings.gap_sizes * size, share))
        order, depth, weight = order[front], depth[front], weight[front]
        gap = settings.hole_sizes * size * (depth[(len(depth) - 1) // 2] + depth[len(depth) // 2]) / 2  # the median's
        kept[order] = 1
        kept[order[seen_through_holes(xy[order], depth, weight, area, gap, share)]] = SEEN_THROUGH_SHARE
    return kept


@njit(cache=True, nogil=True)
def _front_run(depth, weight, gap_share, front_share):  # noqa: ANN001, ANN202
    """(begin, end) of the first run of ascending depths with ``front_share`` of the weight, else of the first of all.

    All else lies behind it, or in small runs before it. Runs are separated by gaps of ``gap_share`` times the median
    depth, which scales with the size of the mask at that depth.
    """
    reached = np.cumsum(weight.astype(np.float64))
    gap = gap_share * depth[np.searchsorted(reached, 0.5 * reached[-1])]
    # begin: where the current run begins; before: the weight of all runs before it; first: where the first run ends.
    first, begin, before = len(depth), 0, 0.0
    for k in range(1, len(depth) + 1):
        if k < len(depth) and not depth[k] - depth[k - 1] > gap:
            continue
        if reached[k - 1] - before >= front_share * reached[-1]:
            return begin, k
        first, begin, before = min(first, k), k, reached[k - 1]
    return 0, first


@njit(cache=True)
def _exposure_factors(first_mask, weights, outside, exposure, kept, n, exposure_factor):  # noqa: ANN001, ANN202
    """Writes to ``exposure_factor`` (entries of exposure,) the share of what a view shows of a point that is not behind
    its masks' objects, exactly 0 where all of it is. Returns the exposure removed by holes, as data, columns and row
    starts of a sparse matrix."""
    weight_start, weight_index, weight = weights
    outside_start, outside_index, outside_weight = outside
    start, index, exposed = exposure
    # For each point, in one view: all weight, the weight removed, and the part of that removed behind a hole.
    shown, hidden, behind_hole = np.zeros(n), np.zeros(n), np.zeros(n)
    most, end = np.sum((kept > 0) & (kept < 1)), 0
    through, through_index, through_start = np.empty(most, np.float32), np.empty(most, np.int32), start.copy()
    for view in range(len(first_mask) - 1):
        for e in range(weight_start[first_mask[view]], weight_start[first_mask[view + 1]]):
            shown[weight_index[e]] += weight[e]
            lost = weight[e] * (1 - kept[e])
            hidden[weight_index[e]] += lost
            behind_hole[weight_index[e]] += lost if kept[e] > 0 else 0
        for e in range(outside_start[view], outside_start[view + 1]):
            shown[outside_index[e]] += outside_weight[e]
        # A view exposes all that it shows, so this resets all sums to zero for the next view.
        for e in range(start[view], start[view + 1]):
            g = index[e]
            exposure_factor[e] = 1 - hidden[g] / shown[g] if hidden[g] > 0 else 1
            # Masks may still be compared by what shows through holes (`MaskTable.with_doubted`).
            if behind_hole[g] > 0:
                through[end], through_index[end] = exposed[e] * behind_hole[g] / shown[g], g
                end += 1
            shown[g], hidden[g], behind_hole[g] = 0.0, 0.0, 0.0
        through_start[view + 1] = end
    return through[:end], through_index[:end], through_start


def _scaled(matrix: csr_array, factor: NDArray[np.float32]) -> csr_array:
    """The matrix with each entry times its factor, without those that are 0 then; in the same memory."""
    columns, values = matrix.indices, matrix.data
    starts = _scale(matrix.indptr, columns, values, factor)
    return csr_array((values[: starts[-1]], columns[: starts[-1]], starts), shape=matrix.shape)


@njit(cache=True)
def _scale(indptr, columns, values, factor):  # noqa: ANN001, ANN202
    """Scales the entries and moves those that are left to the front. Returns where rows begin."""
    starts = np.zeros(len(indptr), np.int32)
    end = 0
    for row in range(len(indptr) - 1):
        for e in range(indptr[row], indptr[row + 1]):
            if factor[e] > 0:
                columns[end], values[end] = columns[e], values[e] * factor[e]
                end += 1
        starts[row + 1] = end
    return starts
