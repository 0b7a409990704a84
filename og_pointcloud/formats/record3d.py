"""A Record3D recording exported as "EXR + JPG": ``metadata.json``, ``rgb/0.jpg``, ``depth/0.exr``.

``K`` is the 3x3 intrinsic matrix column by column for images of ``w`` x ``h``, or one a frame in
``perFrameIntrinsicCoeffs`` (fx, fy, cx, cy). ``poses`` holds qx qy qz qw tx ty tz a frame, camera-to-world with ARKit's
axes (x right, y up, z back). Depth is float metres, smaller than the image; OpenCV reads EXR only if it is started with
``OPENCV_IO_ENABLE_OPENEXR=1``.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.errors import SceneError
from og_pointcloud.formats.depth import DepthFile, find_depth
from og_pointcloud.formats.poses import PosedFrames, PosedImage, naming, numbered, rigid, rotation_of_quaternion
from og_pointcloud.scene import Camera

__all__ = ["holds_record3d", "read_record3d"]

METADATA = "metadata.json"


def holds_record3d(folder: Path) -> bool:
    """Whether the folder has this layout."""
    return (folder / METADATA).is_file() and (folder / "rgb").is_dir()


def read_record3d(folder: Path) -> PosedFrames:
    """Poses, cameras and depth files of all frames. SceneError names file and cure."""
    file = folder / METADATA
    images = numbered([*(folder / "rgb").glob("*.jpg"), *(folder / "rgb").glob("*.png")])
    size, intrinsics, poses = _metadata(file)
    if not images or len(images) > len(poses):
        raise SceneError(
            f"{folder} has {len(images)} images in rgb/ and {len(poses)} poses in {METADATA}; expected at least one "
            "image and a pose for each: export the recording again"
        )
    posed, dropped = [], []
    for index, image in enumerate(images):
        path, pose = f"rgb/{image.name}", poses[index]
        if not np.isfinite(pose).all() or not pose[:4].any():
            dropped.append(path)
            continue
        fx, fy, cx, cy = intrinsics[min(index, len(intrinsics) - 1)].tolist()
        with naming(f"{file}, pose {index}"):
            with np.errstate(over="ignore", invalid="ignore"):  # the camera refuses what comes of it
                world_to_camera = _world_to_camera(pose)
            camera = Camera(*size, fx, fy, cx, cy, world_to_camera)
        depth_file = find_depth(folder, image.stem)
        posed.append(PosedImage(path, camera, depth=DepthFile(depth_file, camera) if depth_file else None))
    return PosedFrames(tuple(posed), tuple(dropped))


def _metadata(file: Path) -> tuple[tuple[int, int], NDArray[np.float64], NDArray[np.float64]]:
    """(width, height), intrinsics (1 or frames, 4), poses (frames, 7)."""
    try:
        content: Any = json.loads(file.read_text(encoding="utf-8"))
        size = int(content["w"]), int(content["h"])
        poses = np.array(content["poses"], np.float64)
        matrix = np.array(content["K"], np.float64).reshape(3, 3).T
        per_frame = content.get("perFrameIntrinsicCoeffs")
        shared = [[matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]]]
        intrinsics = np.array(per_frame or shared, np.float64)
    except (ValueError, TypeError, KeyError, AttributeError, OverflowError, RecursionError) as error:
        raise SceneError(
            f"{file} is not Record3D's metadata with w, h, K and poses ({error!s:.80}): export it again"
        ) from None
    if poses.ndim != 2 or poses.shape[1] != 7 or intrinsics.ndim != 2 or intrinsics.shape[1] < 4:
        raise SceneError(
            f"{file}: poses are {poses.shape}, intrinsics {intrinsics.shape}; expected (frames, 7) and (_, 4)"
        )
    return size, intrinsics[:, :4], poses


def _world_to_camera(pose: NDArray[np.float64]) -> NDArray[np.float64]:
    camera_to_world = rotation_of_quaternion(np.roll(pose[:4] / np.linalg.norm(pose[:4]), 1))  # xyzw to wxyz
    rotation = (camera_to_world * [1.0, -1.0, -1.0]).T  # OpenGL's y and z to OpenCV's
    return rigid(rotation, -rotation @ pose[4:])
