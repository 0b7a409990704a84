"""Square cut-outs of an image, one per mask, and their pixels as an image encoder takes them.

LangSplat's cut-out is the mask's tight box with black outside the mask, padded to a square. Better ones show the
thing's surroundings: a larger window, and outside the mask a blend of the image with a uniform color, so that the
encoder sees the chairs around a table but also which thing is meant. The vectors of several crops are averaged by
weight.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.errors import OgPointcloudError, SceneError
from og_pointcloud.formats.images import require_pillow

Resample = Literal["bilinear", "bicubic"]
Color = tuple[float, float, float]

MAX_SIZE = 4096


@dataclass(frozen=True)
class Crop:
    """One way to cut a mask out.

    scale: side of the window as a multiple of the longer side of the mask's box. outside: how much of the image shows
    outside the mask, from 0, nothing, to 1, all. weight: of this crop's vector in the mask's.
    """

    scale: float = 1.0
    outside: float = 0.0
    weight: float = 1.0

    def __post_init__(self) -> None:
        if not (1 <= self.scale <= 8 and 0 <= self.outside <= 1 and 0 < self.weight < np.inf):
            raise SceneError(f"{self} cannot be cut; expected scale 1 to 8, outside 0 to 1, and a weight above 0")


LANGSPLAT = (Crop(),)
WITH_CONTEXT = (Crop(1.0, 0.0, 1.0), Crop(1.2, 0.35, 1.0), Crop(2.0, 0.6, 0.5))
CROP_STYLES = {"langsplat": LANGSPLAT, "context": WITH_CONTEXT}


@dataclass(frozen=True)
class Preprocessing:
    """How squares of an image become the input of an image model.

    size: of the square, pixels. mean, std: RGB, of values in [0, 1].
    """

    size: int
    mean: Color
    std: Color
    resample: Resample = "bicubic"

    def __post_init__(self) -> None:
        are_colors = len(self.mean) == len(self.std) == 3 and np.isfinite([*self.mean, *self.std]).all()
        known = self.resample in get_args(Resample) and 1 <= self.size <= MAX_SIZE
        if not (known and are_colors and min(self.std) > 0):
            raise OgPointcloudError(
                f"preprocessing is {self}; expected a size up to {MAX_SIZE}, three finite means, three deviations "
                "above 0, and bilinear or bicubic resampling"
            )

    @classmethod
    def from_manifest(cls, entry: Mapping[str, Any]) -> Preprocessing:
        """From a JSON object's fields; TypeError for unknown ones."""
        known = {name: value for name, value in entry.items() if name != "keeps_shape"}  # from earlier exports, unused
        return cls(**{**known, "mean": tuple(entry["mean"]), "std": tuple(entry["std"])})

    @property
    def fill(self) -> tuple[int, int, int]:
        """The color that is normalized to about zero, and so carries no information."""
        red, green, blue = (round(255 * value) for value in self.mean)
        return red, green, blue

    def pixels(self, squares: NDArray[np.uint8]) -> NDArray[np.float32]:
        """(B, 3, size, size) float32 of squares (B, size, size, 3) uint8 RGB."""
        # (value / 255 - mean) / std as one product and one difference.
        scale, offset = 1 / (255 * np.array(self.std)), np.array(self.mean) / np.array(self.std)
        values = squares * scale.astype(np.float32) - offset.astype(np.float32)
        return np.ascontiguousarray(values.transpose(0, 3, 1, 2), np.float32)


def mask_crops(
    image: NDArray[np.uint8],
    masks: NDArray[np.bool_],
    crop: Crop,
    size: int,
    fill: Sequence[int] = (0, 0, 0),
    resample: Resample = "bicubic",
) -> NDArray[np.uint8]:
    """(M, size, size, 3) uint8 RGB.

    image: (H, W, 3) uint8 RGB. masks: (M, H, W) bool; one without a pixel is an error. fill: the color outside the
    mask and beyond the image's edge. SceneError for arrays that do not fit together.
    """
    require_masks(image, masks)
    pillow = require_pillow()
    # The whole image as it looks outside masks, computed once for all masks.
    faded = np.rint(crop.outside * image + (1 - crop.outside) * np.asarray(fill, np.float32)).astype(np.uint8)
    crops = np.empty((len(masks), size, size, 3), np.uint8)
    for row, mask in enumerate(masks):
        square = _square(image, faded, mask, crop.scale, fill)
        # Pillow's filters, as in the models' own processors, smooth when shrinking; OpenCV's do not.
        resized = pillow.fromarray(square).resize((size, size), pillow.Resampling[resample.upper()])
        crops[row] = np.asarray(resized)
    return crops


def require_masks(image: NDArray[np.uint8], masks: NDArray[np.bool_]) -> None:
    """SceneError where the image is not (H, W, 3) uint8, the masks are not (M, H, W) bool, or one has no pixel."""
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8:
        raise SceneError(f"the image is {image.dtype} {image.shape}; expected uint8 (H, W, 3), red first")
    if masks.shape[1:] != image.shape[:2] or masks.dtype != np.bool_:
        raise SceneError(
            f"masks are {masks.dtype} {masks.shape}; expected bool (masks, {image.shape[0]}, {image.shape[1]}), the "
            "size of the image"
        )
    if not masks.any(axis=(1, 2)).all():
        raise SceneError("a mask has no pixels; expected at least one: leave out empty masks")


def mask_box(mask: NDArray[np.bool_]) -> tuple[int, int, int, int]:
    """(top, left, height, width) of the smallest box around all pixels of a mask, which has at least one."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    return int(rows[0]), int(columns[0]), int(rows[-1] - rows[0]) + 1, int(columns[-1] - columns[0]) + 1


def _square(
    image: NDArray[np.uint8], faded: NDArray[np.uint8], mask: NDArray[np.bool_], scale: float, fill: Sequence[int]
) -> NDArray[np.uint8]:
    """A square around the middle of the mask's box, faded outside the mask; beyond the image's edge it is the fill."""
    top, left, height, width = mask_box(mask)
    side = max(round(scale * max(height, width)), 1)
    top, left = top - (side - height) // 2, left - (side - width) // 2
    # The part of the square that lies in the image.
    rows = slice(max(top, 0), min(top + side, image.shape[0]))
    columns = slice(max(left, 0), min(left + side, image.shape[1]))
    shown, inside = faded[rows, columns].copy(), mask[rows, columns]
    shown[inside] = image[rows, columns][inside]
    square = np.full((side, side, 3), fill, np.uint8)
    square[rows.start - top : rows.stop - top, columns.start - left : columns.stop - left] = shown
    return square
