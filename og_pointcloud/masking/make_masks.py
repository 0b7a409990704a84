"""Photographs -> masks and mask features in a capture folder: resumable, on several cores, nothing half-written.

What each image gives is first an atomic file of its own in ``masks.work/``; when all are there they become ``masks/``
with ``mask_features.npz``, or LangSplat's ``language_features/``, and the folder goes. Killed at any moment, the same
command goes on behind the last image; where all is made already it does nothing. ``made.json`` beside the masks says
that they were made here, and how.
"""

from __future__ import annotations

import json
import os
import shutil
import sys
import time
import zipfile
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from hashlib import blake2b
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from og_pointcloud._atomic import replacing
from og_pointcloud.errors import OgPointcloudError, SceneError
from og_pointcloud.formats.images import require_cv2
from og_pointcloud.formats.langsplat import LANGUAGE_FEATURES_FOLDER
from og_pointcloud.formats.masks import FEATURES_NAME, MASKS_FOLDER, UNKNOWN_SPACE
from og_pointcloud.formats.nerfstudio import TRANSFORMS_NAMES
from og_pointcloud.formats.poses import in_local_frame
from og_pointcloud.masking.agreement import ProposedPoints, agreement, points_of_proposals, rescored
from og_pointcloud.masking.contact_sheet import write_contact_sheet
from og_pointcloud.masking.contracts import DepthMaskProposer, MaskEncoder, MaskProposer, Proposals
from og_pointcloud.masking.existing import ExistingMasks
from og_pointcloud.masking.levels import AGREED, LEVELS, PREFERENCE, settle
from og_pointcloud.masking.opening import open_proposer
from og_pointcloud.masking.photographs import Photograph, choose_by_coverage, read_cloud, read_photographs
from og_pointcloud.masking.refine import rendered_depth, smallest_mask_px, split_at_depth_edges
from og_pointcloud.scene import Camera

__all__ = ["MaskSettings", "MasksMade", "make_masks"]

VERSION = 1
"""Of what an image's work file holds; files of another are made again."""
WORK_FOLDER = "masks.work"
MADE_NAME = "made.json"
PREVIEW_NAME = "masks_preview.png"
THREAD_VARIABLES = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
PREVIEW_IMAGES = 6
REPORT_SECONDS = 10.0
AGREEMENT_POINTS = 60_000
"""So many points of the cloud tell how far views agree."""
LANGSPLAT_LEVELS = ("middle", "small", "middle", "large")
"""Our levels in the order of LangSplat's: default, small, medium, large."""


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


@dataclass(frozen=True)
class MasksMade:
    """images, done_before: how many were made, and of these how many an interrupted run had made. masks: of all images.
    left_out: names of images that were not needed. seconds: wall clock."""

    output: Path
    images: int
    done_before: int
    masks: int
    left_out: tuple[str, ...]
    feature_space: str
    seconds: float


class _Task(NamedTuple):
    """proposals, scores: of a first pass, and what other views made of its scores; none in a first or only pass."""

    photograph: Photograph
    work_file: Path
    proposals: Path | None = None
    scores: NDArray[np.float32] | None = None


def make_masks(
    capture: str | os.PathLike[str],
    settings: MaskSettings | None = None,
    output: str | os.PathLike[str] | None = None,
    *,
    processes: int = 1,
    overwrite: bool = False,
    say: Callable[[str], None] = lambda text: print(text, file=sys.stderr, flush=True),
) -> MasksMade:
    """Make the masks of a capture folder, readable by `read_capture`.

    output: where they go; None: into the capture. Another folder becomes a capture of its own: poses of the images that
    are used, and links to everything else. It is needed where images are left out.
    overwrite: replace masks that were not made here, and make again what is complete.
    Raises SceneError where images are broken (after the others are done and kept), and OgPointcloudError where masks
    that were not made here would be overwritten.
    """
    settings, start = settings or MaskSettings(), time.perf_counter()
    capture = Path(capture)
    target = capture if output is None else Path(output)
    photographs = read_photographs(capture)
    settings = _possible(settings, capture, len(photographs), say)
    chosen = _chosen(capture, photographs, settings)
    left_out = tuple(photograph.name for photograph in photographs if photograph not in chosen)
    if left_out and target.resolve() == capture.resolve():
        raise OgPointcloudError(
            f"{len(left_out)} of {len(photographs)} images would be left out, but the pose file names them all; "
            "expected a folder for a capture of the others (-o DIR)"
        )
    if left_out:
        say(f"left out: {len(left_out)} of {len(photographs)} images ({_reason(settings)}): {', '.join(left_out)}")
    _refuse_foreign(target, settings, overwrite)
    work = target / WORK_FOLDER / _fingerprint(settings)
    tasks = [_Task(photograph, work / _work_name(photograph)) for photograph in chosen]
    key = _digest([str(task.work_file.relative_to(target)) for task in tasks])
    if not overwrite and (made := _made_before(target, settings, tasks, key)):
        if target.resolve() != capture.resolve():
            _make_capture_of(capture, target, chosen)  # poses may be new
        say(f"all {len(tasks)} images have these masks already: nothing to do (--overwrite makes them again)")
        masks, space = made["masks"], str(made.get("feature_space", UNKNOWN_SPACE))
        return MasksMade(target, len(tasks), len(tasks), masks, left_out, space, time.perf_counter() - start)
    work.mkdir(parents=True, exist_ok=True)
    waiting = [task for task in tasks if not task.work_file.exists()]
    if len(waiting) < len(tasks):
        say(f"{len(tasks) - len(waiting)} of {len(tasks)} images are done already")
    _work_through(capture, settings, tasks, waiting, processes, target, say)
    if settings.level in AGREED:
        tasks = _confirmed(tasks, say)
        left = [task for task in tasks if not task.work_file.exists()]
        _work_through(capture, settings, tasks, left, processes, target, say)
    masks, space = _assemble(target, settings, tasks)
    if target.resolve() != capture.resolve():
        _make_capture_of(capture, target, chosen)
    _write_made(target, settings, tasks, key=key, masks=masks, feature_space=space)
    shutil.rmtree(target / WORK_FOLDER)
    done_before, seconds = len(tasks) - len(waiting), time.perf_counter() - start
    return MasksMade(target, len(tasks), done_before, masks, left_out, space, seconds)


# Which images, and whose masks ------------------------------------------------------------------------------------


def _chosen(capture: Path, photographs: Sequence[Photograph], settings: MaskSettings) -> list[Photograph]:
    chosen = list(photographs[:: settings.every])
    if settings.enough_views is None:
        return chosen
    return [chosen[index] for index in choose_by_coverage(capture, chosen, settings.enough_views)]


def _possible(settings: MaskSettings, capture: Path, images: int, say: Callable[[str], None]) -> MaskSettings:
    """Without other views or a cloud nothing can agree: the small level is then nearest to it."""
    if settings.level not in AGREED:
        return settings
    reason = "there is one image" if images == 1 else ""
    try:
        read_cloud(capture)
    except SceneError as error:
        reason = str(error)
    if not reason:
        return settings
    say(f"level agreed: no other view can confirm masks ({reason}); the small level is used")
    return replace(settings, level="small")


def _reason(settings: MaskSettings) -> str:
    every = f"every {settings.every} is used" if settings.every > 1 else ""
    enough = f"what they see is seen by {settings.enough_views} others" if settings.enough_views else ""
    return ", ".join(filter(None, (every, enough)))


def _refuse_foreign(target: Path, settings: MaskSettings, overwrite: bool) -> None:
    folder = _folder(target, settings)
    features = target / FEATURES_NAME
    if overwrite or (folder / MADE_NAME).is_file():
        return
    found = folder if folder.is_dir() and any(folder.iterdir()) else features
    if found.exists():
        raise OgPointcloudError(
            f"{found} was not made by this command and would be replaced; expected none: give another folder (-o DIR), "
            "or --overwrite"
        )


def _fingerprint(settings: MaskSettings) -> str:
    """Work files of other settings are not taken up. Which images are used does not matter to an image."""
    of_image = replace(settings, every=1, enough_views=None, download=False)
    given = Path(settings.proposer)
    masks = [_state(file) for file in sorted(given.rglob("*"))] if given.is_dir() else []
    return _digest([VERSION, asdict(of_image), masks])


def _work_name(photograph: Photograph) -> str:
    return f"{_digest([photograph.name, *_state(photograph.file)])}.npz"


def _state(file: Path) -> tuple[str, int, int]:
    """What changes when a file does."""
    state = file.stat()
    return file.name, state.st_size, state.st_mtime_ns


def _digest(value: list[Any]) -> str:
    return blake2b(json.dumps(value).encode(), digest_size=12).hexdigest()


def _made_before(target: Path, settings: MaskSettings, tasks: Sequence[_Task], key: str) -> dict[str, Any] | None:
    """The record of a run that made the same masks of the same images, if all its files are still there."""
    folder = _folder(target, settings)
    try:
        made = json.loads((folder / MADE_NAME).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    endings = ("_s.npy", "_f.npy") if settings.langsplat else (".png",)
    files = [folder / f"{task.photograph.name}{ending}" for task in tasks for ending in endings]
    files += [] if settings.langsplat else [target / FEATURES_NAME]
    same = isinstance(made, dict) and made.get("key") == key and isinstance(made.get("masks"), int)
    return made if same and all(file.is_file() for file in files) else None


def _folder(target: Path, settings: MaskSettings) -> Path:
    return target / (LANGUAGE_FEATURES_FOLDER if settings.langsplat else MASKS_FOLDER)


# The work ---------------------------------------------------------------------------------------------------------


class _Worker:
    """Opened once a process: the models, and the cloud where it is needed."""

    def __init__(self, capture: Path, settings: MaskSettings) -> None:
        self.settings = settings
        self.levels = LEVELS if settings.langsplat else (settings.level,)
        self.preferences = AGREED if settings.level in AGREED else PREFERENCE
        self.proposer = _open_proposer(settings)
        self.encoder = _open_encoder(settings.encoder)
        self.cloud = _SpacedCloud(capture) if settings.needs_points else None

    def __call__(self, task: _Task) -> None:
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


class _SpacedCloud:
    """The points in their local frame, with their spacing."""

    def __init__(self, capture: Path) -> None:
        from og_pointcloud.fitting.geometry import neighbourhood, sample_of_points
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


_worker: _Worker | str = "not opened"
"""This process's own, where there are several, or why it could not be opened."""


def _open_worker(capture: Path, settings: MaskSettings) -> None:
    global _worker
    require_cv2().setNumThreads(1)
    try:
        _worker = _Worker(capture, settings)
    except (OgPointcloudError, ImportError, OSError) as error:  # the pool would only say that it is broken
        _worker = str(error)


def _work_on(task: _Task) -> str | None:
    """What is wrong with the image, or None: one broken image stops no other."""
    if isinstance(_worker, str):
        raise OgPointcloudError(_worker)
    return _tried(_worker, task)


def _tried(worker: _Worker, task: _Task) -> str | None:
    try:
        worker(task)
    except SceneError as error:
        return str(error)
    return None


@contextmanager
def _one_thread_each() -> Iterator[None]:
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


def _results(
    capture: Path, settings: MaskSettings, tasks: Sequence[_Task], processes: int
) -> Iterator[tuple[_Task, str | None]]:
    """Each task when it is done, and what went wrong."""
    if processes <= 1 or len(tasks) == 1:
        worker = _Worker(capture, settings)
        for task in tasks:
            yield task, _tried(worker, task)
        return
    pool = ProcessPoolExecutor(
        min(processes, len(tasks)), get_context("spawn"), initializer=_open_worker, initargs=(capture, settings)
    )
    try:
        with _one_thread_each():
            futures = {pool.submit(_work_on, task): task for task in tasks}  # which starts the processes
        for future in as_completed(futures):
            yield futures[future], future.result()
    except BrokenProcessPool:
        raise OgPointcloudError(
            "a process that makes masks ended without a word (out of memory?); the images that are done are kept: the "
            "same command with --processes 1 goes on behind them, and says what is wrong"
        ) from None
    finally:
        pool.shutdown(cancel_futures=True)


def _work_through(
    capture: Path, settings: MaskSettings, tasks: Sequence[_Task], waiting: Sequence[_Task], processes: int,
    target: Path, say: Callable[[str], None],
) -> None:  # fmt: skip
    """Do what is waiting; a preview after the first images, and now and then a word on the time that remains."""
    if not waiting:
        return
    broken, start = [], time.perf_counter()
    last_said, previewed = start, False
    for count, (task, wrong) in enumerate(_results(capture, settings, waiting, processes), 1):
        if wrong:
            broken.append(wrong)
            say(f"broken: {wrong}")
        done = [task for task in tasks if task.work_file.exists()]
        if not previewed and len(done) >= min(PREVIEW_IMAGES, len(tasks)):
            _write_preview(target, settings, done[:PREVIEW_IMAGES])
            say(f"preview of the first images: {target / PREVIEW_NAME}")
            previewed = True
        now = time.perf_counter()
        if now - last_said > REPORT_SECONDS or count == len(waiting):
            each = (now - start) / count
            say(f"{len(done)} of {len(tasks)} images, {each:.1f} s each, {_spoken(each * (len(waiting) - count))} left")
            last_said = now
    if broken:
        more = f" (and {len(broken) - 1} more)" if len(broken) > 1 else ""
        raise SceneError(
            f"{len(broken)} of {len(tasks)} images cannot be used: {broken[0]}{more}; the others are kept in "
            f"'{target / WORK_FOLDER}': repair or remove these, and the same command goes on"
        )


def _confirmed(tasks: Sequence[_Task], say: Callable[[str], None]) -> list[_Task]:
    """The second pass over images whose proposals are all there, with scores that all of them had a say in."""
    start = time.perf_counter()
    kept = [_read_work(task.work_file, "scores", "seen", "inside") for task in tasks]
    views = [ProposedPoints(work["seen"], work["inside"]) for work in kept]
    agreed = agreement(views, 1 + max((int(view.seen.max(initial=-1)) for view in views), default=0))
    told = np.concatenate(agreed)
    told = told[~np.isnan(told)]
    usual = float(np.median(told)) if len(told) else 1.0
    say(
        f"{len(told)} of {sum(map(len, agreed))} proposals were seen by other views, which confirm them by {usual:.2f} "
        f"(median IoU; {(time.perf_counter() - start) / len(tasks):.2f} s an image)"
    )
    everyone = _digest(sorted(task.work_file.name for task in tasks))
    return [
        _Task(
            task.photograph,
            task.work_file.with_name(f"{task.work_file.stem}.{everyone}.npz"),
            task.work_file,
            rescored(work["scores"], found, usual),
        )
        for task, work, found in zip(tasks, kept, agreed, strict=True)
    ]


def _kept_proposals(task: _Task) -> tuple[Proposals, int]:
    """What the first pass kept, with the scores of the second."""
    assert task.proposals is not None
    assert task.scores is not None
    work = _read_work(task.proposals)
    width = next(work[name] for name in work if name.endswith("_ids")).shape[1]
    masks = np.unpackbits(work["masks"], axis=2, count=width).astype(np.bool_)
    return Proposals(masks, task.scores), int(work["smallest_px"])


def _spoken(seconds: float) -> str:
    return (
        f"{seconds:.0f} s"
        if seconds < 100
        else f"{seconds / 60:.0f} min"
        if seconds < 6000
        else f"{seconds / 3600:.1f} h"
    )


def _write_preview(target: Path, settings: MaskSettings, tasks: Sequence[_Task]) -> None:
    pictures = [
        (task.photograph.read(settings.longest_side), _read_work(task.work_file)[f"{settings.level}_ids"])
        for task in tasks
    ]
    write_contact_sheet(target / PREVIEW_NAME, pictures)


# The folder -------------------------------------------------------------------------------------------------------


def _read_work(file: Path, *names: str) -> dict[str, NDArray[Any]]:
    """All arrays, or those named, of our own file, whole since it was renamed into place; disk errors are named."""
    try:
        with np.load(file, allow_pickle=False) as arrays:
            return {name: arrays[name] for name in names or arrays.files}
    except (ValueError, OSError, EOFError, KeyError, zipfile.BadZipFile) as error:
        raise SceneError(f"{file} cannot be read ({error}): remove it, and the same command makes it again") from None


def _assemble(target: Path, settings: MaskSettings, tasks: Sequence[_Task]) -> tuple[int, str]:
    """Work files -> the capture's files. Number of masks on the level of `settings`, and the feature space."""
    folder = _folder(target, settings)
    folder.mkdir(parents=True, exist_ok=True)
    _write_made(target, settings, tasks)  # first: killed here, the next run knows the folder as ours, but not as whole
    write = _write_langsplat if settings.langsplat else _write_mask_image
    features: dict[str, Any] = {}
    masks, space = 0, UNKNOWN_SPACE
    for task in tasks:
        work = _read_work(task.work_file)
        space, rows = str(work["feature_space"]), work[f"{settings.level}_features"]
        masks += len(rows)
        features[task.photograph.name] = rows
        write(folder / task.photograph.name, work, settings.level)
    if settings.langsplat:
        with replacing(folder / "feature_space.txt") as file:
            file.write(f"{space}\n".encode())
    else:
        with replacing(target / FEATURES_NAME) as file:
            np.savez(file, feature_space=np.array(space), **features)
    return masks, space


def _write_made(target: Path, settings: MaskSettings, tasks: Sequence[_Task], **whole: Any) -> None:
    """whole: what a run leaves that came to its end."""
    made = {"made_by": "og-pointcloud masks", **asdict(settings), "images": len(tasks), **whole}
    _write_json(_folder(target, settings) / MADE_NAME, made)


def _write_mask_image(stem: Path, work: dict[str, NDArray[Any]], level: str) -> None:
    """``<stem>.png``: 0 outside every mask, else the row of the features + 1."""
    stem.parent.mkdir(parents=True, exist_ok=True)
    png = require_cv2().imencode(".png", (work[f"{level}_ids"] + 1).astype(np.uint16))[1]
    with replacing(stem.with_name(f"{stem.name}.png")) as file:
        file.write(png.tobytes())


def _write_langsplat(stem: Path, work: dict[str, NDArray[Any]], _: str) -> None:
    """``<stem>_s.npy`` (4, H, W) float32 of ids that count on from level to level, ``<stem>_f.npy`` (M, D) float16."""
    stem.parent.mkdir(parents=True, exist_ok=True)
    rows = [work[f"{level}_features"] for level in LANGSPLAT_LEVELS]
    firsts = np.cumsum([0, *map(len, rows[:-1])])
    maps = [work[f"{level}_ids"] for level in LANGSPLAT_LEVELS]
    ids = np.stack([np.where(level >= 0, level + first, -1) for level, first in zip(maps, firsts, strict=True)])
    for ending, array in (("_s", ids.astype(np.float32)), ("_f", np.concatenate(rows))):
        with replacing(stem.with_name(f"{stem.name}{ending}.npy")) as file:
            np.save(file, array, allow_pickle=False)


def _make_capture_of(capture: Path, target: Path, chosen: Sequence[Photograph]) -> None:
    """Poses of the chosen images, and links to all else that the capture has and the target lacks."""
    kept = {photograph.path for photograph in chosen}
    for source in sorted(capture.resolve().iterdir()):
        if source.name in (MASKS_FOLDER, FEATURES_NAME, LANGUAGE_FEATURES_FOLDER, WORK_FOLDER):
            continue
        place = target / source.name
        if source.name in TRANSFORMS_NAMES:
            content = json.loads(source.read_text(encoding="utf-8"))
            frames = content["frames"]
            content["frames"] = [frame for frame in frames if frame["file_path"].replace("\\", "/") in kept]
            _write_json(place, content)
        elif not place.exists():
            place.symlink_to(source)


def _write_json(path: Path, value: dict[str, Any]) -> None:
    with replacing(path) as file:
        file.write(json.dumps(value, indent=1).encode() + b"\n")
