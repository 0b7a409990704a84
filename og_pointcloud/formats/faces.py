"""Split an image of any lens into pinhole views: one, if a pinhole can show all that the lens saw, else cube faces.

A single view keeps the image's focal lengths and pose, and extends to the image's rim, which a view of the same size
would crop. The faces of a cube are called front, left, right, up, down and back; those that the lens does not see are
left out, the others are cropped to what it sees. A face is coarsest in its middle: there it is as sharp as the middle
of the image, so that resampling loses no edge.

Masks are resampled by nearest pixel, since ids must not be blended. A pixel that the lens never saw is NOT_SEEN, which
is no evidence of anything, while a pixel outside every mask is evidence of no mask.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.errors import SceneError
from og_pointcloud.formats.images import require_cv2
from og_pointcloud.formats.lenses import Lens
from og_pointcloud.scene import NOT_SEEN, Camera, DoubleArray, FloatArray, IntArray

MAX_SINGLE_VIEW_TAN = float(np.tan(np.radians(55)))
"""Tangent of the angle from the axis to a border; a wider pinhole view stretches its rim more than threefold."""
CIRCULAR_LENS_RAD = float(np.radians(85))
"""A lens that sees this far from its axis towards the middle of a border draws a circle, with black corners."""
MIN_FACE_SHARE = 0.005
"""A cube face of which the lens sees less than this share is not worth a view."""
GRID_RAYS = 257
"""Rays per side of the grid on which a lens's field of view is probed."""
CACHED_MAPS = 12
"""Faces whose lookup maps for masks are kept, 4 bytes per pixel: those of two cameras whose images are read in turn.
Half as many maps for images, 8 bytes per pixel."""
CUBE = {
    "front": np.eye(3),
    "left": np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]),
    "right": np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]]),
    "up": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
    "down": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
    "back": np.array([[-1.0, 0, 0], [0, 1, 0], [0, 0, -1]]),
}
"""Rotation from the image's camera to that of the face; x right, y down, z forward."""


@dataclass(frozen=True)
class Face:
    """A pinhole view of what a lens saw.

    name: of the cube face, "" for a single view. camera: the pinhole, with its pose. whole: size, intrinsics and pose
    of the distorted image, whose projection is ``lens``.
    """

    name: str
    camera: Camera
    whole: Camera
    lens: Lens

    def of_size(self, width: int, height: int) -> Face:
        """This view at width x height pixels, with its image scaled by the same factors."""
        size = _scaled(self.whole, width / self.camera.width, height / self.camera.height)
        return replace(self, camera=self.camera.resized(width, height), whole=self.whole.resized(*size))

    def of_whole_size(self, width: int, height: int) -> Face:
        """This view of an image of width x height pixels."""
        size = _scaled(self.camera, width / self.whole.width, height / self.whole.height)
        return replace(self, camera=self.camera.resized(*size), whole=self.whole.resized(width, height))

    def mask_ids(self, ids: IntArray) -> IntArray:
        """The ids (h, w) of the distorted image -> (H, W) of this view, by nearest pixel; NOT_SEEN where it has
        none."""
        return self.picked(ids, NOT_SEEN)

    def depths(self, depth: FloatArray) -> FloatArray:
        """As `mask_ids`, for depths along this view's axis; 0 where the image has none."""
        return self.picked(depth, 0)

    def picked(self, values: NDArray, otherwise: int) -> NDArray:
        """As `mask_ids`, for values of any type; ``otherwise`` where the image has none."""
        expected = (self.whole.height, self.whole.width)
        if values.shape != expected:
            raise SceneError(f"the map is {values.shape}; expected the camera's {expected} (rows, columns)")
        nearest = _nearest(self._key)
        picked = values.take(nearest, mode="wrap")  # pixels without a counterpart, of index -1, are set below
        picked[nearest < 0] = otherwise
        return picked

    def image(self, rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """(H, W, 3) uint8 of this view, by linear interpolation, black where the lens saw nothing. rgb: (h, w, 3), the
        distorted image."""
        cv2, (x, y) = require_cv2(), _remap(self._key)
        border = cv2.BORDER_WRAP if self.lens.wraps else cv2.BORDER_CONSTANT
        return np.asarray(cv2.remap(rgb, x, y, cv2.INTER_LINEAR, borderMode=border), np.uint8)

    @property
    def _key(self) -> _Key:
        """Everything that determines the lookup maps; views with the same key share them."""
        return self.name, _numbers(self.camera), _numbers(self.whole), self.lens


Numbers = tuple[int, int, float, float, float, float]
"""Width, height, focal lengths, principal point: pixels."""
Box = tuple[float, float, float, float]
"""Left, top, right, bottom."""
_Key = tuple[str, Numbers, Numbers, Lens]


def faces(whole: Camera, lens: Lens) -> tuple[Face, ...]:
    """The pinhole views of an image, with its focal lengths. whole: size, focal lengths, principal point and pose."""
    boxes = _boxes(_numbers(whole), lens)
    made = []
    for name, (left, top, right, bottom) in boxes.items():
        pose = whole.world_to_camera.copy()
        pose[:3] = CUBE[name or "front"] @ pose[:3]  # turned about the camera's center: the translation turns with it
        fx, fy = whole.fx, whole.fy
        width, height = max(1, round((right - left) * fx)), max(1, round((bottom - top) * fy))
        made.append(Face(name, Camera(width, height, fx, fy, -left * fx, -top * fy, pose), whole, lens))
    return tuple(made)


def _scaled(camera: Camera, x: float, y: float) -> tuple[int, int]:
    return max(1, round(camera.width * x)), max(1, round(camera.height * y))


def _numbers(camera: Camera) -> Numbers:
    return camera.width, camera.height, *camera.intrinsics


@lru_cache(maxsize=64)
def _boxes(whole: Numbers, lens: Lens) -> dict[str, Box]:
    """The visible box of each face, at depth 1. A single view is called "" and spans whole pixels of the image."""
    width, height, fx, fy, cx, cy = whole
    # A grid twice as wide as the undistorted image would be resolves a telephoto lens; a wide lens may see more, and is
    # tried again up to the widest single view.
    telephoto = 2 * max(abs(cx), abs(width - cx), 1.0) / fx, 2 * max(abs(cy), abs(height - cy), 1.0) / fy
    half = min(max(telephoto), MAX_SINGLE_VIEW_TAN)
    one, _ = _seen_box("front", whole, lens, half)
    if one is None or max(map(abs, one)) >= half:
        half = MAX_SINGLE_VIEW_TAN
        one, _ = _seen_box("front", whole, lens, half)
    # A box that ends within the grid contains everything that the lens sees.
    if one is not None and not lens.wraps and max(map(abs, one)) < half:
        left, top, right, bottom = (round(at * f + c) for at, f, c in zip(one, (fx, fy) * 2, (cx, cy) * 2, strict=True))
        right, bottom = max(right, left + 1), max(bottom, top + 1)
        return {"": ((left - cx) / fx, (top - cy) / fy, (right - cx) / fx, (bottom - cy) / fy)}
    seen = {name: _seen_box(name, whole, lens, 1.0) for name in CUBE}
    boxes = {name: box for name, (box, share) in seen.items() if box is not None and share > MIN_FACE_SHARE}
    if "front" not in boxes:
        raise SceneError(f"a {lens.model} lens of {lens.terms} sees nothing in front of it: check the pose file")
    return boxes


def _seen_box(name: str, whole: Numbers, lens: Lens, half: float) -> tuple[Box | None, float]:
    """For a face from -half to half at depth 1: the box around the part that the lens sees, and its share of the
    face."""
    at = np.linspace(-half, half, GRID_RAYS)

    def seen(x: DoubleArray, y: DoubleArray) -> NDArray[np.bool_]:
        x, y = np.meshgrid(x, y)
        return ~np.isnan(_image_pixels(np.stack([x, y, np.ones_like(x)], axis=-1) @ CUBE[name], whole, lens)[0])

    coarse = seen(at, at)
    if not coarse.any():
        return None, 0.0
    borders = []
    for end, axis in ((0, 0), (0, 1), (-1, 0), (-1, 1)):  # left, top, right, bottom
        # The border lies between the grid's last visible line and the next one: search there on a finer grid.
        border = np.flatnonzero(coarse.any(axis=axis))[end]
        beside = min(max(border + (1 if end else -1), 0), GRID_RAYS - 1)
        fine = np.linspace(min(at[border], at[beside]), max(at[border], at[beside]), GRID_RAYS)
        strip = seen(fine, at) if axis == 0 else seen(at, fine)
        borders.append(float(fine[np.flatnonzero(strip.any(axis=axis))[end]]))
    return (borders[0], borders[1], borders[2], borders[3]), float(coarse.mean())


def _image_pixels(rays: DoubleArray, whole: Numbers, lens: Lens) -> tuple[DoubleArray, DoubleArray]:
    """Where rays (..., 3) of the camera meet the distorted image, pixel centers at +0.5; NaN where they do not."""
    width, height, fx, fy, cx, cy = whole
    u, v = lens.project(rays)
    reach = max(cx, width - cx) / fx, max(cy, height - cy) / fy
    if max(reach) > lens.radius(CIRCULAR_LENS_RAD):  # the corners of such an image are black: nothing was seen there
        beyond = np.hypot(u, v) > max(reach)
        u, v = np.where(beyond, np.nan, u), np.where(beyond, np.nan, v)
    with np.errstate(over="ignore", invalid="ignore"):  # far beyond the image
        u, v = u * fx + cx, v * fy + cy
    if lens.wraps:  # the whole sphere is in the image: rounding must not put the poles outside
        u, v = u % width, np.clip(v, 0, np.nextafter(height, 0))
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    return np.where(inside, u, np.nan), np.where(inside, v, np.nan)


def _pixels(key: _Key) -> tuple[DoubleArray, DoubleArray]:
    """(H, W) each: column and row of the distorted image that each pixel of the face shows; NaN where it has none."""
    name, (width, height, fx, fy, cx, cy), whole, lens = key
    x, y = np.meshgrid((np.arange(width) + 0.5 - cx) / fx, (np.arange(height) + 0.5 - cy) / fy)
    return _image_pixels(np.stack([x, y, np.ones_like(x)], axis=-1) @ CUBE[name or "front"], whole, lens)


@lru_cache(maxsize=CACHED_MAPS)
def _nearest(key: _Key) -> IntArray:
    """(H, W) int32: the nearest pixel of the distorted image, counted row by row; -1 where it has none."""
    column, row = _pixels(key)
    with np.errstate(invalid="ignore"):
        flat = np.floor(row) * key[2][0] + np.floor(column)
    return np.where(np.isnan(flat), -1, flat).astype(np.int32)


@lru_cache(maxsize=CACHED_MAPS // 2)
def _remap(key: _Key) -> tuple[FloatArray, FloatArray]:
    """(H, W) each: as `_pixels`, for OpenCV, which counts pixel centers at whole numbers; -2, outside of the image and
    so black, where it has none."""
    x, y = (np.nan_to_num(pixels - 0.5, nan=-2.0).astype(np.float32) for pixels in _pixels(key))
    _, _, (_, height, *_), lens = key
    return x, np.clip(y, 0, height - 1) if lens.wraps else y
