"""Image files of a capture: their locations, sizes and pixels."""

from __future__ import annotations

import io
import os
import posixpath
import re
import struct
from contextlib import suppress
from pathlib import Path, PurePosixPath
from types import ModuleType
from typing import TYPE_CHECKING, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.errors import SceneError, naming_extra
from og_pointcloud.formats.atomic import write_file

if TYPE_CHECKING:
    from PIL.Image import Image

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".JPG", ".PNG", ".JPEG", ".webp", ".tif", ".tiff", ".bmp")
IMAGE_FOLDERS = ("images", "images_2", "images_4", "images_8", "color", "rgb", "dslr/resized_images")
LEADS_OUT = re.compile(r"/|\.\.(?:/|$)|[A-Za-z]:/")
"""Beginnings of normalized paths that lead out of a folder, also on Windows."""
PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
MAX_PIXELS = 1 << 27
"""Larger images are refused before anything is allocated."""


EXIF_ORIENTATION = 0x0112
EXIF_QUARTER_TURNS = {3: 2, 6: 3, 8: 1}
"""Orientations that cameras write, but for upright -> quarter turns, counter-clockwise, that undo them."""


class PngHeader(NamedTuple):
    """The first chunk of a PNG. color_type: 0 gray, 2 RGB, 3 palette, 4 gray with alpha, 6 RGBA."""

    width: int
    height: int
    bit_depth: int
    color_type: int


def require_cv2() -> ModuleType:
    """OpenCV, or an error that names the extra."""
    os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(MAX_PIXELS))  # read when it is imported
    os.environ.setdefault("OPENCV_LOG_LEVEL", "ERROR")  # its warning of a damaged file would repeat our error
    with naming_extra("opencv-contrib-python-headless", "fit"):
        import cv2
    return cv2


def require_pillow() -> ModuleType:
    """Pillow's Image, or an error that names the extra."""
    with naming_extra("Pillow", "fit"):
        from PIL import Image
    return Image


def without_suffix(path: str) -> str:
    """``path`` without its image suffix. Only known suffixes are removed: ``frame.0001`` has none."""
    suffix = PurePosixPath(path).suffix
    return path[: -len(suffix)] if suffix.lower() in IMAGE_SUFFIXES else path


def find_image(capture: Path, path: str) -> Path | None:
    """The file that ``path`` in a pose file refers to, or None.

    The path is tried inside the capture folder, then inside its image folders; each also with an image suffix added. A
    path that leads out of the capture folder is never opened: the longest of its endings that is found is used.
    """
    inside = posixpath.normpath(path)
    beginning = LEADS_OUT.match(inside)  # of absolute paths on the machine that wrote the file, or worse
    parts = [part for part in inside[beginning.end() if beginning else 0 :].split("/") if part not in ("", ".", "..")]
    for first in range(len(parts) if beginning else min(1, len(parts))):
        for folder in ("", *IMAGE_FOLDERS):
            file = capture.joinpath(folder, *parts[first:])
            candidates = (file, *(file.with_name(file.name + suffix) for suffix in IMAGE_SUFFIXES))
            if found := next((candidate for candidate in candidates if os.path.isfile(candidate)), None):
                return found
    return None


def png_header(file: Path) -> PngHeader | None:
    """Size and pixel type from a PNG's first 26 bytes; None if the file is no PNG."""
    with file.open("rb") as stream:
        head = stream.read(26)
    if len(head) < 26 or not head.startswith(PNG_SIGNATURE) or head[12:16] != b"IHDR":
        return None
    header = PngHeader(int.from_bytes(head[16:20], "big"), int.from_bytes(head[20:24], "big"), head[24], head[25])
    _check_pixels(file, header.width, header.height)
    return header


def image_size(file: Path) -> tuple[int, int]:
    """(width, height) of an image file, from its header. SceneError beyond MAX_PIXELS."""
    with file.open("rb") as stream:
        size = stated_size(stream, file)
    if size is None:  # a format that is not known here
        height, width = decoded(file, require_cv2().IMREAD_GRAYSCALE).shape[:2]
        return width, height
    return size


def exif_quarter_turns(file: Path) -> int:
    """Quarter turns, counter-clockwise, by which its camera says that the stored image must be turned to stand upright;
    0 where the file says nothing."""
    with file.open("rb") as stream:
        image = _opened(stream, file)
        if image is None or image.format == "PNG":  # Pillow would decode a PNG for it, and cameras write none
            return 0
        with suppress(Exception):  # many types: of damaged tags
            return EXIF_QUARTER_TURNS.get(image.getexif().get(EXIF_ORIENTATION, 1), 0)
    return 0


def _check_pixels(name: Path | str, width: int, height: int) -> None:
    if width * height > MAX_PIXELS:
        raise SceneError(
            f"{name} says it is {width}x{height} pixels; expected at most {MAX_PIXELS} pixels: scale it down"
        )


def stated_size(stream: BinaryIO, name: Path | str) -> tuple[int, int] | None:
    """(width, height) from the header of a PNG, JPEG, BMP, WebP or TIFF; None for other headers.

    No pixel is decoded. SceneError, which begins with ``name``, beyond MAX_PIXELS.
    """
    image = _opened(stream, name)
    if image is None:
        return None
    _check_pixels(name, *image.size)
    return image.size


def _opened(stream: BinaryIO, name: Path | str) -> Image | None:
    """A PNG, JPEG, BMP, WebP or TIFF of which only the header is read; None for other files."""
    pillow = require_pillow()
    from PIL import BmpImagePlugin, JpegImagePlugin, PngImagePlugin, TiffImagePlugin, WebPImagePlugin

    kinds = (
        PngImagePlugin.PngImageFile, JpegImagePlugin.JpegImageFile, BmpImagePlugin.BmpImageFile,
        WebPImagePlugin.WebPImageFile, TiffImagePlugin.TiffImageFile,
    )  # fmt: skip
    for kind in kinds:  # not Image.open, which warns of images from two thirds of MAX_PIXELS on
        stream.seek(0)
        try:
            return kind(stream)
        except pillow.DecompressionBombError as error:  # raised by WebP's own reader
            raise SceneError(f"{name}: {error}; expected at most {MAX_PIXELS} pixels: scale it down") from None
        except Exception:  # many types: readers fail in many ways on foreign or damaged headers
            continue
    return None


def decoded(file: Path, flags: int) -> NDArray[np.generic]:
    """The pixels of a file as OpenCV decodes them: (H, W) or (H, W, channels), colors as BGR.

    EXIF orientation is ignored, as poses and masks ignore it.
    """
    return decoded_bytes(np.fromfile(file, np.uint8), flags, file)


def decoded_bytes(data: NDArray[np.uint8], flags: int, name: Path | str) -> NDArray[np.generic]:
    """As `decoded`, of an image file's bytes. SceneError, which begins with ``name``, where they are none."""
    cv2, content = require_cv2(), data.tobytes()
    stated_size(io.BytesIO(content), name)  # refuses too many pixels before OpenCV allocates them
    _check_chunks(content, name)
    try:
        pixels = cv2.imdecode(data, flags | cv2.IMREAD_IGNORE_ORIENTATION) if data.size else None
    except cv2.error:
        pixels = None
    if pixels is None:
        raise _undecodable(name, data.size)
    return pixels


def _check_chunks(content: bytes, name: Path | str) -> None:
    """SceneError where a chunk of a PNG claims more bytes than follow: OpenCV allocates and fills what it claims."""
    at = len(PNG_SIGNATURE)
    while content.startswith(PNG_SIGNATURE) and at + 8 <= len(content):
        length, kind = struct.unpack_from(">I4s", content, at)
        if length > (left := len(content) - at - 8):
            raise _undecodable(name, len(content), f" (a chunk of {length} bytes has {left} left)")
        at += 12 + length if kind != b"IEND" else len(content)  # what follows the last chunk is not read


def palette_indices(file: Path) -> NDArray[np.uint8]:
    """(H, W) palette indices of a PNG, which video trackers use as ids; OpenCV would return colors."""
    try:
        with require_pillow().open(file, formats=("PNG",)) as image:
            return np.asarray(image, np.uint8)
    except (OSError, SyntaxError, ValueError):
        raise _undecodable(file, file.stat().st_size) from None


def _undecodable(name: Path | str, size: int, why: str = "") -> SceneError:
    return SceneError(
        f"{name} ({size} bytes) cannot be decoded as an image: it is damaged or truncated{why}, copy it again"
    )


def read_rgb(file: Path, size: tuple[int, int]) -> NDArray[np.uint8]:
    """(H, W, 3) uint8 RGB, resized to ``size`` (width, height); the aspect ratios must agree within a pixel."""
    cv2 = require_cv2()
    image = decoded(file, cv2.IMREAD_COLOR)
    height, width = image.shape[:2]
    require_scaled(f"{file} is", (width, height), size)
    if (width, height) != size:
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA if width > size[0] else cv2.INTER_LINEAR)
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), np.uint8)


def require_scaled(
    what: str, size: tuple[int, int], camera: tuple[int, int], cure: str = "fix the width and height in the pose file"
) -> None:
    """SceneError, which begins with ``what``, where a size (width, height) is not its camera's, up to scale."""
    if not same_shape(size, camera):
        raise SceneError(
            f"{what} {size[0]}x{size[1]} pixels, its camera {camera[0]}x{camera[1]}; expected the same aspect ratio: "
            f"{cure}"
        )


def same_shape(size: tuple[int, int], other: tuple[int, int]) -> bool:
    """Whether two sizes (width, height) have the same aspect ratio, up to rounding by a pixel of the smaller."""
    return abs(size[0] * other[1] - size[1] * other[0]) <= max(*size, *other)


def write_png(path: Path, pixels: NDArray[np.generic]) -> Path:
    """A PNG of (H, W) uint8 or uint16, or of (H, W, 3) uint8 RGB; written whole or not at all."""
    written, png = require_cv2().imencode(".png", pixels[:, :, ::-1] if pixels.ndim == 3 else pixels)
    if not written:
        raise SceneError(f"{path}: OpenCV cannot write a PNG of {pixels.shape[1]}x{pixels.shape[0]} pixels")
    return write_file(path, png.tobytes())
