"""COLMAP sparse models, .bin and .txt: world-to-camera poses, OpenCV axes, pixel centres at +0.5 as in the scene.

Layout: https://colmap.github.io/format.html. Binary files are little endian: a count (uint64), then the records. Text
files have a record a line, ``#`` for comments. Both hold the same fields in the same order, so each record is parsed
once, from either of two sources. Where both are present the binary files are read, as COLMAP does.

Since 3.12 a model may have files of rigs and frames. They need not be read: the images file still has all poses.
"""

from __future__ import annotations

import math
import mmap
import struct
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.errors import SceneError
from og_pointcloud.formats.distortion import Distortion, lens_distortion
from og_pointcloud.formats.poses import PosedImage, rigid, rotation_of_quaternion
from og_pointcloud.formats.tables import naming
from og_pointcloud.scene import Camera

__all__ = ["find_model", "read_images", "read_points3d"]

MODEL_FOLDERS = ("sparse/0", "sparse", "colmap/sparse/0", "colmap/sparse")

CAMERA_MODELS: dict[str, tuple[int, str]] = {
    "SIMPLE_PINHOLE": (0, "f cx cy"),
    "PINHOLE": (1, "fx fy cx cy"),
    "SIMPLE_RADIAL": (2, "f cx cy k1"),
    "RADIAL": (3, "f cx cy k1 k2"),
    "OPENCV": (4, "fx fy cx cy k1 k2 p1 p2"),
    "OPENCV_FISHEYE": (5, "fx fy cx cy k1 k2 k3 k4"),
    "FULL_OPENCV": (6, "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6"),
    "SIMPLE_RADIAL_FISHEYE": (8, "f cx cy k1"),
    "RADIAL_FISHEYE": (9, "f cx cy k1 k2"),
    "SIMPLE_FISHEYE": (14, "f cx cy"),
    "FISHEYE": (15, "fx fy cx cy"),
}
"""Models that OpenCV undistorts exactly, with COLMAP's ids and parameters; the others are refused."""
MODEL_NAMES = {model_id: name for name, (model_id, _) in CAMERA_MODELS.items()}

Pose = NDArray[np.float64]


class _Lens(NamedTuple):
    width: int
    height: int
    intrinsics: tuple[float, float, float, float]
    distortion: Distortion | None


def find_model(capture: Path) -> Path | None:
    """The folder of the capture's sparse model, or None."""
    for folder in MODEL_FOLDERS:
        model = capture / folder
        if _file(model, "cameras") and _file(model, "images"):
            return model
    return None


def read_images(model: Path) -> tuple[PosedImage, ...]:
    """The posed images of a sparse model in the file's order. Raises SceneError naming file, place and cure."""
    lenses = dict(map(_camera, _records(model, "cameras", minimum_bytes=24 + 3 * 8)))
    images = []
    for record in _records(model, "images", minimum_bytes=4 + 7 * 8 + 4 + 1 + 8):
        record.integer("I")  # the image's own id
        pose, camera_id, name = record.pose(), record.integer("I"), record.name()
        record.skip_observations()
        lens = lenses.get(camera_id)
        if lens is None:
            raise SceneError(
                f"{model}: image '{name:.60}' has camera {camera_id}, but the cameras file has only "
                f"{sorted(lenses)[:10]}; expected files of one reconstruction: export the model again"
            )
        with naming(f"{model}, image '{name:.60}'"):
            camera = Camera(lens.width, lens.height, *lens.intrinsics, pose)
        images.append(PosedImage(name.replace("\\", "/"), camera, lens.distortion))
    if not images:
        raise SceneError(f"{model}: the images file lists 0 images; expected at least one registered image")
    return tuple(images)


def read_points3d(model: Path) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """World coordinates (n, 3) float64 and colours (n, 3) uint8 of the triangulated points."""
    file = _file(model, "points3D")
    if file is None:
        raise SceneError(f"{model} has neither points3D.bin nor points3D.txt: export the model again or name a cloud")
    return _points_binary(file) if file.suffix == ".bin" else _points_text(file)


def _file(model: Path, stem: str) -> Path | None:
    return next((file for suffix in (".bin", ".txt") if (file := model / (stem + suffix)).is_file()), None)


def _camera(record: _Binary | _Text) -> tuple[int, _Lens]:
    camera_id, model = record.integer("I"), record.camera_model()
    if model not in CAMERA_MODELS:
        raise SceneError(
            f"{record.path}: camera {camera_id} has the model {model:.60}; expected one of {', '.join(CAMERA_MODELS)}: "
            "run 'colmap image_undistorter' and make the masks on its images"
        )
    width, height = record.integer("Q"), record.integer("Q")
    names = CAMERA_MODELS[model][1].split()
    values = dict(zip(names, record.reals(len(names)), strict=True))
    fx, fy = (values.pop("f"),) * 2 if "f" in values else (values.pop("fx"), values.pop("fy"))
    intrinsics = (fx, fy, values.pop("cx"), values.pop("cy"))
    return camera_id, _Lens(width, height, intrinsics, lens_distortion(values, fisheye=model.endswith("FISHEYE")))


# Sources.


def _records(model: Path, stem: str, minimum_bytes: int) -> Iterator[_Binary | _Text]:
    """The records of a model's file, each to be parsed before the next is asked for."""
    file = _file(model, stem)
    if file is None:
        raise SceneError(f"{model} has neither {stem}.bin nor {stem}.txt: export the model again")
    return _Binary(file).records(minimum_bytes) if file.suffix == ".bin" else _Text(file).records()


def _pose(values: tuple[float, ...], source: str) -> Pose:
    """(4, 4) from qw qx qy qz tx ty tz (Hamilton)."""
    norm = math.hypot(*values[:4])
    if not np.isfinite(values).all() or not 1e-8 < norm < math.inf:
        raise SceneError(f"{source}: pose {values} has no rotation; expected a finite quaternion of length 1")
    return rigid(rotation_of_quaternion(np.array(values[:4]) / norm), np.array(values[4:]))


class _Binary:
    """Fields of a .bin file, one after the other; asking for more than the file holds is one clear error."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.data = _mapped(path)
        self.offset = 0

    def records(self, minimum_bytes: int) -> Iterator[_Binary]:
        for _ in range(self.count(minimum_bytes)):
            yield self

    def count(self, minimum_bytes: int) -> int:
        """A number of records, checked against the bytes that are left before anything is made of it."""
        count = self.integer("Q")
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

    def integer(self, code: str) -> int:
        return self.unpack("<" + code)[0]

    def reals(self, count: int) -> tuple[float, ...]:
        return self.unpack(f"<{count}d")

    def pose(self) -> Pose:
        return _pose(self.reals(7), f"{self.path} before byte {self.offset}")

    def camera_model(self) -> str:
        model_id = self.integer("i")
        return MODEL_NAMES.get(model_id, f"of id {model_id}")

    def name(self) -> str:
        end = self.data.find(b"\0", self.offset)
        self.require((end if end >= 0 else len(self.data)) + 1 - self.offset)
        name = self.data[self.offset : end].decode("utf-8", errors="replace")
        self.offset = end + 1
        return name

    def skip_observations(self) -> None:
        """2-D points: x, y, point id, 24 bytes each. There are thousands an image, and nothing here needs them."""
        count = self.count(24)
        self.offset += 24 * count


class _Text:
    """Fields of a .txt file, a record a line; the field codes of the binary form are ignored."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.line_number = 0
        self.lines: Iterator[str] = iter(())
        self.rest = ""

    def records(self) -> Iterator[_Text]:
        with self.path.open(encoding="utf-8", errors="replace") as self.lines:
            for line in self.lines:
                self.line_number += 1
                self.rest = line.strip()
                if self.rest and not self.rest.startswith("#"):
                    yield self

    def damaged(self, field: str, expected: str) -> SceneError:
        return SceneError(
            f"{self.path}, line {self.line_number}: found '{field:.60}'; expected {expected}: export it again"
        )

    def word(self) -> str:
        word, self.rest = (*self.rest.split(None, 1), "", "")[:2]
        return word

    def integer(self, code: str) -> int:
        word = self.word()
        if not word.isdecimal():
            raise self.damaged(word, "a whole number")
        return int(word)

    def reals(self, count: int) -> tuple[float, ...]:
        words = [self.word() for _ in range(count)]
        try:
            return tuple(map(float, words))
        except ValueError:
            raise self.damaged(" ".join(words), f"{count} numbers") from None

    def pose(self) -> Pose:
        return _pose(self.reals(7), f"{self.path}, line {self.line_number}")

    def camera_model(self) -> str:
        return self.word()

    def name(self) -> str:
        if not self.rest:
            raise self.damaged("", "an image name")
        return self.rest

    def skip_observations(self) -> None:
        """The next line: x, y, point id of each 2-D point; empty, but there, where an image has none."""
        self.line_number += 1
        line = next(self.lines, "")
        if len(line.split(None, 10)) == 10:  # ten words are an image, never threes
            raise self.damaged(line.strip(), "the line of 2-D points that follows each image, empty if it has none")


def _mapped(path: Path) -> mmap.mmap | bytes:
    """The file's bytes, mapped: most of a model is 2-D observations, which are never read. An empty file cannot be."""
    with path.open("rb") as stream:
        return mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) if path.stat().st_size else b""


# Points: millions of records, so no record objects.

POINT = np.dtype([("id", "<u8"), ("xyz", "<f8", (3,)), ("rgb", "u1", (3,)), ("error", "<f8"), ("track_length", "<u8")])
TRACK_LENGTH_AT = POINT.itemsize - 8
TRACK_ELEMENT_BYTES = 8


def _points_binary(path: Path) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Records of unequal length (each ends in its track): the lengths are walked, the rest is gathered at once."""
    source = _Binary(path)
    data, offsets = source.data, np.empty(source.count(POINT.itemsize), np.int64)
    last_start = len(data) - POINT.itemsize
    track_length = struct.Struct("<Q").unpack_from
    for row in range(len(offsets)):
        if source.offset > last_start:
            source.require(POINT.itemsize)
        offsets[row] = source.offset
        source.offset += POINT.itemsize + TRACK_ELEMENT_BYTES * track_length(data, source.offset + TRACK_LENGTH_AT)[0]
    source.require(0)
    # A record may start at any byte: view the file as one record per byte, and take those that are real.
    at_every_byte = np.ndarray(max(last_start + 1, 0), POINT, data, strides=(1,))
    points = at_every_byte[offsets]
    return points["xyz"].astype(np.float64), points["rgb"].copy()


def _points_text(path: Path) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """One line a point: id, x, y, z, r, g, b, error, track."""
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "loadtxt: input contained no data")
            values = np.loadtxt(path, usecols=range(1, 7), ndmin=2, encoding="utf-8")
    except ValueError as error:
        raise SceneError(
            f"{path}: {error!s:.120}; expected lines of id x y z r g b and more: export it again"
        ) from None
    with np.errstate(invalid="ignore"):  # a colour that is no number is black
        return values[:, :3].copy(), np.clip(np.nan_to_num(values[:, 3:]), 0, 255).astype(np.uint8)
