"""LeRF-OVS object selection: ``label/<scene>/frame_00041.json``, the outlines of the objects that are asked for.

Rules. A text selects Gaussians, these alone are rendered, and where their alpha is above 0.7 is the predicted mask. A
(frame, object) pair scores the IoU with the outlined mask, 0 where nothing is selected or rendered; several outlines of
one category in a frame are one object. mIoU is the mean over a scene's pairs, accuracy the share of pairs with an IoU
above 0.25; the table's figure is the mean of the four scenes (macro), beside which stands that of all pairs (flat).
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.errors import SceneError
from og_pointcloud.formats.images import MAX_PIXELS, require_cv2

__all__ = ["PAIRS", "LabelledFrame", "LerfScore", "pair_ious", "read_frame", "score_scenes"]

ALPHA_SHOWN, IOU_FOUND = 0.7, 0.25
PAIRS: Mapping[str, int] = {"figurines": 56, "ramen": 71, "teatime": 59, "waldo_kitchen": 22}
"""The (frame, object) pairs of the published table, by scene."""


@dataclass(frozen=True)
class LabelledFrame:
    """name: file stem of the image. width, height: its pixels. objects: category -> (H, W) bool."""

    name: str
    width: int
    height: int
    objects: dict[str, NDArray[np.bool_]]


@dataclass(frozen=True)
class LerfScore:
    """miou, accuracy: macro, over scenes. flat_miou, flat_accuracy: over all pairs. pairs: their number."""

    miou: float
    accuracy: float
    flat_miou: float
    flat_accuracy: float
    pairs: int


def read_frame(file: str | Path) -> LabelledFrame:
    """One label file. SceneError names the file, the object and what was expected."""
    try:
        content: Any = json.loads(Path(file).read_text(encoding="utf-8"))
        info, objects = content["info"], content["objects"]
        name, width, height = str(info["name"]), int(info["width"]), int(info["height"])
        outlines = [(str(entry["category"]), entry["segmentation"]) for entry in objects]
    except (ValueError, TypeError, KeyError, RecursionError, OverflowError) as error:
        raise SceneError(
            f"{file} is no label file of LeRF-OVS with info and objects ({error}): copy it again"
        ) from None
    if min(width, height) < 1 or width * height > MAX_PIXELS:
        raise SceneError(f"{file} is of an image of {width}x{height} pixels; expected 1 to {MAX_PIXELS}")
    masks: dict[str, NDArray[np.bool_]] = {}
    for category, outline in outlines:
        mask = _filled(outline, (height, width), f"{file}, object '{category}'")
        masks[category] = masks[category] | mask if category in masks else mask
    return LabelledFrame(Path(name).stem, width, height, masks)


def pair_ious(frame: LabelledFrame, alphas: Mapping[str, NDArray[np.floating]]) -> dict[str, float]:
    """IoU of each object of a frame. alphas: category -> (H, W) alpha of its selection's render; absent: 0."""
    found = {}
    for category, truth in frame.objects.items():
        alpha = alphas.get(category)
        if alpha is not None and alpha.shape != truth.shape:
            raise SceneError(
                f"frame '{frame.name}', '{category}': the render is {alpha.shape}, the label {truth.shape}; expected "
                "the label's size: render at the labelled image's resolution"
            )
        shown = np.zeros(truth.shape, bool) if alpha is None else alpha > ALPHA_SHOWN
        union = int((shown | truth).sum())
        found[category] = int((shown & truth).sum()) / union if union else 0.0
    return found


def score_scenes(ious: Mapping[str, NDArray[np.floating]]) -> LerfScore:
    """ious: scene -> (pairs,) IoU of all its (frame, object) pairs. Scenes without a pair are left out."""
    scenes = [np.asarray(values, np.float64) for values in ious.values() if len(values)]
    if not scenes:
        raise SceneError("no labelled object in any frame; expected at least one")
    every = np.concatenate(scenes)
    return LerfScore(
        miou=float(np.mean([scene.mean() for scene in scenes])),
        accuracy=float(np.mean([(scene > IOU_FOUND).mean() for scene in scenes])),
        flat_miou=float(every.mean()),
        flat_accuracy=float((every > IOU_FOUND).mean()),
        pairs=len(every),
    )


def _filled(outline: Any, shape: tuple[int, int], source: str) -> NDArray[np.bool_]:
    try:
        corners = np.array(outline, np.float64)
    except (ValueError, TypeError):
        corners = np.empty((0, 0))
    if corners.ndim != 2 or corners.shape[1] != 2 or len(corners) < 3 or not np.isfinite(corners).all():
        raise SceneError(f"{source}: the outline is {outline!r:.60}; expected at least three [x, y]")
    mask = np.zeros(shape, np.uint8)
    limit = 1 << 20  # OpenCV takes 32-bit integers; what lies that far outside is cut either way
    require_cv2().fillPoly(mask, [np.clip(np.rint(corners), -limit, limit).astype(np.int32)], 1)
    return mask.astype(bool)
