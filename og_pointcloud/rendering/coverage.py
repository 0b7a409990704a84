"""Which views a fit needs: where enough views see the same points, further ones add little and cost as much.

A wide lens shows the whole room from each place, a video shows it again with every frame. For a sample of the points,
each view's visible ones are found: those in its image that do not lie behind others. Then views are dropped one after
the other, as long as enough of the remaining views see nearly all points that the dropped view sees, and as many of
them have masks (of anything) on most points of each of its masks. So what only few views have masks of keeps them all.
Masks without a sampled point are ignored, and so is what the other views' masks show.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.journal import Journal, LeftOut
from og_pointcloud.kernels import get_num_threads, njit, prange
from og_pointcloud.rendering.geometry import sample_of_points
from og_pointcloud.rendering.splatting import depth_and_slopes
from og_pointcloud.scene import Camera, Scene, View

SAMPLE_POINTS = 8000
"""Points that stand for the whole cloud."""
MAX_RARE_SHARE = 0.05
"""Share of a view's points that too few other views may see: there are nearly always some at its border."""
POINTS_PER_CELL = 4
"""Mean number of points in a cell of a view's image: even of so few, one lies on the front surface."""
DEPTH_RATIO = 1.3
"""A point deeper than this times the nearest of its cell is hidden: a slanted surface goes nearly as deep in a cell."""


def with_needed_views(scene: Scene, enough: int, journal: Journal) -> Scene:
    """The scene without the views that it does not need; the choice depends on their names, not on their order."""
    order = np.argsort([zlib.crc32(view.name.encode()) for view in scene.views])
    xyz = scene.points.xyz[sample_of_points(scene.points.xyz, SAMPLE_POINTS)]
    seen = seen_points(xyz, [view.camera for view in scene.views])
    # Masks are read only where the cameras alone leave a choice.
    if needed_views(seen, np.full(seen.shape, -1, np.int32), order, enough).all():
        return scene
    needed = needed_views(seen, masks_at(xyz, seen, scene.views), order, enough)
    if needed.all():
        return scene
    journal.leave_out(LeftOut.VIEWS, count=int((~needed).sum()), total=len(needed), enough=enough)
    return replace(scene, views=tuple(view for view, stays in zip(scene.views, needed, strict=True) if stays))


def needed_views(
    seen: NDArray[np.bool_], mask: NDArray[np.int32], order: NDArray[np.integer], enough: int
) -> NDArray[np.bool_]:
    """(views,) bool, False for views that may be left out together. seen: (views, points). mask: (views, points) int32,
    the mask that each point is seen in, -1 none. order: in which views are tried."""
    needed, count, masked = np.ones(len(seen), np.bool_), seen.sum(axis=0), (mask >= 0).sum(axis=0)
    for view in order:
        points = np.flatnonzero(seen[view])
        inside = points[mask[view, points] >= 0]
        rare = np.bincount(mask[view, inside], np.where(masked[inside] <= enough, 1, -1))
        if np.count_nonzero(count[points] <= enough) < MAX_RARE_SHARE * len(points) and (rare <= 0).all():
            needed[view] = False
            count[points] -= 1
            masked[inside] -= 1
    return needed


def masks_at(xyz: NDArray[np.float32], seen: NDArray[np.bool_], views: Sequence[View]) -> NDArray[np.int32]:
    """(views, n) int32: the mask that each view sees each point (n, 3) in, -1 where it is in none or hidden."""
    found = np.full(seen.shape, -1, np.int32)

    def look_up(row: int) -> None:
        points = np.flatnonzero(seen[row])
        masks, (uv_px, _) = views[row].mask_map(), views[row].camera.project(xyz[points])
        column, line = np.clip(uv_px.astype(np.intp), 0, np.array(masks.shape[::-1]) - 1).T
        found[row, points] = np.maximum(masks[line, column], -1)

    with ThreadPoolExecutor(get_num_threads()) as pool:
        list(pool.map(look_up, np.flatnonzero(seen.any(axis=1))))
    return found


def seen_points(xyz: NDArray[np.float32], cameras: Sequence[Camera]) -> NDArray[np.bool_]:
    """(cameras, n) bool: the points (n, 3) in each image that are not hidden. In each cell of the image, the nearest
    point hides those that lie far behind it."""
    seen = np.zeros((len(cameras), len(xyz)), np.bool_)
    poses = np.stack([camera.world_to_camera for camera in cameras])
    numbers = np.array([(*camera.intrinsics, camera.width, camera.height) for camera in cameras])
    _mark_seen(xyz.astype(np.float64), poses, numbers, seen)
    return seen


@njit(cache=True, parallel=True, nogil=True, error_model="numpy")
def _mark_seen(xyz, poses, numbers, seen):  # noqa: ANN001, ANN202
    for view in prange(len(poses)):
        fx, fy, cx, cy, width, height = numbers[view]
        inside, place, count = np.empty(len(xyz), np.int32), np.empty((len(xyz), 3)), 0  # column, row, depth
        for g in range(len(xyz)):
            depth, across, down = depth_and_slopes(xyz[g, 0], xyz[g, 1], xyz[g, 2], poses[view])
            column, row = fx * across + cx, fy * down + cy
            if depth > 0 and 0 <= column < width and 0 <= row < height:
                inside[count] = g
                place[count] = column, row, depth
                count += 1
        side = np.sqrt(width * height * POINTS_PER_CELL / max(count, 1))
        front = np.full((int(height / side) + 1, int(width / side) + 1), np.inf)
        for k in range(count):
            cell = int(place[k, 1] / side), int(place[k, 0] / side)
            front[cell] = min(front[cell], place[k, 2])
        for k in range(count):
            seen[view, inside[k]] = place[k, 2] <= DEPTH_RATIO * front[int(place[k, 1] / side), int(place[k, 0] / side)]
