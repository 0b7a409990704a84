"""What the cloud's points know about proposals: which of them other views confirm.

A proposal is the set of points that show in it. In another view that sees enough of these points, the best IoU of the
set with any proposal there is taken, counted on the points that both views see; its mean over the views is the
proposal's agreement. One sparse product a view gives its intersections with all proposals of all other views.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, vstack

from og_pointcloud.formats.images import require_cv2
from og_pointcloud.masking.contracts import Proposals
from og_pointcloud.scene import Camera

__all__ = ["ProposedPoints", "agreement", "points_of_proposals", "rendered_depth", "rescored"]

DEPTH_SIDE = 320
"""Depth for the visibility test is drawn at so many pixels along the longer side."""
BEHIND, SPACINGS_BEHIND = 0.03, 2.0
"""A point is seen that lies behind the drawn surface by at most this share of its depth, and so many spacings."""
ENOUGH_SHARE, ENOUGH_POINTS = 0.5, 5
"""A view counts for a proposal of which it sees at least this share of the points, and so many."""
FLOATER = 3.0
"""Points whose spacing is more than so many times the median are no surface and are not drawn."""
WIDEST_PX = 6
"""A point is drawn at most so many pixels to each side."""


@dataclass(frozen=True)
class ProposedPoints:
    """seen: (k,) int32 ascending, the points that a view sees. inside: (M, k) bool, which of them show in each mask."""

    seen: NDArray[np.int32]
    inside: NDArray[np.bool_]

    def sets(self, count: int) -> csr_array:
        """(M, count) float32, 1 where a point of the cloud shows in a proposal."""
        proposal, place = np.nonzero(self.inside)
        ones = np.ones(len(place), np.float32)
        return csr_array((ones, (proposal, self.seen[place])), shape=(len(self.inside), count))


def points_of_proposals(
    proposals: Proposals,
    xyz: NDArray[np.float32],
    spacing: NDArray[np.float32],
    asked: NDArray[np.int64],
    camera: Camera,
) -> ProposedPoints:
    """What a view's proposals are as sets of points.

    xyz: (n, 3) in the frame that ``camera.world_to_camera`` starts from; spacing: (n,). asked: rows of the points that
    stand for the cloud; all of it hides them. ``seen`` counts them 0, 1, 2...
    """
    shrink = min(1.0, DEPTH_SIDE / max(camera.width, camera.height))
    small = camera.resized(max(1, round(camera.width * shrink)), max(1, round(camera.height * shrink)))
    depth = rendered_depth(xyz, spacing, small)
    uv_px, z = camera.project(xyz[asked])
    front = np.flatnonzero(camera.shows(uv_px))
    (u, v), z = uv_px[front].T, z[front]
    column, row = (u * small.width / camera.width).astype(np.int64), (v * small.height / camera.height).astype(np.int64)
    surface = depth[row, column]
    seen = (surface > 0) & (z <= (1 + BEHIND) * surface + SPACINGS_BEHIND * spacing[asked][front])
    inside = proposals.masks[:, v[seen].astype(np.int64), u[seen].astype(np.int64)]
    return ProposedPoints(front[seen].astype(np.int32), inside)


def agreement(views: Sequence[ProposedPoints], count: int) -> list[NDArray[np.float64]]:
    """For each view (M,) in [0, 1], NaN where no other view can tell. count: points that ``seen`` counts.

    The order of the views does not matter. Memory: the sets, and one view's intersections with all proposals.
    """
    sets = [view.sets(count) for view in views]
    every = csr_array(vstack(sets))
    points_to_every = csr_array(every.T)
    sight = csr_array(
        (
            np.ones(sum(len(view.seen) for view in views), np.float32),
            np.concatenate([view.seen for view in views]),
            np.cumsum([0, *(len(view.seen) for view in views)]),
        ),
        shape=(len(views), count),
    )
    view_of = np.repeat(np.arange(len(views)), [len(view.inside) for view in views])
    with_proposals, first = np.unique(view_of, return_index=True)
    found = []
    for index, mine in enumerate(sets):
        shared = (mine @ points_to_every).toarray()
        mine_seen = (mine @ sight.T).toarray()  # (M, views)
        theirs_seen = every @ sight[[index]].toarray()[0]
        union = mine_seen[:, view_of] + theirs_seen - shared
        iou = shared / np.maximum(union, 1)
        best = np.zeros(mine_seen.shape)  # float64 adds up float32 without rounding: views may come in any order
        if len(first):
            best[:, with_proposals] = np.maximum.reduceat(iou, first, axis=1)
        size = mine_seen[:, index : index + 1]
        sees_enough = (mine_seen >= ENOUGH_SHARE * size) & (mine_seen >= ENOUGH_POINTS)
        sees_enough[:, index] = False
        count_of_views = sees_enough.sum(axis=1)
        total = np.where(sees_enough, best, 0).sum(axis=1)
        found.append(np.where(count_of_views > 0, total / np.maximum(count_of_views, 1), np.nan))
    return found


def rescored(scores: NDArray[np.float32], agreed: NDArray[np.float64], usual: float) -> NDArray[np.float32]:
    """(M,) agreement times the root of the proposer's score, which counts less: it knows one image alone.

    usual: the agreement of what no other view can tell.
    """
    return (np.where(np.isnan(agreed), usual, agreed) * np.sqrt(np.maximum(scores, 0))).astype(np.float32)


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
