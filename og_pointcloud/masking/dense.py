"""A mask's vector from one run of the encoder on the whole image: the mean of its patches. Faster than crops, coarser.

Crops show the encoder each mask by itself, in several runs per mask. Here it sees the image once, and a mask's vector
is the mean of its patches' vectors, each weighted by how much of the patch the mask covers. Patch vectors that describe
the patch rather than the whole image are made as in MaskCLIP (Zhou, Loy and Dai, ECCV 2022): see `clip.ImageTower`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.formats.images import require_cv2, require_pillow
from og_pointcloud.masking.contracts import ImageModel, MaskEncoder
from og_pointcloud.masking.crops import require_masks

SHORTER_SIDE_SCALE = 2.0
"""The image's shorter side, in sides of the square that the model was trained on. With CLIP B/16 it then spans 28
patches instead of 14; their position embeddings are interpolated."""


class DenseEncoder(MaskEncoder):
    """A `contracts.MaskEncoder` around a model with patches."""

    def __init__(self, model: ImageModel) -> None:
        """model: one with a ``patch``."""
        assert model.patch is not None
        self.model, self.feature_space, self.width, self.patch = model, model.feature_space, model.width, model.patch

    def embed(self, image: NDArray[np.uint8], masks: NDArray[np.bool_]) -> NDArray[np.float32]:
        """image (H, W, 3) uint8 RGB, masks (M, H, W) bool -> (M, width) float32, L2-normalized rows.

        SceneError for arrays that do not fit together, and for a mask without a pixel.
        """
        require_masks(image, masks)
        if len(masks) == 0:
            return np.zeros((0, self.width), np.float32)
        found = self.model.patches(self._pixels(image))
        height, width = found.shape[:2]
        shares = [_shares(mask, width, height) for mask in masks]
        # Weighted sums instead of means: they are normalized at the end anyway.
        total = np.stack(shares).reshape(len(masks), -1) @ found.reshape(-1, self.width)
        return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), np.finfo(np.float32).tiny)

    def _pixels(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        """(1, 3, h, w) float32, whole patches along each side; the image's aspect ratio up to rounding."""
        before, pillow = self.model.preprocessing, require_pillow()
        # Both sides by one scale, then each rounded to whole patches: models were trained on squares, but squeezing an
        # image would squeeze the things in it.
        scale = SHORTER_SIDE_SCALE * before.size / min(image.shape[:2])
        height, width = (max(1, round(side * scale / self.patch)) * self.patch for side in image.shape[:2])
        resized = pillow.fromarray(image).resize((width, height), pillow.Resampling[before.resample.upper()])
        return before.pixels(np.asarray(resized)[None])


def _shares(mask: NDArray[np.bool_], width: int, height: int) -> NDArray[np.float32]:
    """(height, width) float32: how much of each patch the mask covers. In an image with fewer pixels than patches, the
    mask is interpolated."""
    cv2 = require_cv2()
    shrinks = mask.shape[0] >= height and mask.shape[1] >= width
    shrunk = cv2.resize(
        mask.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    )
    return np.asarray(shrunk, np.float32)
