"""What a mask proposer and a mask encoder are: the protocols of the front end."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.errors import SceneError

__all__ = ["DepthMaskProposer", "MaskEncoder", "MaskProposer", "Proposals"]


@dataclass(frozen=True)
class Proposals:
    """Masks of one image; they may overlap, and contain one another.

    masks: (M, H, W) bool. scores: (M,) float32 in [0, 1], how much the proposer trusts each; what no model scored is 1.
    """

    masks: NDArray[np.bool_]
    scores: NDArray[np.float32]

    def __post_init__(self) -> None:
        if self.masks.ndim != 3 or self.masks.dtype != np.bool_:
            raise SceneError(f"proposals are {self.masks.dtype} {self.masks.shape}; expected bool (masks, H, W)")
        if self.scores.shape != (len(self.masks),) or not np.isfinite(self.scores).all():
            raise SceneError(
                f"{len(self.masks)} proposals have scores of shape {self.scores.shape}; expected a finite one each"
            )

    def __len__(self) -> int:
        return len(self.masks)


class MaskProposer(Protocol):
    """Where things are in an image. ``name`` says which one it was, for the record that lies with the masks."""

    @property
    def name(self) -> str:
        """Which proposer it is."""
        ...

    def propose(self, image: NDArray[np.uint8]) -> Proposals:
        """image: (H, W, 3) uint8 RGB. No thing found is a Proposals of length 0, not an error."""
        ...


class MaskEncoder(Protocol):
    """What masks show, in the feature space of the text encoder of the same name.

    feature_space: as in `text.encoder`, such as ``openai/clip-vit-base-patch16``. width: length of a vector.
    """

    feature_space: str
    width: int

    def embed(self, image: NDArray[np.uint8], masks: NDArray[np.bool_]) -> NDArray[np.float32]:
        """image (H, W, 3) uint8 RGB, masks (M, H, W) bool -> (M, width) float32, L2-normalised rows."""
        ...


@runtime_checkable
class DepthMaskProposer(Protocol):
    """A `MaskProposer` that can also use depth."""

    @property
    def name(self) -> str:
        """Which proposer it is."""
        ...

    def propose_with_depth(self, image: NDArray[np.uint8], depth: NDArray[np.float32] | None) -> Proposals:
        """depth: (H, W) float32 along the optical axis, any unit, 0 where it is not known; None: there is none."""
        ...
