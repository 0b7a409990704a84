"""What is done for one image: proposals, a map for each level, features, all in one atomic work file; and this for many
images side by side.

Each process opens its models once and serves one pipe: it takes a task, answers with what is wrong with the image, and
takes the next. A pipe ends with the process at its other end, so a worker stops when its parent is gone, and the parent
notices a worker that was killed. One broken image stops no other.
"""

from __future__ import annotations

import os
import zipfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from multiprocessing import get_context
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.cloud import UNKNOWN_SPACE
from og_pointcloud.errors import OgPointcloudError, SceneError
from og_pointcloud.formats.atomic import replacing
from og_pointcloud.formats.images import require_cv2
from og_pointcloud.formats.poses import in_local_frame
from og_pointcloud.masking.agreement import (
    ProposedPoints,
    points_of_proposals,
    rendered_depth,
    smallest_mask_px,
    split_at_depth_edges,
)
from og_pointcloud.masking.contracts import (
    AGREED,
    LEVELS,
    DepthMaskProposer,
    MaskEncoder,
    MaskProposer,
    MaskSettings,
    Proposals,
)
from og_pointcloud.masking.existing import ExistingMasks, own_proposer
from og_pointcloud.masking.levels import AGREED_PREFERENCE, PREFERENCE, settle
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
        self.levels = LEVELS if settings.langsplat else (settings.level,)
        self.preferences = AGREED_PREFERENCE if settings.level == AGREED else PREFERENCE
        self.proposer = _open_proposer(settings)
        self.encoder = _open_encoder(settings.encoder)
        self.cloud = _SpacedCloud(capture) if settings.needs_points else None

    def __call__(self, task: ImageTask) -> str | None:
        """Make the image's work file; what is wrong with the image, or None."""
        try:
            self._make(task)
        except SceneError as error:
            return str(error)
        return None

    def _make(self, task: ImageTask) -> None:
        """Masks on the levels asked for, and their features; in a first pass the proposals."""
        image = task.photograph.read(self.settings.longest_side)
        if task.scores is not None:
            arrays = self._masks(image, *_kept_proposals(task))
        elif self.settings.level == AGREED:
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


def _open_encoder(name: str | None) -> MaskEncoder | None:
    if name is None:
        return None
    from og_pointcloud.masking.encode import open_encoder

    return open_encoder(name)


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
    waiting = list(reversed(tasks))
    workers = _started(min(processes, len(tasks)), capture, settings)
    try:
        at_work = {pipe: _sent(pipe, waiting.pop()) for _, pipe in workers}
        while at_work:
            for pipe in wait(list(at_work)):
                assert isinstance(pipe, Connection)
                task, wrong = at_work.pop(pipe), _answer(pipe)
                if waiting:
                    at_work[pipe] = _sent(pipe, waiting.pop())
                yield task, wrong
    finally:
        for process, pipe in workers:
            pipe.close()  # the worker ends after the image that it is at
            process.join()


def _started(count: int, capture: Path, settings: MaskSettings) -> list[tuple[BaseProcess, Connection]]:
    """Processes that serve the other end of a pipe each."""
    context, workers = get_context("spawn"), []
    with one_thread_each():
        for _ in range(count):
            ours, theirs = context.Pipe()
            process = context.Process(target=_serve, args=(theirs, capture, settings), daemon=True)
            process.start()
            theirs.close()
            workers.append((process, ours))
    return workers


def _serve(pipe: Connection, capture: Path, settings: MaskSettings) -> None:
    """In a process of its own: answer tasks until the other end of the pipe is closed, or gone."""
    require_cv2().setNumThreads(1)
    with suppress(EOFError, ConnectionError, KeyboardInterrupt):
        try:
            work = ImageWorker(capture, settings)
        except (OgPointcloudError, ImportError, OSError) as error:
            pipe.recv()
            pipe.send(OgPointcloudError(str(error)))
            return
        while True:
            pipe.send(work(pipe.recv()))


def _sent(pipe: Connection, task: ImageTask) -> ImageTask:
    with suppress(OSError):  # a worker that has ended: waiting for its answer says so
        pipe.send(task)
    return task


def _answer(pipe: Connection) -> str | None:
    try:
        answer = pipe.recv()
    except (EOFError, OSError):
        raise OgPointcloudError(
            "a process that makes masks ended early (out of memory?); the images that are done are kept: the same "
            "command with --processes 1 goes on behind them, and says what is wrong"
        ) from None
    if isinstance(answer, OgPointcloudError):
        raise answer
    return answer


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
