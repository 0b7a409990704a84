"""A made room whose surfaces are known exactly: a box of walls with a box in it, seen by cameras that look around."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from og_pointcloud.formats.depth import DepthFile, DepthFrame
from og_pointcloud.scene import Camera

ROOM = np.array([[0.0, 0.0, 0.0], [4.0, 3.0, 2.5]])
CRATE = np.array([[1.6, 1.2, 0.0], [2.4, 1.8, 0.9]])
WIDTH, HEIGHT, FOCAL_PX = 160, 120, 130.0
WALL, THING = (90, 90, 90), (220, 200, 40)


def poses(count: int = 12, offset=(0.0, 0.0, 0.0)):
    """Camera-to-world (4, 4), OpenCV axes: on a ring, looking at the crate; every other one to the far wall."""
    made = []
    for index in range(count):
        angle = 2 * np.pi * index / count
        eye = np.array([2 + 1.5 * np.cos(angle), 1.5 + 1.1 * np.sin(angle), 1.3])
        forward = np.array([2.0, 1.5, 0.5 if index % 2 else 1.0]) - eye
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0, 0, 1.0])
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3] = np.stack([right, np.cross(forward, right), forward, eye + offset], axis=1)
        made.append(pose)
    return made


def look(pose, offset=(0.0, 0.0, 0.0), size=(WIDTH, HEIGHT), intrinsics=None):
    """Exact depth (H, W) float64 and colours (H, W, 3) of the room. intrinsics: fx fy cx cy, pixel centres at +0.5."""
    width, height = size
    fx, fy, cx, cy = intrinsics or default_intrinsics(size)
    x, y = np.meshgrid((np.arange(width) + 0.5 - cx) / fx, (np.arange(height) + 0.5 - cy) / fy)
    ray = np.stack([x, y, np.ones_like(x)], axis=2) @ pose[:3, :3].T
    eye = pose[:3, 3] - offset
    with np.errstate(divide="ignore"):
        to_walls = np.where(ray > 0, ROOM[1] - eye, ROOM[0] - eye) / ray
        enters, leaves = np.sort(np.stack([(CRATE[0] - eye) / ray, (CRATE[1] - eye) / ray]), axis=0)
    near, far = enters.max(axis=2), leaves.min(axis=2)
    on_crate = (near < far) & (near > 0)
    depth = np.where(on_crate, near, np.abs(to_walls).min(axis=2))
    return depth, np.where(on_crate[..., None], THING, WALL).astype(np.uint8)


def default_intrinsics(size):
    width, height = size
    focal = FOCAL_PX * width / WIDTH
    return focal, focal, width / 2, height / 2


def distance_to_surface(xyz):
    """Of points (n, 3) to the room's walls or the crate, whichever is nearer; in the room's own coordinates."""
    to_walls = np.minimum(np.abs(xyz - ROOM[0]), np.abs(xyz - ROOM[1])).min(axis=1)
    outside = np.maximum(np.maximum(CRATE[0] - xyz, xyz - CRATE[1]), 0)
    inside = np.minimum(xyz - CRATE[0], CRATE[1] - xyz).min(axis=1)
    to_crate = np.where(inside > 0, inside, np.linalg.norm(outside, axis=1))
    return np.minimum(to_walls, to_crate)


def camera(pose, size=(WIDTH, HEIGHT), intrinsics=None):
    return Camera(*size, *(intrinsics or default_intrinsics(size)), world_to_camera=np.linalg.inv(pose))


def write_depth(file: Path, depth, unit=1e-3):
    """16-bit PNG in steps of ``unit``."""
    file.parent.mkdir(parents=True, exist_ok=True)
    stored = np.round(np.asarray(depth) / unit).clip(0, 65535).astype(np.uint16)
    file.write_bytes(cv2.imencode(".png", stored)[1].tobytes())


def write_rgb(file: Path, rgb):
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(cv2.imencode(file.suffix, rgb[..., ::-1])[1].tobytes())


def write_frames(folder: Path, count=12, offset=(0.0, 0.0, 0.0), spoiled=None, unit=1e-3, colors=True):
    """DepthFrames of the room, written as PNG. spoiled(index, depth) -> the depth that the sensor gives."""
    frames = []
    for index, pose in enumerate(poses(count, offset)):
        depth, rgb = look(pose, offset)
        if spoiled:
            depth = spoiled(index, depth)
        write_depth(folder / f"{index}.png", depth, unit)
        file = DepthFile(folder / f"{index}.png", camera(pose), unit)
        frames.append(DepthFrame(f"view{index}", file, (lambda _, rgb=rgb: rgb) if colors else None))
    return frames
