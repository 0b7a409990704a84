"""What masks show, by an image model: crops of them encoded one by one, or the image's patches pooled in them."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.errors import SceneError
from og_pointcloud.masking.crops import Crop, mask_crops
from og_pointcloud.masking.encoders.preprocessing import Preprocessing

__all__ = ["CropEncoder", "DenseModel", "ImageModel", "PatchEncoder"]

CROPS_PER_RUN = 16


class ImageModel(Protocol):
    """Squares of pixels -> vectors. feature_space: as of the text encoder. width: of a vector."""

    feature_space: str
    width: int
    preprocessing: Preprocessing

    def __call__(self, pixels: NDArray[np.float32]) -> NDArray[np.float32]:
        """(B, width) float32 unit rows of pixels (B, 3, S, S) float32."""
        ...


class DenseModel(ImageModel, Protocol):
    """An image model that also says what each patch of the image shows. grid: patches along a side."""

    grid: int

    def patches(self, pixels: NDArray[np.float32]) -> NDArray[np.float32]:
        """(B, grid, grid, width) float32, unit vectors, of pixels (B, 3, S, S) float32."""
        ...


class CropEncoder:
    """A mask's vector is the weighted mean of its crops' vectors (a `contracts.MaskEncoder`)."""

    def __init__(
        self,
        model: ImageModel,
        crops: Sequence[Crop],
        crops_per_run: int = CROPS_PER_RUN,
        seconds_per_image: float | None = None,
    ) -> None:
        """crops: ways to cut a mask out, in the order in which they are left out last. crops_per_run: bounds memory.

        seconds_per_image: ways are left out where, by the time that those before took, the next would not be done in
        time; the first never is. None: all are always used, and the same image always gives the same vectors.
        """
        if not crops or crops_per_run < 1:
            raise SceneError(f"{len(crops)} ways to crop, {crops_per_run} crops a run; expected at least one of both")
        self.model, self.crops = model, tuple(crops)
        self.feature_space, self.width = model.feature_space, model.width
        self._crops_per_run, self._seconds = crops_per_run, seconds_per_image

    def embed(self, image: NDArray[np.uint8], masks: NDArray[np.bool_]) -> NDArray[np.float32]:
        """image (H, W, 3) uint8 RGB, masks (M, H, W) bool -> (M, width) float32, L2-normalised rows.

        SceneError for arrays that do not fit together, and for a mask without a pixel.
        """
        total = np.zeros((len(masks), self.width), np.float32)
        start = time.perf_counter()
        for done, crop in enumerate(self.crops):
            spent = time.perf_counter() - start
            if done and self._seconds is not None and spent * (done + 1) / done > self._seconds:
                break
            for rows in _batches(len(masks), self._crops_per_run):
                total[rows] += np.float32(crop.weight) * self._vectors(image, masks[rows], crop)
        return _unit(total)

    def _vectors(self, image: NDArray[np.uint8], masks: NDArray[np.bool_], crop: Crop) -> NDArray[np.float32]:
        before = self.model.preprocessing
        # Black outside, as LangSplat has it, is a colour to the model; what a blend goes to should be none.
        fill = before.fill if crop.outside else (0, 0, 0)
        return self.model(before.pixels(mask_crops(image, masks, crop, before.size, fill, before.resample)))


class PatchEncoder:
    """A mask's vector is the mean of the patches that it covers, by area: one run an image, however many masks.

    The image is seen in squares as large as its shorter side, as many as cover it, evenly laid (a
    `contracts.MaskEncoder`).
    """

    def __init__(self, model: DenseModel) -> None:
        self.model = model
        self.feature_space, self.width = model.feature_space, model.width

    def embed(self, image: NDArray[np.uint8], masks: NDArray[np.bool_]) -> NDArray[np.float32]:
        """As `CropEncoder.embed`."""
        if masks.shape[1:] != image.shape[:2] or not masks.any(axis=(1, 2)).all():
            raise SceneError(f"masks are {masks.shape}, the image {image.shape}; expected one size, and no mask empty")
        before, grid = self.model.preprocessing, self.model.grid
        total = np.zeros((len(masks), self.width), np.float32)
        for square in _squares(*image.shape[:2]):
            patches = self.model.patches(before.pixels(before.square(image[square])[None])).reshape(-1, self.width)
            covered = (
                np.stack([_pixels_in_patches(mask[square], grid) for mask in masks]) if len(masks) else total[:, :0]
            )
            if len(masks):
                total += covered.reshape(len(masks), -1) @ patches
        return _unit(total)


def _batches(count: int, size: int) -> Iterator[slice]:
    for start in range(0, count, size):
        yield slice(start, start + size)


def _squares(height: int, width: int) -> Iterator[tuple[slice, slice]]:
    side, longer = min(height, width), max(height, width)
    for start in np.linspace(0, longer - side, math.ceil(longer / side)).astype(int).tolist():
        along, across = slice(start, start + side), slice(0, side)
        yield (across, along) if width >= height else (along, across)


def _pixels_in_patches(mask: NDArray[np.bool_], grid: int) -> NDArray[np.float32]:
    """(grid, grid) how many pixels of a square mask lie in each patch."""
    edges = np.arange(grid) * len(mask) // grid
    return np.add.reduceat(np.add.reduceat(mask.astype(np.float32), edges, axis=0), edges, axis=1)


def _unit(rows: NDArray[np.float32]) -> NDArray[np.float32]:
    return rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), np.finfo(np.float32).tiny)
