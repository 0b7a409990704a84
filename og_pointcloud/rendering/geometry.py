"""What a fit asks of points before anything is drawn: spacing, neighbors, samples, the pixels worth looking at.

A plain cloud's points are drawn as isotropic Gaussians of a share of their own spacing; `fitting.held_out` chooses the
share.
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

TAMED_BY = 16
"""A point's spacing is at most the median spacing of this many neighbors."""
SPARSE = 3.0
"""A point whose spacing is more than so many times the scene's is a floater, if those about it are scattered."""
SCATTERED = 0.1
"""They are if more than this share of their spread lies across the plane that fits them best: of 1/3 in all directions
alike. Of a surface it is less the sparser it is beside its noise."""
FLOATER = 0.1
"""Floaters are drawn so many typical spacings apart: they hide next to nothing."""
ROWS_AT_ONCE = 1 << 18
"""Points whose neighbors are looked up at once: the look-up returns three times as many bytes as are kept."""

CELLS = 1 << 13
"""Cells to half the cloud's width in which places are told apart: some to a spacing of 100 million points, and so much
wider than float32 rounds that another unit of length moves few points into another cell."""
FARTHEST = 1 << 17
"""Halves of the cloud's width within which there are cells: as many as 32 bits can number."""
CURVE_BITS = 10
"""Of a cell's number along an axis, of three in 32 bits, on the curve that points are ordered along."""
CURVE_REACH = 4
"""Halves of the cloud's width to either side that the curve runs through; what lies beyond is at its border."""


@dataclass(frozen=True)
class Neighborhood:
    """spacing: (n,) float32, mean distance to the three nearest other places, tamed for floaters.
    index: (n, k) int32, nearest points, nearest first, without the point itself. adjoining: (n, k) bool, those within
    the settings' reach (in spacings)."""

    spacing: NDArray[np.float32]
    index: NDArray[np.int32]
    adjoining: NDArray[np.bool_]


def nearest_in(tree: cKDTree, xyz: NDArray[np.floating], k: int = 1) -> tuple[NDArray[np.float64], NDArray[Any]]:
    """Distance and index of the k points of a tree nearest to each, on all cores: (N,), or (N, k) of several.

    The look-up runs in a thread of its own, which Ctrl-C waits for: else the threads that scipy starts would go on, in
    memory that is freed.
    """
    with ThreadPoolExecutor(1) as pool:
        pool.submit(int).result()  # starts the thread: from now on there is one to wait for
        distance, index = pool.submit(tree.query, xyz, k=k, workers=-1).result()
    return np.asarray(distance), np.asarray(index)


def neighborhood(xyz: NDArray[np.float32], settings: GeometrySettings) -> Neighborhood:
    """Spacing and neighbors of every point. xyz: (n, 3), any unit.

    A floater's own spacing says nothing about a surface: it is held to the median spacing of its neighbors.
    Duplicates have the spacing of their place, as if it held one point. One point or place alone has spacing 1.
    """
    index, distance = _nearest(xyz, settings.neighbors)
    if distance[:, :1].all():
        spacing, typical = _spacing(index, distance)
    else:
        first, place = distinct_places(xyz)
        of_places, typical = _spacing(*_nearest(xyz[first], settings.neighbors))
        spacing = of_places[place]
    # Where points are denser than is typical, they adjoin as far as elsewhere.
    adjoining = distance <= settings.reach * np.maximum(spacing, typical)[:, None]
    return Neighborhood(spacing, index, adjoining)


def _nearest(xyz: NDArray[np.float32], most: int) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
    """(n, k) each, the k nearest points of every point, nearest first and without itself, and how far away they are; k
    is ``most``, or all others."""
    n = len(xyz)
    k = min(most, n - 1)
    index, distance = np.empty((n, k), np.int32), np.empty((n, k))
    if k == 0:
        return index, distance
    tree = cKDTree(xyz)
    for low in range(0, n, ROWS_AT_ONCE):
        rows = slice(low, min(n, low + ROWS_AT_ONCE))
        away, near = nearest_in(tree, xyz[rows], k + 1)
        # The point itself is usually first, but not always among duplicates.
        itself = near == np.arange(n)[rows, None]
        itself[~itself.any(axis=1), -1] = True  # more duplicates than k: leave out the last of them instead
        distance[rows], index[rows] = away[~itself].reshape(-1, k), near[~itself].reshape(-1, k)
    return index, distance


def _spacing(index: NDArray[np.int32], distance: NDArray[np.float64]) -> tuple[NDArray[np.float32], float]:
    """(n,) spacing of points at different places from their nearest ones (n, k), and what is typical."""
    if distance.shape[1] == 0:
        return np.ones(len(distance), np.float32), 1.0
    spacing = distance[:, :3].mean(axis=1)
    tamed = np.minimum(spacing, np.median(spacing[index[:, :TAMED_BY]], axis=1))
    return tamed.astype(np.float32), float(np.median(spacing))


def drawn_spacing(xyz: NDArray[np.float32], around: Neighborhood) -> NDArray[np.float32]:
    """(n,) float32, the spacing that points are drawn by: their own, and FLOATER of the typical one for floaters.

    Points that lie far apart in all directions close no surface. Drawn as large as they are apart, a few hundred of
    them would hide a room.
    """
    spacing, typical = around.spacing.copy(), float(np.median(around.spacing))
    sparse = np.flatnonzero(spacing > SPARSE * typical)
    for low in range(0, len(sparse), ROWS_AT_ONCE):
        rows = sparse[low : low + ROWS_AT_ONCE]
        near = xyz[around.index[rows]].astype(np.float64)
        near -= near.mean(axis=1, keepdims=True)
        spread = np.linalg.eigvalsh(near.transpose(0, 2, 1) @ near)
        spacing[rows[spread[:, 0] > SCATTERED * spread.sum(axis=1)]] = FLOATER * typical
    return spacing


def near_plane(xyz: NDArray[np.float32], cameras: Iterable[Camera]) -> float:
    """Depth of the near plane: a share of the median depth at which cameras see the cloud. Never 0."""
    sample = xyz[:: 1 + len(xyz) // 20_000].astype(np.float64)  # enough for a median; once for all cameras
    seen = [depths(sample, camera) for camera in cameras]
    front = np.concatenate([depth[depth > 0] for depth in seen])
    return NEAR_SHARE * float(np.median(front)) if len(front) else 1e-6


def chance_of_place(xyz: NDArray[np.float32], name: str = "") -> NDArray[np.float32]:
    """(n,) float32 in [0, 1), by place in the cloud and by name alone: a sample drawn by it depends neither on the
    order of the points nor on their unit of length."""
    if not len(xyz):
        return np.zeros(0, np.float32)
    # Cells of the cloud's own size; beyond the farthest, all is one place.
    cell = np.rint(CELLS * _in_halves(xyz, FARTHEST)).astype(np.int32).view(np.uint32)
    # Their numbers, mixed by odd constants (those of xxHash).
    value = cell[:, 0] * np.uint32(0x9E3779B1) ^ cell[:, 1] * np.uint32(0x85EBCA77) ^ cell[:, 2] * np.uint32(0xC2B2AE3D)
    value ^= np.uint32(zlib.crc32(name.encode()))
    # Each bit of the input changes half of the bits of the result (finaliser of MurmurHash3, public domain). The upper
    # 24 of them are as many as float32 holds exactly.
    for shift, factor in ((16, 0x85EBCA6B), (13, 0xC2B2AE35)):
        value = (value ^ (value >> np.uint32(shift))) * np.uint32(factor)
    return (((value ^ (value >> np.uint32(16))) >> np.uint32(8)) * 2.0**-24).astype(np.float32)


def along_curve(xyz: NDArray[np.float32]) -> NDArray[np.int32]:
    """(n,) rows of points along Morton's curve through space: what is near in space is then mostly near in memory. So
    runs of points lie beside an image as one, and what a view or a mask shows is read from few places.

    >>> along_curve(np.array([[5, 5], [0, 0], [5, 4], [0, 1]], np.float32) @ np.eye(2, 3, dtype=np.float32))
    array([1, 3, 2, 0], dtype=int32)
    """
    if not len(xyz):
        return np.zeros(0, np.int32)
    cells = 1 << CURVE_BITS
    cell = ((_in_halves(xyz, CURVE_REACH) / CURVE_REACH + 1) / 2 * (cells - 1)).astype(np.uint32)
    # Two zeros after each bit: halves of the number are moved apart, then halves of these.
    for shift, kept in ((16, 0x030000FF), (8, 0x0300F00F), (4, 0x030C30C3), (2, 0x09249249)):
        cell = (cell | cell << np.uint32(shift)) & np.uint32(kept)
    return ascending(cell[:, 0] | cell[:, 1] << np.uint32(1) | cell[:, 2] << np.uint32(2))


def _in_halves(xyz: NDArray[np.float32], farthest: float) -> NDArray[np.float32]:
    """(n, 3) places from the cloud's middle in halves of its width, cut at ``farthest``. Both are medians, lest a far
    outlier makes all else one place."""
    place = xyz - np.median(xyz, axis=0)
    size = np.median(np.abs(place), axis=0).max() or np.abs(place).max() or 1.0
    return np.clip(place, -farthest * size, farthest * size) / size


def sample_of_points(xyz: NDArray[np.float32], count: int) -> NDArray[np.int64]:
    """Ascending rows of about ``count`` points, all if there are no more; the same places whatever the order."""
    if len(xyz) <= count:
        return np.arange(len(xyz))
    chance = chance_of_place(xyz)
    return np.flatnonzero(chance <= np.partition(chance, count - 1)[count - 1])


def distinct_places(xyz: NDArray[np.float32]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows of the first point at each place, ascending, and for every point which of these rows is its place."""
    everyone = np.arange(len(xyz))
    # A 64-bit hash of each place: where all differ, so do the places; equal ones may be a collision, so look closer.
    bits = np.ascontiguousarray(xyz + np.float32(0)).view(np.uint32).astype(np.uint64)  # -0 becomes 0
    key = bits @ np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], np.uint64)
    ordered = np.sort(key)
    if (ordered[1:] != ordered[:-1]).all():  # nearly every cloud; a fifth of the time that looking closer takes
        return everyone, everyone
    # np.unique numbers places by their coordinates; rank numbers them by their first point.
    _, first, place = np.unique(xyz + np.float32(0), axis=0, return_index=True, return_inverse=True)
    rank = np.empty(len(first), np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    return np.sort(first), rank[place.ravel()]


def strided(camera: Camera, stride: int) -> Camera:
    """The camera of every stride-th pixel, ``image[stride // 2 :: stride, stride // 2 :: stride]``."""
    first = stride // 2

    def center(c: float) -> float:
        """Pixel i of the result is pixel first + stride i, and centers of pixels lie at halves."""
        return (c - first - 0.5) / stride + 0.5

    return replace(
        camera,
        width=-(-(camera.width - first) // stride),
        height=-(-(camera.height - first) // stride),
        fx=camera.fx / stride,
        fy=camera.fy / stride,
        cx=center(camera.cx),
        cy=center(camera.cy),
    )


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
