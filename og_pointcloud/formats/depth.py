"""Depth images: each pixel's distance along the optical axis (z, not the length of the ray), 0 where none was measured.

16-bit gray PNG and TIFF, float TIFF, ``.npy``. Stored integers are millimeters in a world of meters unless the data
set states otherwise; stored floats are world lengths. The largest 16-bit number, 65535, is not a depth, like 0: sensors
write it for "no reading" or "too far". Nor are 1e10 and 65504 as floats: renderers write them for the background, the
second as half floats.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.errors import SceneError
from og_pointcloud.formats.faces import faces
from og_pointcloud.formats.images import MAX_PIXELS, decoded, png_header, require_cv2, require_scaled
from og_pointcloud.formats.lenses import Lens
from og_pointcloud.formats.npy import mapped_array
from og_pointcloud.scene import Camera

DEPTH_FOLDERS = ("depth", "depths", "depth_images")
DEPTH_SUFFIXES = (".png", ".npy", ".tif", ".tiff")
MILLIMETER = 1e-3
NO_READING = 65535
"""Largest whole number of 16 bits, also where a file has widened them."""
BACKGROUND, HALF_BACKGROUND = 1e10, 65504
"""Blender's depth where a ray meets nothing, and the largest half float, which it becomes."""


@dataclass(frozen=True)
class DepthImage:
    """depth: (H, W) float32, in lengths of the world along the optical axis, 0 unmeasured. camera: its own, of that
    size, with its pose from world coordinates."""

    depth: NDArray[np.float32]
    camera: Camera


@dataclass(frozen=True)
class DepthFile:
    """A depth image, read on demand.

    camera: the depth sensor's, from world coordinates; a file of another size scales it. unit: world lengths per
    stored step; None: depends on the type (`lengths`). integer_unit: that of whole numbers, if it differs.
    """

    path: Path
    camera: Camera
    unit: float | None = None
    lens: Lens | None = None
    integer_unit: float | None = None

    def read(self) -> DepthImage:
        """Decode, scale and undistort; for a lens that no pinhole can show, only the front face.

        SceneError names the file, what it holds and what was expected.
        """
        stored = _stored(self.path)
        height, width = stored.shape
        require_scaled(f"{self.path} is", (width, height), (self.camera.width, self.camera.height))
        of_integers = stored.dtype.kind in "iu" and self.integer_unit is not None
        depth = lengths(stored, self.integer_unit if of_integers else self.unit)
        camera = self.camera.resized(width, height)
        if self.lens is None:
            return DepthImage(depth, camera)
        front = faces(camera, self.lens)[0]  # the only face whose axis depths are measured along
        return DepthImage(front.depths(depth), front.camera)


@dataclass(frozen=True)
class DepthFrame:
    """A depth image with the colors of its view.

    colors: a function from a camera with the view's pose to its pixels' colors, (H, W, 3) uint8; None without an image.
    """

    name: str
    depth: DepthFile
    colors: Callable[[Camera], NDArray[np.uint8]] | None = None


def lengths(stored: NDArray, unit: float | None = None) -> NDArray[np.float32]:
    """(H, W) float32 world lengths of stored depths, 0 where nothing was measured: at 0, negative numbers, NaN,
    infinity, NO_READING of integers and the backgrounds of floats. unit: world lengths per stored step; None: 1/1000
    for integers, which are millimeters in a world of meters, and 1 for floats."""
    whole = stored.dtype.kind in "iu"
    with np.errstate(invalid="ignore", over="ignore"):  # NaN and overflows count as unmeasured
        depth = stored.astype(np.float32) * np.float32((MILLIMETER if whole else 1.0) if unit is None else unit)
        measured = np.isfinite(depth) & (depth > 0)
        measured &= (stored != NO_READING) if whole else (stored != HALF_BACKGROUND) & (stored < BACKGROUND)
    return np.where(measured, depth, np.float32(0))


def find_depth(capture: Path, name: str) -> Path | None:
    """The depth image of the view called ``name``: ``depth/<name>.png`` and the like, or None."""
    # os.path.isfile: Path.is_file fails for names that are too long.
    files = (capture / folder / f"{name}{suffix}" for folder in DEPTH_FOLDERS for suffix in DEPTH_SUFFIXES)
    return next((file for file in files if os.path.isfile(file)), None)


def resampled(values: NDArray, source: Camera, target: Camera) -> NDArray:
    """(H, W, ...) pixels of one camera at the pixels of another with the same pose; 0 outside its view.

    Between two pinholes with one center and one orientation, columns depend only on columns and rows only on rows,
    so whole lines are picked; by nearest pixel, as depths must not be blended across an edge.
    """
    columns = _positions(target.width, target.fx, target.cx, source.fx, source.cx)
    rows = _positions(target.height, target.fy, target.cy, source.fy, source.cy)
    # Lines beyond the source's border are taken from the border, then set to 0.
    seen = (columns >= 0) & (columns < source.width), (rows >= 0) & (rows < source.height)
    picked = values[np.ix_(np.clip(rows, 0, source.height - 1), np.clip(columns, 0, source.width - 1))]
    picked[:, ~seen[0]] = 0
    picked[~seen[1]] = 0
    return picked


def _positions(count: int, focal: float, center: float, source_focal: float, source_center: float) -> NDArray[np.intp]:
    """(count,) the source's pixel, along one axis, at each of the target's pixels; it may lie outside the image."""
    along = (np.arange(count) + 0.5 - center) / focal
    return np.floor(along * source_focal + source_center).astype(np.intp)


def _stored(file: Path) -> NDArray:
    """(H, W) numbers as stored in the file."""
    suffix = file.suffix.lower()
    if suffix not in DEPTH_SUFFIXES:
        raise SceneError(f"{file} ends in '{suffix}'; expected a depth image: {', '.join(DEPTH_SUFFIXES)}")
    if not file.is_file():
        raise SceneError(f"{file} is listed as a depth image but is not a file: add it or fix the pose file")
    if suffix == ".npy":
        values = mapped_array(file)
        if values.size > MAX_PIXELS:
            raise SceneError(f"{file} has {values.size} numbers; expected a depth image of at most {MAX_PIXELS} pixels")
    else:
        header = png_header(file)
        if header is not None and (header.bit_depth != 16 or header.color_type != 0):
            raise SceneError(
                f"{file} is a PNG with {header.bit_depth} bits and color type {header.color_type}; expected 16-bit "
                "gray: depth images in color or 8 bits have lost the lengths"
            )
        values = decoded(file, require_cv2().IMREAD_UNCHANGED)
    if values.ndim == 3 and values.shape[-1] == 1:  # a channel axis of one
        values = values[..., 0]
    kind = values.dtype.kind
    if values.ndim != 2 or not (kind == "f" or (kind in "iu" and values.dtype.itemsize > 1)) or not values.size:
        raise SceneError(
            f"{file} is {values.dtype} {values.shape}; expected (height, width) floats, or whole numbers of 16 bits or "
            "more"
        )
    return values
