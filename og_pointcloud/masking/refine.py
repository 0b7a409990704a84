"""What the points know about masks: where depth breaks off, how small a mask they still resolve."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.formats.images import require_cv2
from og_pointcloud.masking.contracts import Proposals
from og_pointcloud.scene import Camera

__all__ = ["depth_edges", "rendered_depth", "smallest_mask_px", "split_at_depth_edges"]

FLOATER = 3.0
"""Points whose spacing is more than so many times the median are no surface and are not drawn."""
WIDEST_PX = 6
"""A point is drawn at most so many pixels to each side."""
STEP = 0.05
"""Relative step of depth between neighbours three pixels apart that is an edge."""
EDGE_REACH_PX = 2
PART = 0.15
"""A part of a mask that is cut off counts when it is more than this share of the mask."""
POINTS_PER_MASK = 4
"""A mask on which fewer points have room is dropped."""


def rendered_depth(xyz: NDArray[np.float32], spacing: NDArray[np.float32], camera: Camera) -> NDArray[np.float32]:
    """(H, W) float32 depth of the nearest points, 0 where there are none. Each point is a square of its spacing.

    xyz: (n, 3) in the frame that ``camera.world_to_camera`` starts from. spacing: (n,).
    """
    xyz, spacing = xyz[spacing <= FLOATER * np.median(spacing)], spacing[spacing <= FLOATER * np.median(spacing)]
    uv_px, z = camera.project(xyz)
    u, v = uv_px.T
    inside = (u >= -WIDEST_PX) & (u < camera.width + WIDEST_PX) & (v >= -WIDEST_PX) & (v < camera.height + WIDEST_PX)
    order = np.flatnonzero(inside)[np.argsort(-z[inside], kind="stable")]  # far to near: the last one drawn stays
    column, row, z = u[order].astype(np.int64), v[order].astype(np.int64), z[order]
    reach = np.clip(np.ceil(0.7 * spacing[order] * camera.fx / z - 0.5), 0, WIDEST_PX)
    depth = np.full((camera.height, camera.width), np.inf, np.float32)
    for shift_y in range(-WIDEST_PX, WIDEST_PX + 1):
        for shift_x in range(-WIDEST_PX, WIDEST_PX + 1):
            at_x, at_y = column + shift_x, row + shift_y
            drawn = (reach >= max(abs(shift_x), abs(shift_y))) & (at_x >= 0) & (at_x < camera.width)
            drawn &= (at_y >= 0) & (at_y < camera.height)
            layer = np.full_like(depth, np.inf)
            layer[at_y[drawn], at_x[drawn]] = z[drawn]
            np.minimum(depth, layer, out=depth)
    depth[np.isinf(depth)] = 0
    return np.asarray(require_cv2().medianBlur(depth, 5), np.float32)


def depth_edges(depth: NDArray[np.float32]) -> NDArray[np.bool_]:
    """(H, W): where depth steps by more than `STEP` and more than the slopes beside it explain."""
    edges = np.zeros(depth.shape, np.bool_)
    reach = EDGE_REACH_PX
    for along, out in ((depth, edges), (depth.T, edges.T)):
        if along.shape[1] <= 4 * reach:
            continue
        a, b, c, d = (along[:, k * reach : along.shape[1] - (3 - k) * reach] for k in range(4))
        known = (a > 0) & (b > 0) & (c > 0) & (d > 0)
        beyond_slope = np.abs(c - b) - np.minimum(np.abs(b - a), np.abs(d - c))
        out[:, reach + 1 : reach + 1 + a.shape[1]] |= known & (beyond_slope > STEP * np.minimum(b, c))
    return edges


def split_at_depth_edges(proposals: Proposals, depth: NDArray[np.float32]) -> Proposals:
    """Masks that a depth edge cuts in two or more large parts become these parts, with the mask's score."""
    cv2 = require_cv2()
    edges = depth_edges(depth)
    masks, scores = [], []
    for mask, score in zip(proposals.masks, proposals.scores, strict=True):
        parts = [mask]
        if (mask & edges).any():
            count, labels, stats, _ = cv2.connectedComponentsWithStats((mask & ~edges).astype(np.uint8), connectivity=4)
            large = [k for k in range(1, count) if stats[k, cv2.CC_STAT_AREA] > PART * mask.sum()]
            parts = [_grown(labels == k, mask) for k in large] if len(large) > 1 else parts
        masks += parts
        scores += [score] * len(parts)
    return Proposals(np.array(masks, np.bool_).reshape(-1, *depth.shape), np.array(scores, np.float32))


def _grown(part: NDArray[np.bool_], mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The part with its side of the edge, which was cut away."""
    side = 2 * EDGE_REACH_PX - 1
    return require_cv2().dilate(part.astype(np.uint8), np.ones((side, side), np.uint8)).astype(np.bool_) & mask


def smallest_mask_px(xyz: NDArray[np.float32], spacing: NDArray[np.float32], camera: Camera) -> int:
    """Pixels that a mask needs for `POINTS_PER_MASK` points to have room on it, at the depth of the median point."""
    uv_px, depth = camera.project(xyz)
    shown = camera.shows(uv_px)
    if not shown.any():
        return 1
    px_per_spacing = float(np.median(camera.fx * spacing[shown] / depth[shown]))
    return max(1, round(POINTS_PER_MASK * px_per_spacing**2))
