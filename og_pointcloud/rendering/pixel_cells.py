"""Points denser than pixels -> the mean points of cells two pixels wide.

Images tell nothing apart that is smaller than a pixel. Where points are denser than that, as those of a laser scan
beside small images, what neighbors decide is decided within less than a pixel: gaps that no view saw stay open, and
edges stay ragged. So all points of a cell share one state, decided at their mean. A cell is CELL_PIXELS pixels wide at
the distance of the nearest views.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from og_pointcloud.journal import Journal, LeftOut
from og_pointcloud.rendering.geometry import distinct_positions, nearest_in, sample_of_points
from og_pointcloud.scene import Points, Scene, View

CELL_PIXELS = 2.0
"""Width of a cell, in pixels."""
MAX_KEPT_SHARE = 0.4
"""Points are merged only where no more than this share of them is left: else many views tell most of them apart."""
SAMPLED_POINTS = 2_000
"""Points at which the width of a pixel is measured (the others have that of the nearest of these), and the spacing."""
NEAREST_SHARE = 0.25
"""The width of a pixel is its quantile of this order over the views that show a point."""
MAX_LEVEL = 8
"""Cells are at most this many times halved or doubled in width."""
INDEX_BITS = 19
"""Bits of a cell's place along each axis; points farther from the middle are put into the outermost cells."""
STEPS_OF_CELL = float(1 << 20)
"""Places in a cell are rounded to this share of its width, so that their sums are exact in any order."""


def with_points_of_cells(scene: Scene, journal: Journal) -> tuple[Scene, NDArray[np.int64] | None]:
    """The scene with one point for each cell, at the mean place and color of its points, and for each point the row of
    its cell. The scene as it is, and None, where its points are not denser than pixels."""
    points = scene.points
    level, typical = _levels(points.xyz, scene.views)
    if not typical > 0:
        return scene, None
    width = typical * np.exp2(level)  # cells of one width tile the space
    middle, half = np.median(points.xyz, axis=0).astype(np.float64), 1 << (INDEX_BITS - 1)
    key = level.astype(np.int64) + MAX_LEVEL
    for axis in range(3):
        index = np.floor((points.xyz[:, axis] - middle[axis]) / width)
        key = key << INDEX_BITS | np.clip(index + half, 0, 2 * half - 1).astype(np.int64)
    _, first, cell = np.unique(key, return_index=True, return_inverse=True)
    if len(first) > MAX_KEPT_SHARE * len(points):
        return scene, None
    journal.leave_out(LeftOut.DENSE_POINTS, share=1 - len(first) / len(points), pixels=CELL_PIXELS)
    cell, held = cell.ravel(), np.bincount(cell.ravel())
    steps = width / STEPS_OF_CELL
    # Sums of whole numbers are exact: the order of points does not matter.
    xyz = [
        middle[axis] + steps[first] * (np.bincount(cell, np.rint((of - middle[axis]) / steps)) / held)
        for axis, of in enumerate(points.xyz.T)
    ]
    rgb = points.rgb
    if rgb is not None:
        rgb = np.stack([np.rint(np.bincount(cell, of) / held) for of in rgb.T], axis=1).astype(np.uint8)
    merged = Points(np.stack(xyz, axis=1).astype(np.float32), points.origin, rgb)
    return replace(scene, points=merged), cell


def typical_spacing(xyz: NDArray[np.float32], spacing: NDArray[np.float32]) -> float:
    """Of a whole cloud (n, 3), from the spacing of the points that stand for it; of a sample of it, where these are
    cells' points, which lie farther apart."""
    positions = xyz if len(spacing) > MAX_KEPT_SHARE * len(xyz) else xyz[distinct_positions(xyz)[0]]
    if len(spacing) > MAX_KEPT_SHARE * len(positions):
        return float(np.median(spacing))
    few = positions[sample_of_points(positions, SAMPLED_POINTS)]
    nearest = nearest_in(cKDTree(positions), few, min(4, len(positions)))[0]
    return float(np.median(nearest[:, 1:].mean(axis=1)))


def pixel_widths(xyz: NDArray[np.float64], views: Sequence[View]) -> NDArray[np.float64]:
    """(n,) how wide a pixel is at each point (n, 3), scene units, in the views whose images it lies in: in the nearest
    quarter of them, as farther ones may look at it through walls. NaN where there are none."""
    widths = np.full((len(views), len(xyz)), np.nan)
    for width, camera in zip(widths, (view.camera for view in views), strict=True):
        uv, depth = camera.project(xyz)
        shown = camera.shows(uv) & (depth > 0)
        width[shown] = np.linalg.norm(xyz[shown] - camera.center, axis=1) / np.sqrt(camera.fx * camera.fy)
    # The quantile over the views that show a point, between the two ranks beside it. (np.nanquantile takes ten times
    # as long.)
    widths.sort(axis=0)  # NaN last
    last = np.count_nonzero(np.isfinite(widths), axis=0) - 1
    rank = NEAREST_SHARE * np.maximum(last, 0)
    low = rank.astype(np.intp)
    below, above = np.take_along_axis(widths, np.stack([low, np.minimum(low + 1, np.maximum(last, 0))]), axis=0)
    return below + (rank - low) * (above - below)


def _levels(xyz: NDArray[np.float32], views: Sequence[View]) -> tuple[NDArray[np.float64], float]:
    """(n,) how many times each point's cell is twice as wide as the typical one, and the width of that; 0 if no view
    shows any point."""
    sample = xyz[sample_of_points(xyz, SAMPLED_POINTS)].astype(np.float64)
    pixel = pixel_widths(sample, views)
    known = pixel > 0
    if not known.any():
        return np.zeros(len(xyz)), 0.0
    typical = float(np.median(pixel[known]))
    level = np.clip(np.floor(np.log2(pixel[known] / typical) + 0.5), -MAX_LEVEL, MAX_LEVEL - 1)
    return level[nearest_in(cKDTree(sample[known]), xyz)[1]], CELL_PIXELS * typical
