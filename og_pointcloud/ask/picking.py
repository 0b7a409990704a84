"""A click selects an instance (Sec. 4.3): a pixel of a camera, or a place, -> instance, its points, its mask anywhere.

numpy only. Points are drawn as discs that face the camera, wide enough to close the surface they sample; at each pixel
the front surface wins, and on it the point whose centre is nearest to the pixel. The same drawing answers a click and
renders a mask, so a picked instance's mask contains the pixel that was clicked. Images much finer than the cloud are
drawn coarser and enlarged: their pixels see nothing new of it.

Frames. Everything here is in world coordinates, like ``scene.xyz``; a camera's ``world_to_camera`` maps from them.
Views of a capture map from its local frame: ``in_world(view.camera, capture.points.origin)`` is the camera to pass.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from og_pointcloud.ask.choosing import chooser_of
from og_pointcloud.ask.labelled_scene import LabelledScene, SceneLike
from og_pointcloud.bundle.read import read_bundle
from og_pointcloud.cloud import BACKGROUND, TOO_FAR, UNOBSERVED, LabelledCloud
from og_pointcloud.errors import OgPointcloudError
from og_pointcloud.scene import Camera
from og_pointcloud.text.words import Labels, TextFeatures, resolve_labels

__all__ = ["Pick", "front_points", "in_world", "pick"]

FOOTPRINT = 1.0
"""Radius of a point's disc in point spacings. An evenly sampled surface is closed from 0.71 on; of one sampled at
random a sixth stays open at 1. Wider discs make masks fatter: 1.5 costs up to 0.06 of IoU on noisy RGB-D clouds."""
NEAR = 1.0
"""Depth of the near plane in point spacings: nearer points would cover half the image each."""
NEIGHBOURS = 9
"""Points in the 27 voxels around a point that show how densely a surface is sampled there; a grid of them has 9."""
LEVELS = 6
"""Sizes of voxels tried, from 2 spacings, each twice the last: LiDAR is 30 times as dense near by as far away."""
STRAY_SHARE = 0.03
"""The loneliest points, up to this share of the cloud, are strays: they float before surfaces, or behind them."""
PIXELS_PER_SPACING = 2.0
"""Pixels drawn per point spacing, at most; as many as the fit looks at."""
NO_POINT = -1
HALF_DIAGONAL = 0.7072
"""Of a pixel: the least radius of a disc, so that it covers the pixel that holds its centre."""
PAIRS_PER_CHUNK = 1_000_000
"""(disc, pixel) pairs drawn at once: about 100 MB."""

_NOTHING_PICKED = {
    BACKGROUND: "background: views saw this point, but outside every mask",
    UNOBSERVED: "an unobserved point: no view says what it is",
    TOO_FAR: "no point of the scene",
}


@dataclass(frozen=True)
class Pick:
    """What a click hit.

    instance: id in the scene's table; or BACKGROUND (-1), UNOBSERVED (-2) or TOO_FAR (-3), a miss.
    point: index of the scene's point that was hit, None for a miss. xyz_world: (3,) float64, its place, or None.
    path: the scene's .ogpc file, None for one in memory.
    """

    cloud: LabelledCloud = field(repr=False)
    instance: int
    point: int | None
    xyz_world: NDArray[np.float64] | None
    path: Path | None = None

    @property
    def found(self) -> bool:
        """Whether an instance was hit."""
        return self.instance >= 0

    @property
    def point_indices(self) -> NDArray[np.int64]:
        """Indices of the instance's points in the scene, ascending. OgPointcloudError where no instance was hit."""
        self._require_instance()
        return np.flatnonzero(self.cloud.instance_ids == self.instance)

    def mask(self, camera: Camera) -> NDArray[np.bool_]:
        """(H, W) bool: where the camera sees the instance, whatever hides it taken away.

        camera: maps from world coordinates (`in_world`). OgPointcloudError where no instance was hit.
        """
        self._require_instance()
        front = front_points(self.cloud, camera)
        return (front != NO_POINT) & (self.cloud.instance_ids[front] == self.instance)

    def words(self, labels: Labels = None, *, text_features: TextFeatures = None) -> list[tuple[str, float]]:
        """Words with their scores on the instance, best first; empty for an instance without a descriptor.

        A score is the probability that the instance is what the word says, where the scene has a word bank, else a
        cosine. labels, text_features: as for ``segment``; left out, the scene's own words. OgPointcloudError where no
        instance was hit, or as ``segment``.
        """
        self._require_instance()
        cloud = self.cloud
        words = resolve_labels(labels, text_features, cloud.vocabulary, cloud.feature_space, self.path)
        return chooser_of(cloud).choose(words.vectors).words(self.instance, words.names)

    def __str__(self) -> str:
        if not self.found:
            return _NOTHING_PICKED[self.instance]
        return f"instance {self.instance} of {len(self.point_indices):,} points"

    def _require_instance(self) -> None:
        if not self.found:
            raise OgPointcloudError(
                f"the click hit {self}; expected an instance (where `found` is true): click elsewhere"
            )


@overload
def pick(scene: SceneLike, where: Camera, uv_px: ArrayLike) -> Pick: ...
@overload
def pick(scene: SceneLike, where: ArrayLike) -> Pick: ...
def pick(scene: SceneLike, where: Camera | ArrayLike, uv_px: ArrayLike | None = None) -> Pick:
    """Select the instance at a pixel of a camera, or at a place.

    scene: a loaded scene, a LabelledCloud or the path of a .ogpc file.
    where: a camera that maps from world coordinates (`in_world`), with uv_px, (2,) pixels (column, row; pixel centres
        at +0.5); or a place, (3,) world coordinates: the nearest point counts, if within the scene's reach.

    A miss is a Pick too: its ``instance`` says which kind, ``str(pick)`` in words. Raises OgPointcloudError for a pixel
    outside the image and for numbers that are not finite.
    """
    cloud, path = _opened(scene)
    if isinstance(where, Camera):
        point = _point_at_pixel(cloud, where, uv_px)
    elif uv_px is not None:
        raise OgPointcloudError(f"uv_px is given with a {type(where).__name__}; expected it with a Camera alone")
    else:
        point = _nearest_point(cloud, where)
    if point == NO_POINT:
        return Pick(cloud, TOO_FAR, None, None, path)
    return Pick(cloud, int(cloud.instance_ids[point]), point, cloud.xyz[point].astype(np.float64) + cloud.origin, path)


def in_world(camera: Camera, origin: NDArray[np.float64]) -> Camera:
    """A camera of a scene's local frame as one of world coordinates. origin: (3,), world = local + origin."""
    pose = camera.world_to_camera.copy()
    pose[:3, 3] -= pose[:3, :3] @ np.asarray(origin, np.float64)
    return replace(camera, world_to_camera=pose)


def front_points(cloud: LabelledCloud, camera: Camera) -> NDArray[np.int64]:
    """(H, W) index of the point that each pixel shows, NO_POINT (-1) where there is none.

    camera: maps from world coordinates.

    A disc of FOOTPRINT spacings covers the pixels whose centres it holds, and always the one that holds its own. At
    each pixel the nearest disc begins the front surface, as thick as the scene's reach; within it the disc with the
    nearest centre wins, of equals the lowest index. Strays, which float alone, show only where nothing else does.
    """
    discs, drawn = _discs(cloud, camera)
    front = _draw(discs, cloud.reach, (0, 0, drawn.width, drawn.height))
    rows = ((np.arange(camera.height) + 0.5) * drawn.height / camera.height).astype(np.intp)
    columns = ((np.arange(camera.width) + 0.5) * drawn.width / camera.width).astype(np.intp)
    return front[rows[:, None], columns]


def _point_at_pixel(cloud: LabelledCloud, camera: Camera, uv_px: ArrayLike | None) -> int:
    """What `front_points` has at the pixel that holds uv_px, without drawing the others."""
    uv = np.asarray(uv_px, np.float64) if uv_px is not None else np.full(2, np.nan)
    size = np.array([camera.width, camera.height])
    if uv.shape != (2,) or not ((uv >= 0) & (uv < size)).all():
        raise OgPointcloudError(
            f"uv_px is {uv_px}; expected a pixel (column, row) of the camera's image, 0 to {camera.width} and 0 to "
            f"{camera.height}, both less than the end"
        )
    discs, drawn = _discs(cloud, camera)
    column, row = ((np.floor(uv) + 0.5) * [drawn.width, drawn.height] / size).astype(int).tolist()
    return int(_draw(discs, cloud.reach, (column, row, 1, 1))[0, 0])


def _nearest_point(cloud: LabelledCloud, place: ArrayLike) -> int:
    """Index of the nearest point within the scene's reach, the same that a query point would find, else NO_POINT."""
    world = np.asarray(place, np.float64)
    if world.shape != (3,) or not np.isfinite(world).all():
        raise OgPointcloudError(f"the place is {place}; expected three finite world coordinates x, y, z")
    local = (world - cloud.origin).astype(np.float32).astype(np.float64)
    squared = np.square(cloud.xyz.astype(np.float64) - local).sum(axis=1)
    nearest = int(squared.argmin()) if len(squared) else NO_POINT
    return nearest if len(squared) and squared[nearest] <= cloud.reach**2 else NO_POINT


def _opened(scene: SceneLike) -> tuple[LabelledCloud, Path | None]:
    if isinstance(scene, LabelledCloud):
        return scene, None
    if isinstance(scene, LabelledScene):
        return scene.cloud, scene.path
    if isinstance(scene, (str, os.PathLike)):
        return read_bundle(scene).cloud, Path(scene)
    raise OgPointcloudError(
        f"scene is a {type(scene).__name__}; expected a loaded scene, a LabelledCloud or the path of a .ogpc file"
    )


@dataclass(frozen=True)
class _Discs:
    """Points as discs in an image. index: (m,) in the cloud, ascending. u, v, radius: px. depth. stray: bool."""

    index: NDArray[np.int64]
    u: NDArray[np.float64]
    v: NDArray[np.float64]
    depth: NDArray[np.float64]
    radius: NDArray[np.float64]
    stray: NDArray[np.bool_]


def _discs(cloud: LabelledCloud, camera: Camera) -> tuple[_Discs, Camera]:
    """The discs of all points before the near plane, and the camera that they are drawn by."""
    rotation, translation = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
    in_camera = cloud.xyz.astype(np.float64) @ rotation.T + (rotation @ cloud.origin + translation)
    times_spacing, stray = _local_spacing(cloud)
    index = np.flatnonzero(in_camera[:, 2] > NEAR * cloud.spacing)
    x, y, depth = in_camera[index].T
    inside = np.abs(camera.fx * x / depth + camera.cx - camera.width / 2) < camera.width / 2
    inside &= np.abs(camera.fy * y / depth + camera.cy - camera.height / 2) < camera.height / 2
    spacing_px = np.sqrt(camera.fx * camera.fy) * cloud.spacing * times_spacing[index] / depth
    shrink = max(1.0, float(np.median(spacing_px[inside])) / PIXELS_PER_SPACING) if inside.any() else 1.0
    drawn = camera.resized(max(1, round(camera.width / shrink)), max(1, round(camera.height / shrink)))
    radius = np.maximum(FOOTPRINT * spacing_px * np.sqrt(drawn.fx * drawn.fy / (camera.fx * camera.fy)), HALF_DIAGONAL)
    u, v = drawn.fx * x / depth + drawn.cx, drawn.fy * y / depth + drawn.cy
    return _Discs(index, u, v, depth, radius, stray[index]), drawn


def _draw(discs: _Discs, reach: float, window: tuple[int, int, int, int]) -> NDArray[np.int64]:
    """(height, width) front points of a window (first column, first row, width, height) of the drawn image."""
    front = _front(discs, np.flatnonzero(~discs.stray), reach, window)
    if discs.stray.any() and (front == NO_POINT).any():
        front = np.where(front == NO_POINT, _front(discs, np.flatnonzero(discs.stray), reach, window), front)
    return front.reshape(window[3], window[2])


def _front(
    discs: _Discs, some: NDArray[np.int64], reach: float, window: tuple[int, int, int, int]
) -> NDArray[np.int64]:
    """(pixels,) front points among some of the discs."""
    pixels = window[2] * window[3]
    nearest_depth = np.full(pixels, np.inf)
    for part in _covered(discs, some[discs.depth[some].argsort()[::-1]], window):
        nearest_depth[part.pixel] = discs.depth[part.disc]  # far to near: of several writes the last one stays
    front = np.full(pixels, NO_POINT, np.int64)
    closest = np.full(pixels, np.inf)
    for part in _covered(discs, some, window):
        on_front = discs.depth[part.disc] <= nearest_depth[part.pixel] + reach
        better = np.flatnonzero(on_front & (part.distance < closest[part.pixel]))
        better = better[np.lexsort([-part.disc[better], -part.distance[better]])]  # the best one last
        front[part.pixel[better]] = discs.index[part.disc[better]]
        closest[part.pixel[better]] = part.distance[better]
    return front


@dataclass(frozen=True)
class _Covered:
    """(disc, pixel) pairs, disc by disc. pixel: row-major in the window. distance: squared, centre to centre, px^2."""

    disc: NDArray[np.int64]
    pixel: NDArray[np.int64]
    distance: NDArray[np.float64]


def _covered(discs: _Discs, order: NDArray[np.int64], window: tuple[int, int, int, int]) -> Iterator[_Covered]:
    """The pixels of a window that each disc covers, discs in this order, in chunks that bound the memory."""
    left, top, width, height = window
    # Clipped as floats: what is projected from next to the camera may lie 1e30 pixels away.
    first_column = np.clip(np.ceil(discs.u - discs.radius - 0.5), left, left + width).astype(np.int64)
    last_column = np.clip(np.floor(discs.u + discs.radius - 0.5), left - 1, left + width - 1).astype(np.int64)
    first_row = np.clip(np.ceil(discs.v - discs.radius - 0.5), top, top + height).astype(np.int64)
    last_row = np.clip(np.floor(discs.v + discs.radius - 0.5), top - 1, top + height - 1).astype(np.int64)
    columns, rows = np.maximum(last_column - first_column + 1, 0), np.maximum(last_row - first_row + 1, 0)
    order = order[(columns * rows)[order] > 0]
    ends = np.cumsum((columns * rows)[order])
    cuts = np.searchsorted(ends, np.arange(PAIRS_PER_CHUNK, ends[-1] if len(ends) else 0, PAIRS_PER_CHUNK))
    for low, high in itertools.pairwise(np.unique([0, *cuts, len(order)])):
        some = order[low:high]
        cells = (columns * rows)[some]
        disc = np.repeat(some, cells)
        cell = np.arange(len(disc)) - np.repeat(np.cumsum(cells) - cells, cells)
        column = first_column[disc] + cell % columns[disc]
        row = first_row[disc] + cell // columns[disc]
        distance = np.square(column + 0.5 - discs.u[disc]) + np.square(row + 0.5 - discs.v[disc])
        held = distance <= np.square(discs.radius[disc])
        pixel = (row - top) * width + column - left
        yield _Covered(disc[held], pixel[held], distance[held])


def _local_spacing(cloud: LabelledCloud) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """(n,) how many times the cloud's spacing points lie apart around each: 1, 2, 4, ...; (n,) bool, the strays.

    The first size of voxel with NEIGHBOURS in the 27 around a point says how far apart points lie there; but points
    are no wider apart than the densest ones in those voxels, or a point that floats before a wall would hide it.
    The cloud keeps the answer, so that the next click is quick.
    """
    known = cloud.__dict__.get("_local_spacing")
    if known is None:
        found = np.full(len(cloud), LEVELS)
        level = found.copy()
        for size in range(LEVELS):
            pending = np.flatnonzero(found == LEVELS)
            count, least = _around(cloud.xyz, 2 * cloud.spacing * 2.0**size, level, pending)
            reached = count >= NEIGHBOURS
            found[pending[reached]] = size
            level[pending[reached]] = np.minimum(least[reached], size)
        level[level == LEVELS] = 0  # alone: nothing to fill a gap between
        share_this_lonely = np.bincount(found, minlength=LEVELS + 1)[::-1].cumsum()[::-1] / max(len(cloud), 1)
        known = 2.0**level, share_this_lonely[found] <= STRAY_SHARE
        cloud.__dict__["_local_spacing"] = known
    return known


def _around(
    xyz: NDArray[np.float32], edge: float, values: NDArray[np.int64], asked: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """For each point asked: how many points lie in the 27 voxels around it, and the least of their values."""
    voxel = np.floor(np.clip(xyz.astype(np.float64) / edge, -1e15, 1e15)).astype(np.int64)
    order = np.argsort(_key(voxel), kind="stable")
    sorted_keys = _key(voxel)[order]
    first = np.flatnonzero(np.diff(sorted_keys, prepend=-1))
    keys, counts = sorted_keys[first], np.diff(first, append=len(order))
    least_of = np.minimum.reduceat(values[order], first) if len(first) else values
    count, least = np.zeros(len(asked), np.int64), np.full(len(asked), LEVELS)
    for step in itertools.product((-1, 0, 1), repeat=3) if len(asked) else ():
        neighbour = _key(voxel[asked] + step)
        place = np.minimum(np.searchsorted(keys, neighbour), len(keys) - 1)
        there = keys[place] == neighbour
        count += np.where(there, counts[place], 0)
        least = np.where(there, np.minimum(least, least_of[place]), least)
    return count, least


def _key(voxel: NDArray[np.int64]) -> NDArray[np.int64]:
    """21 bits a coordinate: voxels share a key only where two million voxels lie between them."""
    low = voxel & ((1 << 21) - 1)
    return low[:, 0] << 42 | low[:, 1] << 21 | low[:, 2]
