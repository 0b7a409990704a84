"""What every pose file gives, whatever its format: one record per image, in world coordinates."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from og_pointcloud.errors import SceneError
from og_pointcloud.formats.depth import DepthFile
from og_pointcloud.formats.faces import Face, faces
from og_pointcloud.formats.lenses import Lens
from og_pointcloud.scene import Camera

__all__ = [
    "MAX_JSON_BYTES",
    "PosedFrames",
    "PosedImage",
    "in_local_frame",
    "in_pinholes",
    "numbered",
    "read_json",
    "read_numbers",
    "rigid",
    "rotation_of_quaternion",
]

MAX_TEXT_BYTES, MAX_JSON_BYTES = 1 << 26, 1 << 30


@dataclass(frozen=True)
class PosedImage:
    """An image as a pose file lists it, or a pinhole view of it.

    path: as written there, with forward slashes; relative to the capture folder or to its image folder.
    camera: its ``world_to_camera`` still starts from world coordinates (float64), not from the scene's local frame.
    lens: None for a pinhole. depth: the depth image that the pose file or data set has for it.
    face: of a view, where in the image it lies; None where the image is the view.
    """

    path: str
    camera: Camera
    lens: Lens | None = None
    depth: DepthFile | None = None
    face: Face | None = None


@dataclass(frozen=True)
class PosedFrames:
    """What a data set's folder holds. dropped: paths of images without a finite pose (trackers get lost)."""

    images: tuple[PosedImage, ...]
    dropped: tuple[str, ...]


def in_pinholes(image: PosedImage) -> tuple[PosedImage, ...]:
    """The pinhole views of an image: itself, unless it has a lens."""
    if image.lens is None:
        return (image,)
    views = faces(image.camera, image.lens)  # depths are along the axis of the first
    return tuple(
        replace(image, camera=face.camera, lens=None, depth=None if index else image.depth, face=face)
        for index, face in enumerate(views)
    )


def rigid(rotation: NDArray[np.float64], translation: NDArray[np.float64]) -> NDArray[np.float64]:
    """The (4, 4) transform x -> rotation @ x + translation."""
    transform = np.eye(4)
    transform[:3, :3] = rotation
    transform[:3, 3] = translation
    return transform


def rotation_of_quaternion(wxyz: ArrayLike) -> NDArray[np.float64]:
    """(3, 3) rotation matrix, for column vectors, of a unit quaternion w x y z (Hamilton)."""
    w, x, y, z = np.asarray(wxyz, np.float64)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def in_local_frame(camera: Camera, origin: NDArray[np.float64]) -> Camera:
    """The camera seen from local coordinates, world = local + origin.

    R (local + origin) + t = R local + (R origin + t): in float64, so that an offset of 1e6 costs under 1e-9.
    """
    rotation, translation = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
    return replace(camera, world_to_camera=rigid(rotation, rotation @ origin + translation))


def numbered(files: Iterable[Path]) -> list[Path]:
    """Files in the order of the numbers in their names: 2.jpg before 10.jpg."""
    return sorted(files, key=lambda file: ([int(digits) for digits in re.findall(r"\d+", file.name)], file.name))


def read_json(file: Path, most: int = MAX_TEXT_BYTES) -> Any:
    """What a JSON file of bounded size holds, which takes up to twenty times its bytes. SceneError where it is none."""
    if (size := file.stat().st_size) > most:
        raise SceneError(f"{file} has {size} bytes; expected at most {most}")
    try:
        return json.loads(file.read_text(encoding="utf-8-sig"))  # editors of Windows put a mark before it
    except (ValueError, RecursionError) as error:
        raise SceneError(f"{file} is not valid JSON ({error}): export it again") from None


def read_numbers(file: Path, columns: int) -> NDArray[np.float64]:
    """(rows, columns) float64 of a text file of numbers, ``nan`` and ``inf`` among them."""
    try:
        if (size := file.stat().st_size) > MAX_TEXT_BYTES:
            raise SceneError(f"{file} has {size} bytes; expected a text file of numbers, at most {MAX_TEXT_BYTES}")
        rows = [line.split() for line in file.read_text(encoding="utf-8").splitlines() if line.strip()]
        numbers = np.array([[float(word) for word in row] for row in rows], np.float64)
    except (ValueError, OSError) as error:
        if isinstance(error, SceneError):
            raise
        raise SceneError(f"{file} cannot be read as rows of numbers ({error!s:.80}): export it again") from None
    if numbers.ndim != 2 or numbers.shape[1] != columns:
        raise SceneError(f"{file} has numbers of shape {numbers.shape}; expected rows of {columns}")
    return numbers
