"""A ScanNet scene as its exporter writes it: ``color/0.jpg``, ``depth/0.png``, ``pose/0.txt``, ``intrinsic/``.

Depth is 16-bit, millimetres, 0 unmeasured, with intrinsics of its own. A pose is camera-to-world, OpenCV axes, and all
``-inf`` where tracking was lost. Colour and depth share a pose: the extrinsics in ``intrinsic/`` are the identity.
The layout of the 25k-frame subset (``intrinsics_color.txt`` beside the folders) is read as well.
"""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np

from og_pointcloud.errors import SceneError
from og_pointcloud.formats.depth import MILLIMETRE, DepthFile
from og_pointcloud.formats.images import IMAGE_SUFFIXES, image_size
from og_pointcloud.formats.poses import PosedFrames, PosedImage, camera_from_pose, naming, numbered, read_numbers

__all__ = ["find_mesh", "holds_scannet", "read_scannet"]

Intrinsics = tuple[float, float, float, float]


def holds_scannet(folder: Path) -> bool:
    """Whether the folder has this layout."""
    return (folder / "color").is_dir() and (folder / "pose").is_dir() and _matrix_file(folder, "color") is not None


def read_scannet(folder: Path) -> PosedFrames:
    """Poses, cameras and depth files of all frames, in the order of their numbers. SceneError names file and cure."""
    images = numbered(file for file in (folder / "color").iterdir() if file.suffix in IMAGE_SUFFIXES)
    if not images:
        raise SceneError(f"{folder / 'color'} has no image; expected 0.jpg, 1.jpg, ...: export the colour frames")
    size, intrinsics = image_size(images[0]), _intrinsics(folder, "color")
    depth_files = {file.stem: file for file in (folder / "depth").glob("*.png")}
    depth_size = image_size(next(iter(depth_files.values()))) if depth_files else (1, 1)
    depth_intrinsics = _intrinsics(folder, "depth") if depth_files else intrinsics
    _warn_of_extrinsics(folder)
    posed, dropped = [], []
    for file in images:
        path, pose_file = f"color/{file.name}", folder / "pose" / f"{file.stem}.txt"
        pose = read_numbers(pose_file, 4) if pose_file.is_file() else np.full((4, 4), np.nan)
        if not np.isfinite(pose).all():
            dropped.append(path)
            continue
        with naming(str(pose_file)):
            depth_file = depth_files.get(file.stem)
            depth = None
            if depth_file:
                depth = DepthFile(depth_file, camera_from_pose(pose, depth_size, depth_intrinsics), MILLIMETRE)
            posed.append(PosedImage(path, camera_from_pose(pose, size, intrinsics), depth=depth))
    return PosedFrames(tuple(posed), tuple(dropped))


def find_mesh(folder: Path) -> Path | None:
    """The scene's decimated mesh, whose vertices are the points that ScanNet's labels belong to, or None."""
    return next(iter(sorted(folder.glob("*_vh_clean_2.ply"))), None)


def _matrix_file(folder: Path, sensor: str, kind: str = "intrinsic") -> Path | None:
    files = (folder / "intrinsic" / f"{kind}_{sensor}.txt", folder / f"{kind}s_{sensor}.txt")
    return next((file for file in files if file.is_file()), None)


def _intrinsics(folder: Path, sensor: str) -> Intrinsics:
    file = _matrix_file(folder, sensor)
    if file is None:
        raise SceneError(f"{folder} has no intrinsic/intrinsic_{sensor}.txt: export the intrinsics again")
    matrix = read_numbers(file, 4)
    if matrix.shape != (4, 4):
        raise SceneError(f"{file} is {matrix.shape}; expected a 4x4 matrix with fx, fy, cx, cy")
    return float(matrix[0, 0]), float(matrix[1, 1]), float(matrix[0, 2]), float(matrix[1, 2])


def _warn_of_extrinsics(folder: Path) -> None:
    for sensor in ("color", "depth"):
        file = _matrix_file(folder, sensor, "extrinsic")
        if file is not None and np.abs(read_numbers(file, 4) - np.eye(4)).max() > 1e-3:
            warnings.warn(
                f"{file} is not the identity and is not applied: depth and colours are taken to share a pose",
                stacklevel=5,
            )
