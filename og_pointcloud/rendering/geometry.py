"""What a fit asks of points before anything is drawn: spacing, neighbours, samples, the pixels worth looking at.

A plain cloud's points are drawn as isotropic Gaussians of a share of their own spacing; `fitting.held_out` chooses it.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from og_pointcloud.rendering.splatting import NEAR_SHARE, Gaussians
from og_pointcloud.scene import Camera, Points, View
from og_pointcloud.settings import GeometrySettings

TAMED_BY = 16
"""Neighbours whose median spacing a point's own may not exceed."""
ROWS_AT_ONCE = 1 << 18
"""Points whose neighbours are looked up at once: what the look-up returns is three times what is kept."""


@dataclass(frozen=True)
class Neighbourhood:
    """spacing: (n,) float32, mean distance to the three nearest points, tamed for duplicates and floaters.
    index: (n, k) int32, nearest points, nearest first, without the point itself. adjoining: (n, k) bool, those within
    the settings' reach (in spacings)."""

    spacing: NDArray[np.float32]
    index: NDArray[np.int32]
    adjoining: NDArray[np.bool_]


def nearest_in(tree: cKDTree, xyz: NDArray[np.floating], k: int = 1) -> tuple[NDArray[np.float64], NDArray[Any]]:
    """Distance and index of the k points of a tree nearest to each, on all cores: (N,), or (N, k) of several.

    Asked in a thread of its own, which Ctrl-C waits for: those that scipy starts would go on in memory that is gone.
    """
    with ThreadPoolExecutor(1) as pool:
        pool.submit(int).result()  # from now on there is a thread to wait for
        distance, index = pool.submit(tree.query, xyz, k=k, workers=-1).result()
    return np.asarray(distance), np.asarray(index)


def neighbourhood(xyz: NDArray[np.float32], settings: GeometrySettings) -> Neighbourhood:
    """Spacing and neighbours of every point.

    A floater's own spacing says nothing of a surface: it is held to the median spacing of its neighbours.
    Duplicates have none: they take the scene's. One point alone has spacing 1.
    """
    n = len(xyz)
    k = min(settings.neighbours, n - 1)
    if k == 0:
        return Neighbourhood(np.ones(n, np.float32), np.zeros((n, 0), np.int32), np.zeros((n, 0), bool))
    tree, index, distance = cKDTree(xyz), np.empty((n, k), np.int32), np.empty((n, k))
    for low in range(0, n, ROWS_AT_ONCE):
        rows = slice(low, min(n, low + ROWS_AT_ONCE))
        away, near = nearest_in(tree, xyz[rows], k + 1)
        # The point itself is usually first, but not always among duplicates.
        itself = near == np.arange(n)[rows, None]
        itself[~itself.any(axis=1), -1] = True
        distance[rows], index[rows] = away[~itself].reshape(-1, k), near[~itself].reshape(-1, k)
    spacing = distance[:, :3].mean(axis=1)
    typical = float(np.median(spacing[spacing > 0])) if (spacing > 0).any() else 1.0
    spacing = np.where(spacing > 0, spacing, typical)
    spacing = np.minimum(spacing, np.median(spacing[index[:, :TAMED_BY]], axis=1)).astype(np.float32)
    adjoining = distance <= settings.reach * np.maximum(spacing, typical)[:, None]
    return Neighbourhood(spacing, index, adjoining)


def near_plane(xyz: NDArray[np.float32], cameras: Iterable[Camera]) -> float:
    """Depth of the near plane: a share of the median depth at which cameras see the cloud. Never 0."""
    sample = xyz[:: 1 + len(xyz) // 20_000].astype(np.float64)  # once for all cameras
    depths = [_depths(sample, camera) for camera in cameras]
    front = np.concatenate([depth[depth > 0] for depth in depths])
    return NEAR_SHARE * float(np.median(front)) if len(front) else 1e-6


def pixels_per_spacing(points: Points, spacing: NDArray[np.float32], views: Sequence[View]) -> float:
    """How many pixels apart neighbouring points lie in the images, median over the points in front of the cameras."""
    step = 1 + len(points) // 20_000
    apart = []
    for view in views:
        depth = _depths(points.xyz[::step], view.camera)
        front = depth > 0
        apart.append(np.sqrt(view.camera.fx * view.camera.fy) * spacing[::step][front] / depth[front])
    seen = np.concatenate(apart)
    return float(np.median(seen)) if len(seen) else 1.0


def chance_of_place(xyz: NDArray[np.float32], name: str = "") -> NDArray[np.float32]:
    """(n,) float32 in [0, 1), by place and name alone: a sample drawn by it does not depend on the points' order."""
    bits = np.ascontiguousarray(xyz + np.float32(0)).view(np.uint32)  # -0 becomes 0
    value = bits[:, 0] * np.uint32(0x9E3779B1) ^ bits[:, 1] * np.uint32(0x85EBCA77) ^ bits[:, 2] * np.uint32(0xC2B2AE3D)
    value ^= np.uint32(zlib.crc32(name.encode()))
    # Each bit of the input changes half of those that are used (finaliser of MurmurHash3, public domain).
    for shift, factor in ((16, 0x85EBCA6B), (13, 0xC2B2AE35)):
        value = (value ^ (value >> np.uint32(shift))) * np.uint32(factor)
    return (((value ^ (value >> np.uint32(16))) >> np.uint32(8)) * 2.0**-24).astype(np.float32)


def sample_of_points(xyz: NDArray[np.float32], count: int) -> NDArray[np.int64]:
    """Ascending rows of about ``count`` points, all if there are no more; the same places whatever the order."""
    if len(xyz) <= count:
        return np.arange(len(xyz))
    chance = chance_of_place(xyz)
    return np.flatnonzero(chance <= np.partition(chance, count - 1)[count - 1])


def distinct_places(xyz: NDArray[np.float32]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows of the first point at each place, ascending, and for every point which of these rows is its place."""
    everyone = np.arange(len(xyz))
    bits = np.ascontiguousarray(xyz + np.float32(0)).view(np.uint32).astype(np.uint64)  # -0 becomes 0
    key = bits @ np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], np.uint64)
    ordered = np.sort(key)
    if (ordered[1:] != ordered[:-1]).all():  # nearly every cloud; a fifth of the time that looking closer takes
        return everyone, everyone
    _, first, place = np.unique(xyz + np.float32(0), axis=0, return_index=True, return_inverse=True)
    rank = np.empty(len(first), np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    return np.sort(first), rank[place.ravel()]


def strided(camera: Camera, stride: int) -> Camera:
    """The camera of every stride-th pixel, ``image[stride // 2 :: stride, stride // 2 :: stride]``."""
    first = stride // 2

    def center(c: float) -> float:
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
    """Round Gaussians of ``scale`` spacings."""
    n = len(points)
    rotation = np.zeros((n, 4), np.float32)
    rotation[:, 0] = 1
    size = np.repeat((scale * spacing).astype(np.float32)[:, None], 3, axis=1)
    return Gaussians(points.xyz, size, rotation, np.full(n, opacity, np.float32))


def _depths(xyz: NDArray[np.floating], camera: Camera) -> NDArray[np.float64]:
    return xyz @ camera.world_to_camera[2, :3] + camera.world_to_camera[2, 3]
