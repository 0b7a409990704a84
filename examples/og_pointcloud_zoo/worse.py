"""A scene made worse, in one way by so much: what does a capture need, and what does a fit make of less?

views    so many of the views, evenly spread
points   this share of the points, at random
noise    every point is off by so many spacings, standard deviation along each axis
strays   so many points more, as a share of them, anywhere in the scene's box
poses    every camera is turned to a random side, so that its image is off by so many pixels
masks    this share of the masks is missing
colors   "noisy": the points' colors with noise; "grey": that without hue; "none": without colors

The same scene and amount is the same worse scene, always. Truth goes with its points; of strays nobody knows it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from og_pointcloud.errors import OgPointcloudError
from og_pointcloud.evaluate.truth import Truth
from og_pointcloud.formats.poses import rotation_of_vector
from og_pointcloud.scene import Points, Scene, View

COLOR_NOISE = 30.0
"""Standard deviation of noisy colors, of 255 levels: made colors are cleaner than those of a scan."""
COLORS = ("noisy", "grey", "none")
LADDER: Mapping[str, tuple[float, ...]] = {
    "views": (12, 8, 5, 3),
    "points": (0.5, 0.2, 0.05),
    "noise": (0.5, 1, 2, 4),
    "strays": (0.02, 0.1, 0.3),
    "poses": (1, 2, 4, 8),
    "masks": (0.25, 0.5, 0.75),
}
"""What is tried of each, from little to much."""


def worse(scene: Scene, truth: Truth, kind: str, amount: Any) -> tuple[Scene, Truth]:
    """The scene and its truth made worse. OgPointcloudError for another kind or amount."""
    valid = amount in COLORS if kind == "colors" else isinstance(amount, int | float) and 0 < amount < np.inf
    if kind not in WAYS or not valid or (kind in ("points", "masks") and amount > 1):
        raise OgPointcloudError(
            f"'{kind}={amount}' makes nothing worse; expected one of {', '.join(WAYS)}, and a positive number, a share "
            f"of points or masks up to 1, or a color of {', '.join(COLORS)}"
        )
    return WAYS[kind](scene, truth, amount, np.random.default_rng(0))


def _views(scene: Scene, truth: Truth, count: float, _: np.random.Generator) -> tuple[Scene, Truth]:
    most = len(scene.views)
    kept = np.unique(np.linspace(0, most - 1, min(int(count), most)).round().astype(int))
    return replace(scene, views=tuple(scene.views[k] for k in kept)), truth


def _points(scene: Scene, truth: Truth, share: float, rng: np.random.Generator) -> tuple[Scene, Truth]:
    n = len(scene.points)
    rows = np.sort(rng.choice(n, max(1, round(share * n)), replace=False))
    return replace(scene, points=scene.points.take(rows)), _truth_of(truth, rows)


def _noise(scene: Scene, truth: Truth, spacings: float, rng: np.random.Generator) -> tuple[Scene, Truth]:
    points = scene.points
    spacing = float(np.median(np.asarray(cKDTree(points.xyz).query(points.xyz, 2)[0])[:, 1]))
    moved = points.xyz + rng.normal(0, spacings * spacing, points.xyz.shape)
    return replace(scene, points=replace(points, xyz=moved.astype(np.float32))), truth


def _strays(scene: Scene, truth: Truth, share: float, rng: np.random.Generator) -> tuple[Scene, Truth]:
    points = scene.points
    low, high = np.percentile(points.xyz, [1, 99], axis=0)
    count = round(share * len(points))
    xyz = np.concatenate([points.xyz, rng.uniform(low, high, (count, 3)).astype(np.float32)])
    rgb = None
    if points.rgb is not None:
        rgb = np.concatenate([points.rgb, points.rgb[rng.integers(0, len(points), count)]])
    rows = np.append(np.arange(len(points)), np.full(count, -1))
    return replace(scene, points=Points(xyz, points.origin, rgb)), _truth_of(truth, rows)


def _poses(scene: Scene, truth: Truth, pixels: float, rng: np.random.Generator) -> tuple[Scene, Truth]:
    def turned(view: View) -> View:
        side, turn = rng.uniform(0, 2 * np.pi), np.eye(4)
        turn[:3, :3] = rotation_of_vector(np.array([np.cos(side), np.sin(side), 0]) * pixels / view.camera.fx)
        return replace(view, camera=replace(view.camera, world_to_camera=turn @ view.camera.world_to_camera))

    return replace(scene, views=tuple(map(turned, scene.views))), truth


def _masks(scene: Scene, truth: Truth, share: float, rng: np.random.Generator) -> tuple[Scene, Truth]:
    def without(view: View) -> View:
        kept = rng.random(view.mask_count) >= share
        number = np.where(kept, np.cumsum(kept) - 1, -1)
        ids = view.mask_map()
        tracks = None if view.mask_tracks is None else view.mask_tracks[kept]
        fewer = np.where(ids >= 0, np.append(number, -1)[ids], ids).astype(np.int32)
        return replace(view, masks=fewer, mask_features=view.mask_features[kept], mask_tracks=tracks, cut_from=None)

    return replace(scene, views=tuple(map(without, scene.views))), truth


def _colors(scene: Scene, truth: Truth, kept: str, rng: np.random.Generator) -> tuple[Scene, Truth]:
    rgb = scene.points.rgb
    if rgb is None:
        return scene, truth
    found = None
    if kept != "none":
        exact = rgb.astype(np.float64) if kept == "noisy" else np.repeat(rgb.mean(axis=1, keepdims=True), 3, axis=1)
        found = np.clip(exact + rng.normal(0, COLOR_NOISE, rgb.shape), 0, 255).astype(np.uint8)
    return replace(scene, points=replace(scene.points, rgb=found)), truth


def _truth_of(truth: Truth, rows: NDArray[np.integer]) -> Truth:
    """The truth of some of its points; of rows below 0 nothing is known."""
    known = rows >= 0
    return Truth(
        np.where(known, truth.cls[rows], -1),
        truth.names,
        known & truth.scored[rows],
        None if truth.background is None else known & truth.background[rows],
        None if truth.instance is None else np.where(known, truth.instance[rows], -1),
    )


WAYS: Mapping[str, Callable[[Scene, Truth, Any, np.random.Generator], tuple[Scene, Truth]]] = {
    "views": _views, "points": _points, "noise": _noise, "strays": _strays, "poses": _poses, "masks": _masks,
    "colors": _colors,
}  # fmt: skip
