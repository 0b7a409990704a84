"""Scenes that tests make, whose truth is known exactly: two balls on a floor, as a tiny capture that is fitted,
segmented and damaged; and a room with a crate in it, as depth images.

Other makers: `labelled_clouds` (clouds as a fit leaves them), `capture_files` (a few poses in every format), `street`.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from pinhole import looking, rays

from og_pointcloud.formats.depth import DepthFile, DepthFrame
from og_pointcloud.formats.poses import rigid
from og_pointcloud.scene import Camera, Points, Scene, View

NAMES = ("red ball", "blue ball")
UNUSED_NAME = "lamp"
FEATURE_SPACE = "tiny-test-space"
FEATURE_WIDTH = 16
CENTERS = np.array([[-0.6, 0.0, 0.5], [0.6, 0.1, 0.5]])
RADIUS = 0.5
COLORS = np.array([[200, 40, 40], [40, 40, 200], [120, 120, 120]], np.uint8)  # the last one is the floor's
WIDTH, HEIGHT, FOCAL_PX = 120, 90, 110.0
FLOOR = -1

ROOM = np.array([[0.0, 0.0, 0.0], [4.0, 3.0, 2.5]])
CRATE = np.array([[1.6, 1.2, 0.0], [2.4, 1.8, 0.9]])
ROOM_SIZE, ROOM_FOCAL_PX = (160, 120), 130.0
WALL, THING = (90, 90, 90), (220, 200, 40)


@dataclass(frozen=True)
class TinyCapture:
    """folder: the capture. object_ids: (n,) int32, row of NAMES per point of points.ply, -1 on the floor."""

    folder: Path
    object_ids: NDArray[np.int32]

    @property
    def text_features(self) -> Path:
        return self.folder / "text_features.npz"

    def share_correct(self, labels: NDArray[np.int32], names: list[str]) -> float:
        """Share of the balls' points whose label is their ball; unknown counts as wrong."""
        truth = np.array([names.index(name) for name in NAMES])[self.object_ids]
        on_ball = self.object_ids != FLOOR
        return float((labels[on_ball] == truth[on_ball]).mean())


def write_tiny_capture(folder: Path, view_count: int = 6) -> TinyCapture:
    random = np.random.default_rng(0)
    xyz, object_ids = sample_surfaces()
    vectors = np.linalg.qr(random.normal(size=(FEATURE_WIDTH, FEATURE_WIDTH)))[0].astype(np.float32)[:3]
    views = []
    for index in range(view_count):
        angle = 2 * np.pi * (index + 0.25) / view_count
        eye = 2.6 * np.array([np.cos(angle), np.sin(angle), 0.6])
        seen_by = Camera(WIDTH, HEIGHT, FOCAL_PX, FOCAL_PX, WIDTH / 2, HEIGHT / 2, looking(eye, [0, 0, 0.4] - eye))
        object_map = ray_cast(seen_by)
        order = random.permutation(len(NAMES))  # mask ids mean nothing across views
        rows = np.argsort(order)
        features = vectors[rows] + 0.05 * random.normal(size=(len(rows), FEATURE_WIDTH)).astype(np.float32)
        masks = np.append(order, -1)[object_map].astype(np.int32)
        views.append(View(f"view{index}", seen_by, masks, features, COLORS[object_map]))
    write_scene(folder, Scene(Points(xyz, np.zeros(3), COLORS[object_ids]), tuple(views), FEATURE_SPACE))
    names = np.array([*NAMES, UNUSED_NAME])
    np.savez(folder / "text_features.npz", names=names, vectors=vectors, feature_space=np.array(FEATURE_SPACE))
    return TinyCapture(folder, object_ids)


def write_scene(folder: Path, scene: Scene) -> Path:
    """The scene as a capture folder: nerfstudio's poses, in the world; all views have the first one's intrinsics."""
    frames = []
    for view in scene.views:
        center, rotation = view.camera.center + scene.points.origin, view.camera.world_to_camera[:3, :3].T
        camera_to_world = rigid(rotation @ np.diag([1.0, -1, -1]), center)  # OpenGL axes
        frames.append({"file_path": f"images/{view.name}.png", "transform_matrix": camera_to_world.tolist()})
        write_image(folder / "masks" / f"{view.name}.png", (view.mask_map() + 1).astype(np.uint16))
        image = view.image_rgb()
        if image is not None:
            write_image(folder / "images" / f"{view.name}.png", image[..., ::-1])
    one = scene.views[0].camera
    intrinsics = {"fl_x": one.fx, "fl_y": one.fy, "cx": one.cx, "cy": one.cy, "w": one.width, "h": one.height}
    transforms = {**intrinsics, "ply_file_path": "points.ply", "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(transforms))
    features = {view.name: view.mask_features for view in scene.views}
    np.savez(folder / "mask_features.npz", allow_pickle=False, feature_space=np.array(scene.feature_space), **features)
    points = scene.points
    write_ply(folder / "points.ply", points.xyz_world if points.origin.any() else points.xyz, points.rgb)
    return folder


def sample_surfaces(per_ball: int = 500, floor_side: int = 24) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Points (n, 3) on two balls (Fibonacci lattice) and a square floor at z = 0, with their object ids."""
    step = np.arange(per_ball) + 0.5
    height, turn = 1 - 2 * step / per_ball, step * np.pi * (3 - np.sqrt(5))
    ring = np.sqrt(1 - height**2)
    sphere = np.stack([ring * np.cos(turn), ring * np.sin(turn), height], axis=1) * RADIUS
    side = np.linspace(-1.2, 1.2, floor_side)
    floor = np.stack([*np.meshgrid(side, side), np.zeros((floor_side, floor_side))], axis=-1).reshape(-1, 3)
    xyz = np.concatenate([sphere + CENTERS[0], sphere + CENTERS[1], floor]).astype(np.float32)
    return xyz, np.repeat(np.array([0, 1, FLOOR], np.int32), [per_ball, per_ball, len(floor)])


def ray_cast(camera: Camera, centers: NDArray[np.float64] = CENTERS, radius: float = RADIUS) -> NDArray[np.int32]:
    """(H, W) int32: the ball that each pixel's ray meets first, a row of NAMES; -1 none."""
    ray = rays(camera)
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    nearest, seen = np.full(ray.shape[:2], np.inf), np.full(ray.shape[:2], -1, np.int32)
    for ball, center in enumerate(centers):
        along = ray @ (center - camera.center)
        missed = ((center - camera.center) ** 2).sum() - along**2
        distance = np.where(missed < radius**2, along - np.sqrt(np.maximum(radius**2 - missed, 0)), np.inf)
        seen[distance < nearest] = ball
        nearest = np.minimum(nearest, distance)
    return seen


def write_ply(path: Path, xyz: NDArray[np.floating], rgb: NDArray[np.uint8] | None) -> None:
    """A binary little-endian cloud, float or double as the positions are; written here so that the project's own writer
    is not what its reader is held to."""
    kind = "double" if xyz.dtype == np.float64 else "float"
    lines = [f"property {kind} {axis}" for axis in "xyz"]
    lines += [f"property uchar {color}" for color in ("red", "green", "blue") if rgb is not None]
    header = "\n".join(["ply", "format binary_little_endian 1.0", f"element vertex {len(xyz)}", *lines, "end_header\n"])
    rows = np.zeros(len(xyz), [("xyz", xyz.dtype.newbyteorder("<"), 3), ("rgb", "u1", (0 if rgb is None else 3,))])
    rows["xyz"], rows["rgb"] = xyz, np.zeros((len(xyz), 0)) if rgb is None else rgb
    path.write_bytes(header.encode() + rows.tobytes())


def write_image(file: Path, pixels: NDArray[np.generic]) -> None:
    """Pixels as OpenCV orders them, encoded as the file's suffix says."""
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(cv2.imencode(file.suffix, pixels)[1].tobytes())


# The room and its depth images ------------------------------------------------------------


def room_poses(count: int = 12, offset=(0.0, 0.0, 0.0)):
    """Camera-to-world (4, 4), OpenCV axes: on a ring, looking at the crate; every other one to the far wall."""
    made = []
    for index in range(count):
        angle = 2 * np.pi * index / count
        eye = np.array([2 + 1.5 * np.cos(angle), 1.5 + 1.1 * np.sin(angle), 1.3])
        made.append(np.linalg.inv(looking(eye + offset, [2.0, 1.5, 0.5 if index % 2 else 1.0] - eye)))
    return made


def look(pose, offset=(0.0, 0.0, 0.0), size=ROOM_SIZE, intrinsics=None):
    """Exact depth (H, W) float64 and colors (H, W, 3) of the room. intrinsics: fx fy cx cy, pixel centers at +0.5."""
    ray, eye = rays(camera(pose, size, intrinsics)), pose[:3, 3] - offset
    with np.errstate(divide="ignore"):
        to_walls = np.where(ray > 0, ROOM[1] - eye, ROOM[0] - eye) / ray
        enters, leaves = np.sort(np.stack([(CRATE[0] - eye) / ray, (CRATE[1] - eye) / ray]), axis=0)
    near, far = enters.max(axis=2), leaves.min(axis=2)
    on_crate = (near < far) & (near > 0)
    depth = np.where(on_crate, near, np.abs(to_walls).min(axis=2))
    return depth, np.where(on_crate[..., None], THING, WALL).astype(np.uint8)


def default_intrinsics(size):
    width, height = size
    focal = ROOM_FOCAL_PX * width / ROOM_SIZE[0]
    return focal, focal, width / 2, height / 2


def distance_to_surface(xyz):
    """Distance of points (n, 3), in the room's own coordinates, to its walls or the crate, whichever is nearer."""
    to_walls = np.minimum(np.abs(xyz - ROOM[0]), np.abs(xyz - ROOM[1])).min(axis=1)
    outside = np.maximum(np.maximum(CRATE[0] - xyz, xyz - CRATE[1]), 0)
    inside = np.minimum(xyz - CRATE[0], CRATE[1] - xyz).min(axis=1)
    to_crate = np.where(inside > 0, inside, np.linalg.norm(outside, axis=1))
    return np.minimum(to_walls, to_crate)


def camera(pose, size=ROOM_SIZE, intrinsics=None):
    return Camera(*size, *(intrinsics or default_intrinsics(size)), world_to_camera=np.linalg.inv(pose))


def write_depth(file: Path, depth, unit=1e-3):
    """16-bit PNG in steps of ``unit``."""
    write_image(file, np.round(np.asarray(depth) / unit).clip(0, 65535).astype(np.uint16))


def write_rgb(file: Path, rgb):
    write_image(file, rgb[..., ::-1])


def write_frames(folder: Path, count=12, offset=(0.0, 0.0, 0.0), spoiled=None, unit=1e-3, colors=True):
    """DepthFrames of the room, written as PNG. spoiled(index, depth) -> the depth that the sensor gives."""
    frames = []
    for index, pose in enumerate(room_poses(count, offset)):
        depth, rgb = look(pose, offset)
        if spoiled:
            depth = spoiled(index, depth)
        write_depth(folder / f"{index}.png", depth, unit)
        file = DepthFile(folder / f"{index}.png", camera(pose), unit)
        frames.append(DepthFrame(f"view{index}", file, (lambda _, rgb=rgb: rgb) if colors else None))
    return frames
