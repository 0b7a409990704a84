"""The common result of all pose files: one record per image, in world coordinates. Also what their readers share:
cameras without a pose, recordings that lose tracking, numbers in text and JSON."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from og_pointcloud.errors import SceneError
from og_pointcloud.formats.depth import DepthFile
from og_pointcloud.formats.faces import Face, faces
from og_pointcloud.formats.images import IMAGE_SUFFIXES
from og_pointcloud.formats.lenses import Lens
from og_pointcloud.formats.tables import naming
from og_pointcloud.scene import Camera, DoubleArray

MAX_TEXT_BYTES, MAX_JSON_BYTES = 1 << 26, 1 << 30
MAX_NUMBER = 1e30
"""Larger numbers in a pose file mean that it is damaged. Squares of smaller ones are finite."""
LAST_ROW_TOLERANCE = 1e-3
"""Of a 4x4 pose: exporters round it."""
OPENGL_SIGNS = np.array([1.0, -1.0, -1.0, 1.0])
"""Factors of a camera-to-world pose's columns, between OpenGL's axes (y up, z back) and OpenCV's."""


@dataclass(frozen=True)
class PosedImage:
    """An image as a pose file lists it, or a pinhole view of it.

    path: as written there, with forward slashes; relative to the capture folder or to its image folder.
    camera: its ``world_to_camera`` still starts from world coordinates (float64), not from the scene's local frame.
    lens: None for a pinhole. depth: the depth image that the pose file or data set has for it.
    face: the view's part of the image; None if the image is the view. depth_unit, integer_depth_unit: as the pose file
    states them, for a depth image that it does not name; as in `DepthFile`. up: where up is in the world, if the data
    set says so.
    """

    path: str
    camera: Camera
    lens: Lens | None = None
    depth: DepthFile | None = None
    face: Face | None = None
    depth_unit: float | None = None
    integer_depth_unit: float | None = None
    up: tuple[float, float, float] | None = None


@dataclass(frozen=True)
class PosedFrames:
    """The contents of a pose file or a data set's folder. dropped: paths of images without a finite pose (lost
    tracking). ply_file_path: the cloud's path as written in the file."""

    images: tuple[PosedImage, ...]
    dropped: tuple[str, ...] = ()
    ply_file_path: str | None = None


@dataclass(frozen=True)
class Sensor:
    """A pinhole camera without its pose: pixels, pixel centers at +0.5. unit: of depth, as in `DepthFile`."""

    size: tuple[int, int]
    fx: float
    fy: float
    cx: float
    cy: float
    unit: float | None = None

    @classmethod
    def from_matrix(cls, size: tuple[int, int], matrix: DoubleArray) -> Sensor:
        """From intrinsics (3 or 4, 3 or 4) with pixel centers at whole numbers, as in most RGB-D data sets."""
        return cls(size, matrix[0, 0].item(), matrix[1, 1].item(), matrix[0, 2].item() + 0.5, matrix[1, 2].item() + 0.5)

    def at(self, camera_to_world: DoubleArray) -> Camera:
        """The camera at a pose; camera_to_world: (3 or 4, 4), finite, OpenCV axes."""
        if camera_to_world.shape not in ((3, 4), (4, 4)):
            raise SceneError(f"the pose has shape {camera_to_world.shape}; expected a 4x4 matrix, camera to world")
        # A transposed matrix has a rotation too, but its translation is in this row, and would be lost.
        if len(camera_to_world) == 4 and np.abs(camera_to_world[3] - [0, 0, 0, 1]).max() > LAST_ROW_TOLERANCE:
            raise SceneError(
                f"the pose's last row is {camera_to_world[3].tolist()}; expected [0, 0, 0, 1]: is it transposed?"
            )
        return Camera(*self.size, self.fx, self.fy, self.cx, self.cy, inverse(camera_to_world))


@dataclass(frozen=True)
class RecordedFrame:
    """A frame found by a data set's reader.

    path: of the image, in the capture folder. source: where the pose comes from, for errors. pose: camera to world,
    OpenCV axes; None, or not finite, where tracking was lost. color: the image's sensor; None if unknown.
    depth: the depth sensor, and a file that may be absent. up: of the world, where it is known.
    """

    path: str
    source: Path | str
    pose: DoubleArray | None = None
    color: Sensor | None = None
    depth: tuple[Sensor, Path] | None = None
    up: tuple[float, float, float] | None = None

    def image(self) -> PosedImage | None:
        """The posed image, None without a pose."""
        if self.pose is None or self.color is None or not np.isfinite(self.pose).all():
            return None
        with naming(self.source):
            camera, file = self.color.at(self.pose), None
            if self.depth is not None and self.depth[1].is_file():
                sensor, path = self.depth
                file = DepthFile(path, sensor.at(self.pose), sensor.unit)
        return PosedImage(self.path, camera, depth=file, up=self.up)


def recorded(frames: Iterable[RecordedFrame]) -> PosedFrames:
    """The posed images of a data set's folder, and the frames without a pose."""
    read = [(frame.path, frame.image()) for frame in frames]
    return PosedFrames(
        tuple(image for _, image in read if image is not None), tuple(path for path, image in read if image is None)
    )


def in_pinholes(image: PosedImage) -> tuple[PosedImage, ...]:
    """The pinhole views of an image: itself, unless it has a lens."""
    if image.lens is None:
        return (image,)
    views = faces(image.camera, image.lens)  # depth is measured along the axis of the first
    return tuple(
        replace(image, camera=face.camera, lens=None, depth=None if index else image.depth, face=face)
        for index, face in enumerate(views)
    )


def rigid(rotation: DoubleArray, translation: DoubleArray) -> DoubleArray:
    """The (4, 4) transform x -> rotation @ x + translation."""
    transform = np.eye(4)
    transform[:3, :3] = rotation
    transform[:3, 3] = translation
    return transform


def inverse(transform: DoubleArray) -> DoubleArray:
    """(4, 4) inverse of a rigid transform (3 or 4, 4)."""
    rotation = transform[:3, :3].T
    with np.errstate(over="ignore", invalid="ignore"):  # `Camera` refuses the result of absurd numbers
        return rigid(rotation, -rotation @ transform[:3, 3])


def rotation_of_quaternion(wxyz: ArrayLike) -> DoubleArray:
    """(3, 3) rotation matrix, for column vectors, of a unit quaternion w x y z (Hamilton)."""
    w, x, y, z = np.asarray(wxyz, np.float64)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def pose_of_quaternion(wxyz: ArrayLike, translation: ArrayLike) -> DoubleArray:
    """(4, 4) of a quaternion w x y z of any length, and a translation (3,); SceneError if it is no rotation."""
    quaternion, shift = np.asarray(wxyz, np.float64), np.asarray(translation, np.float64)
    length = math.hypot(*quaternion)
    if not 1e-8 < length < np.inf or not np.isfinite(shift).all():  # also if it is NaN
        raise SceneError(
            f"the pose {quaternion} {shift} has no rotation; expected a finite quaternion that is not zero"
        )
    return rigid(rotation_of_quaternion(quaternion / length), shift)


def rotation_of_vector(radians: ArrayLike) -> DoubleArray:
    """(3, 3) rotation about a vector (3,) by its length; NaN if that is not finite."""
    half = np.asarray(radians, np.float64) / 2
    with np.errstate(over="ignore", invalid="ignore"):
        # The quaternion cos(angle), sin(angle) half / angle; np.sinc(x), sin(pi x) / (pi x), is 1 at an angle of 0.
        angle = np.linalg.norm(half)
        return rotation_of_quaternion([np.cos(angle), *(np.sinc(angle / np.pi) * half)])


def quaternion_of(rotation: DoubleArray) -> DoubleArray:
    """(4,) unit quaternion wxyz, w >= 0, of a rotation matrix (3, 3) that turns column vectors."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = rotation
    # 4 q q': row i is the quaternion times four times its component i. The row of the largest one divides safely.
    products = np.array(
        [
            [1 + xx + yy + zz, zy - yz, xz - zx, yx - xy],
            [zy - yz, 1 + xx - yy - zz, xy + yx, xz + zx],
            [xz - zx, xy + yx, 1 - xx + yy - zz, yz + zy],
            [yx - xy, xz + zx, yz + zy, 1 - xx - yy + zz],
        ]
    )
    quaternion = products[products.diagonal().argmax()]
    return quaternion / np.linalg.norm(quaternion) * (1 if quaternion[0] >= 0 else -1)


def upright_axes(up: DoubleArray) -> DoubleArray:
    """(3, 3) right-handed orthonormal rows, the third of which is a unit vector up."""
    # Any direction perpendicular to up will do; the coordinate axis least along up gives a product far from zero.
    aside = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    aside /= np.linalg.norm(aside)
    return np.asarray([aside, np.cross(up, aside), up], np.float64)


def in_local_frame(camera: Camera, origin: DoubleArray) -> Camera:
    """The camera seen from local coordinates, world = local + origin.

    R (local + origin) + t = R local + (R origin + t): in float64, so that an offset of 1e6 adds an error under 1e-9.
    """
    rotation, translation = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
    return replace(camera, world_to_camera=rigid(rotation, rotation @ origin + translation))


def numbered(files: Iterable[Path]) -> list[Path]:
    """Files in the order of the numbers in their names: 2.jpg before 10.jpg."""
    return sorted(files, key=lambda file: ([int(digits) for digits in re.findall(r"\d+", file.name)], file.name))


def numbered_images(folder: Path) -> list[Path]:
    """The images in a folder, as `numbered`; none if it is not a folder."""
    found = folder.iterdir() if folder.is_dir() else ()
    return numbered(file for file in found if file.suffix.lower() in IMAGE_SUFFIXES and file.is_file())


def the_only(folder: Path, pattern: str, what: str) -> Path | None:
    """The one file of a folder that matches the pattern, None without any; SceneError, which calls them ``what``, for
    several."""
    files = sorted(folder.glob(pattern))
    if len(files) > 1:
        raise SceneError(
            f"{folder} has {len(files)} {what} ({files[0].name}, {files[1].name}, ...); expected one: name the one to "
            "use (--gaussians)"
        )
    return next(iter(files), None)


def read_json(file: Path, most: int = MAX_TEXT_BYTES) -> Any:
    """The content of a JSON file of bounded size (in memory up to 20 times larger). SceneError if it is not JSON."""
    text = read_text(file, most)
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise SceneError(f"{file} is not valid JSON ({error}): export it again") from None


def read_json_object(file: Path) -> dict[str, Any]:
    """As `read_json`, for a file that holds one object."""
    content = read_json(file)
    if not isinstance(content, dict):
        raise SceneError(f"{file} contains {content!r:.40}; expected a JSON object: export or fetch it again")
    return content


def read_text(file: Path, most: int = MAX_TEXT_BYTES) -> str:
    """A text file of bounded size, in UTF-8; SceneError if it is longer, or not text."""
    try:
        if not file.is_file():
            raise SceneError(f"{file} is not a file; expected a text file")  # a device or a pipe never ends
        if (size := file.stat().st_size) > most:
            raise SceneError(f"{file} has {size} bytes; expected at most {most}: split it")
        return file.read_text(encoding="utf-8-sig")  # editors on Windows write a byte order mark
    except (UnicodeDecodeError, OSError) as error:
        raise SceneError(f"{file} cannot be read as text ({error!s:.80}): export it again") from None


def read_numbers(file: Path, columns: int) -> DoubleArray:
    """(rows, columns) float64 of a text file of numbers, including ``nan`` and ``inf``."""
    rows = [line.split() for line in read_text(file).splitlines() if line.strip()]
    try:
        numbers = np.array([[float(word) for word in row] for row in rows], np.float64)
    except ValueError as error:
        raise SceneError(f"{file} cannot be read as rows of numbers ({error!s:.80}): export it again") from None
    if numbers.ndim != 2 or numbers.shape[1] != columns:
        raise SceneError(f"{file} has numbers of shape {numbers.shape}; expected rows of {columns}: export it again")
    return numbers


def named_numbers(content: Any, keys: Sequence[Any], source: Path | str) -> list[float]:
    """The values of a JSON object, or list, at these keys; SceneError where one is not a finite number."""
    try:
        values = [float(content[key]) for key in keys]
    except (TypeError, ValueError, KeyError, IndexError, OverflowError):
        values = []
    if not values or not np.abs(values).max() <= MAX_NUMBER:
        raise SceneError(f"{source} lacks finite numbers {', '.join(map(str, keys)):.120}: export or copy it again")
    return values
