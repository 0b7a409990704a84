"""What a fit needs to know of points before anything is drawn: spacing, neighbors, samples, used pixels.

A plain cloud's points are drawn as isotropic Gaussians whose size is a share of their own spacing, chosen by
`fitting.held_out`.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from og_pointcloud.rendering.splatting import NEAR_SHARE, Gaussians, ascending
from og_pointcloud.scene import Camera, Points, View
from og_pointcloud.settings import GeometrySettings

SPACING_MEDIAN_NEIGHBORS = 16
"""A point's spacing is at most the median spacing of this many neighbors."""
FLOATER_SPACINGS = 3.0
"""A point whose spacing is more than so many times the scene's is a floater, if those about it are scattered."""
FLOATER_SCATTER_SHARE = 0.1
"""They are if more than this share of their spread lies across the plane that fits them best: of 1/3 in all directions
alike. Of a surface it is less the sparser it is beside its noise."""
FLOATER_DRAWN_SPACINGS = 0.1
"""Floaters are drawn as if this many typical spacings apart, so that they hide next to nothing."""
POINTS_PER_QUERY = 1 << 18
"""Points in one neighbor query: it returns three times as many bytes as are kept."""

CELLS_PER_HALF_WIDTH = 1 << 13
"""Hash cells per half of the cloud's width: several per spacing of 100 million points, and so much wider than float32's
rounding that another unit of length moves few points into another cell."""
MAX_HALF_WIDTHS = 1 << 17
"""Hash cells end this many half widths from the middle: as many as 32 bits can number."""
MORTON_BITS = 10
"""Bits of a cell's number along each axis; three of them fit into a Morton code of 32 bits."""
MORTON_HALF_WIDTHS = 4
"""The Morton curve reaches this many half widths to either side; points beyond are put at its border."""


@dataclass(frozen=True)
class Neighborhood:
    """spacing: (n,) float32, mean distance to the three nearest other positions, clamped for floaters.
    index: (n, k) int32, nearest points, nearest first, without the point itself. adjoining: (n, k) bool, those within
    the settings' reach (in spacings)."""

    spacing: NDArray[np.float32]
    index: NDArray[np.int32]
    adjoining: NDArray[np.bool_]


def nearest_in(tree: cKDTree, xyz: NDArray[np.floating], k: int = 1) -> tuple[NDArray[np.float64], NDArray[Any]]:
    """Distance and index of the k points of a tree nearest to each point, on all cores: (N,), or (N, k) if k > 1.

    The query runs in a thread of its own, which Ctrl-C waits for: else the threads that scipy starts would go on in
    freed memory.
    """
    with ThreadPoolExecutor(1) as pool:
        pool.submit(int).result()  # starts the thread, so that there is one to wait for
        distance, index = pool.submit(tree.query, xyz, k=k, workers=-1).result()
    return np.asarray(distance), np.asarray(index)


def neighborhood(xyz: NDArray[np.float32], settings: GeometrySettings) -> Neighborhood:
    """Spacing and neighbors of every point. xyz: (n, 3), any unit.

    A floater's own spacing says nothing about a surface: it is clamped to the median spacing of its neighbors.
    Duplicates have the spacing of their position, as if it held one point. A single point or position has spacing 1.
    """
    index, distance = _nearest(xyz, settings.neighbors)
    if distance[:, :1].all():
        spacing, typical = _spacing(index, distance)
    else:
        first, place = distinct_positions(xyz)
        of_positions, typical = _spacing(*_nearest(xyz[first], settings.neighbors))
        spacing = of_positions[place]
    # Points that are denser than the typical ones adjoin as far as those.
    adjoining = distance <= settings.reach * np.maximum(spacing, typical)[:, None]
    return Neighborhood(spacing, index, adjoining)


def _nearest(xyz: NDArray[np.float32], max_neighbors: int) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
    """(n, k) each, the k nearest points of every point, nearest first and without itself, and how far away they are; k
    is ``max_neighbors``, or all others."""
    n = len(xyz)
    k = min(max_neighbors, n - 1)
    index, distance = np.empty((n, k), np.int32), np.empty((n, k))
    if k == 0:
        return index, distance
    tree = cKDTree(xyz)
    for low in range(0, n, POINTS_PER_QUERY):
        rows = slice(low, min(n, low + POINTS_PER_QUERY))
        away, found = nearest_in(tree, xyz[rows], k + 1)
        # The point itself is usually first, but not always among duplicates.
        itself = found == np.arange(n)[rows, None]
        itself[~itself.any(axis=1), -1] = True  # more duplicates than k: leave out the last of them instead
        distance[rows], index[rows] = away[~itself].reshape(-1, k), found[~itself].reshape(-1, k)
    return index, distance


def _spacing(index: NDArray[np.int32], distance: NDArray[np.float64]) -> tuple[NDArray[np.float32], float]:
    """(n,) spacing of points at distinct positions, from their nearest ones (n, k); and the typical spacing."""
    if distance.shape[1] == 0:
        return np.ones(len(distance), np.float32), 1.0
    spacing = distance[:, :3].mean(axis=1)
    clamped = np.minimum(spacing, np.median(spacing[index[:, :SPACING_MEDIAN_NEIGHBORS]], axis=1))
    return clamped.astype(np.float32), float(np.median(spacing))


def drawn_spacing(xyz: NDArray[np.float32], around: Neighborhood) -> NDArray[np.float32]:
    """(n,) float32, the spacing that points are drawn by: their own; for floaters, a share of the typical spacing.

    Points that lie far apart in all directions close no surface. Drawn as large as their distance, a few hundred of
    them would hide a room.
    """
    spacing, typical = around.spacing.copy(), float(np.median(around.spacing))
    sparse = np.flatnonzero(spacing > FLOATER_SPACINGS * typical)
    for low in range(0, len(sparse), POINTS_PER_QUERY):
        rows = sparse[low : low + POINTS_PER_QUERY]
        near = xyz[around.index[rows]].astype(np.float64)
        near -= near.mean(axis=1, keepdims=True)
        spread = np.linalg.eigvalsh(near.transpose(0, 2, 1) @ near)
        spacing[rows[spread[:, 0] > FLOATER_SCATTER_SHARE * spread.sum(axis=1)]] = FLOATER_DRAWN_SPACINGS * typical
    return spacing


def near_plane(xyz: NDArray[np.float32], cameras: Iterable[Camera]) -> float:
    """Depth of the near plane: a share of the median depth at which cameras see the cloud. Never 0."""
    sample = xyz[:: 1 + len(xyz) // 20_000].astype(np.float64)  # enough for a median; once for all cameras
    seen = [depths(sample, camera) for camera in cameras]
    front = np.concatenate([depth[depth > 0] for depth in seen])
    return NEAR_SHARE * float(np.median(front)) if len(front) else 1e-6


def position_hash(xyz: NDArray[np.float32], name: str = "") -> NDArray[np.float32]:
    """(n,) float32 in [0, 1), a hash of position in the cloud and name: a sample drawn by it depends neither on the
    order of the points nor on their unit of length."""
    if not len(xyz):
        return np.zeros(0, np.float32)
    # Cells scale with the cloud; all points beyond the farthest cell share it.
    cell = np.rint(CELLS_PER_HALF_WIDTH * _in_half_widths(xyz, MAX_HALF_WIDTHS)).astype(np.int32).view(np.uint32)
    # Cell numbers, mixed by xxHash's odd constants.
    value = cell[:, 0] * np.uint32(0x9E3779B1) ^ cell[:, 1] * np.uint32(0x85EBCA77) ^ cell[:, 2] * np.uint32(0xC2B2AE3D)
    value ^= np.uint32(zlib.crc32(name.encode()))
    # Each bit of the input changes half of the bits of the result (finaliser of MurmurHash3, public domain). The upper
    # 24 are kept, as many as float32 holds exactly.
    for shift, factor in ((16, 0x85EBCA6B), (13, 0xC2B2AE35)):
        value = (value ^ (value >> np.uint32(shift))) * np.uint32(factor)
    return (((value ^ (value >> np.uint32(16))) >> np.uint32(8)) * 2.0**-24).astype(np.float32)


def morton_order(xyz: NDArray[np.float32]) -> NDArray[np.int32]:
    """(n,) rows of points in Morton order: points near in space are then mostly near in memory. So runs of points
    outside an image are culled together, and the points of a view or a mask are read from few places.

    >>> morton_order(np.array([[5, 5], [0, 0], [5, 4], [0, 1]], np.float32) @ np.eye(2, 3, dtype=np.float32))
    array([1, 3, 2, 0], dtype=int32)
    """
    if not len(xyz):
        return np.zeros(0, np.int32)
    cells = 1 << MORTON_BITS
    cell = ((_in_half_widths(xyz, MORTON_HALF_WIDTHS) / MORTON_HALF_WIDTHS + 1) / 2 * (cells - 1)).astype(np.uint32)
    # Insert two zeros after each bit: move the halves of the number apart, then the halves of these.
    for shift, kept in ((16, 0x030000FF), (8, 0x0300F00F), (4, 0x030C30C3), (2, 0x09249249)):
        cell = (cell | cell << np.uint32(shift)) & np.uint32(kept)
    return ascending(cell[:, 0] | cell[:, 1] << np.uint32(1) | cell[:, 2] << np.uint32(2))


def _in_half_widths(xyz: NDArray[np.float32], farthest: float) -> NDArray[np.float32]:
    """(n, 3) offsets from the cloud's middle in halves of its width, clipped at ``farthest``. Middle and width are
    medians, so that a far outlier does not squeeze all else into one cell."""
    place = xyz - np.median(xyz, axis=0)
    size = np.median(np.abs(place), axis=0).max() or np.abs(place).max() or 1.0
    return np.clip(place, -farthest * size, farthest * size) / size


def sample_of_points(xyz: NDArray[np.float32], count: int) -> NDArray[np.int64]:
    """Ascending rows of about ``count`` points, all if there are no more; the same places whatever the order."""
    if len(xyz) <= count:
        return np.arange(len(xyz))
    chance = position_hash(xyz)
    return np.flatnonzero(chance <= np.partition(chance, count - 1)[count - 1])


def distinct_positions(xyz: NDArray[np.float32]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows of the first point at each position, ascending; and for each point, which of these is at its position."""
    everyone = np.arange(len(xyz))
    # A 64-bit hash of each position: if all differ, so do the positions; equal ones may be a collision, so look closer.
    bits = np.ascontiguousarray(xyz + np.float32(0)).view(np.uint32).astype(np.uint64)  # -0 becomes 0
    key = bits @ np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], np.uint64)
    ordered = np.sort(key)
    if (ordered[1:] != ordered[:-1]).all():  # true of nearly every cloud; takes a fifth of the time of looking closer
        return everyone, everyone
    # np.unique numbers positions by their coordinates; rank numbers them by their first point.
    _, first, place = np.unique(xyz + np.float32(0), axis=0, return_index=True, return_inverse=True)
    rank = np.empty(len(first), np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    return np.sort(first), rank[place.ravel()]


def strided(camera: Camera, stride: int) -> Camera:
    """The camera of every stride-th pixel, ``image[stride // 2 :: stride, stride // 2 :: stride]``."""
    first = stride // 2
    width, height = (-(-(side - first) // stride) for side in (camera.width, camera.height))
    # Pixel i of the result is pixel first + stride i, and centers of pixels lie at halves.
    cx, cy = ((center - first - 0.5) / stride + 0.5 for center in (camera.cx, camera.cy))
    return replace(camera, width=width, height=height, fx=camera.fx / stride, fy=camera.fy / stride, cx=cx, cy=cy)


def thinned(view: View, stride: int) -> View:
    """The view of every stride-th row and column of its masks, without its image."""
    if stride == 1:
        return view
    first = stride // 2
    masks = np.ascontiguousarray(view.mask_map()[first::stride, first::stride])
    return replace(view, camera=strided(view.camera, stride), masks=masks, image=None)


def isotropic(points: Points, spacing: NDArray[np.float32], scale: float, opacity: float) -> Gaussians:
    """Round Gaussians with a standard deviation of ``scale`` times each point's spacing."""
    n = len(points)
    rotation = np.zeros((n, 4), np.float32)
    rotation[:, 0] = 1
    size = np.repeat((scale * spacing).astype(np.float32)[:, None], 3, axis=1)
    return Gaussians(points.xyz, size, rotation, np.full(n, opacity, np.float32))


def depths(xyz: NDArray[np.floating], camera: Camera) -> NDArray[np.float64]:
    """(n,) depths along the camera's axis, scene units; negative behind it."""
    return xyz @ camera.world_to_camera[2, :3] + camera.world_to_camera[2, 3]
