"""Settings of ``og-pointcloud masks``."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from og_pointcloud.errors import OgPointcloudError
from og_pointcloud.masking.levels import AGREED, LEVELS

__all__ = ["MaskSettings"]

IMAGES_A_PROCESS = 8
"""A process takes a second or two to begin: with fewer images each it saves nothing."""


@dataclass(frozen=True)
class MaskSettings:
    """How masks are made; what changes one of these starts anew.

    proposer: see `opening.open_proposer`, or a folder of masks. encoder: see `encoders.open_encoder`; None: masks
    alone, with zero features. level: small, middle or large, for ``masks/`` (LangSplat's files have all); or agreed:
    all images are proposed for first, and proposals count by how far other views confirm them (`agreement`).
    longest_side: larger images are shrunk to this; masks have the shrunk size.
    seconds_per_image: where SAM stops adding prompts. use_depth: colour and the points' depth, where the proposer
    takes it. split: masks are cut at depth edges. drop_tiny: masks that the points do not resolve are dropped
    (a proposer that makes none, such as opencv, then need not read the cloud).
    every: of so many images one is used. enough_views: images are left out whose content so many others show.
    """

    proposer: str = "opencv"
    encoder: str | None = "demo"
    level: str = "middle"
    langsplat: bool = False
    longest_side: int = 1024
    seconds_per_image: float | None = None
    use_depth: bool = False
    split: bool = False
    drop_tiny: bool = False
    every: int = 1
    enough_views: int | None = None
    download: bool = False

    def __post_init__(self) -> None:
        if self.level not in (*LEVELS, *AGREED):
            raise OgPointcloudError(f"mask level is '{self.level}'; expected one of {', '.join((*LEVELS, *AGREED))}")
        if self.langsplat and self.level in AGREED:
            raise OgPointcloudError(f"mask level is '{self.level}'; LangSplat's files hold {', '.join(LEVELS)}")
        if self.every < 1 or self.longest_side < 16:
            raise OgPointcloudError(
                f"every is {self.every} and longest_side {self.longest_side}; expected at least 1 and 16"
            )

    @property
    def needs_points(self) -> bool:
        """Whether the cloud is read: a proposer of colour alone needs none."""
        return self.use_depth or self.split or self.drop_tiny or self.level in AGREED

    def processes_for(self, images: int) -> int:
        """How many processes to use where nobody says: a core each, but one alone for models that fill memory and
        cores by themselves."""
        light = (self.proposer == "opencv" or Path(self.proposer).is_dir()) and self.encoder in (None, "demo")
        return min(os.cpu_count() or 1, max(1, images // IMAGES_A_PROCESS)) if light else 1
