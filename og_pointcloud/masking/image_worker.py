"""What is done for one image: proposals, their maps on each level, features; all of it into one atomic work file."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.errors import SceneError
from og_pointcloud.formats.atomic import replacing
from og_pointcloud.formats.mask_files import UNKNOWN_SPACE
from og_pointcloud.formats.poses import in_local_frame
from og_pointcloud.masking.agreement import ProposedPoints, points_of_proposals
from og_pointcloud.masking.contracts import DepthMaskProposer, MaskEncoder, MaskProposer, Proposals
from og_pointcloud.masking.existing import ExistingMasks
from og_pointcloud.masking.levels import AGREED, LEVELS, PREFERENCE, settle
from og_pointcloud.masking.opening import open_proposer
from og_pointcloud.masking.photographs import Photograph, read_cloud
from og_pointcloud.masking.refine import rendered_depth, smallest_mask_px, split_at_depth_edges
from og_pointcloud.masking.settings import MaskSettings
from og_pointcloud.scene import Camera

__all__ = ["AGREEMENT_POINTS", "ImageTask", "ImageWorker", "read_work"]

AGREEMENT_POINTS = 60_000
"""So many points of the cloud tell how far views agree."""


class ImageTask(NamedTuple):
    """proposals, scores: of a first pass, and what other views made of its scores; none in a first or only pass."""

    photograph: Photograph
    work_file: Path
    proposals: Path | None = None
    scores: NDArray[np.float32] | None = None


class ImageWorker:
    """Opened once a process: the models, and the cloud where it is needed."""

    def __init__(self, capture: Path, settings: MaskSettings) -> None:
        self.settings = settings
        self.levels = LEVELS if settings.langsplat else (settings.level,)
        self.preferences = AGREED if settings.level in AGREED else PREFERENCE
        self.proposer = _open_proposer(settings)
        self.encoder = _open_encoder(settings.encoder)
        self.cloud = _SpacedCloud(capture) if settings.needs_points else None

    def __call__(self, task: ImageTask) -> None:
        """Masks of one image on the levels asked for, and their features, into its work file; in a first pass its
        proposals."""
        image = task.photograph.read(self.settings.longest_side)
        if task.scores is not None:
            arrays = self._masks(image, *_kept_proposals(task))
        elif self.settings.level in AGREED:
            arrays = self._first_pass(image, task.photograph)
        else:
            arrays = self._masks(image, *self._proposals(image, task.photograph))
        with replacing(task.work_file) as file:
            np.savez_compressed(file, **arrays)

    def _masks(self, image: NDArray[np.uint8], proposals: Proposals, smallest_px: int) -> dict[str, Any]:
        settled = settle(proposals, smallest_px, self.preferences)
        space = self.encoder.feature_space if self.encoder else UNKNOWN_SPACE
        arrays: dict[str, Any] = {"feature_space": np.array(space)}
        for level in self.levels:
            arrays[f"{level}_ids"] = settled[level].ids
            arrays[f"{level}_features"] = self._features(image, settled[level].masks())
        return arrays

    def _first_pass(self, image: NDArray[np.uint8], photograph: Photograph) -> dict[str, Any]:
        """Proposals, the points that show in them, and for the preview a map by the proposer's scores alone."""
        proposals, smallest_px = self._proposals(image, photograph)
        points = ProposedPoints(np.zeros(0, np.int32), np.zeros((len(proposals), 0), np.bool_))
        if self.cloud is not None and photograph.distortion is None:
            points = self.cloud.in_proposals(proposals, photograph.camera.resized(image.shape[1], image.shape[0]))
        level = self.settings.level
        return {
            "masks": np.packbits(proposals.masks, axis=2),
            "scores": proposals.scores,
            "smallest_px": np.array(smallest_px),
            "seen": points.seen,
            "inside": points.inside,
            f"{level}_ids": settle(proposals, smallest_px, self.preferences)[level].ids,
        }

    def _proposals(self, image: NDArray[np.uint8], photograph: Photograph) -> tuple[Proposals, int]:
        """What the proposer says, after geometry, and the fewest pixels of a mask."""
        if isinstance(self.proposer, ExistingMasks):
            return self.proposer.of(photograph.name, image.shape[:2]), 1
        if self.cloud is None or photograph.distortion is not None:  # the points fit pinhole images alone
            return self.proposer.propose(image), 1
        camera = photograph.camera.resized(image.shape[1], image.shape[0])
        use_depth, split = self.settings.use_depth, self.settings.split
        depth = self.cloud.depth(camera) if use_depth or split else None
        if use_depth and isinstance(self.proposer, DepthMaskProposer):
            proposals = self.proposer.propose_with_depth(image, depth)
        else:
            proposals = self.proposer.propose(image)
        if split and depth is not None:
            proposals = split_at_depth_edges(proposals, depth)
        return proposals, self.cloud.smallest_mask_px(camera) if self.settings.drop_tiny else 1

    def _features(self, image: NDArray[np.uint8], masks: NDArray[np.bool_]) -> NDArray[np.float16]:
        if self.encoder is None:
            return np.zeros((len(masks), 1), np.float16)
        if not len(masks):
            return np.zeros((0, self.encoder.width), np.float16)
        return self.encoder.embed(image, masks).astype(np.float16)


def _kept_proposals(task: ImageTask) -> tuple[Proposals, int]:
    """What the first pass kept, with the scores of the second."""
    assert task.proposals is not None
    assert task.scores is not None
    work = read_work(task.proposals)
    width = next(work[name] for name in work if name.endswith("_ids")).shape[1]
    masks = np.unpackbits(work["masks"], axis=2, count=width).astype(np.bool_)
    return Proposals(masks, task.scores), int(work["smallest_px"])


def read_work(file: Path, *names: str) -> dict[str, NDArray[Any]]:
    """All arrays, or those named, of our own file, whole since it was renamed into place; disk errors are named."""
    try:
        with np.load(file, allow_pickle=False) as arrays:
            return {name: arrays[name] for name in names or arrays.files}
    except (ValueError, OSError, EOFError, KeyError, zipfile.BadZipFile) as error:
        raise SceneError(f"{file} cannot be read ({error}): remove it, and the same command makes it again") from None


class _SpacedCloud:
    """The points in their local frame, with their spacing."""

    def __init__(self, capture: Path) -> None:
        from og_pointcloud.rendering.geometry import neighbourhood, sample_of_points
        from og_pointcloud.settings import GeometrySettings

        self.points = read_cloud(capture)
        self.spacing = neighbourhood(self.points.xyz, GeometrySettings()).spacing
        self.asked = sample_of_points(self.points.xyz, AGREEMENT_POINTS)

    def depth(self, camera: Camera) -> NDArray[np.float32]:
        """camera: from world coordinates."""
        return rendered_depth(self.points.xyz, self.spacing, in_local_frame(camera, self.points.origin))

    def in_proposals(self, proposals: Proposals, camera: Camera) -> ProposedPoints:
        """camera: from world coordinates."""
        camera = in_local_frame(camera, self.points.origin)
        return points_of_proposals(proposals, self.points.xyz, self.spacing, self.asked, camera)

    def smallest_mask_px(self, camera: Camera) -> int:
        """camera: from world coordinates."""
        return smallest_mask_px(self.points.xyz, self.spacing, in_local_frame(camera, self.points.origin))


def _open_proposer(settings: MaskSettings) -> MaskProposer | ExistingMasks:
    folder = Path(settings.proposer)
    if folder.is_dir():
        return ExistingMasks(folder)
    return open_proposer(settings.proposer, seconds_per_image=settings.seconds_per_image, download=settings.download)


def _open_encoder(name: str | None) -> MaskEncoder | None:
    if name is None:
        return None
    from og_pointcloud.masking.encoders import open_encoder

    return open_encoder(name)
