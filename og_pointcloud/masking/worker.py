"""From images to id maps and features, in work files that are written whole or not at all.

Models are opened once. A broken image does not stop the others; a killed run loses only the images in progress.
"""

from __future__ import annotations

import zipfile
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.cloud import UNKNOWN_SPACE
from og_pointcloud.errors import SceneError
from og_pointcloud.formats.atomic import replacing
from og_pointcloud.masking.contracts import MaskProposer, MaskSettings
from og_pointcloud.masking.encode import open_encoder
from og_pointcloud.masking.existing import ExistingMasks, user_proposer
from og_pointcloud.masking.levels import masks_of_level
from og_pointcloud.masking.photographs import Photograph


class ImageTask(NamedTuple):
    """A photograph, and the file in which its masks are kept until all images are done."""

    photograph: Photograph
    work_file: Path


class ImageWorker:
    """The models of a run."""

    def __init__(self, settings: MaskSettings, done: int = 0) -> None:
        """done: number of images of earlier runs; tracks do not continue from these."""
        self.settings = settings
        if settings.folder and not settings.words:
            self.proposer = ExistingMasks(settings.folder, settings.tracks)
        else:
            self.proposer = open_proposer(settings.proposer, settings.words, done if settings.tracks else None)
        self.encoder = open_encoder(settings.encoder, settings.features) if settings.encoder is not None else None

    def __call__(self, task: ImageTask) -> str | None:
        """Make the image's work file; returns the image's error, or None."""
        try:
            image = task.photograph.read(self.settings.longest_side)
            with replacing(task.work_file) as file:
                np.savez_compressed(file, **self._masks(image, task.photograph))
        except SceneError as error:
            return str(error)
        return None

    def _masks(self, image: NDArray[np.uint8], photograph: Photograph) -> dict[str, Any]:
        """The arrays of a work file: the id map at the chosen level, and features and tracks of its masks.

        Models see the image upright, as those were that they learned from; ids are for the image as stored.
        """
        proposer, turns = self.proposer, photograph.quarter_turns
        upright = np.ascontiguousarray(np.rot90(image, turns))
        if isinstance(proposer, ExistingMasks):  # of the image as stored
            stored = proposer.of(photograph.name, image.shape[:2], photograph.face)
            proposals = replace(stored, masks=np.rot90(stored.masks, turns, axes=(1, 2)))
        else:
            proposals = proposer.propose(upright)
        ids, chosen = masks_of_level(proposals, self.settings.level)
        masks = ids == np.arange(len(chosen))[:, None, None]
        space = self.encoder.feature_space if self.encoder else UNKNOWN_SPACE
        features = self.encoder.embed(upright, masks) if self.encoder else np.zeros((len(masks), 1))
        # Components of unit vectors lose at most 0.05 % in 16 bits.
        stored_ids = np.rot90(ids, -turns)
        made = {"feature_space": np.array(space), "ids": stored_ids, "features": features.astype(np.float16)}
        return made if proposals.tracks is None else {**made, "tracks": proposals.tracks[chosen]}


def read_work(file: Path) -> dict[str, NDArray[Any]]:
    """The arrays of a work file. SceneError where it cannot be read: a disk error, as work files are
    never incomplete."""
    try:
        with np.load(file, allow_pickle=False) as arrays:
            return dict(arrays)
    except (ValueError, OSError, EOFError, zipfile.BadZipFile) as error:
        raise SceneError(f"{file} cannot be read ({error}): remove it and run the same command again") from None


def open_proposer(text: str, words: Sequence[str] = (), images_before: int | None = None) -> MaskProposer:
    """``opencv``; ``sam:FOLDER`` or ``sam:OWNER/MODEL``; ``python:MODULE:NAME``, a user's function or proposer
    (`existing.user_proposer`).

    words: what SAM 3 looks for; by default everything. images_before: with words, track them from image to image, in a
    run that begins after this many images (`sam3.FollowedWords`).
    Nothing is downloaded. SceneError lists what is known. A folder of masks is not opened here: its masks are found by
    image name (`existing.ExistingMasks`).
    """
    kind, _, name = text.partition(":")
    if words or images_before is not None:
        if kind != "sam" or not name or not words:
            needs = "tracks" if images_before is not None else "words"
            raise SceneError(
                f"proposer '{text}' is asked for {needs}{'' if words else ' without words'}; expected words with SAM 3 "
                "(--proposer sam:facebook/sam3 --words chair,lamp), and tracks with both or with a folder of id PNGs"
            )
        # Imported on demand, like all proposers below: torch takes seconds, and not everybody has it.
        from og_pointcloud.masking.sam3 import FollowedWords, NamedThings

        return NamedThings(name, words) if images_before is None else FollowedWords(name, words, images_before)
    if text == "opencv":
        from og_pointcloud.masking.opencv import OpenCVProposer

        return OpenCVProposer()
    if kind == "sam" and name:
        from og_pointcloud.masking.automatic import AutomaticMasks
        from og_pointcloud.masking.sam import SamPredictor

        return AutomaticMasks(SamPredictor(name))
    if kind == "python" and name:
        return user_proposer(name)
    raise SceneError(
        f"proposer is '{text}'; expected opencv, sam:FOLDER, sam:OWNER/MODEL, python:MODULE:NAME, or a folder of id "
        "PNGs or COCO JSON files"
    )


def results(settings: MaskSettings, tasks: Sequence[ImageTask], done: int = 0) -> Iterator[str | None]:
    """Each task's error, or None, in the order of the tasks. Without tasks no model is opened. done: number of images
    of earlier runs."""
    if tasks:
        with ThreadPoolExecutor(settings.threads) as pool:  # on early exit, it waits for the images in progress
            yield from pool.map(ImageWorker(settings, done), tasks)
