"""KITTI-360: the rectified stereo images of a drive, in the layout of the data set's documentation.

calibration/perspective.txt                      ``S_rect_00: 1408 376``, ``P_rect_00:`` 12 numbers, row by row
data_poses/DRIVE/cam0_to_world.txt               frame number, then 16 numbers: rectified left camera to world,
                                                 OpenCV axes, meters; keyframes only
data_2d_raw/DRIVE/image_00/data_rect/*.png       and image_01, the right camera: named by frame number, ten digits
data_3d_semantics/*/DRIVE/static/FIRST_LAST.ply  a cloud of these frames: the capture's geometry, if there is one file

The right camera is offset sideways from the left one: the last column of P_rect_01 holds the baseline times the focal
length. The fisheye images to the sides (image_02, image_03) are not read.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.errors import SceneError
from og_pointcloud.formats.poses import (
    RecordedFrame,
    Sensor,
    named_numbers,
    numbered_images,
    read_numbers,
    read_text,
    rigid,
    the_only,
)

CALIBRATION = Path("calibration/perspective.txt")
CAMERAS = ("00", "01")


def is_kitti360(folder: Path) -> bool:
    """Whether a folder has the data set's layout."""
    return (folder / CALIBRATION).is_file() and next(folder.glob("data_poses/*/cam0_to_world.txt"), None) is not None


def read_kitti360(folder: Path) -> Iterator[RecordedFrame]:
    """Frames of the one drive that has images, left images first. SceneError names file and cure."""
    poses_file = _poses_of_drive(folder)
    rows = read_numbers(poses_file, 17)
    pose_of_frame = dict(zip(rows[:, 0].tolist(), rows[:, 1:].reshape(-1, 4, 4), strict=True))
    for camera in CAMERAS:
        images = numbered_images(_images_folder(folder, poses_file.parent.name, camera))
        sensor, beside = _sensor(folder / CALIBRATION, camera) if images else (None, np.eye(4))
        for file in images:
            path = file.relative_to(folder).as_posix()
            pose = pose_of_frame.get(float(file.stem)) if file.stem.isdecimal() else None
            with np.errstate(over="ignore", invalid="ignore"):  # poses that are not finite are left out
                pose = None if pose is None else pose @ beside
            yield RecordedFrame(path, poses_file, pose, sensor)


def find_static_cloud(folder: Path) -> Path | None:
    """The accumulated cloud, or None; SceneError for several, as each covers only some of the frames."""
    return the_only(folder, "data_3d_semantics/*/*/static/*.ply", "static clouds, each covering some frames")


def _images_folder(folder: Path, drive: str, camera: str) -> Path:
    return folder / "data_2d_raw" / drive / f"image_{camera}" / "data_rect"


def _poses_of_drive(folder: Path) -> Path:
    files = sorted(folder.glob("data_poses/*/cam0_to_world.txt"))
    # Poses are published for all drives together, images drive by drive.
    seen = [file for file in files if _images_folder(folder, file.parent.name, "00").is_dir()]
    if len(seen) != 1:
        drives = ", ".join(file.parent.name for file in seen[:3]) or "none"
        raise SceneError(
            f"{folder} has rectified images of {len(seen)} drives with poses ({drives:.120}); expected one: make a "
            f"folder of calibration/ and one drive's data_poses/DRIVE and {_images_folder(Path(), 'DRIVE', '00')}"
        )
    return seen[0]


def _sensor(file: Path, camera: str) -> tuple[Sensor, NDArray[np.float64]]:
    """The lens of a rectified camera, and its pose in the left camera's frame, (4, 4)."""
    parts = (line.partition(":") for line in read_text(file).splitlines())
    lines = {key: numbers for key, _, numbers in parts}
    width, height = _stated(lines, f"S_rect_{camera}", 2, file)
    # P = K [I | t] for points in the left camera's frame: its last column holds fx t_x; the camera center is at -t_x.
    projection = np.reshape(_stated(lines, f"P_rect_{camera}", 12, file), (3, 4))
    sensor = Sensor.from_matrix((round(width), round(height)), projection)
    beside = -projection[0, 3] / (projection[0, 0] or 1.0)  # `Camera` refuses a focal length of 0
    return sensor, rigid(np.eye(3), np.array([beside, 0.0, 0.0]))


def _stated(lines: dict[str, str], key: str, count: int, file: Path) -> list[float]:
    return named_numbers(lines.get(key, "").split(), range(count), f"{file}, {key},")
