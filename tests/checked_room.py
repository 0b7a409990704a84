"""A room of colored tiles seen from inside, by closed formulas: small, without symmetry, right in every part."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
from pinhole import looking, rays

from og_pointcloud.formats.poses import in_local_frame
from og_pointcloud.scene import Camera, Points, Scene, View

SIZE = np.array([4.0, 3.0, 2.5])
WIDTH, HEIGHT, FOCAL_PX = 96, 72, 60.0
CENTER = (45.0, 37.0)
TILE, MASK = 0.25, 0.7
"""Edges of tiles, which have a color each, and of masks."""
FEATURES = 24


@lru_cache
def tiled_room(seed=0, views=10, points=9000, origin=(0.0, 0.0, 0.0), scale=1.0):
    """A right scene: photographs, masks, features and colored points of the room's six sides."""
    random = np.random.default_rng(seed)
    xyz, side = _surface(random, points)
    rgb = _colors(xyz, side, seed)
    cloud = Points.from_world(scale * xyz + origin, rgb=rgb)
    vectors = random.normal(size=(4000, FEATURES))
    found = tuple(_view(random, index, views, seed, vectors, scale) for index in range(views))
    moved = (replace(v, camera=in_local_frame(v.camera, cloud.origin - origin)) for v in found)
    return Scene(cloud, tuple(moved), "tiles")


def with_cameras(scene, change):
    """The scene with the cameras that ``change`` makes of all of them, which start from world coordinates."""
    world = [in_local_frame(view.camera, -scene.points.origin) for view in scene.views]
    cameras = [in_local_frame(camera, scene.points.origin) for camera in change(world)]
    views = (replace(view, camera=camera) for view, camera in zip(scene.views, cameras, strict=True))
    return replace(scene, views=tuple(views))


def with_views(scene, **parts):
    """The scene with the parts of views that functions of (view, index, views) make."""
    changed = (
        replace(view, **{name: part(view, index, scene.views) for name, part in parts.items()})
        for index, view in enumerate(scene.views)
    )
    return replace(scene, views=tuple(changed))


def _surface(random, count):
    side = random.choice(6, count, p=np.array([7.5, 7.5, 10, 10, 12, 12]) / 59)
    xyz = random.uniform(size=(count, 3)) * SIZE
    axis = side // 2
    xyz[np.arange(count), axis] = np.where(side % 2, SIZE[axis], 0)
    return xyz, side


def _cells(xyz, side, edge):
    """A number for the square of that edge, on its side, that a place lies in."""
    cell = np.floor(xyz / edge + 1e-6).astype(np.int64)
    cell[np.arange(len(xyz)), side // 2] = 0
    return side * 4096 + cell @ np.array([1, 16, 256])


def _colors(xyz, side, seed):
    palette = np.random.default_rng(seed + 100).integers(30, 226, (6 * 4096, 3)).astype(np.uint8)
    return palette[_cells(xyz, side, TILE)]


def _view(random, index, count, seed, vectors, scale):
    camera = _camera(random, index, count)
    xyz, side = _hits(camera)
    image = _colors(xyz, side, seed).reshape(HEIGHT, WIDTH, 3)
    things = _cells(xyz, side, MASK)
    shown, ids = np.unique(things, return_inverse=True)
    order = random.permutation(len(shown))
    features = vectors[shown % len(vectors)] + 0.3 * random.normal(size=(len(shown), FEATURES))
    rows = np.empty_like(features)
    rows[order] = features
    pose = camera.world_to_camera.copy()
    pose[:3, 3] *= scale
    masks = order[ids.reshape(HEIGHT, WIDTH)].astype(np.int32)
    return View(f"view{index:02d}", replace(camera, world_to_camera=pose), masks, rows.astype(np.float32), image)


def _camera(random, index, count):
    """From a place in the middle, looking around, a little up or down, never level twice."""
    place = SIZE / 2 + random.uniform(-0.5, 0.5, 3)
    angle = 2 * np.pi * index / count + random.uniform(0, 0.2)
    pose = looking(place, [np.cos(angle), np.sin(angle), random.uniform(-0.5, 0.3)])
    return Camera(WIDTH, HEIGHT, FOCAL_PX, FOCAL_PX, *CENTER, pose)


def _hits(camera):
    along, place = rays(camera).reshape(-1, 3), camera.center
    with np.errstate(divide="ignore"):
        reach = np.where(along > 0, (SIZE - place) / along, -place / along)
    axis = reach.argmin(axis=1)
    rows = np.arange(len(along))
    return place + along * reach[rows, axis, None], 2 * axis + (along[rows, axis] > 0)
