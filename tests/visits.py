"""Two visits of a small place whose truth is known exactly: boxes on a floor, seen by cameras around them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from pinhole import looking, rays

import og_pointcloud as og
from og_pointcloud.scene import Camera, Points, Scene, View

SPACE, WIDTH = "visits-test-space", 16
SIZE, FOCAL_PX = (160, 120), 140.0
SPACING = 0.04
FLOOR = 1.6
DIRECTIONS = np.linalg.qr(np.random.default_rng(0).normal(size=(WIDTH, WIDTH)))[0].astype(np.float32)
"""A feature a row: the floor's, then those that things name."""


@dataclass(frozen=True)
class Thing:
    """A box: its lowest corner, its size, its color, and the row of its feature direction."""

    low: tuple[float, float, float]
    size: tuple[float, float, float]
    color: tuple[int, int, int]
    feature: int


CHEST = Thing((-1.0, -0.3, 0.0), (0.6, 0.7, 0.5), (200, 60, 50), 1)
BIN = Thing((0.3, -0.9, 0.0), (0.4, 0.4, 0.6), (50, 80, 210), 2)
CRATE = Thing((0.4, 0.5, 0.0), (0.5, 0.4, 0.4), (60, 190, 80), 3)
PARCEL = Thing((-0.3, -1.3, 0.0), (0.4, 0.4, 0.4), (220, 200, 40), 4)


def moved(thing: Thing, by: tuple[float, float, float]) -> Thing:
    """The same thing elsewhere."""
    x, y, z = (a + b for a, b in zip(thing.low, by, strict=True))
    return replace(thing, low=(x, y, z))


def cameras(count: int = 14, part: tuple[float, float] = (0, 1), size: tuple[int, int] = SIZE) -> list[Camera]:
    """On a circle, looking at the middle from above; of the circle, a part. size: of the images, of the same view."""
    focal_px = FOCAL_PX * size[0] / SIZE[0]
    made = []
    for turn in np.linspace(*part, count, endpoint=False) * 2 * np.pi:
        center = np.array([3.4 * np.cos(turn), 3.4 * np.sin(turn), 2.0])
        made.append(Camera(*size, focal_px, focal_px, size[0] / 2, size[1] / 2, looking(center, -center)))
    return made


def cast(things: list[Thing], camera: Camera) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """(H, W) depth along the axis, 0 beyond the floor, and what is seen: a row of things, -1 floor, -2 nothing."""
    along, center = rays(camera), camera.center
    depth, seen = np.full(along.shape[:2], np.inf), np.full(along.shape[:2], -2, np.int32)
    with np.errstate(divide="ignore", invalid="ignore"):
        to_floor = -center[2] / along[..., 2]
        hits = center + to_floor[..., None] * along
        on_floor = (to_floor > 0) & (np.abs(hits[..., :2]).max(axis=-1) < FLOOR)
        depth[on_floor], seen[on_floor] = to_floor[on_floor], -1
        for row, thing in enumerate(things):
            low = (np.array(thing.low) - center) / along
            high = (np.array(thing.low) + thing.size - center) / along
            enters, leaves = np.minimum(low, high).max(axis=-1), np.maximum(low, high).min(axis=-1)
            hit = (enters < leaves) & (enters > 0) & (enters < depth)
            depth[hit], seen[hit] = enters[hit], row
    return np.where(np.isfinite(depth), depth, 0).astype(np.float32), seen


def surface(
    things: list[Thing], seed: int = 0, spacing: float = SPACING
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Points strewn over floor and boxes but for what things stand on, and the thing of each, -1 floor."""
    random = np.random.default_rng(seed)
    floor = random.uniform(-FLOOR, FLOOR, (int((2 * FLOOR / spacing) ** 2), 2))
    parts, owner = [np.c_[floor, np.zeros(len(floor))]], [np.full(len(floor), -1)]
    for row, thing in enumerate(things):
        low, size = np.array(thing.low), np.array(thing.size)
        inside = ((parts[0][:, :2] > low[:2]) & (parts[0][:, :2] < low[:2] + size[:2])).all(axis=1)
        parts[0], owner[0] = parts[0][~inside], owner[0][~inside]
        for axis in range(3):
            for side in (0, 1) if axis < 2 else (1,):
                others = [a for a in range(3) if a != axis]
                count = int(np.prod(size[others]) / spacing**2)
                face = np.empty((count, 3))
                face[:, axis] = low[axis] + side * size[axis]
                face[:, others] = low[others] + random.random((count, 2)) * size[others]
                parts.append(face)
                owner.append(np.full(count, row))
    return np.concatenate(parts), np.concatenate(owner).astype(np.int32)


def features(
    things: list[Thing], seen: NDArray[np.int32], seed: int, floor: bool = True
) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """A view's masks, numbered at random, and their features. floor: whether it has a mask too."""
    random = np.random.default_rng(seed)
    shown = [row for row in np.unique(seen).tolist() if row > (-2 if floor else -1)]
    order = random.permutation(len(shown))
    ids = np.full(seen.shape, -1, np.int32)
    rows = np.zeros((len(shown), WIDTH), np.float32)
    for place, row in zip(order, shown, strict=True):
        ids[seen == row] = place
        rows[place] = DIRECTIONS[0 if row < 0 else things[row].feature]
    return ids, rows + 0.05 * random.normal(size=rows.shape).astype(np.float32)


def scene(
    things: list[Thing], views: list[Camera] | None = None, seed: int = 0, spacing: float = SPACING,
    floor: bool = True, photographs: bool = False,
) -> Scene:  # fmt: skip
    """A visit as a capture: points in the world frame whose origin is 0, and views."""
    xyz, owner = surface(things, seed, spacing)
    colors = np.array([(0, 0, 0), (128, 128, 128), *(thing.color for thing in things)], np.uint8)
    made = []
    for number, camera in enumerate(cameras() if views is None else views):
        seen = cast(things, camera)[1]
        ids, rows = features(things, seen, seed * 100 + number, floor)
        made.append(View(f"view{number:03d}", camera, ids, rows, colors[seen + 2] if photographs else None))
    points = Points(xyz.astype(np.float32), np.zeros(3), colors[owner + 2])
    return Scene(points, tuple(made), SPACE, f"visit {seed}")


def frames(things: list[Thing], views: list[Camera] | None = None, seed: int = 0, first: float = 0.0) -> list[og.Frame]:
    """A visit as frames with depth, masks and colors."""
    colors = np.array([(0, 0, 0), (128, 128, 128), *(thing.color for thing in things)], np.uint8)
    made = []
    for number, camera in enumerate(cameras() if views is None else views):
        depth, seen = cast(things, camera)
        ids, rows = features(things, seen, seed * 100 + number)
        made.append(og.Frame(camera, ids, rows, depth, rgb=colors[seen + 2], stamp=first + number))
    return made


def instance_of(cloud: og.LabelledCloud, thing: Thing) -> int:
    """The instance that most points within a thing's box have, -1 where none has one."""
    low, high = np.array(thing.low) - 0.02, np.array(thing.low) + thing.size + 0.02
    low[2] = 0.06  # not the floor's
    ids = cloud.instance_ids[((cloud.xyz_world > low) & (cloud.xyz_world < high)).all(axis=1)]
    return int(np.bincount(ids[ids >= 0]).argmax()) if (ids >= 0).any() else -1
