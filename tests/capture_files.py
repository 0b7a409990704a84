"""Writers for miniature captures in every format, straight from the formats' descriptions, for the reader's tests."""

from __future__ import annotations

import itertools
import json
import struct
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scenes import write_image

from og_pointcloud.scene import Camera

WIDTH, HEIGHT = 64, 48
CAMERA_MODEL_IDS = {
    "SIMPLE_PINHOLE": 0,
    "PINHOLE": 1,
    "SIMPLE_RADIAL": 2,
    "OPENCV": 4,
    "OPENCV_FISHEYE": 5,
    "FULL_OPENCV": 6,
    "FOV": 7,
    "RAD_TAN_THIN_PRISM_FISHEYE": 11,
}


def quaternion_matrix(q):
    """Rotation of a unit quaternion wxyz as q v q*, written out as the cross-product form."""
    w, v = q[0], np.asarray(q[1:])
    cross = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    return np.eye(3) + 2 * w * cross + 2 * cross @ cross


@dataclass
class World:
    """A few posed images of a handful of points, known exactly."""

    names: list[str]
    quaternions: np.ndarray
    translations: np.ndarray
    xyz: np.ndarray
    rgb: np.ndarray
    intrinsics: tuple[float, float, float, float] = (70.0, 72.0, 31.0, 25.5)
    features: dict[str, np.ndarray] = field(default_factory=dict)

    @property
    def poses(self):
        """(n, 4, 4) world-to-camera, OpenCV."""
        poses = np.tile(np.eye(4), (len(self.names), 1, 1))
        poses[:, :3, :3] = [quaternion_matrix(q) for q in self.quaternions]
        poses[:, :3, 3] = self.translations
        return poses

    def camera(self, pose):
        return Camera(WIDTH, HEIGHT, *self.intrinsics, world_to_camera=pose)


def edit_poses(folder, change):
    """Change what a transforms.json holds."""
    file = folder / "transforms.json"
    content = json.loads(file.read_text())
    change(content)
    file.write_text(json.dumps(content))


def make_world(offset=(0.0, 0.0, 0.0), count=3, seed=0):
    rng = np.random.default_rng(seed)
    quaternions = rng.normal(size=(count, 4))
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    centers = rng.normal(size=(count, 3)) + offset
    translations = np.array([-quaternion_matrix(q) @ c for q, c in zip(quaternions, centers, strict=True)])
    xyz = rng.normal(size=(50, 3)) * 2 + offset
    rgb = rng.integers(0, 256, (50, 3)).astype(np.uint8)
    return World([f"frame_{i:02d}" for i in range(count)], quaternions, translations, xyz, rgb)


def write_masks(folder: Path, names, size=(WIDTH, HEIGHT), dtype: type = np.uint16, replaced=None):
    """Two masks an image: id 1 the left third, id 2 the right third. Features of width 8, but for ``replaced``."""
    width, height = size
    ids = np.zeros((height, width), dtype)
    ids[:, : width // 3], ids[:, -(width // 3) :] = 1, 2
    rng = np.random.default_rng(1)
    features = {name: rng.normal(size=(2, 8)).astype(np.float16) for name in names}
    for name in names:
        write_image(folder / "masks" / f"{name}.png", ids)
    write_features(folder, {"feature_space": np.array("tiny"), **features, **(replaced or {})})
    return ids, features


BY_COLOR = "python:capture_files:by_color"
"""A mask proposer that takes no time: for tests of what is done with masks."""


def by_color(image):
    """(H, W, 3) -> (H, W) ids: a mask a color."""
    packed = image.astype(np.int32) @ np.array([1 << 16, 1 << 8, 1])
    return np.unique(packed, return_inverse=True)[1].reshape(packed.shape)


def write_features(folder: Path, arrays):
    np.savez(folder / "mask_features.npz", allow_pickle=False, **arrays)


def write_images(folder: Path, names, size=(WIDTH, HEIGHT)):
    """A red ramp to the right, a green one downwards, blue 30."""
    width, height = size
    bgr = np.full((height, width, 3), 30, np.uint8)
    bgr[..., 2] = np.linspace(0, 250, width).round()
    bgr[..., 1] = np.linspace(0, 250, height).round()[:, None]
    for name in names:
        write_image(folder / "images" / f"{name}.png", bgr)
    return bgr[..., ::-1]


def write_transforms(folder: Path, world: World, per_frame=False, suffix=".png", name="transforms.json", **keys):
    fx, fy, cx, cy = world.intrinsics
    shared = {"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, "w": WIDTH, "h": HEIGHT}
    frames = []
    for image, pose in zip(world.names, world.poses, strict=True):
        camera_to_world = np.linalg.inv(pose) @ np.diag([1.0, -1.0, -1.0, 1.0])
        # A camera far from the origin: inverting the pose would lose digits that the center has.
        frame = {"file_path": f"images/{image}{suffix}", "transform_matrix": camera_to_world.tolist()}
        frames.append({**frame, **shared} if per_frame else frame)
    content = {**({} if per_frame else shared), "frames": frames, **keys}
    (folder / name).write_text(json.dumps({key: value for key, value in content.items() if value is not None}))


def _colmap_images(world: World, cameras, poses):
    """(name, pose, camera id) of each image; the cameras take turns."""
    rows = np.hstack([world.quaternions, world.translations]) if poses is None else poses
    return zip(world.names, rows, itertools.cycle(cameras), strict=False)


def write_colmap_text(model: Path, world: World, cameras=None, poses=None):
    """cameras: lines of cameras.txt by camera id; poses: (qw qx qy qz tx ty tz) per image, else the world's."""
    model.mkdir(parents=True, exist_ok=True)
    cameras = cameras or {1: ("PINHOLE", world.intrinsics)}
    lines = [
        f"{camera_id} {name} {WIDTH} {HEIGHT} " + " ".join(f"{value!r}" for value in values)
        for camera_id, (name, values) in cameras.items()
    ]
    (model / "cameras.txt").write_text("# Camera list\n" + "\n".join(lines) + "\n")
    text = "# Image list\n# Number of images\n"
    for index, (name, row, camera_id) in enumerate(_colmap_images(world, cameras, poses)):
        text += f"{index + 1} " + " ".join(f"{float(v)!r}" for v in row) + f" {camera_id} {name}.png\n"
        text += "1.5 2.5 -1 3.5 4.5 7\n" if index % 2 else "\n"
    (model / "images.txt").write_text(text)
    points = [
        f"{i} {x!r} {y!r} {z!r} {r} {g} {b} 0.5 1 0 2 0"
        for i, ((x, y, z), (r, g, b)) in enumerate(zip(world.xyz.tolist(), world.rgb.tolist(), strict=True))
    ]
    (model / "points3D.txt").write_text("# 3D point list\n" + "\n".join(points) + "\n")


def write_colmap_binary(model: Path, world: World, cameras=None, poses=None):
    model.mkdir(parents=True, exist_ok=True)
    cameras = cameras or {1: ("PINHOLE", world.intrinsics)}
    data = struct.pack("<Q", len(cameras))
    for camera_id, (name, values) in cameras.items():
        data += struct.pack("<IiQQ", camera_id, CAMERA_MODEL_IDS[name], WIDTH, HEIGHT)
        data += struct.pack(f"<{len(values)}d", *values)
    (model / "cameras.bin").write_bytes(data)
    data = struct.pack("<Q", len(world.names))
    for index, (name, row, camera_id) in enumerate(_colmap_images(world, cameras, poses)):
        data += struct.pack("<I7dI", index + 1, *row, camera_id) + f"{name}.png".encode() + b"\0"
        data += struct.pack("<Q", index) + struct.pack("<ddq", 1.5, 2.5, -1) * index
    (model / "images.bin").write_bytes(data)
    data = struct.pack("<Q", len(world.xyz))
    for index, (point, color) in enumerate(zip(world.xyz, world.rgb, strict=True)):
        track = index % 4
        data += struct.pack("<Q3d3BdQ", index, *point, *color.tolist(), 0.5, track) + struct.pack("<II", 1, 0) * track
    (model / "points3D.bin").write_bytes(data)


def same_camera(ours: Camera, theirs: Camera, tolerance=1e-9):
    """Whether two cameras agree to ``tolerance`` in every number."""
    a = np.array([ours.width, ours.height, ours.fx, ours.fy, ours.cx, ours.cy, *ours.world_to_camera.ravel()])
    b = np.array(
        [theirs.width, theirs.height, theirs.fx, theirs.fy, theirs.cx, theirs.cy, *theirs.world_to_camera.ravel()]
    )
    return float(np.abs(a - b).max()) <= tolerance
