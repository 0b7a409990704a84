"""What is done for one image, proposals, an id map and features in one atomic work file; and this for many images.

Each process opens its models once. One broken image stops no other; a process that is killed stops the run, but not
what is done.
"""

from __future__ import annotations

import os
import signal
import zipfile
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from functools import lru_cache
from multiprocessing import get_context, parent_process
from pathlib import Path
from threading import Thread
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.cloud import UNKNOWN_SPACE
from og_pointcloud.errors import OgPointcloudError, SceneError
from og_pointcloud.formats.atomic import replacing
from og_pointcloud.formats.images import require_cv2
from og_pointcloud.formats.poses import in_local_frame
from og_pointcloud.masking.agreement import ProposedPoints, points_of_proposals
from og_pointcloud.masking.contracts import AGREED, MaskProposer, MaskSettings, Proposals
from og_pointcloud.masking.encode import open_encoder
from og_pointcloud.masking.existing import ExistingMasks, own_proposer
from og_pointcloud.masking.levels import AGREED_PREFERENCE, PREFERENCE, Level, settle
from og_pointcloud.masking.photographs import Photograph, read_cloud
from og_pointcloud.scene import Camera

__all__ = ["AGREEMENT_POINTS", "ImageTask", "open_proposer", "read_work", "results"]

THREAD_VARIABLES = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")

AGREEMENT_POINTS = 60_000
"""Points of the cloud, at most, on which it is counted how far views agree."""


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
        folder, seconds = Path(settings.proposer), settings.seconds_per_image
        self.proposer = (
            ExistingMasks(folder)
            if folder.is_dir()
            else open_proposer(settings.proposer, seconds_per_image=seconds, download=settings.download)
        )
        self.encoder = open_encoder(settings.encoder) if settings.encoder is not None else None
        self.cloud = _SpacedCloud(capture) if settings.level == AGREED else None

    def __call__(self, task: ImageTask) -> str | None:
        """Make the image's work file; what is wrong with the image, or None."""
        try:
            image = task.photograph.read(self.settings.longest_side)
            if task.scores is not None:
                arrays = self._masks(image, _kept_proposals(task))
            elif self.cloud is not None:
                arrays = self._first_pass(self.cloud, self._proposals(image, task.photograph), task.photograph)
            else:
                arrays = self._masks(image, self._proposals(image, task.photograph))
            with replacing(task.work_file) as file:
                np.savez_compressed(file, **arrays)
        except SceneError as error:
            return str(error)
        return None

    def _proposals(self, image: NDArray[np.uint8], photograph: Photograph) -> Proposals:
        if isinstance(self.proposer, ExistingMasks):
            return self.proposer.of(photograph.name, image.shape[:2])
        return self.proposer.propose(image)

    def _settled(self, proposals: Proposals) -> Level:
        level = self.settings.level
        return settle(proposals, AGREED_PREFERENCE if level == AGREED else PREFERENCE)[level]

    def _masks(self, image: NDArray[np.uint8], proposals: Proposals) -> dict[str, Any]:
        """The id map of the level that is asked for, and its masks' features."""
        level = self._settled(proposals)
        space = self.encoder.feature_space if self.encoder else UNKNOWN_SPACE
        masks = level.masks()
        features = self.encoder.embed(image, masks) if self.encoder else np.zeros((len(masks), 1))
        return {"feature_space": np.array(space), "ids": level.ids, "features": features.astype(np.float16)}

    def _first_pass(self, cloud: _SpacedCloud, proposals: Proposals, photograph: Photograph) -> dict[str, Any]:
        """Proposals, the points that show in them, and for the preview a map by the proposer's scores alone."""
        points = ProposedPoints(np.zeros(0, np.int32), np.zeros((len(proposals), 0), np.bool_))
        if photograph.distortion is None:  # the points fit pinhole images alone
            height, width = proposals.masks.shape[1:]
            points = cloud.in_proposals(proposals, photograph.camera.resized(width, height))
        return {
            "masks": np.packbits(proposals.masks, axis=2),
            "scores": proposals.scores,
            "seen": points.seen,
            "inside": points.inside,
            "ids": self._settled(proposals).ids,
        }


def _kept_proposals(task: ImageTask) -> Proposals:
    """What the first pass kept, with the scores of the second."""
    assert task.proposals is not None
    assert task.scores is not None
    work = read_work(task.proposals)
    masks = np.unpackbits(work["masks"], axis=2, count=work["ids"].shape[1]).astype(np.bool_)
    return Proposals(masks, task.scores)


def read_work(file: Path, *names: str) -> dict[str, NDArray[Any]]:
    """The arrays of a work file, all or those named. SceneError where the disk fails: such files are complete."""
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

    def in_proposals(self, proposals: Proposals, camera: Camera) -> ProposedPoints:
        """camera: from world coordinates."""
        camera = in_local_frame(camera, self.points.origin)
        return points_of_proposals(proposals, self.points.xyz, self.spacing, self.asked, camera)


def open_proposer(text: str, *, seconds_per_image: float | None = None, download: bool = False) -> MaskProposer:
    """``opencv``; ``sam:FOLDER`` or ``sam:OWNER/MODEL``; ``onnx:ENCODER,DECODER``, SAM as two ONNX files;
    ``python:MODULE:NAME``, a function or proposer of the user's own (`existing.own_proposer`).

    seconds_per_image: where SAM stops adding prompts; None: never. download: let transformers fetch the model.
    Nothing is downloaded otherwise. SceneError names what is known. A folder of masks is no proposer of this kind: it
    goes by the image's name (`existing.ExistingMasks`).
    """
    kind, _, name = text.partition(":")
    if text == "opencv":
        from og_pointcloud.masking.opencv import OpenCVProposer

        return OpenCVProposer()
    if kind == "sam" and name:
        from og_pointcloud.masking.sam import open_sam

        return open_sam(name, seconds_per_image=seconds_per_image, download=download)
    if kind == "onnx" and name:
        from og_pointcloud.masking.onnx import open_onnx

        return open_onnx([Path(part) for part in name.split(",")], seconds_per_image=seconds_per_image)
    if kind == "python" and name:
        return own_proposer(name)
    raise SceneError(
        f"proposer is '{text}'; expected opencv, sam:FOLDER, sam:OWNER/MODEL, "
        "onnx:ENCODER.onnx,DECODER.onnx, python:MODULE:NAME, or a folder of id PNGs or COCO JSON files"
    )


def results(
    capture: Path, settings: MaskSettings, tasks: Sequence[ImageTask], processes: int
) -> Iterator[tuple[ImageTask, str | None]]:
    """Each task when it is done, and what is wrong with its image (None: nothing). No task is no work, and no error.

    OgPointcloudError where a worker cannot open its models, or a process ends early.
    """
    if not tasks:
        return
    if processes <= 1 or len(tasks) == 1:
        work = ImageWorker(capture, settings)
        for task in tasks:
            yield task, work(task)
        return
    with one_thread_each():
        pool = ProcessPoolExecutor(min(processes, len(tasks)), get_context("spawn"), initializer=_begin_process)
        waiting = {pool.submit(_in_process, capture, settings, task): task for task in tasks}
    try:
        for future in as_completed(waiting):
            yield waiting[future], future.result()
    except BrokenProcessPool:
        raise OgPointcloudError(
            "a process that makes masks ended early (out of memory?); the images that are done are kept: the same "
            "command with --processes 1 goes on behind them, and says what is wrong"
        ) from None
    finally:
        pool.shutdown(cancel_futures=True)  # after the images that are being made


def _begin_process() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent stops for all
    require_cv2().setNumThreads(1)
    Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """A parent that is killed does not end its processes."""
    parent = parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


@lru_cache(maxsize=1)
def _opened(capture: Path, settings: MaskSettings) -> ImageWorker:
    """The one that this process has."""
    return ImageWorker(capture, settings)


def _in_process(capture: Path, settings: MaskSettings, task: ImageTask) -> str | None:
    try:
        work = _opened(capture, settings)
    except ImportError as error:  # MissingExtraError cannot be sent to another process
        raise OgPointcloudError(str(error)) from None
    return work(task)


@contextmanager
def one_thread_each() -> Iterator[None]:
    """Processes started within multiply matrices on one thread: two that take two threads each on two cores are slower
    than one alone. Read when a process imports numpy, so it must stand in the environment before."""
    before = {name: os.environ.get(name) for name in THREAD_VARIABLES}
    os.environ.update(dict.fromkeys(THREAD_VARIABLES, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
