"""A 7-Scenes sequence: ``frame-000000.color.png``, ``frame-000000.depth.png``, ``frame-000000.pose.txt``.

The folder is one sequence, or a scene of ``seq-01/``, ``seq-02/``, ... Depth is 16-bit, millimetres, 65535 (and 0)
unmeasured. Poses are camera-to-world, OpenCV axes. The Kinect was never calibrated; the data set's authors used, and
the poses belong to, a depth camera of focal length 585 pixels about the image's middle. Colour has the wider lens of
525 pixels that the sensor's driver states. ``camera-intrinsics.txt`` (a 3x3 matrix, as TSDF-fusion's copies have, where
colour and depth are registered) replaces both.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.errors import SceneError
from og_pointcloud.formats.depth import MILLIMETRE, DepthFile
from og_pointcloud.formats.images import image_size
from og_pointcloud.formats.poses import PosedFrames, PosedImage, camera_from_pose, naming, numbered, read_numbers

__all__ = ["holds_seven_scenes", "read_seven_scenes"]

DEPTH_FOCAL_PX, COLOR_FOCAL_PX, FOCAL_WIDTH = 585.0, 525.0, 640
"""Focal lengths in pixels of an image of that width."""
INVALID = 65535
COLOR_NAMES = ("frame-*.color.png", "frame-*.color.jpg")
INTRINSICS_NAME = "camera-intrinsics.txt"


def holds_seven_scenes(folder: Path) -> bool:
    """Whether the folder has this layout, itself or in ``seq-*`` folders."""
    return any(next(sequence.glob("frame-*.pose.txt"), None) is not None for sequence in _sequences(folder))


def read_seven_scenes(folder: Path) -> PosedFrames:
    """Poses, cameras and depth files of all frames, sequence by sequence. SceneError names file and cure."""
    images = [
        file
        for sequence in _sequences(folder)
        for file in numbered(file for names in COLOR_NAMES for file in sequence.glob(names))
    ]
    if not images:
        raise SceneError(f"{folder} has poses but no frame-*.color.png or .color.jpg: add the colour images")
    size = image_size(images[0])
    color, depth = _intrinsics(folder, size)
    posed, dropped = [], []
    for file in images:
        path, frame = file.relative_to(folder).as_posix(), file.name.split(".")[0]
        pose_file, depth_file = file.with_name(f"{frame}.pose.txt"), file.with_name(f"{frame}.depth.png")
        pose = read_numbers(pose_file, 4) if pose_file.is_file() else np.full((4, 4), np.nan)
        if not np.isfinite(pose).all():
            dropped.append(path)
            continue
        with naming(str(pose_file)):
            of_depth = DepthFile(depth_file, camera_from_pose(pose, size, depth), MILLIMETRE, INVALID)
            camera = camera_from_pose(pose, size, color)
        posed.append(PosedImage(path, camera, depth=of_depth if depth_file.is_file() else None))
    return PosedFrames(tuple(posed), tuple(dropped))


def _sequences(folder: Path) -> list[Path]:
    return [folder, *sorted(path for path in folder.glob("seq-*") if path.is_dir())]


def _intrinsics(
    folder: Path, size: tuple[int, int]
) -> tuple[tuple[float, float, float, float], tuple[float, float, float, float]]:
    """fx, fy, cx, cy of colour and of depth."""
    file = next(
        (place / INTRINSICS_NAME for place in (folder, folder.parent) if (place / INTRINSICS_NAME).is_file()), None
    )
    if file is not None:
        matrix: NDArray[np.float64] = read_numbers(file, 3)
        if matrix.shape != (3, 3):
            raise SceneError(f"{file} is {matrix.shape}; expected a 3x3 matrix with fx, fy, cx, cy")
        both = float(matrix[0, 0]), float(matrix[1, 1]), float(matrix[0, 2]), float(matrix[1, 2])
        return both, both
    width, height = size
    color, depth = (focal * width / FOCAL_WIDTH for focal in (COLOR_FOCAL_PX, DEPTH_FOCAL_PX))
    return (color, color, width / 2, height / 2), (depth, depth, width / 2, height / 2)
