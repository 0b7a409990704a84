"""Faults added one at a time to a correct room's depth images: how far the views agree, and what the check reports.

    python examples/benchmark_depth_checks.py [SEED ...]

The room is the demo's, of the given seeds (0), in 24 views of 320 x 240 whose depth ends at 3.5 m, like a sensor's.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from og_pointcloud_room.capture import CaptureSettings, make_capture

from og_pointcloud.formats.depth import DepthFile, DepthFrame
from og_pointcloud.formats.fusion import doubtful_depth
from og_pointcloud.scene import Camera

FARTHEST_M = 3.5
OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
Depth = NDArray[np.floating]
DEPTH: dict[str, Callable[[Depth, Camera], Depth]] = {
    "none": lambda depth, camera: depth,
    "millimeters": lambda depth, camera: depth * 1000,
    "times 0.2": lambda depth, camera: depth * 0.2,
    "times 1.2": lambda depth, camera: depth * 1.2,
    "times 1.5": lambda depth, camera: depth * 1.5,
    "times 2.5": lambda depth, camera: depth * 2.5,
    "lengths of rays": lambda depth, camera: depth * ray_lengths(camera),
    "disparities": lambda depth, camera: np.where(depth > 0, 1 / np.maximum(depth, 0.1), 0),
    "inverted": lambda depth, camera: np.where(depth > 0, 4 - depth, 0),
    "constant": lambda depth, camera: np.full_like(depth, 2),
    "next frame": lambda depth, camera: np.roll(depth, 1, axis=0),
    "another camera": lambda depth, camera: np.roll(depth, 5, axis=0),
    "20 pixels off": lambda depth, camera: np.roll(depth, 20, axis=2),
    "turned": lambda depth, camera: depth[:, ::-1, ::-1],
}
"""Faults of (V, H, W) depth images in meters."""
CAMERAS: dict[str, Callable[[Camera], Camera]] = {
    "poses in millimeters": lambda camera: replace(camera, world_to_camera=scaled(camera.world_to_camera, 1000)),
    "OpenCV axes": lambda camera: replace(camera, world_to_camera=OPENCV @ camera.world_to_camera),
    "world-to-camera": lambda camera: replace(camera, world_to_camera=np.linalg.inv(camera.world_to_camera)),
    "half intrinsics": lambda camera: replace(
        camera, fx=camera.fx / 2, fy=camera.fy / 2, cx=camera.cx / 2, cy=camera.cy / 2
    ),
}
"""Faults of cameras."""


def main(seeds: list[int]) -> None:
    """Print a line per fault: what the check reports, or nothing."""
    for seed in seeds:
        made = make_capture(seed, CaptureSettings(views=24, width=320, height=240, samples_per_view=20_000))
        depth = np.stack([np.where(frame.depth_m < FARTHEST_M, frame.depth_m, 0) for frame in made.frames])
        cameras = [made.intrinsics.camera(frame.camera_to_world) for frame in made.frames]
        print(f"demo room {seed}")
        for name, fault in DEPTH.items():
            print(f"{name:22}{said_of(fault(depth, cameras[0]), cameras)}")
        for name, change in CAMERAS.items():
            print(f"{name:22}{said_of(depth, [change(camera) for camera in cameras])}")


def said_of(depth: Depth, cameras: list[Camera]) -> str:
    """What the check reports of depth images (V, H, W) in meters with these cameras."""
    with tempfile.TemporaryDirectory() as folder:
        frames = []
        for number, (image, camera) in enumerate(zip(depth, cameras, strict=True)):
            path = Path(folder) / f"{number}.npy"
            np.save(path, image.astype(np.float32))
            frames.append(DepthFrame(path.stem, DepthFile(path, camera, 1.0)))
        return doubtful_depth(frames) or "-"


def ray_lengths(camera: Camera) -> Depth:
    """(H, W) length of each pixel's ray to the plane at depth 1."""
    row, column = np.mgrid[: camera.height, : camera.width] + 0.5
    return np.sqrt(((column - camera.cx) / camera.fx) ** 2 + ((row - camera.cy) / camera.fy) ** 2 + 1)


def scaled(world_to_camera: NDArray[np.float64], factor: float) -> NDArray[np.float64]:
    """The pose in another unit."""
    pose = world_to_camera.copy()
    pose[:3, 3] *= factor
    return pose


if __name__ == "__main__":
    main([int(seed) for seed in sys.argv[1:]] or [0])
