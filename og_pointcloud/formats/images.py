"""Image files of a capture: where they lie, how large they are, and their pixels."""

from __future__ import annotations

import io
import os
import posixpath
import struct
from pathlib import Path, PurePosixPath
from types import ModuleType
from typing import BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.errors import SceneError, naming_extra
from og_pointcloud.formats.atomic import write_file

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".JPG", ".PNG", ".JPEG", ".webp", ".tif", ".tiff", ".bmp")
IMAGE_FOLDERS = ("images", "images_2", "images_4", "images_8", "color", "rgb", "dslr/resized_images")
MAX_PIXELS = 1 << 27
"""Larger images are refused before anything is allocated."""
MOST_SEGMENTS = 1000
"""Segments of a JPEG among which its size must stand."""


class PngHeader(NamedTuple):
    """The first chunk of a PNG. color_type: 0 gray, 2 RGB, 3 palette, 4 gray with alpha, 6 RGBA."""

    width: int
    height: int
    bit_depth: int
    color_type: int


def require_cv2() -> ModuleType:
    """OpenCV, or an error that names the extra."""
    os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(MAX_PIXELS))  # read when it is imported
    os.environ.setdefault("OPENCV_LOG_LEVEL", "ERROR")  # its warning of a damaged file stands beside our error
    with naming_extra("opencv-contrib-python-headless", "fit"):
        import cv2
    return cv2


def require_pillow() -> ModuleType:
    """Pillow's Image, or an error that names the extra."""
    with naming_extra("Pillow", "fit"):
        from PIL import Image
    return Image


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
    if inside.startswith(("/", "..")):  # absolute paths of the machine that wrote the file, or worse
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
    with file.open("rb") as stream:
        size = stated_size(stream)
    if size is None:  # of a kind that is not known here
        height, width = decoded(file, require_cv2().IMREAD_GRAYSCALE).shape[:2]
        return width, height
    _check_pixels(file, *size)
    return size


def _check_pixels(file: Path, width: int, height: int) -> None:
    if width * height > MAX_PIXELS:
        raise SceneError(
            f"{file} says it is {width}x{height} pixels; expected at most {MAX_PIXELS} pixels: scale it down"
        )


def stated_size(stream: BinaryIO) -> tuple[int, int] | None:
    """(width, height) as a PNG, JPEG, BMP, WebP or TIFF states it; None where the file is no such image."""
    head = stream.read(30)
    if head[:8] == b"\x89PNG\r\n\x1a\n" and head[12:16] == b"IHDR":
        return int.from_bytes(head[16:20], "big"), int.from_bytes(head[20:24], "big")
    if head[:2] == b"\xff\xd8":
        return _jpeg_size(stream)
    if head[:2] == b"BM" and len(head) >= 26:
        width, height = struct.unpack_from("<ii", head, 18)
        return abs(width), abs(height)  # rows from the top have a negative height
    if head[:4] == b"RIFF" and head[8:12] == b"WEBP" and len(head) == 30:
        return _webp_size(head)
    return _tiff_size(stream, head) if head[:4] in (b"II*\0", b"MM\0*") else None


def _jpeg_size(stream: BinaryIO) -> tuple[int, int] | None:
    """The size in the first frame header. Segments before it are skipped by their lengths (ITU-T T.81, B.1)."""
    stream.seek(2)
    for _ in range(MOST_SEGMENTS):
        marker = stream.read(4)
        while marker[:2] == b"\xff\xff":  # any number may stand before a marker
            marker = marker[1:] + stream.read(1)
        if len(marker) < 4 or marker[0] != 0xFF:
            return None
        # Frame headers, SOF0 to SOF15; C4, C8 and CC in between are tables (DHT, DAC) and reserved (JPG).
        if marker[1] in range(0xC0, 0xD0) and marker[1] not in (0xC4, 0xC8, 0xCC):
            frame = stream.read(5)  # precision, height, width
            return int.from_bytes(frame[3:5], "big"), int.from_bytes(frame[1:3], "big")
        stream.seek(int.from_bytes(marker[2:], "big") - 2, os.SEEK_CUR)
    return None


def _webp_size(head: bytes) -> tuple[int, int] | None:
    """The size in a lossy (VP8, RFC 6386 9.1), lossless (VP8L) or extended (VP8X, RFC 9649) file."""
    if head[12:16] == b"VP8 ":  # 14 bits each; the upper two scale the display
        width, height = struct.unpack_from("<HH", head, 26)
        return width & 0x3FFF, height & 0x3FFF
    if head[12:16] == b"VP8L":  # 14 bits each, less one
        bits = int.from_bytes(head[21:25], "little")
        return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    # 24 bits each, less one.
    sizes = int.from_bytes(head[24:27], "little") + 1, int.from_bytes(head[27:30], "little") + 1
    return sizes if head[12:16] == b"VP8X" else None


def _tiff_size(stream: BinaryIO, head: bytes) -> tuple[int, int] | None:
    """Tags 256 and 257 of the first directory (TIFF 6.0, section 2)."""
    order = "<" if head[:2] == b"II" else ">"
    if len(head) < 8:
        return None
    stream.seek(struct.unpack_from(order + "I", head, 4)[0])
    count = int.from_bytes(stream.read(2), "little" if order == "<" else "big")
    entries = stream.read(12 * count)
    size: dict[int, int] = {}
    for at in range(0, len(entries) - 11, 12):
        tag, kind = struct.unpack_from(order + "HH", entries, at)
        size[tag] = struct.unpack_from(order + ("H" if kind == 3 else "I"), entries, at + 8)[0]  # 3: SHORT, else LONG
    return (size[256], size[257]) if {256, 257} <= size.keys() else None


def decoded(file: Path, flags: int) -> NDArray[np.generic]:
    """The pixels as OpenCV gives them. EXIF orientation is ignored, as poses and masks ignore it."""
    cv2 = require_cv2()
    data = np.fromfile(file, np.uint8)
    # Before OpenCV takes memory for the pixels.
    if stated := stated_size(io.BytesIO(data.tobytes())):
        _check_pixels(file, *stated)
    try:
        pixels = cv2.imdecode(data, flags | cv2.IMREAD_IGNORE_ORIENTATION) if data.size else None
    except cv2.error:
        pixels = None
    if pixels is None:
        raise _undecodable(file, data.size)
    return pixels


def palette_indices(file: Path) -> NDArray[np.uint8]:
    """(H, W) the entries of a PNG's palette, as video trackers write ids; OpenCV would give their colors."""
    try:
        with require_pillow().open(file, formats=("PNG",)) as image:
            return np.asarray(image, np.uint8)
    except (OSError, SyntaxError, ValueError):
        raise _undecodable(file, file.stat().st_size) from None


def _undecodable(file: Path, size: int) -> SceneError:
    return SceneError(f"{file} ({size} bytes) cannot be decoded as an image: it is damaged or truncated, copy it again")


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
    return write_file(path, png.tobytes())
