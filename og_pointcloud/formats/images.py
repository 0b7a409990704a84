"""Image files of a capture: where they lie, how large they are, and their pixels."""

from __future__ import annotations

import io
import os
import posixpath
from pathlib import Path, PurePosixPath
from types import ModuleType
from typing import BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.errors import MissingExtraError, SceneError
from og_pointcloud.formats.atomic import replacing

__all__ = [
    "IMAGE_SUFFIXES",
    "PngHeader",
    "decoded",
    "find_image",
    "image_size",
    "png_header",
    "read_rgb",
    "require_cv2",
    "require_scaled",
    "same_shape",
    "without_suffix",
    "write_png",
]

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".JPG", ".PNG", ".JPEG", ".webp", ".tif", ".tiff", ".bmp")
IMAGE_FOLDERS = ("images", "images_2", "images_4", "images_8", "color", "rgb", "dslr/resized_images")
MAX_PIXELS = 1 << 27
"""Larger images are refused before anything is allocated."""
HEADERS = ("PNG", "JPEG", "BMP", "WEBP", "TIFF")
"""Formats whose headers are read for an image's size; others are decoded for it."""


class PngHeader(NamedTuple):
    """The first chunk of a PNG. color_type: 0 grey, 2 RGB, 3 palette, 4 grey with alpha, 6 RGBA."""

    width: int
    height: int
    bit_depth: int
    color_type: int


def require_cv2() -> ModuleType:
    """OpenCV, or an error that names the extra."""
    os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(MAX_PIXELS))  # read when it is imported
    try:
        import cv2
    except ImportError as error:
        raise MissingExtraError("opencv-contrib-python-headless", "fit") from error
    return cv2


def without_suffix(path: str) -> str:
    """``path`` without its image suffix. Only a known suffix goes: ``frame.0001`` is a name, not a ``.0001`` file."""
    suffix = PurePosixPath(path).suffix
    return path[: -len(suffix)] if suffix.lower() in IMAGE_SUFFIXES else path


def find_image(capture: Path, path: str) -> Path | None:
    """The file that a pose file means by ``path``, or None.

    Tried: the path inside the capture folder, then inside its image folders; each also with an image suffix added. A
    path that leads out of the capture folder is never opened: its file name is looked for in the image folders.
    """
    inside = posixpath.normpath(path)
    if inside.startswith(("/", "..")):
        inside = posixpath.basename(inside)
    for folder in ("", *IMAGE_FOLDERS):
        file = capture / folder / inside
        candidates = (file, *(file.with_name(file.name + suffix) for suffix in IMAGE_SUFFIXES))
        if found := next((candidate for candidate in candidates if os.path.isfile(candidate)), None):
            return found
    return None


def png_header(file: Path) -> PngHeader | None:
    """Size and pixel type from a PNG's first 26 bytes; None if the file is no PNG."""
    with file.open("rb") as stream:
        head = stream.read(26)
    if len(head) < 26 or head[:8] != b"\x89PNG\r\n\x1a\n" or head[12:16] != b"IHDR":
        return None
    header = PngHeader(int.from_bytes(head[16:20], "big"), int.from_bytes(head[20:24], "big"), head[24], head[25])
    _check_pixels(file, header.width, header.height)
    return header


def image_size(file: Path) -> tuple[int, int]:
    """(width, height) of an image file, as its header states it. SceneError beyond MAX_PIXELS."""
    if size := _stated_size(file, file):
        return size
    height, width = decoded(file, require_cv2().IMREAD_GRAYSCALE).shape[:2]  # of a kind that is not known here
    return width, height


def _check_pixels(file: Path, width: int, height: int) -> None:
    if width * height > MAX_PIXELS:
        raise SceneError(f"{file} says it is {width}x{height} pixels; expected at most {MAX_PIXELS} pixels")


def _stated_size(file: Path, data: Path | BinaryIO) -> tuple[int, int] | None:
    """(width, height) as the header states it; None where it is no image that Pillow knows. data: of the file."""
    try:
        from PIL import Image
    except ImportError as error:
        raise MissingExtraError("Pillow", "fit") from error
    try:
        with Image.open(data, formats=HEADERS) as image:
            size = image.size
    except Image.DecompressionBombError as error:
        raise SceneError(f"{file} cannot be used ({error}); expected at most {MAX_PIXELS} pixels") from None
    except Exception:  # of as many kinds as there are formats
        return None
    _check_pixels(file, *size)
    return size


def decoded(file: Path, flags: int) -> NDArray[np.generic]:
    """The pixels as OpenCV gives them. EXIF orientation is ignored, as poses and masks ignore it."""
    cv2 = require_cv2()
    data = np.fromfile(file, np.uint8)
    _stated_size(file, io.BytesIO(data.tobytes()))  # before anything is allocated
    try:
        pixels = cv2.imdecode(data, flags | cv2.IMREAD_IGNORE_ORIENTATION) if data.size else None
    except cv2.error:
        pixels = None
    if pixels is None:
        raise SceneError(
            f"{file} ({data.size} bytes) cannot be decoded as an image: it is damaged or truncated, copy it again"
        )
    return pixels


def read_rgb(file: Path, size: tuple[int, int]) -> NDArray[np.uint8]:
    """(H, W, 3) uint8 RGB, resized to ``size`` (width, height); its shape must agree within a pixel."""
    cv2 = require_cv2()
    image = decoded(file, cv2.IMREAD_COLOR)
    height, width = image.shape[:2]
    require_scaled(f"{file} is", (width, height), size)
    if (width, height) != size:
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA if width > size[0] else cv2.INTER_LINEAR)
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), np.uint8)


def require_scaled(
    what: str, size: tuple[int, int], camera: tuple[int, int], cure: str = "fix the width and height of the pose file"
) -> None:
    """SceneError, which begins with ``what``, where a size (width, height) is not its camera's, or that scaled."""
    if not same_shape(size, camera):
        raise SceneError(
            f"{what} {size[0]}x{size[1]} pixels, its camera {camera[0]}x{camera[1]}; expected the same size or a "
            f"scaled one: {cure}"
        )


def same_shape(size: tuple[int, int], other: tuple[int, int]) -> bool:
    """Whether one size (width, height) is the other scaled, but for rounding by at most a pixel of the smaller."""
    return abs(size[0] * other[1] - size[1] * other[0]) <= max(*size, *other)


def write_png(path: Path, pixels: NDArray[np.generic]) -> Path:
    """A PNG of (H, W) uint8 or uint16, or of (H, W, 3) uint8 RGB; written whole or not at all."""
    written, png = require_cv2().imencode(".png", pixels[:, :, ::-1] if pixels.ndim == 3 else pixels)
    if not written:
        raise SceneError(f"{path}: OpenCV cannot write a PNG of {pixels.shape[1]}x{pixels.shape[0]} pixels")
    with replacing(path) as file:
        file.write(png.tobytes())
    return path
