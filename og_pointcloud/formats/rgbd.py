"""Folders of RGB-D data sets: ScanNet, 7-Scenes and Replica, as their exporters or renderers write them.

ScanNet   ``color/0.jpg``, ``depth/0.png``, ``pose/0.txt``, ``intrinsic/`` (or, in the 25k-frame subset,
          ``intrinsics_color.txt`` beside the folders). Depth is 16-bit millimeters with intrinsics of its own. A pose
          is all ``-inf`` where tracking was lost. Color and depth share a pose: the extrinsics are the identity.
7-Scenes  ``frame-000000.color.png``, ``.depth.png``, ``.pose.txt``, in the folder or in ``seq-01/``, ``seq-02/``, ...
          Depth is 16-bit millimeters. The Kinect was never calibrated: the data set's authors, and so the poses,
          assume a depth camera with a focal length of 585 pixels, centered in the image; the color camera has the wider
          lens of 525 pixels that the sensor's driver states. ``camera-intrinsics.txt`` (3x3, in TSDF-fusion's copies,
          where color and depth are registered) replaces both.
Replica   as NICE-SLAM renders it: ``results/frame000000.jpg``, ``results/depth000000.png``; line i of ``traj.txt`` is
          the pose of frame i, 16 numbers. ``cam_params.json`` lies in the folder or beside it: ``{"camera": {"w", "h",
          "fx", "fy", "cx", "cy", "scale"}}``; a stored depth of ``scale`` is one meter.

Poses are camera-to-world with OpenCV axes. Pixel centers are at whole numbers; in the scene, at +0.5.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.errors import SceneError
from og_pointcloud.formats.depth import MILLIMETER
from og_pointcloud.formats.images import image_size
from og_pointcloud.formats.kitti360 import is_kitti360, read_kitti360
from og_pointcloud.formats.phones import PHONE_LAYOUTS
from og_pointcloud.formats.poses import (
    PosedFrames,
    RecordedFrame,
    Sensor,
    named_numbers,
    numbered,
    numbered_images,
    read_json_object,
    read_numbers,
    recorded,
)

DEPTH_FOCAL_PX, COLOR_FOCAL_PX, FOCAL_WIDTH = 585.0, 525.0, 640
"""Focal lengths of 7-Scenes, in pixels of an image of this width."""
SEVEN_SCENES_IMAGES = ("frame-*.color.png", "frame-*.color.jpg")
SEVEN_SCENES_INTRINSICS = "camera-intrinsics.txt"
REPLICA_PARAMETERS = "cam_params.json"
REPLICA_KEYS = ("w", "h", "fx", "fy", "cx", "cy", "scale")


def read_rgbd(folder: Path) -> PosedFrames | None:
    """Poses, cameras and depth files of a data set's folder, frames in order; None where it has none of these layouts.

    SceneError names the faulty file and the cure.
    """
    return next((recorded(read(folder)) for holds, read in LAYOUTS if holds(folder)), None)


def _is_scannet(folder: Path) -> bool:
    return (folder / "color").is_dir() and (folder / "pose").is_dir() and _scannet_file(folder, "color") is not None


def _is_seven_scenes(folder: Path) -> bool:
    return any(next(sequence.glob("frame-*.pose.txt"), None) is not None for sequence in _sequences(folder))


def _is_replica(folder: Path) -> bool:
    return (folder / "traj.txt").is_file() and (folder / "results").is_dir()


def _pose_in(file: Path) -> NDArray[np.float64]:
    return read_numbers(file, 4) if file.is_file() else np.full((4, 4), np.nan)


def _matrix_in(file: Path, side: int) -> NDArray[np.float64]:
    matrix = read_numbers(file, side)
    if matrix.shape != (side, side):
        raise SceneError(f"{file} has shape {matrix.shape}; expected a {side}x{side} matrix with fx, fy, cx, cy")
    return matrix


def _in_or_above(folder: Path, name: str) -> Path | None:
    return next((place / name for place in (folder, folder.parent) if (place / name).is_file()), None)


def _scannet(folder: Path) -> Iterator[RecordedFrame]:
    images = numbered_images(folder / "color")
    if not images:
        raise SceneError(f"{folder / 'color'} has no image; expected 0.jpg, 1.jpg, ...: export the color frames")
    # One color and one depth lens for all frames; depth images may differ in size.
    color = _scannet_lens(folder, "color", images[0])
    some_depth = next((folder / "depth").glob("*.png"), None)
    depth = replace(_scannet_lens(folder, "depth", some_depth) if some_depth else color, unit=MILLIMETER)
    for file in images:
        source, depth_file = folder / "pose" / f"{file.stem}.txt", folder / "depth" / f"{file.stem}.png"
        yield RecordedFrame(f"color/{file.name}", source, _pose_in(source), color, (depth, depth_file))


def find_mesh(folder: Path) -> Path | None:
    """ScanNet's decimated mesh, whose vertices are the points that its labels belong to, or None."""
    return next(iter(sorted(folder.glob("*_vh_clean_2.ply"))), None)


def _scannet_file(folder: Path, sensor: str) -> Path | None:
    files = (folder / "intrinsic" / f"intrinsic_{sensor}.txt", folder / f"intrinsics_{sensor}.txt")
    return next((file for file in files if file.is_file()), None)


def _scannet_lens(folder: Path, sensor: str, image: Path) -> Sensor:
    file = _scannet_file(folder, sensor)
    if file is None:
        raise SceneError(f"{folder} has no intrinsic/intrinsic_{sensor}.txt: export the intrinsics again")
    return Sensor.from_matrix(image_size(image), _matrix_in(file, 4))


def _seven_scenes(folder: Path) -> Iterator[RecordedFrame]:
    """Frames sequence by sequence, in the order of their numbers."""
    images = [
        file
        for sequence in _sequences(folder)
        for file in numbered(file for names in SEVEN_SCENES_IMAGES for file in sequence.glob(names))
    ]
    if not images:
        raise SceneError(f"{folder} has poses but no frame-*.color.png or .color.jpg: add the color images")
    color, depth = _seven_scenes_lenses(folder, image_size(images[0]))
    depth = replace(depth, unit=MILLIMETER)
    for file in images:
        frame = file.name.split(".")[0]
        source, depth_file = file.with_name(f"{frame}.pose.txt"), file.with_name(f"{frame}.depth.png")
        path = file.relative_to(folder).as_posix()
        yield RecordedFrame(path, source, _pose_in(source), color, (depth, depth_file))


def _sequences(folder: Path) -> list[Path]:
    return [folder, *sorted(path for path in folder.glob("seq-*") if path.is_dir())]


def _seven_scenes_lenses(folder: Path, size: tuple[int, int]) -> tuple[Sensor, Sensor]:
    """The lenses of color and of depth."""
    file = _in_or_above(folder, SEVEN_SCENES_INTRINSICS)
    if file is not None:
        both = Sensor.from_matrix(size, _matrix_in(file, 3))
        return both, both
    width, height = size
    color, depth = (focal * width / FOCAL_WIDTH for focal in (COLOR_FOCAL_PX, DEPTH_FOCAL_PX))
    middle = width / 2 + 0.5, height / 2 + 0.5  # (320, 240) in the data set, which counts centers at whole numbers
    return Sensor(size, color, color, *middle), Sensor(size, depth, depth, *middle)


def _replica(folder: Path) -> Iterator[RecordedFrame]:
    results = folder / "results"
    images = numbered([*results.glob("frame*.jpg"), *results.glob("frame*.png")])
    poses = read_numbers(folder / "traj.txt", 16).reshape(-1, 4, 4)
    lines = list(range(len(poses)))
    if len(images) != len(poses):  # a thinned recording: frame000010 has the pose of line 10, counted from 0
        lines = [int((re.findall(r"\d+", file.stem) or [len(poses)])[-1]) for file in images]
    if not images or max(lines) >= len(poses):
        raise SceneError(
            f"{folder} has {len(images)} images in results/ and {len(poses)} poses in traj.txt; expected at least one "
            "image and a pose for each, in line i (from 0) for frame i: copy both from one run"
        )
    width, height, fx, fy, cx, cy, scale = _replica_parameters(folder)
    lens = Sensor((round(width), round(height)), fx, fy, cx + 0.5, cy + 0.5, unit=1 / scale)  # meters per stored step
    for file, line in zip(images, lines, strict=True):
        depth_file = results / f"{file.stem.replace('frame', 'depth', 1)}.png"
        source = f"{folder / 'traj.txt'}, line {line + 1}"
        yield RecordedFrame(f"results/{file.name}", source, poses[line], lens, (lens, depth_file))


def _replica_parameters(folder: Path) -> list[float]:
    file = _in_or_above(folder, REPLICA_PARAMETERS)
    if file is None:
        raise SceneError(
            f"{folder} has no {REPLICA_PARAMETERS}, nor has the folder above; expected it with w h fx fy cx cy scale"
        )
    values = named_numbers(read_json_object(file).get("camera"), REPLICA_KEYS, file)
    if min(values[0], values[1], values[-1]) <= 0 or max(values[:2]) > 1 << 16:
        raise SceneError(f"{file}: {', '.join(REPLICA_KEYS)} are {values}; expected positive sizes and scale")
    return values


LAYOUTS: tuple[tuple[Callable[[Path], bool], Callable[[Path], Iterable[RecordedFrame]]], ...] = (
    (_is_scannet, _scannet),
    (_is_seven_scenes, _seven_scenes),
    (_is_replica, _replica),
    (is_kitti360, read_kitti360),
    *PHONE_LAYOUTS,
)
"""Pairs of functions, one that tests whether a folder has a layout and one that reads it; the first match is used. To
add a layout, add a pair."""
