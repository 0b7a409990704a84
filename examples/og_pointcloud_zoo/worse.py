"""A scene made worse in one way, by an amount: what does a capture need, and what does a fit make of less?

views    only this many views, evenly spread
points   only this share of the points, at random
noise    every point is off by this many spacings, standard deviation along each axis
strays   this many more points, as a share of them, anywhere in the scene's box
poses    every camera is turned in a random direction, so that its image is off by this many pixels
masks    this share of the masks is missing
eroded   every mask ends this many pixels before its object does, as some proposers' masks do
colors   "noisy": the points' colors with noise; "grey": those without hue; "none": no colors; "bled": those of places
         a pixel or two off, as where photographs and depth do not fit exactly
exposure every photograph is brighter or darker by a factor, whose logarithm has this standard deviation, and its
         channels by factors of a quarter of it, as those of a camera are that adjusts itself

The same scene and amount always give the same worse scene. It is scored at the points that the scene had before.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from og_pointcloud.errors import OgPointcloudError
from og_pointcloud.formats.poses import rotation_of_vector
from og_pointcloud.scene import Points, Scene, View

COLOR_NOISE = 30.0
"""Standard deviation of color noise, of 255 levels: made colors are cleaner than those of a scan."""
COLORS = ("noisy", "grey", "none", "bled")
BLED_PX = 1.5
"""Standard deviation, along each axis, of where a bled color comes from, in pixels of the views."""
LADDER: Mapping[str, tuple[float, ...]] = {
    "views": (12, 8, 5, 3),
    "points": (0.5, 0.2, 0.05),
    "noise": (0.5, 1, 2, 4),
    "strays": (0.02, 0.1, 0.3),
    "poses": (1, 2, 4, 8),
    "masks": (0.25, 0.5, 0.75),
    "eroded": (1, 2, 4),
    "exposure": (0.2, 0.4),
}
"""The amounts tried of each kind, from little to much."""


def worse(scene: Scene, kind: str, amount: Any) -> Scene:
    """The scene made worse: remaining points keep their order, strays come after them. OgPointcloudError for any other
    kind or amount."""
    valid = amount in COLORS if kind == "colors" else isinstance(amount, int | float) and 0 < amount < np.inf
    if kind not in WAYS or not valid or (kind in ("points", "masks") and amount > 1):
        raise OgPointcloudError(
            f"'{kind}={amount}' makes nothing worse; expected one of {', '.join(WAYS)}, and a positive number, a share "
            f"of points or masks up to 1, or a color of {', '.join(COLORS)}"
        )
    return WAYS[kind](scene, amount, np.random.default_rng(0))


def _views(scene: Scene, count: float, _: np.random.Generator) -> Scene:
    most = len(scene.views)
    kept = np.unique(np.linspace(0, most - 1, min(int(count), most)).round().astype(int))
    return replace(scene, views=tuple(scene.views[k] for k in kept))


def _points(scene: Scene, share: float, rng: np.random.Generator) -> Scene:
    n = len(scene.points)
    rows = np.sort(rng.choice(n, max(1, round(share * n)), replace=False))
    return replace(scene, points=scene.points.take(rows))


def _noise(scene: Scene, spacings: float, rng: np.random.Generator) -> Scene:
    points = scene.points
    spacing = float(np.median(np.asarray(cKDTree(points.xyz).query(points.xyz, 2)[0])[:, 1]))
    moved = points.xyz + rng.normal(0, spacings * spacing, points.xyz.shape)
    return replace(scene, points=replace(points, xyz=moved.astype(np.float32)))


def _strays(scene: Scene, share: float, rng: np.random.Generator) -> Scene:
    points = scene.points
    low, high = np.percentile(points.xyz, [1, 99], axis=0)
    count = round(share * len(points))
    xyz = np.concatenate([points.xyz, rng.uniform(low, high, (count, 3)).astype(np.float32)])
    rgb = None
    if points.rgb is not None:
        rgb = np.concatenate([points.rgb, points.rgb[rng.integers(0, len(points), count)]])
    return replace(scene, points=Points(xyz, points.origin, rgb))


def _poses(scene: Scene, pixels: float, rng: np.random.Generator) -> Scene:
    def turned(view: View) -> View:
        side, turn = rng.uniform(0, 2 * np.pi), np.eye(4)
        turn[:3, :3] = rotation_of_vector(np.array([np.cos(side), np.sin(side), 0]) * pixels / view.camera.fx)
        return replace(view, camera=replace(view.camera, world_to_camera=turn @ view.camera.world_to_camera))

    return replace(scene, views=tuple(map(turned, scene.views)))


def _masks(scene: Scene, share: float, rng: np.random.Generator) -> Scene:
    def without(view: View) -> View:
        return _with_some(view, view.mask_map(), rng.random(view.mask_count) >= share)

    return replace(scene, views=tuple(map(without, scene.views)))


def _eroded(scene: Scene, pixels: float, _: np.random.Generator) -> Scene:
    def smaller(view: View) -> View:
        ids, cross = view.mask_map().astype(np.float32), cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
        inside = (cv2.erode(ids, cross) == cv2.dilate(ids, cross)).astype(np.uint8)
        edge = (ids >= 0) & (cv2.distanceTransform(inside, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) < pixels)
        left = np.where(edge, -1, ids).astype(np.int32)
        return _with_some(view, left, np.isin(np.arange(view.mask_count), left))

    return replace(scene, views=tuple(map(smaller, scene.views)))


def _with_some(view: View, ids: NDArray[np.int32], kept: NDArray[np.bool_]) -> View:
    """The view with these of its masks. ids: (H, W) its masks, -1 and NOT_SEEN elsewhere."""
    number = np.where(kept, np.cumsum(kept) - 1, -1)
    tracks = None if view.mask_tracks is None else view.mask_tracks[kept]
    fewer = np.where(ids >= 0, np.append(number, -1)[ids], ids).astype(np.int32)
    return replace(view, masks=fewer, mask_features=view.mask_features[kept], mask_tracks=tracks, cut_from=None)


def _colors(scene: Scene, kept: str, rng: np.random.Generator) -> Scene:
    rgb = scene.points.rgb
    if rgb is None:
        return scene
    found = None
    if kept == "bled":
        xyz = scene.points.xyz
        place = xyz + rng.normal(0, BLED_PX, xyz.shape) * _pixel_sizes(scene)[:, None]
        found = rgb[np.asarray(cKDTree(xyz).query(place)[1])]
    elif kept != "none":
        exact = rgb.astype(np.float64) if kept == "noisy" else np.repeat(rgb.mean(axis=1, keepdims=True), 3, axis=1)
        found = np.clip(exact + rng.normal(0, COLOR_NOISE, rgb.shape), 0, 255).astype(np.uint8)
    return replace(scene, points=replace(scene.points, rgb=found))


def _exposure(scene: Scene, spread: float, rng: np.random.Generator) -> Scene:
    def adjusted(view: View) -> View:
        image, factors = view.image_rgb(), np.exp(rng.normal(0, spread) + rng.normal(0, spread / 4, 3))
        if image is None:
            return view
        return replace(view, image=np.clip(np.rint(image * factors), 0, 255).astype(np.uint8))

    return replace(scene, views=tuple(map(adjusted, scene.views)))


def _pixel_sizes(scene: Scene) -> NDArray[np.float64]:
    """(n,) the size of a pixel at each point, scene units: the median over views; 0 where no image has the point."""
    sizes = np.full((len(scene.views), len(scene.points)), np.nan)
    for row, camera in enumerate(view.camera for view in scene.views):
        uv_px, depth = camera.project(scene.points.xyz)
        inside = (depth > 0) & ((uv_px >= 0) & (uv_px < [camera.width, camera.height])).all(axis=1)
        sizes[row, inside] = depth[inside] / camera.fx
    shown = ~np.isnan(sizes).all(axis=0)
    found = np.zeros(len(scene.points))
    found[shown] = np.nanmedian(sizes[:, shown], axis=0)
    return found


WAYS: Mapping[str, Callable[[Scene, Any, np.random.Generator], Scene]] = {
    "views": _views, "points": _points, "noise": _noise, "strays": _strays, "poses": _poses, "masks": _masks,
    "eroded": _eroded, "colors": _colors, "exposure": _exposure,
}  # fmt: skip
