"""Recordings of phones: Polycam's raw data, 3D Scanner App's "all data", Apple's ARKitScenes.

Polycam         ``keyframes/corrected_images`` (or ``images``) with ``corrected_cameras`` (``cameras``): a JSON per
                image, ``fx fy cx cy width height`` and ``t_00`` ... ``t_23``, camera to world, ARKit's axes (y up, z
                back); ``depth`` of 256 x 192, millimeters.
3D Scanner App  ``frame_00000.jpg`` with ``frame_00000.json``: ``cameraPoseARFrame``, 16 numbers, and ``intrinsics``,
                9 numbers, row by row or column by column; ``depth_00000.png``, millimeters. Most poses have no image.
ARKitScenes     ``lowres_wide/<video>_<time>.png``, ``lowres_depth``, ``lowres_wide_intrinsics/*.pincam`` (width height
                fx fy cx cy), whose names may be off by 1 ms, and ``lowres_wide.traj``: time, rotation vector,
                translation, world to camera, OpenCV's axes. An image gets the pose nearest in time, if within 10 ms.

Image and depth image differ in size but share a lens. Worlds are in meters and kept as they are, so that clouds
exported by the apps (y up) fit. Images are in the sensor's landscape orientation, however the phone was held; masks are
made of them upright.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from og_pointcloud.formats.depth import MILLIMETER
from og_pointcloud.formats.images import image_size
from og_pointcloud.formats.poses import (
    OPENGL_SIGNS,
    RecordedFrame,
    Sensor,
    inverse,
    named_numbers,
    numbered,
    numbered_images,
    read_json_object,
    read_numbers,
    rigid,
    rotation_of_vector,
)
from og_pointcloud.scene import DoubleArray

POLYCAM = (("corrected_images", "corrected_cameras"), ("images", "cameras"))
POLYCAM_KEYS = ("width", "height", "fx", "fy", "cx", "cy")
POSE_KEYS = [f"t_{row}{column}" for row in range(3) for column in range(4)]
Y_UP, Z_UP = (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
"""ARKit's world is y up; in ARKitScenes it was turned to z up."""
MAX_OFFSET_S = 0.01
"""Largest time between an image and its pose."""
PINCAM_SHIFTS_S = -0.001, 0.001
"""By which ARKitScenes' authors look for a file of intrinsics that has not its image's time."""


def _sensor(width: float, height: float, fx: float, fy: float, cx: float, cy: float) -> Sensor:
    return Sensor((round(width), round(height)), fx, fy, cx, cy, MILLIMETER)


def _is_polycam(folder: Path) -> bool:
    return any(next((folder / "keyframes" / cameras).glob("*.json"), None) for _, cameras in POLYCAM)


def _polycam(folder: Path) -> Iterator[RecordedFrame]:
    keyframes = folder / "keyframes"
    images, cameras = next(pair for pair in POLYCAM if next((keyframes / pair[1]).glob("*.json"), None))
    for file in numbered_images(keyframes / images):
        source, path = keyframes / cameras / f"{file.stem}.json", f"keyframes/{images}/{file.name}"
        if not source.is_file():
            yield RecordedFrame(path, source)
            continue
        content = read_json_object(source)
        sensor = _sensor(*named_numbers(content, POLYCAM_KEYS, source))
        pose = np.reshape(named_numbers(content, POSE_KEYS, source), (3, 4)) * OPENGL_SIGNS
        yield RecordedFrame(path, source, pose, sensor, (sensor, keyframes / "depth" / f"{file.stem}.png"), Y_UP)


def _is_scanner_app(folder: Path) -> bool:
    return next(folder.glob("frame_*.json"), None) is not None and next(folder.glob("frame_*.jpg"), None) is not None


def _scanner_app(folder: Path) -> Iterator[RecordedFrame]:
    for file in numbered(folder.glob("frame_*.jpg")):
        source, depth = file.with_suffix(".json"), folder / f"{file.stem.replace('frame_', 'depth_', 1)}.png"
        if not source.is_file():
            yield RecordedFrame(file.name, source)
            continue
        content = read_json_object(source)
        pose = _matrix(content, "cameraPoseARFrame", 4, source) * OPENGL_SIGNS
        lens = Sensor.from_matrix(image_size(file), _matrix(content, "intrinsics", 3, source))
        sensor = replace(lens, unit=MILLIMETER)
        yield RecordedFrame(file.name, source, pose, sensor, (sensor, depth), Y_UP)


def _matrix(content: dict[str, Any], key: str, side: int, source: Path) -> DoubleArray:
    """A matrix listed row by row; or column by column, as ARKit holds it in memory: its last row is 0 ... 0 1."""
    matrix = np.reshape(named_numbers(content.get(key), range(side * side), source), (side, side))
    return matrix if not matrix[-1, :-1].any() else matrix.T


def _is_arkit_scenes(folder: Path) -> bool:
    return (folder / "lowres_wide.traj").is_file() and (folder / "lowres_wide").is_dir()


def _arkit_scenes(folder: Path) -> Iterator[RecordedFrame]:
    rows = read_numbers(folder / "lowres_wide.traj", 7)
    rows = rows[np.isfinite(rows[:, 0])]  # NaN would be nearest to every time
    rows = rows[np.argsort(rows[:, 0])]
    for file in numbered_images(folder / "lowres_wide"):
        path, lens = f"lowres_wide/{file.name}", folder / "lowres_wide_intrinsics" / f"{file.stem}.pincam"
        time = re.search(r"_(\d+\.\d+)$", file.stem)
        if time and not lens.is_file():
            stamps = [f"{float(time[1]) + shift:.3f}" for shift in PINCAM_SHIFTS_S]
            beside = [lens.with_name(f"{file.stem[: time.start(1)]}{stamp}.pincam") for stamp in stamps]
            lens = next((other for other in beside if other.is_file()), lens)
        nearest = rows[np.abs(rows[:, 0] - float(time[1])).argmin()] if time and len(rows) else None
        if nearest is None or time is None or not lens.is_file() or abs(nearest[0] - float(time[1])) > MAX_OFFSET_S:
            yield RecordedFrame(path, lens)
            continue
        width, height, fx, fy, cx, cy = named_numbers(read_numbers(lens, 6).ravel(), range(6), lens)
        sensor = _sensor(width, height, fx, fy, cx + 0.5, cy + 0.5)
        pose = inverse(rigid(rotation_of_vector(nearest[1:4]), nearest[4:7]))  # stored world to camera
        yield RecordedFrame(path, lens, pose, sensor, (sensor, folder / "lowres_depth" / file.name), Z_UP)


PHONE_LAYOUTS = ((_is_polycam, _polycam), (_is_scanner_app, _scanner_app), (_is_arkit_scenes, _arkit_scenes))
"""Of `rgbd.LAYOUTS`."""
