"""What phones record: Polycam's raw data, 3D Scanner App's "all data", Apple's ARKitScenes.

Polycam         ``keyframes/corrected_images`` (or ``images``) with ``corrected_cameras`` (``cameras``): a JSON an
                image, ``fx fy cx cy width height`` and ``t_00`` ... ``t_23``, camera to world, ARKit's axes (y up, z
                back); ``depth`` of 256 x 192, millimetres.
3D Scanner App  ``frame_00000.jpg`` with ``frame_00000.json``: ``cameraPoseARFrame``, 16 numbers row by row, and
                ``intrinsics``, 9 numbers; ``depth_00000.png``, millimetres. Most poses have no image.
ARKitScenes     ``lowres_wide/<video>_<time>.png``, ``lowres_depth``, ``lowres_wide_intrinsics/*.pincam`` (width height
                fx fy cx cy) and ``lowres_wide.traj``: time, rotation vector, translation, world to camera, OpenCV's
                axes. An image takes the pose whose time is nearest, if that is within 10 ms.

Images and depth images are of different sizes and one lens. Worlds are in metres and kept, so clouds that the apps
export (y up) fit. Images are as the sensor gave them, in landscape, however the phone was held.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.errors import SceneError
from og_pointcloud.formats.depth import MILLIMETRE, DepthFile
from og_pointcloud.formats.images import IMAGE_SUFFIXES, image_size
from og_pointcloud.formats.poses import PosedFrames, PosedImage, numbered, read_json, read_numbers, rigid
from og_pointcloud.formats.tables import naming
from og_pointcloud.scene import Camera

__all__ = ["PHONE_LAYOUTS"]

Doubles = NDArray[np.float64]
POLYCAM = (("corrected_images", "corrected_cameras"), ("images", "cameras"))
INTRINSICS = ("fx", "fy", "cx", "cy")
SAME_TIME_S = 0.01
OPENGL = np.array([1.0, -1.0, -1.0])


def _posed(path: str, lens: Sequence[float], camera_to_world: Doubles, depth: Path) -> PosedImage:
    """lens: width, height, fx, fy, cx, cy, pixel centres at +0.5. camera_to_world: (3 or 4, 4), OpenCV axes."""
    rotation = camera_to_world[:3, :3].T
    with np.errstate(all="ignore"):  # the camera refuses what comes of it
        pose = rigid(rotation, -rotation @ camera_to_world[:3, 3])
    width, height, fx, fy, cx, cy = lens
    camera = Camera(round(width), round(height), fx, fy, cx, cy, pose)
    return PosedImage(path, camera, depth=DepthFile(depth, camera, MILLIMETRE) if depth.is_file() else None)


def _values(content: Any, keys: Sequence[str], source: Path) -> list[float]:
    try:
        values = [float(content[key]) for key in keys]
    except (TypeError, ValueError, KeyError, OverflowError) as error:
        raise SceneError(
            f"{source} has no number {error!s:.60}; expected {', '.join(map(str, keys)):.120}: export it again"
        ) from None
    if not np.isfinite(values).all() or np.abs(values).max() > 1e30:
        raise SceneError(
            f"{source} holds numbers that are not finite; expected {', '.join(map(str, keys)):.120}: export it again"
        )
    return values


def _images_in(folder: Path) -> list[Path]:
    return numbered(file for file in folder.iterdir() if file.suffix in IMAGE_SUFFIXES) if folder.is_dir() else []


def _is_polycam(folder: Path) -> bool:
    return any(next((folder / "keyframes" / cameras).glob("*.json"), None) for _, cameras in POLYCAM)


def _polycam(folder: Path) -> PosedFrames:
    keyframes = folder / "keyframes"
    images, cameras = next(pair for pair in POLYCAM if next((keyframes / pair[1]).glob("*.json"), None))
    posed, dropped = [], []
    for file in _images_in(keyframes / images):
        source, path = keyframes / cameras / f"{file.stem}.json", f"keyframes/{images}/{file.name}"
        if not source.is_file():
            dropped.append(path)
            continue
        content = read_json(source)
        with naming(source):
            lens = _values(content, ("width", "height", *INTRINSICS), source)
            pose = _values(content, [f"t_{row}{column}" for row in range(3) for column in range(4)], source)
            camera_to_world = np.array(pose).reshape(3, 4) * [*OPENGL, 1.0]
            posed.append(_posed(path, lens, camera_to_world, keyframes / "depth" / f"{file.stem}.png"))
    return PosedFrames(tuple(posed), tuple(dropped))


def _is_scanner_app(folder: Path) -> bool:
    return next(folder.glob("frame_*.json"), None) is not None and next(folder.glob("frame_*.jpg"), None) is not None


def _scanner_app(folder: Path) -> PosedFrames:
    posed, dropped = [], []
    for file in numbered(folder.glob("frame_*.jpg")):
        source = file.with_suffix(".json")
        if not source.is_file():
            dropped.append(file.name)
            continue
        content = read_json(source)
        with naming(source):
            keys = content if isinstance(content, dict) else {}
            matrix = np.array(_listed(keys, "cameraPoseARFrame", 16, source)).reshape(4, 4)
            fx, _, cx, _, fy, cy, *_ = _listed(keys, "intrinsics", 9, source)
            lens = (*image_size(file), fx, fy, cx + 0.5, cy + 0.5)
            depth = folder / f"{file.stem.replace('frame_', 'depth_', 1)}.png"
            posed.append(_posed(file.name, lens, matrix * [*OPENGL, 1.0], depth))
    return PosedFrames(tuple(posed), tuple(dropped))


def _listed(content: dict[str, Any], key: str, count: int, source: Path) -> list[float]:
    value = content.get(key)
    if not isinstance(value, list) or len(value) != count:
        raise SceneError(f"{source} has no {count} numbers '{key}'; expected 3D Scanner App's export of all data")
    return _values(value, range(count), source)  # pyright: ignore[reportArgumentType]


def _is_arkit_scenes(folder: Path) -> bool:
    return (folder / "lowres_wide.traj").is_file() and (folder / "lowres_wide").is_dir()


def _arkit_scenes(folder: Path) -> PosedFrames:
    rows = read_numbers(folder / "lowres_wide.traj", 7)
    rows = rows[np.argsort(rows[:, 0])]
    posed, dropped = [], []
    for file in _images_in(folder / "lowres_wide"):
        path, lens = f"lowres_wide/{file.name}", folder / "lowres_wide_intrinsics" / f"{file.stem}.pincam"
        time = re.search(r"_(\d+\.\d+)$", file.stem)
        nearest = rows[np.abs(rows[:, 0] - float(time[1])).argmin()] if time else None
        if nearest is None or time is None or not lens.is_file() or abs(nearest[0] - float(time[1])) > SAME_TIME_S:
            dropped.append(path)
            continue
        with naming(lens):
            numbers = read_numbers(lens, 6)
            if len(numbers) != 1 or not np.isfinite(numbers).all() or np.abs(numbers).max() > 1e30:
                raise SceneError("expected one line of width height fx fy cx cy: copy it again")
            world_to_camera = rigid(_rotation(nearest[1:4]), nearest[4:7])
            width, height, fx, fy, cx, cy = numbers[0].tolist()
            depth = folder / "lowres_depth" / file.name
            posed.append(_posed(path, (width, height, fx, fy, cx + 0.5, cy + 0.5), _inverse(world_to_camera), depth))
    return PosedFrames(tuple(posed), tuple(dropped))


def _inverse(transform: Doubles) -> Doubles:
    rotation = transform[:3, :3].T
    return rigid(rotation, -rotation @ transform[:3, 3])


def _rotation(vector: Doubles) -> Doubles:
    """(3, 3) of a rotation vector (Rodrigues); not finite where the vector is not."""
    angle = float(np.linalg.norm(vector))
    if not 0 < angle < 1e6:
        return np.eye(3) if angle == 0 else np.full((3, 3), np.nan)
    x, y, z = vector / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


PHONE_LAYOUTS = ((_is_polycam, _polycam), (_is_scanner_app, _scanner_app), (_is_arkit_scenes, _arkit_scenes))
"""As `rgbd.LAYOUTS`."""
