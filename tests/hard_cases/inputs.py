"""Small inputs that the cases deform: Gaussians before a camera, two balls seen from around, a labelled cloud."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from labelled_clouds import unit_rows
from numpy.typing import ArrayLike, NDArray
from pinhole import looking
from reference_splatting import reference_pixel_weights, round_splats
from scenes import ray_cast, write_scene
from scipy.sparse import csr_array

from hard_cases import naive
from hard_cases.case import Answer
from og_pointcloud.cloud import InstanceTable, LabelledCloud, Vocabulary
from og_pointcloud.fitting.mask_table import MaskTable
from og_pointcloud.formats.poses import in_local_frame, rigid
from og_pointcloud.rendering.splatting import Gaussians, view_weights
from og_pointcloud.scene import Camera, Points, Scene, View

__all__ = [
    "SPACE", "by_ball", "camera", "dense_weights", "int32", "labelled_cloud", "mask_table_of", "scatter", "single",
    "solid", "splatted", "two_balls", "unit_rows", "write_two_balls",
]  # fmt: skip

NEAR = 0.05
SPACE = "catalogue"
BALLS = np.array([[-0.8, 0, 0], [0.8, 0, 0]])
RADIUS = 0.5


def single(values: ArrayLike) -> NDArray[np.float32]:
    """An array of float32."""
    return np.asarray(values, np.float32)


def int32(values: ArrayLike) -> NDArray[np.int32]:
    """An array of int32."""
    return np.asarray(values, np.int32)


def camera(
    width: int = 24, height: int = 18, focal_px: float = 22.0, pose: NDArray[np.float64] | None = None
) -> Camera:
    """A pinhole camera with its principal point in the middle."""
    pose = np.eye(4) if pose is None else pose
    return Camera(width, height, focal_px, focal_px, width / 2, height / 2, pose)


def scatter(count: int = 10, seed: int = 0) -> Gaussians:
    """Gaussians of any shape and direction, 2 to 4 before a camera at the origin."""
    random = np.random.default_rng(seed)
    xyz = np.c_[random.uniform(-0.8, 0.8, (count, 2)), random.uniform(2, 4, count)]
    return Gaussians(
        xyz.astype(np.float32),
        random.uniform(0.05, 0.3, (count, 3)).astype(np.float32),
        unit_rows(count, 4, seed),
        random.uniform(0.3, 0.95, count).astype(np.float32),
    )


def solid(xyz: NDArray[np.float32]) -> Gaussians:
    """Round, nearly opaque Gaussians at these points."""
    return round_splats(xyz, 0.06)


def dense_weights(gaussians: Gaussians, view: Camera, near: float = NEAR) -> NDArray[np.float32]:
    """The library's blending weights, (H, W, n)."""
    return view_weights(gaussians, view, near).toarray().reshape(view.height, view.width, len(gaussians))


def splatted(gaussians: Gaussians, view: Camera, near: float = NEAR, naive_near: float | None = None) -> Answer:
    """Blending weights by the library, by definition, and by float32; naive_near: its near plane, where another."""
    plain_near = near if naive_near is None else naive_near
    parts = gaussians.xyz, gaussians.scale, gaussians.rotation, gaussians.opacity
    return Answer(
        dense_weights(gaussians, view, near),
        reference_pixel_weights(gaussians, view, near),
        lambda: naive.pixel_weights(*parts, view, plain_near),
    )


def mask_table_of(weights: NDArray[np.floating], mask_view: list[int]) -> MaskTable:
    """A table of these (masks, n) weights, without anything outside the masks."""
    table = csr_array(weights.astype(np.float32))
    nothing = csr_array(np.zeros((max(mask_view) + 1, weights.shape[1]), np.float32))
    features = unit_rows(len(mask_view), 4)
    pixels = np.asarray(table.sum(axis=1)).astype(np.int32)
    return MaskTable(table, nothing, nothing, np.array(mask_view, np.int32), pixels, features)


def two_balls(
    views: int = 5,
    points: int = 300,
    size: float = 1.0,
    origin: tuple[float, float, float] = (0, 0, 0),
    features: NDArray[np.float32] | None = None,
) -> tuple[Scene, NDArray[np.int32]]:
    """Two balls seen from around, ray-cast, and the ball of each point. size: scene units per meter; origin: world
    coordinates of the middle; features: of the two masks, else unit rows of width 8."""
    features = unit_rows(2, 8) if features is None else features
    step = (np.arange(points) + 0.5) / points
    turn = step * points * np.pi * (3 - np.sqrt(5))
    ring = np.sqrt(1 - (1 - 2 * step) ** 2)
    sphere = RADIUS * np.stack([ring * np.cos(turn), ring * np.sin(turn), 1 - 2 * step], axis=1)
    world = size * np.concatenate([sphere + center for center in BALLS]) + origin
    cloud = Points.from_world(world)
    made = []
    for index in range(views):
        seen = camera(48, 36, 40.0, _around(2 * np.pi * index / views + 0.3))
        # The pose in the world, then in the cloud's frame, as readers do it.
        world_camera = in_local_frame(_scaled(seen, size), -np.asarray(origin, np.float64))
        made.append(
            View(f"view{index}", in_local_frame(world_camera, cloud.origin), ray_cast(seen, BALLS, RADIUS), features)
        )
    return Scene(cloud, tuple(made), SPACE), np.repeat(np.array([0, 1], np.int32), points)


def write_two_balls(folder: Path, **how: Any) -> NDArray[np.int32]:
    """The same as a capture folder in world coordinates; returns the ball of each point."""
    scene, balls = two_balls(**how)
    write_scene(folder, scene)
    return balls


def labelled_cloud(
    count: int = 200,
    instances: int = 5,
    width: int = 16,
    origin: tuple[float, float, float] = (0, 0, 0),
    size: float = 1.0,
    descriptors: NDArray[np.float32] | None = None,
) -> LabelledCloud:
    """Points in a unit cube, each of a random instance; row k of the descriptors is of instance k."""
    random = np.random.default_rng(0)
    xyz = (size * random.random((count, 3))).astype(np.float32)
    ids = random.integers(0, instances, count).astype(np.int32)
    descriptors = unit_rows(instances, width) if descriptors is None else descriptors
    ones, points = np.ones(instances, np.int32), np.bincount(ids, minlength=instances).astype(np.int32)
    owners = np.arange(len(descriptors), dtype=np.int32)
    table = InstanceTable(descriptors, owners, points, ones, ones, ones.astype(np.float32), ones.astype(np.float32))
    words = Vocabulary(tuple(f"word {i}" for i in range(len(descriptors))), descriptors)
    world = np.array(origin, np.float64)
    return LabelledCloud(xyz, world, ids, table, SPACE, 0.1 * size, 0.3 * size, vocabulary=words)


def by_ball(ids: NDArray[np.int32], balls: NDArray[np.int32]) -> NDArray[np.int32]:
    """Instance ids renamed to the ball that they hold most of, -1 none; an instance that holds both is wrong of one."""
    named = np.full(len(ids), -1, np.int32)
    for instance in np.unique(ids[ids >= 0]):
        named[ids == instance] = np.bincount(balls[ids == instance]).argmax()
    return named


def _around(angle: float) -> NDArray[np.float64]:
    """World-to-camera of a camera 2.6 from the origin that looks at it, a little from above."""
    toward = np.array([np.cos(angle), np.sin(angle), 0.5])
    return looking(2.6 * toward / np.linalg.norm(toward), -toward)


def _scaled(seen: Camera, size: float) -> Camera:
    rotation, translation = seen.world_to_camera[:3, :3], seen.world_to_camera[:3, 3]
    return Camera(seen.width, seen.height, seen.fx, seen.fy, seen.cx, seen.cy, rigid(rotation, size * translation))
