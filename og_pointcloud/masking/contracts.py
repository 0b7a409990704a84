"""The interface of proposers, encoders and the code that runs them: protocols and settings."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.errors import OgPointcloudError, SceneError
from og_pointcloud.masking.crops import Crop, Preprocessing

FEATURES = ("crops", "dense")
"""How the encoder is shown a mask."""
LEVELS = ("small", "medium", "large")
"""How much one mask covers, in LangSplat's terms: SAM's subparts, parts and wholes."""


@dataclass(frozen=True)
class Proposals:
    """Masks of one image; they may overlap, and contain one another.

    masks: (M, H, W) bool. scores: (M,) float32 in [0, 1], the proposer's confidence, 1 where no model scored them.
    tracks: (M,) int64, from a tracker: one number per thing, the same in all images, -1 unknown.
    """

    masks: NDArray[np.bool_]
    scores: NDArray[np.float32]
    tracks: NDArray[np.int64] | None = None

    def __post_init__(self) -> None:
        if self.masks.ndim != 3 or self.masks.dtype != np.bool_:
            raise SceneError(f"proposals are {self.masks.dtype} {self.masks.shape}; expected bool (masks, H, W)")
        if self.scores.shape != (len(self.masks),) or not np.isfinite(self.scores).all():
            raise SceneError(
                f"{len(self.masks)} proposals have scores {self.scores.shape}; expected a finite one per proposal"
            )
        tracks = self.tracks
        if tracks is not None and (tracks.shape != self.scores.shape or tracks.dtype.kind not in "iu"):
            raise SceneError(
                f"{len(self.masks)} proposals have tracks {tracks.dtype} {tracks.shape}; expected a whole number each"
            )

    def __len__(self) -> int:
        return len(self.masks)


class MaskProposer(Protocol):
    """Where things are in an image."""

    def propose(self, image: NDArray[np.uint8]) -> Proposals:
        """image: (H, W, 3) uint8 RGB. Returns Proposals of length 0 if it finds nothing."""
        ...


class MaskEncoder(Protocol):
    """What masks show, in the feature space of the text encoder of the same name.

    feature_space: as in `text.encoder`, such as ``openai/clip-vit-base-patch16``. width: length of a vector.
    """

    feature_space: str
    width: int

    def embed(self, image: NDArray[np.uint8], masks: NDArray[np.bool_]) -> NDArray[np.float32]:
        """image (H, W, 3) uint8 RGB, masks (M, H, W) bool -> (M, width) float32, L2-normalized rows."""
        ...


class ImageModel(Protocol):
    """Squares of pixels -> vectors.

    feature_space: the text encoder's. width: of a vector. crops: how masks are best cut out for it. patch: side in
    pixels of the patches that it can also encode; None if it cannot.
    """

    feature_space: str
    width: int
    preprocessing: Preprocessing
    crops: tuple[Crop, ...]
    patch: int | None

    def __call__(self, pixels: NDArray[np.float32]) -> NDArray[np.float32]:
        """(B, width) float32 unit rows of pixels (B, 3, S, S) float32."""
        ...

    def patches(self, pixels: NDArray[np.float32]) -> NDArray[np.float32]:
        """(h, w, width) unit vectors of pixels (1, 3, h * patch, w * patch), for a model with a patch."""
        ...


@dataclass(frozen=True)
class MaskSettings:
    """How masks are made. A run with other settings reuses nothing of an earlier one.

    proposer: see `worker.open_proposer`. encoder: see `encode.open_encoder`; None: masks alone, with zero features.
    level: small, medium or large (`levels.PARTS_WEIGHT`).
    features: crops, a few encoder runs per mask; or dense, one per image, coarser (`masking/dense.py`).
    longest_side: larger images are shrunk to this; masks have the shrunk size.
    every: use every n-th image.
    words: what to look for, with a proposer that takes words (`sam3`).
    tracks: things are followed from image to image, in the order of the pose file. With a folder of id PNGs: an id
        means the same thing in all images, as video trackers write them.
    """

    proposer: str = "opencv"
    encoder: str | None = "demo"
    level: str = "medium"
    features: str = "crops"
    longest_side: int = 1024
    every: int = 1
    words: tuple[str, ...] = ()
    tracks: bool = False

    def __post_init__(self) -> None:
        if self.features not in FEATURES:
            raise OgPointcloudError(f"features are '{self.features}'; expected one of {', '.join(FEATURES)}")
        if self.features != "crops" and self.encoder is None:
            raise OgPointcloudError(f"features are '{self.features}' without an encoder; expected an encoder, or crops")
        if self.level not in LEVELS:
            raise OgPointcloudError(f"mask level is '{self.level}'; expected one of {', '.join(LEVELS)}")
        if isinstance(self.words, str):  # would become one word per letter
            raise OgPointcloudError(f"words are {self.words!r:.60}; expected a tuple such as ({self.words!r:.60},)")
        if self.every < 1 or self.longest_side < 16:
            raise OgPointcloudError(
                f"every is {self.every} and longest_side {self.longest_side}; expected at least 1 and 16"
            )

    @property
    def folder(self) -> Path | None:
        """The folder of masks, where one is given instead of a proposer's name; else None."""
        folder = Path(self.proposer)
        # "opencv" never means a folder of that name, such as a clone.
        return folder if self.proposer != "opencv" and folder.is_dir() else None

    @property
    def threads(self) -> int:
        """Images processed in parallel: one per core, but only one with models, which fill memory and cores
        themselves."""
        light = (self.proposer == "opencv" or self.folder) and self.encoder in (None, "demo")
        return (os.cpu_count() or 1) if light else 1
