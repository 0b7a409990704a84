"""Photographs -> masks and mask features in a capture folder: resumable, nothing half-written.

The masks of each image are first a separate file in ``masks.work/``, written whole or not at all. Once complete, they
become ``masks/`` with ``mask_features.npz``, and ``masks.work/`` is removed. After a kill at any moment, the same
command resumes after the last finished image; if everything is finished, it does nothing. ``made.json`` beside
the masks records that they were made here, and how.
"""

from __future__ import annotations

import json
import shutil
import time
import warnings
import zipfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from hashlib import blake2b
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.cloud import UNKNOWN_SPACE
from og_pointcloud.errors import OgPointcloudError, SceneError
from og_pointcloud.formats.atomic import StrPath, locked, replacing, write_json
from og_pointcloud.formats.images import write_png
from og_pointcloud.formats.langsplat import LANGUAGE_FEATURES_FOLDER
from og_pointcloud.formats.mask_files import FEATURES_NAME, MADE_NAME, MASKS_FOLDER, TRACKS
from og_pointcloud.formats.nerfstudio import TRANSFORMS_NAMES
from og_pointcloud.formats.poses import read_json_object
from og_pointcloud.journal import with_bar
from og_pointcloud.masking.contracts import MaskSettings
from og_pointcloud.masking.encode import encoder_folder
from og_pointcloud.masking.existing import ExistingMasks, user_source
from og_pointcloud.masking.photographs import Photograph, read_photographs, write_contact_sheet
from og_pointcloud.masking.worker import ImageTask, read_work, results
from og_pointcloud.models import model_folder

VERSION = 4
"""Version of the contents of an image's work file; files of other versions are made again."""
WORK_FOLDER = "masks.work"
PREVIEW_NAME = "masks_preview.png"
PREVIEW_IMAGES = 4


@dataclass(frozen=True)
class MasksMade:
    """images: number used; done_before: number of these that an interrupted run had done. masks: total number.
    left_out: names of images that were not used. seconds: wall clock."""

    output: Path
    images: int
    done_before: int
    masks: int
    left_out: tuple[str, ...]
    feature_space: str
    seconds: float


def make_masks(
    capture: StrPath,
    settings: MaskSettings | None = None,
    output: StrPath | None = None,
    *,
    overwrite: bool = False,
    progress: bool = True,
) -> MasksMade:
    """Make the masks of a capture folder, readable by `read_capture`.

    output: where they go; None: into the capture. Another folder becomes a separate capture: poses of the images that
    are used, and links to everything else. It is required where images are left out.
    overwrite: replace masks that were not made here, and make complete ones again. progress: show a bar with the
    remaining time where stderr is a terminal; masks_preview.png shows the first images as soon as they are done.
    Warns of each image that is broken, and raises SceneError once the others are finished and saved; OgPointcloudError
    where masks that were not made here would be overwritten.
    """
    settings, start = settings or MaskSettings(), time.perf_counter()
    capture = Path(capture)
    target = capture if output is None else Path(output)
    separate = target.resolve() != capture.resolve()
    photographs = read_photographs(capture)
    # Every n-th image, with all its faces.
    used = set(list(dict.fromkeys(photograph.path for photograph in photographs))[:: settings.every])
    chosen = tuple(photograph for photograph in photographs if photograph.path in used)
    left_out = _left_out(photographs, chosen, separate)
    _refuse_name(chosen)
    _refuse_foreign(target, overwrite, settings.folder)
    # Names of work files encode everything that determines their contents, so that existing ones can be reused.
    work = target / WORK_FOLDER / _fingerprint(settings)
    tasks = [ImageTask(each, work / f"{_digest(_state_of(each, settings.folder))}.npz") for each in chosen]
    key = _digest([str(task.work_file.relative_to(target)) for task in tasks])
    made, done_before = None if overwrite else _made_before(target, tasks, key), len(tasks)
    if made is None:
        with locked(target / WORK_FOLDER):
            work.mkdir(parents=True, exist_ok=True)
            done_before = sum(task.work_file.exists() for task in tasks)
            _work_through(settings, tasks, target, progress)
            masks, space = _assemble(target, settings, tasks)
            made = {"key": key, "masks": masks, "feature_space": space}
            _write_made(target, settings, tasks, **made)
            shutil.rmtree(target / WORK_FOLDER)
    if separate:
        _make_capture_of(capture, target, chosen)  # also where masks were complete: poses may have changed
    space = str(made.get("feature_space", UNKNOWN_SPACE))
    return MasksMade(target, len(tasks), done_before, made["masks"], left_out, space, time.perf_counter() - start)


# Which images, and which are finished -------------------------------------------------------------------------------


def _left_out(photographs: Sequence[Photograph], chosen: Sequence[Photograph], separate: bool) -> tuple[str, ...]:
    """Names of the images that are not used; OgPointcloudError if there are any and the output is not a separate
    folder."""
    used = {photograph.name for photograph in chosen}
    names = tuple(photograph.name for photograph in photographs if photograph.name not in used)
    if names and not separate:
        raise OgPointcloudError(
            f"{len(names)} of {len(photographs)} images would be left out, but the pose file names them all; "
            "expected a separate folder for a capture of the rest (-o DIR)"
        )
    return names


def _refuse_name(chosen: Sequence[Photograph]) -> None:
    """OgPointcloudError for an image whose features would replace the name of their encoder."""
    for photograph in chosen:
        if photograph.name == "feature_space":
            raise OgPointcloudError(
                f"{photograph.file} has the name by which {FEATURES_NAME} states the encoder; expected another one: "
                "rename the image, in the pose file too"
            )


def _fingerprint(settings: MaskSettings) -> str:
    """A name for settings and the user's code, models and COCO files that they refer to: other work files are not
    reused."""
    of_image = replace(settings, every=1)  # which images are used does not change the masks of any
    kind, _, place = settings.proposer.partition(":")
    given = user_source(place) if kind == "python" else []
    if settings.folder:  # not all files in it: it may be the capture; those of single images are in `_state_of`
        given = sorted(settings.folder.glob("*.json"))
    encoder, model = settings.encoder, place if kind == "sam" else None
    models = encoder_folder(encoder) if encoder else None, model_folder(model) if model else None
    given = [*given, *(file for folder in models if folder for file in sorted(folder.rglob("*")))]
    return _digest([VERSION, asdict(of_image), [_state(file) for file in given if file.is_file()]])


def _state_of(photograph: Photograph, folder: Path | None) -> list[Any]:
    """What decides the pixels of a photograph, and its masks in a folder of the user's. Those of a face depend on the
    lens."""
    face = photograph.face
    cameras = [] if face is None else [[of.width, of.height, *of.intrinsics] for of in (face.camera, face.whole)]
    turns = [photograph.quarter_turns] if photograph.quarter_turns else []
    masks = ExistingMasks(folder).files(photograph.name, face) if folder else []
    return [
        photograph.name, *_state(photograph.file), *cameras, *([asdict(face.lens)] if face else []), *turns,
        *map(_state, masks),
    ]  # fmt: skip


def _state(file: Path) -> tuple[str, int, int]:
    """Name, size and time of a file, which change when the file does."""
    state = file.stat()
    return file.name, state.st_size, state.st_mtime_ns


def _digest(value: list[Any]) -> str:
    return blake2b(json.dumps(value).encode(), digest_size=12).hexdigest()


# The work -----------------------------------------------------------------------------------------------------------


def _work_through(settings: MaskSettings, tasks: Sequence[ImageTask], target: Path, progress: bool) -> None:
    """Process the unfinished images, with a preview after the first ones."""
    waiting = [task for task in tasks if not task.work_file.exists()]
    broken, previewed = [], False
    made = with_bar(results(settings, waiting, len(tasks) - len(waiting)), "masks", len(waiting), progress)
    for wrong in chain([None], made):  # first, the preview of images that an interrupted run has done
        if wrong:
            broken.append(wrong)
            warnings.warn(wrong, stacklevel=4)
        # So that wrong masks are noticed after the first images, not after a night.
        done = [] if previewed else [task for task in tasks if task.work_file.exists()]
        if len(done) >= min(PREVIEW_IMAGES, len(tasks)):
            write_contact_sheet(target / PREVIEW_NAME, [_shown(task, settings) for task in done[:PREVIEW_IMAGES]])
            previewed = True
    if broken:
        raise SceneError(
            f"{len(broken)} of {len(tasks)} images cannot be used, the first: {broken[0]}; masks of the others are "
            f"kept in '{target / WORK_FOLDER}': repair or remove these images, then run the same command again"
        )


def _shown(task: ImageTask, settings: MaskSettings) -> tuple[NDArray[np.uint8], NDArray[np.int32]]:
    """An image and its ids, upright."""
    photograph = task.photograph
    image, ids = photograph.read(settings.longest_side), read_work(task.work_file)["ids"]
    return np.rot90(image, photograph.quarter_turns), np.rot90(ids, photograph.quarter_turns)


# The final files, and the record by which the next run recognizes them --------------------------------------------


def _refuse_foreign(target: Path, overwrite: bool, given: Path | None) -> None:
    """OgPointcloudError where masks or features that were not made here would be replaced, or folders are links.
    given: the user's folder of masks."""
    folder, features = target / MASKS_FOLDER, target / FEATURES_NAME
    if given is not None and given.resolve() == folder.resolve():
        raise OgPointcloudError(
            f"the masks in {given} would be replaced by those made of them; expected a folder that is only read: give "
            "another output (-o DIR), or move them"
        )
    for link in (folder, target / WORK_FOLDER):
        if link.is_symlink():  # an untrusted capture could redirect masks anywhere
            raise OgPointcloudError(
                f"{link} is a link to '{link.readlink()}'; expected a real folder, as nothing is written "
                "through links: remove the link, or give another folder (-o DIR)"
            )
    if overwrite or (folder / MADE_NAME).is_file():
        return
    # Hidden files are no masks: a killed run leaves one where it had just begun to write.
    found = folder if folder.is_dir() and any(file.name[0] != "." for file in folder.iterdir()) else features
    if found.exists():
        raise OgPointcloudError(
            f"{found} was not made by this command and would be replaced; expected nothing there: give another folder "
            "(-o DIR), or --overwrite"
        )


def _made_before(target: Path, tasks: Sequence[ImageTask], key: str) -> dict[str, Any] | None:
    """The record of a run that made the same masks of the same images, if all its files are still there."""
    folder = target / MASKS_FOLDER
    try:
        made = read_json_object(folder / MADE_NAME)  # of a capture that may come from a stranger
    except SceneError:
        return None
    files = [target / FEATURES_NAME, *(folder / f"{task.photograph.name}.png" for task in tasks)]
    same = made.get("key") == key and isinstance(made.get("masks"), int)
    return made if same and all(file.is_file() for file in files) else None


def _assemble(target: Path, settings: MaskSettings, tasks: Sequence[ImageTask]) -> tuple[int, str]:
    """Write the capture's files from the work files; returns the number of masks and the feature space."""
    folder = target / MASKS_FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    # First, and without a key: after a kill from here on, the next run recognizes the folder as ours but incomplete.
    _write_made(target, settings, tasks)
    # Their rows belong to the masks that are replaced here: until the end the capture is without any.
    (target / FEATURES_NAME).unlink(missing_ok=True)
    features: dict[str, Any] = {}
    space, masks = UNKNOWN_SPACE, 0
    for task in tasks:
        work = read_work(task.work_file)
        name, space = task.photograph.name, str(work["feature_space"])
        features[name], masks = work["features"], masks + len(work["features"])
        if "tracks" in work:
            features[name + TRACKS] = work["tracks"]
        # 16 bit: 0 outside every mask, else the feature row + 1
        write_png(folder / f"{name}.png", (work["ids"] + 1).astype(np.uint16))
    with replacing(target / FEATURES_NAME) as file, zipfile.ZipFile(file, "w") as archive:
        # Not numpy.savez: it would take an image called "file" for its own argument.
        for name, array in {"feature_space": np.array(space), **features}.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, array, allow_pickle=False)
    return masks, space


def _write_made(target: Path, settings: MaskSettings, tasks: Sequence[ImageTask], **record: Any) -> None:
    """Write made.json. record: added at the end of a run."""
    named = {key: _last_part(value) for key, value in asdict(settings).items()}
    made = {"made_by": "og-pointcloud masks", **named, "images": len(tasks), **record}
    write_json(target / MASKS_FOLDER / MADE_NAME, made)


def _last_part(value: Any) -> Any:
    """A path reduced to its last part: captures are shared, and paths of models on this machine are private."""
    kind, colon, name = value.rpartition(":") if isinstance(value, str) else ("", "", "")
    return f"{kind}{colon}{Path(name).name}" if Path(name).is_absolute() else value


def _make_capture_of(capture: Path, target: Path, chosen: Sequence[Photograph]) -> None:
    """Write poses of the chosen images, and links to everything else that the capture has and the target lacks."""
    kept = {photograph.path for photograph in chosen}
    others = {MASKS_FOLDER, FEATURES_NAME, LANGUAGE_FEATURES_FOLDER, WORK_FOLDER}
    pose_file = next((name for name in TRANSFORMS_NAMES if (capture / name).is_file()), None)  # the others are not read
    for source in sorted(capture.resolve().iterdir()):
        if source.name in others or source == target.resolve():  # the target may lie in the capture
            continue
        place = target / source.name
        if source.name == pose_file:
            content = read_json_object(source)
            frames = content["frames"]
            content["frames"] = [frame for frame in frames if frame["file_path"].replace("\\", "/") in kept]
            write_json(place, content)
        elif not place.exists():
            place.unlink(missing_ok=True)  # a link to a capture that was moved
            place.symlink_to(source)
