"""From pixels to what an image model takes: resize, cut to a square, mean and standard deviation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.errors import OgPointcloudError
from og_pointcloud.masking.crops import Resample, resized

__all__ = ["CLIP_MEAN", "CLIP_STD", "HALF", "Preprocessing"]

Colour = tuple[float, float, float]

CLIP_MEAN: Colour = (0.48145466, 0.4578275, 0.40821073)
CLIP_STD: Colour = (0.26862954, 0.26130258, 0.27577711)
HALF: Colour = (0.5, 0.5, 0.5)
"""Mean and standard deviation of SigLIP."""
MAX_SIZE = 4096


@dataclass(frozen=True)
class Preprocessing:
    """size: of the square, pixels. mean, std: RGB, of values in [0, 1]. keeps_shape: an image that is no square loses
    its longer side's ends; else it is squeezed."""

    size: int
    mean: Colour
    std: Colour
    resample: Resample = "bicubic"
    keeps_shape: bool = True

    def __post_init__(self) -> None:
        numbers = np.array([*self.mean, *self.std], float)
        if not 1 <= self.size <= MAX_SIZE or len(self.mean) != 3 or len(self.std) != 3 or self.resample not in (
            "bilinear", "bicubic"
        ) or not np.isfinite(numbers).all() or min(self.std) <= 0:  # fmt: skip
            raise OgPointcloudError(
                f"preprocessing is {self}; expected a size up to {MAX_SIZE}, three finite means, three deviations "
                "above 0, and bilinear or bicubic"
            )

    @classmethod
    def from_manifest(cls, entry: Mapping[str, Any]) -> Preprocessing:
        """Read back what ``as_manifest`` gave; TypeError for other fields."""
        return cls(**{**entry, "mean": tuple(entry["mean"]), "std": tuple(entry["std"])})

    def as_manifest(self) -> dict[str, Any]:
        """As JSON has it."""
        return asdict(self)

    @property
    def fill(self) -> tuple[int, int, int]:
        """The colour that becomes zero, as good as it can: what says nothing to the model."""
        red, green, blue = (round(255 * value) for value in self.mean)
        return red, green, blue

    def square(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """(size, size, 3) uint8 of an image (H, W, 3) uint8 RGB."""
        height, width = image.shape[:2]
        if not self.keeps_shape:
            return resized(image, self.size, self.size, self.resample)
        shorter = min(height, width)
        height, width = self.size * height // shorter, self.size * width // shorter
        image = resized(image, height, width, self.resample)
        top, left = (height - self.size) // 2, (width - self.size) // 2
        return image[top : top + self.size, left : left + self.size]

    def pixels(self, squares: NDArray[np.uint8]) -> NDArray[np.float32]:
        """(B, 3, size, size) float32 of squares (B, size, size, 3) uint8 RGB."""
        scale, offset = 1 / (255 * np.array(self.std)), np.array(self.mean) / np.array(self.std)
        values = squares * scale.astype(np.float32) - offset.astype(np.float32)
        return np.ascontiguousarray(values.transpose(0, 3, 1, 2), np.float32)
