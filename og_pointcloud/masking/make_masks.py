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
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from hashlib import blake2b
from pathlib import Path
from typing import Any

import numpy as np

from og_pointcloud.errors import OgPointcloudError, SceneError
from og_pointcloud.formats.mask_files import UNKNOWN_SPACE
from og_pointcloud.masking.agreement import ProposedPoints, agreement, rescored
from og_pointcloud.masking.contact_sheet import write_contact_sheet
from og_pointcloud.masking.image_worker import ImageTask, read_work
from og_pointcloud.masking.levels import AGREED
from og_pointcloud.masking.mask_files import (
    WORK_FOLDER,
    assemble,
    made_before,
    make_capture_of,
    refuse_foreign,
    write_made,
)
from og_pointcloud.masking.photographs import Photograph, choose_by_coverage, read_cloud, read_photographs
from og_pointcloud.masking.settings import MaskSettings
from og_pointcloud.masking.side_by_side import results

__all__ = ["MaskSettings", "MasksMade", "make_masks"]

VERSION = 1
"""Of what an image's work file holds; files of another are made again."""
PREVIEW_NAME = "masks_preview.png"
PREVIEW_IMAGES = 6
REPORT_SECONDS = 10.0

Say = Callable[[str], None]


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


def make_masks(
    capture: str | os.PathLike[str],
    settings: MaskSettings | None = None,
    output: str | os.PathLike[str] | None = None,
    *,
    processes: int | None = None,
    overwrite: bool = False,
    say: Say = lambda text: print(text, file=sys.stderr, flush=True),
) -> MasksMade:
    """Make the masks of a capture folder, readable by `read_capture`.

    output: where they go; None: into the capture. Another folder becomes a capture of its own: poses of the images that
    are used, and links to everything else. It is needed where images are left out.
    processes: images worked on side by side; None: `MaskSettings.processes_for`.
    overwrite: replace masks that were not made here, and make again what is complete.
    Raises SceneError where images are broken (after the others are done and kept), and OgPointcloudError where masks
    that were not made here would be overwritten.
    """
    settings, start = settings or MaskSettings(), time.perf_counter()
    capture = Path(capture)
    target = capture if output is None else Path(output)
    apart = target.resolve() != capture.resolve()
    photographs = read_photographs(capture)
    settings = _possible(settings, capture, len(photographs), say)
    chosen = _chosen(capture, photographs, settings)
    left_out = _left_out(photographs, chosen, settings, apart, say)
    refuse_foreign(target, settings, overwrite)
    work = target / WORK_FOLDER / _fingerprint(settings)
    tasks = [ImageTask(photograph, work / _work_name(photograph)) for photograph in chosen]
    key = _digest([str(task.work_file.relative_to(target)) for task in tasks])
    made, done_before = None if overwrite else made_before(target, settings, tasks, key), len(tasks)
    if made:
        say(f"all {len(tasks)} images have these masks already: nothing to do (--overwrite makes them again)")
    else:
        work.mkdir(parents=True, exist_ok=True)
        done_before = sum(task.work_file.exists() for task in tasks)
        made = _make(capture, target, settings, tasks, processes or settings.processes_for(len(tasks)), key, say)
    if apart:
        make_capture_of(capture, target, chosen)  # poses may be new
    space = str(made.get("feature_space", UNKNOWN_SPACE))
    return MasksMade(target, len(tasks), done_before, made["masks"], left_out, space, time.perf_counter() - start)


# Which images, and what of them is done -----------------------------------------------------------------------------


def _chosen(capture: Path, photographs: Sequence[Photograph], settings: MaskSettings) -> list[Photograph]:
    chosen = list(photographs[:: settings.every])
    if settings.enough_views is None:
        return chosen
    return [chosen[index] for index in choose_by_coverage(capture, chosen, settings.enough_views)]


def _possible(settings: MaskSettings, capture: Path, images: int, say: Say) -> MaskSettings:
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


def _left_out(
    photographs: Sequence[Photograph], chosen: Sequence[Photograph], settings: MaskSettings, apart: bool, say: Say
) -> tuple[str, ...]:
    """Names of the images that are not used, which needs a folder of its own."""
    used = {photograph.name for photograph in chosen}
    names = tuple(photograph.name for photograph in photographs if photograph.name not in used)
    if names and not apart:
        raise OgPointcloudError(
            f"{len(names)} of {len(photographs)} images would be left out, but the pose file names them all; "
            "expected a folder for a capture of the others (-o DIR)"
        )
    if names:
        say(f"left out: {len(names)} of {len(photographs)} images ({_reason(settings)}): {', '.join(names)}")
    return names


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


# The work -----------------------------------------------------------------------------------------------------------


def _make(
    capture: Path, target: Path, settings: MaskSettings, tasks: Sequence[ImageTask], processes: int, key: str, say: Say
) -> dict[str, Any]:
    """Masks of all images, in one pass or two, and what the record says of them."""
    _work_through(capture, settings, tasks, processes, target, say)
    if settings.level in AGREED:
        tasks = _confirmed(tasks, say)
        _work_through(capture, settings, tasks, processes, target, say)
    masks, space = assemble(target, settings, tasks)
    made = {"key": key, "masks": masks, "feature_space": space}
    write_made(target, settings, tasks, **made)
    shutil.rmtree(target / WORK_FOLDER)
    return made


def _work_through(
    capture: Path, settings: MaskSettings, tasks: Sequence[ImageTask], processes: int, target: Path, say: Say
) -> None:
    """Do what is not done yet; a preview after the first images, and now and then a word on the time that remains."""
    waiting = [task for task in tasks if not task.work_file.exists()]
    if len(waiting) < len(tasks):
        say(f"{len(tasks) - len(waiting)} of {len(tasks)} images are done already")
    broken, start = [], time.perf_counter()
    last_said, previewed = start, False
    for count, (task, wrong) in enumerate(results(capture, settings, waiting, processes), 1):
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


def _confirmed(tasks: Sequence[ImageTask], say: Say) -> list[ImageTask]:
    """The second pass over images whose proposals are all there, with scores that all of them had a say in."""
    start = time.perf_counter()
    kept = [read_work(task.work_file, "scores", "seen", "inside") for task in tasks]
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
        ImageTask(
            task.photograph,
            task.work_file.with_name(f"{task.work_file.stem}.{everyone}.npz"),
            task.work_file,
            rescored(work["scores"], found, usual),
        )
        for task, work, found in zip(tasks, kept, agreed, strict=True)
    ]


def _spoken(seconds: float) -> str:
    return (
        f"{seconds:.0f} s"
        if seconds < 100
        else f"{seconds / 60:.0f} min"
        if seconds < 6000
        else f"{seconds / 3600:.1f} h"
    )


def _write_preview(target: Path, settings: MaskSettings, tasks: Sequence[ImageTask]) -> None:
    pictures = [
        (task.photograph.read(settings.longest_side), read_work(task.work_file)[f"{settings.level}_ids"])
        for task in tasks
    ]
    write_contact_sheet(target / PREVIEW_NAME, pictures)
