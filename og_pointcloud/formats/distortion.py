"""Lens distortion: masks and images of a distorted lens become those of a pinhole camera with the same K and size.

K is kept, so content that the pinhole image has no room for (the rim of a strong barrel or fisheye lens) is cropped,
and pixels that the lens never saw become -1 in masks and black in images.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.errors import SceneError
from og_pointcloud.formats.images import require_cv2
from og_pointcloud.scene import Camera

__all__ = ["Distortion", "Undistortion", "lens_distortion", "undistorted"]

PERSPECTIVE_TERMS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
FISHEYE_TERMS = ("k1", "k2", "k3", "k4")
CACHED_LENSES = 4
"""Lenses whose maps are kept: 12 bytes a pixel each, and cheaper to rebuild than the mask image is to decode."""


@dataclass(frozen=True)
class Distortion:
    """Coefficients in OpenCV's order and meaning, for normalised coordinates: they do not change with image size.

    perspective: k1 k2 p1 p2 k3 k4 k5 k6; the radius r is scaled by (1 + k1 r^2 + k2 r^4 + k3 r^6) /
        (1 + k4 r^2 + k5 r^4 + k6 r^6), p1 and p2 are tangential.
    fisheye: k1 k2 k3 k4; a ray at angle a from the axis has radius a (1 + k1 a^2 + k2 a^4 + k3 a^6 + k4 a^8).
    """

    fisheye: bool
    coefficients: tuple[float, ...]


def lens_distortion(values: Mapping[str, float], *, fisheye: bool) -> Distortion | None:
    """The lens with these named coefficients (absent ones are zero); None if it is a pinhole.

    A fisheye lens with zero coefficients is equidistant, not a pinhole, so it always has a distortion.
    """
    terms = FISHEYE_TERMS if fisheye else PERSPECTIVE_TERMS
    unknown = [name for name, value in values.items() if value and name not in terms]
    if unknown:
        raise SceneError(
            f"lens distortion has the term {unknown[0]} = {values[unknown[0]]}; expected only {', '.join(terms)}: "
            "undistort images and masks first and give pinhole cameras"
        )
    coefficients = tuple(float(values.get(name, 0.0)) for name in terms)
    if not np.isfinite(coefficients).all():
        raise SceneError(f"lens distortion {', '.join(terms)} is {coefficients}; expected finite numbers")
    return Distortion(fisheye, coefficients) if fisheye or any(coefficients) else None


@dataclass(frozen=True)
class Undistortion:
    """Where each pixel of the pinhole image lies in the distorted one.

    x, y: (H, W) float32, pixel indices in the distorted image (0 is the first pixel's centre), -1 where it has none.
    nearest: (H, W) int32, flat index of the nearest distorted pixel, -1 outside.
    """

    x: NDArray[np.float32]
    y: NDArray[np.float32]
    nearest: NDArray[np.int32]

    def mask_ids(self, ids: NDArray[np.int32]) -> NDArray[np.int32]:
        """(H, W) mask ids by nearest pixel, -1 where the distorted image has none: ids must not be blended."""
        if ids.shape != self.nearest.shape:
            raise SceneError(f"the mask map is {ids.shape}; expected the camera's {self.nearest.shape} (rows, columns)")
        return np.where(self.nearest < 0, np.int32(-1), ids.reshape(-1)[self.nearest])

    def image(self, rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """(H, W, 3) uint8, linear, black outside."""
        cv2 = require_cv2()
        return np.asarray(cv2.remap(rgb, self.x, self.y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT), np.uint8)


def undistorted(camera: Camera, distortion: Distortion) -> Undistortion:
    """The maps of this lens at the camera's image size; views that share intrinsics share them."""
    intrinsics = (camera.fx, camera.fy, camera.cx, camera.cy)
    return _maps((camera.width, camera.height), intrinsics, distortion)


@lru_cache(maxsize=CACHED_LENSES)
def _maps(size: tuple[int, int], intrinsics: tuple[float, ...], distortion: Distortion) -> Undistortion:
    cv2 = require_cv2()
    width, height = size
    fx, fy, cx, cy = intrinsics
    # OpenCV counts pixel centres at whole numbers, the scene at +0.5.
    matrix = np.array([[fx, 0, cx - 0.5], [0, fy, cy - 0.5], [0, 0, 1]])
    build = cv2.fisheye.initUndistortRectifyMap if distortion.fisheye else cv2.initUndistortRectifyMap
    coefficients = np.array(distortion.coefficients)
    x, y = build(matrix, coefficients, np.eye(3), matrix, size, cv2.CV_32FC1)
    beyond = _beyond_the_fold(size, intrinsics, distortion)
    x, y = np.where(beyond, np.float32(-1), x), np.where(beyond, np.float32(-1), y)
    column, row = np.floor(x + 0.5), np.floor(y + 0.5)
    inside = ~beyond & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    nearest = np.where(inside, row * width + column, -1).astype(np.int32)
    return Undistortion(x, y, nearest)


def _beyond_the_fold(size: tuple[int, int], intrinsics: tuple[float, ...], distortion: Distortion) -> NDArray[np.bool_]:
    """(H, W): pixels so far out that the polynomial turns back and would show the image's inside once more."""
    width, height = size
    fx, fy, cx, cy = intrinsics
    u = (np.arange(width) + 0.5 - cx) / fx
    v = (np.arange(height) + 0.5 - cy) / fy
    radius = np.hypot(u[None, :], v[:, None])
    sampled = np.linspace(0.0, float(radius.max()), 2048)
    falling = np.diff(_distorted_radius(sampled, distortion)) <= 0
    limit = sampled[int(np.argmax(falling))] if falling.any() else np.inf
    return radius > limit


def _distorted_radius(radius: NDArray[np.float64], distortion: Distortion) -> NDArray[np.float64]:
    if distortion.fisheye:
        theta = np.arctan(radius)
        return theta * np.polynomial.Polynomial((1.0, *distortion.coefficients))(theta**2)
    k1, k2, _, _, k3, k4, k5, k6 = distortion.coefficients
    r2 = radius**2
    return radius * (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
