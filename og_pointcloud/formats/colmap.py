"""COLMAP sparse models, .bin and .txt: world-to-camera poses, OpenCV axes, pixel centers at +0.5 as in the scene.

Layout: https://colmap.github.io/format.html. Binary files are little endian: a count (uint64), then the records. Text
files have one record per line, ``#`` for comments. If both are present, the binary files are read, as in COLMAP.

Since 3.12 a model may have rigs and frames files. They are not needed: the images file still has all poses.
"""

from __future__ import annotations

import math
import mmap
import struct
import warnings
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.errors import SceneError
from og_pointcloud.formats.lenses import SPHERICAL, Lens, lens_of, spherical_camera
from og_pointcloud.formats.poses import PosedImage, pose_of_quaternion
from og_pointcloud.formats.tables import naming
from og_pointcloud.scene import Camera, DoubleArray

MODEL_FOLDERS = ("sparse/0", "sparse", "colmap/sparse/0", "colmap/sparse", "dslr/colmap")

CAMERA_MODELS: dict[str, tuple[int, str]] = {
    "SIMPLE_PINHOLE": (0, "f cx cy"),
    "PINHOLE": (1, "fx fy cx cy"),
    "SIMPLE_RADIAL": (2, "f cx cy k1"),
    "RADIAL": (3, "f cx cy k1 k2"),
    "OPENCV": (4, "fx fy cx cy k1 k2 p1 p2"),
    "OPENCV_FISHEYE": (5, "fx fy cx cy k1 k2 k3 k4"),
    "FULL_OPENCV": (6, "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6"),
    "FOV": (7, "fx fy cx cy omega"),
    "SIMPLE_RADIAL_FISHEYE": (8, "f cx cy k1"),
    "RADIAL_FISHEYE": (9, "f cx cy k1 k2"),
    "THIN_PRISM_FISHEYE": (10, "fx fy cx cy k1 k2 p1 p2 k3 k4 sx1 sy1"),
    "SIMPLE_DIVISION": (12, "f cx cy k"),
    "DIVISION": (13, "fx fy cx cy k"),
    "SIMPLE_FISHEYE": (14, "f cx cy"),
    "FISHEYE": (15, "fx fy cx cy"),
    "EUCM": (16, "fx fy cx cy alpha beta"),
    "EQUIRECTANGULAR": (17, "w h"),
}
"""COLMAP's ids and parameters. Only RAD_TAN_THIN_PRISM_FISHEYE (11) is refused."""
LENS_MODELS = {"FOV": "fov", "DIVISION": "division", "SIMPLE_DIVISION": "division", "EUCM": "extended"}
MODEL_NAMES = {model_id: name for name, (model_id, _) in CAMERA_MODELS.items()}

CameraRecord = tuple[int, str, tuple[int, int], dict[str, float]]
"""Id, model, (width, height), parameters by name."""
ImageRecord = tuple[tuple[float, ...], int, str]
"""Pose qw qx qy qz tx ty tz, the camera's id, name."""
Records = TypeVar("Records")
Number = TypeVar("Number", int, float)


def find_model(capture: Path) -> Path | None:
    """The folder of the capture's sparse model, or None."""
    for folder in MODEL_FOLDERS:
        model = capture / folder
        if _file(model, "cameras") and _file(model, "images"):
            return model
    return None


def read_images(model: Path) -> tuple[PosedImage, ...]:
    """The posed images of a sparse model in the file's order. Raises SceneError naming file, place and cure."""
    cameras: dict[int, tuple[Callable[[DoubleArray], Camera], Lens | None]] = {}
    for camera_id, camera_model, size, values in _records(model, "cameras", _cameras_binary, _cameras_text):
        if camera_id in cameras:
            raise SceneError(
                f"{model}: two cameras have the id {camera_id}; expected files from one reconstruction, not from two: "
                "export the model again"
            )
        cameras[camera_id] = _camera(camera_model, size, values)
    images = []
    for pose, camera_id, name in _records(model, "images", _images_binary, _images_text):
        if camera_id not in cameras:
            raise SceneError(
                f"{model}: image '{name:.60}' has camera {camera_id}, but the cameras file has only "
                f"{sorted(cameras)[:10]}; expected files from one reconstruction: export the model again"
            )
        with naming(f"{model}, image '{name:.60}'"):
            camera_at, lens = cameras[camera_id]
            camera = camera_at(pose_of_quaternion(pose[:4], pose[4:]))
        images.append(PosedImage(name.replace("\\", "/"), camera, lens))  # models made on Windows
    if not images:
        raise SceneError(f"{model}: the images file lists 0 images; expected at least one registered image")
    return tuple(images)


def larger_model(model: Path, count: int) -> str | None:
    """A warning where ``sparse/1`` or the like beside ``sparse/0`` has more images than the ``count`` of that, or None;
    COLMAP numbers its models by the order in which it began them."""
    others = [folder for folder in model.parent.glob("[0-9]*") if model.name == "0" and folder.name.isdigit()]
    most, largest = max(((_image_count(folder), folder) for folder in others), default=(0, model))
    if most <= count:
        return None
    return (
        f"{model} has {count} images, but {largest} has {most}: the photographs were registered in several models, and "
        f"only {model.name} is read; to use the other, swap the two folders' names"
    )


def _image_count(model: Path) -> int:
    """Images of a model, by its file's head or lines."""
    file = _file(model, "images")
    if file is None:
        return 0
    with file.open("rb") as stream:
        if file.suffix == ".bin":
            return int.from_bytes(stream.read(8), "little")
        return sum(not line.startswith(b"#") for line in stream) // 2


def read_points3d(model: Path) -> tuple[DoubleArray, NDArray[np.uint8]]:
    """World coordinates (n, 3) float64 and colors (n, 3) uint8 of the triangulated points."""
    return _records(model, "points3D", _points_binary, _points_text)


def _file(model: Path, stem: str) -> Path | None:
    return next((file for suffix in (".bin", ".txt") if (file := model / (stem + suffix)).is_file()), None)


def _records(model: Path, stem: str, binary: Callable[[Path], Records], text: Callable[[Path], Records]) -> Records:
    """Read the model's file of that name by the reader for its format."""
    file = _file(model, stem)
    if file is None:
        raise SceneError(f"{model} has neither {stem}.bin nor {stem}.txt: export the model again or name a cloud")
    return binary(file) if file.suffix == ".bin" else text(file)


def _parameters(file: Path, camera_id: int, camera_model: str) -> list[str]:
    """Names of a camera model's parameters."""
    if camera_model not in CAMERA_MODELS:
        raise SceneError(
            f"{file}: camera {camera_id} has the model {camera_model:.60}; expected one of {', '.join(CAMERA_MODELS)}: "
            "run 'colmap image_undistorter' and make the masks on its images"
        )
    return CAMERA_MODELS[camera_model][1].split()


def _camera(
    camera_model: str, size: tuple[int, int], values: dict[str, float]
) -> tuple[Callable[[DoubleArray], Camera], Lens | None]:
    """A function from a pose (world to camera) to the camera, and the lens. values: by parameter name."""
    if camera_model == "EQUIRECTANGULAR":
        return partial(spherical_camera, *size), SPHERICAL
    # The values other than focal lengths and principal point are the terms of the lens.
    fx, fy = (values.pop("f"),) * 2 if "f" in values else (values.pop("fx"), values.pop("fy"))
    intrinsics = (fx, fy, values.pop("cx"), values.pop("cy"))
    model = "fisheye" if camera_model.endswith("FISHEYE") else LENS_MODELS.get(camera_model, "perspective")
    return partial(Camera, *size, *intrinsics), lens_of(model, values)


# Text files.


def _cameras_text(file: Path) -> Iterator[CameraRecord]:
    for place, line, _ in _lines(file):
        words = [*line.split(), *[""] * 4]  # "" for missing fields, which then fail as numbers
        (camera_id,), camera_model, size = _numbers(int, words[:1], place), words[1], _numbers(int, words[2:4], place)
        names = _parameters(file, camera_id, camera_model)
        if len(line.split()) > 4 + len(names):  # for example if the model's name is wrong
            raise SceneError(
                f"{place}: a {camera_model} with more than {len(names)} parameters; expected {', '.join(names)}: name "
                "the model they belong to"
            )
        values = _numbers(float, words[4 : 4 + len(names)], place)
        yield camera_id, camera_model, (size[0], size[1]), dict(zip(names, values, strict=True))


def _images_text(file: Path) -> Iterator[ImageRecord]:
    """Two lines each. The second lists 2-D points; it is present but empty if an image has none."""
    for place, line, lines in _lines(file):
        words = [*line.split(None, 9), *[""] * 10]
        if not words[9].strip():
            raise SceneError(f"{place}: found '{line.strip():.60}'; expected ten fields, name last: export it again")
        _, camera_id = _numbers(int, [words[0], words[8]], place)
        yield _numbers(float, words[1:8], place), camera_id, words[9].strip()
        number, observations = next(lines, (0, ""))
        if not _is_in_threes(observations.split()):
            raise SceneError(
                f"{file}, line {number}: found '{observations.strip():.60}'; expected the line of 2-D points that "
                "follows each image, empty if it has none: export it again"
            )


def _is_in_threes(words: list[str]) -> bool:
    """Whether they are a line of 2-D points, x y id each; an image's line has its name from the tenth word on."""
    try:
        return len(words) % 3 == 0 and all(math.isfinite(float(word)) for word in [*words[:12], *words[-1:]])
    except ValueError:
        return False


def _lines(file: Path) -> Iterator[tuple[str, str, Iterator[tuple[int, str]]]]:
    """Lines that are not comments: each line's place, for errors, its text, and the numbered lines after it."""
    with file.open(encoding="utf-8-sig", errors="replace") as stream:  # editors on Windows write a byte order mark
        lines = enumerate(stream, 1)
        for number, line in lines:
            if line.strip() and not line.startswith("#"):
                yield f"{file}, line {number}", line, lines


def _numbers(kind: Callable[[str], Number], words: Sequence[str], place: str) -> tuple[Number, ...]:
    try:
        return tuple(map(kind, words))
    except ValueError:
        what = "whole numbers" if kind is int else "numbers"
        raise SceneError(
            f"{place}: found '{' '.join(words):.60}'; expected {len(words)} {what}: export it again"
        ) from None


# Binary files.


def _cameras_binary(file: Path) -> Iterator[CameraRecord]:
    source = _Binary(file)
    for _ in range(source.count(24 + 3 * 8)):  # at least three parameters
        camera_id, model_id, width, height = source.unpack("<IiQQ")
        camera_model = MODEL_NAMES.get(model_id, f"of id {model_id}")
        names = _parameters(file, camera_id, camera_model)
        values = source.unpack(f"<{len(names)}d")
        yield camera_id, camera_model, (width, height), dict(zip(names, values, strict=True))


def _images_binary(file: Path) -> Iterator[ImageRecord]:
    source = _Binary(file)
    for _ in range(source.count(4 + 7 * 8 + 4 + 1 + 8)):  # id, pose, camera, an empty name, number of 2-D points
        _, *pose, camera_id = source.unpack("<I7dI")
        yield tuple(pose), camera_id, source.name()
        points = source.count(24)  # 2-D points: thousands per image, not needed here
        source.offset += 24 * points


class _Binary:
    """Fields of a .bin file, one after the other; asking for more than the file holds is one clear error."""

    def __init__(self, path: Path) -> None:
        self.path, self.offset = path, 0
        with path.open("rb") as stream:
            # Most of a model is 2-D observations, which are never read. An empty file cannot be mapped.
            self.data = mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) if path.stat().st_size else b""

    def count(self, minimum_bytes: int) -> int:
        """A number of records, checked against the remaining bytes before memory is allocated for them."""
        count = self.unpack("<Q")[0]
        self.require(count * minimum_bytes)
        return count

    def require(self, size: int) -> None:
        if self.offset + size > len(self.data):
            raise SceneError(
                f"{self.path} is truncated or damaged: at byte {self.offset} it needs {size} more bytes, but has "
                f"{len(self.data) - self.offset} (of {len(self.data)}): copy or export it again"
            )

    def unpack(self, layout: str) -> tuple:
        size = struct.calcsize(layout)
        self.require(size)
        values = struct.unpack_from(layout, self.data, self.offset)
        self.offset += size
        return values

    def name(self) -> str:
        """Text up to the zero byte that ends it."""
        end = self.data.find(b"\0", self.offset)
        self.require((end if end >= 0 else len(self.data)) + 1 - self.offset)
        name = self.data[self.offset : end].decode("utf-8", errors="replace")
        self.offset = end + 1
        return name


# Points: millions of records, so no record objects.

POINT = np.dtype([("id", "<u8"), ("xyz", "<f8", (3,)), ("rgb", "u1", (3,)), ("error", "<f8"), ("track_length", "<u8")])
TRACK_LENGTH_AT = POINT.itemsize - 8
TRACK_ELEMENT_BYTES = 8


def _points_binary(path: Path) -> tuple[DoubleArray, NDArray[np.uint8]]:
    """Records differ in length, as each ends with its track: a loop finds where they start, numpy reads the rest."""
    source = _Binary(path)
    data, offsets = source.data, np.empty(source.count(POINT.itemsize), np.int64)
    last_start = len(data) - POINT.itemsize
    track_length = struct.Struct("<Q").unpack_from
    for row in range(len(offsets)):
        if source.offset > last_start:  # called only on failure: there are millions of records
            source.require(POINT.itemsize)
        offsets[row] = source.offset
        source.offset += POINT.itemsize + TRACK_ELEMENT_BYTES * track_length(data, source.offset + TRACK_LENGTH_AT)[0]
    source.require(0)
    # A record may start at any byte: view the file as one record per byte, and pick the real ones.
    at_every_byte = np.ndarray(max(last_start + 1, 0), POINT, data, strides=(1,))
    points = at_every_byte[offsets]
    return points["xyz"].astype(np.float64), points["rgb"].copy()


def _points_text(path: Path) -> tuple[DoubleArray, NDArray[np.uint8]]:
    """One line per point: id, x, y, z, r, g, b, error, track."""
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "loadtxt: input contained no data")
            values = np.loadtxt(path, usecols=range(1, 7), ndmin=2, encoding="utf-8-sig")
    except ValueError as error:
        raise SceneError(
            f"{path}: {error!s:.120}; expected lines of id x y z r g b and more: export it again"
        ) from None
    with np.errstate(invalid="ignore"):  # a color that is not a number is black
        return values[:, :3].copy(), np.clip(np.nan_to_num(values[:, 3:]), 0, 255).astype(np.uint8)
