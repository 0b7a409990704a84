"""The files that masks end in, and the record beside them by which the next run knows them as ours."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.errors import OgPointcloudError
from og_pointcloud.formats.atomic import replacing
from og_pointcloud.formats.images import require_cv2
from og_pointcloud.formats.langsplat import LANGUAGE_FEATURES_FOLDER
from og_pointcloud.formats.mask_files import FEATURES_NAME, MASKS_FOLDER, UNKNOWN_SPACE
from og_pointcloud.formats.nerfstudio import TRANSFORMS_NAMES
from og_pointcloud.masking.image_worker import ImageTask, read_work
from og_pointcloud.masking.photographs import Photograph
from og_pointcloud.masking.settings import MaskSettings

__all__ = ["WORK_FOLDER", "assemble", "made_before", "make_capture_of", "refuse_foreign", "write_made"]

WORK_FOLDER = "masks.work"
MADE_NAME = "made.json"
LANGSPLAT_LEVELS = ("middle", "small", "middle", "large")
"""Our levels in the order of LangSplat's: default, small, medium, large."""


def _folder(target: Path, settings: MaskSettings) -> Path:
    return target / (LANGUAGE_FEATURES_FOLDER if settings.langsplat else MASKS_FOLDER)


def refuse_foreign(target: Path, settings: MaskSettings, overwrite: bool) -> None:
    """OgPointcloudError where masks or features of somebody else would be replaced."""
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


def made_before(target: Path, settings: MaskSettings, tasks: Sequence[ImageTask], key: str) -> dict[str, Any] | None:
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


def assemble(target: Path, settings: MaskSettings, tasks: Sequence[ImageTask]) -> tuple[int, str]:
    """Work files -> the capture's files. Number of masks on the level of `settings`, and the feature space."""
    folder = _folder(target, settings)
    folder.mkdir(parents=True, exist_ok=True)
    write_made(target, settings, tasks)  # first: killed here, the next run knows the folder as ours, but not as whole
    write = _write_langsplat if settings.langsplat else _write_mask_image
    features: dict[str, Any] = {}
    masks, space = 0, UNKNOWN_SPACE
    for task in tasks:
        work = read_work(task.work_file)
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


def write_made(target: Path, settings: MaskSettings, tasks: Sequence[ImageTask], **whole: Any) -> None:
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


def make_capture_of(capture: Path, target: Path, chosen: Sequence[Photograph]) -> None:
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
