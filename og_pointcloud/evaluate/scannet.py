"""ScanNet point segmentation as OpenGaussian's table has it: NYU40 classes of ``*_vh_clean_2.labels.ply``.

Rules. A task is 19, 15 or 10 classes, asked by their bare names. Points of other classes, and points whose Gaussian has
an opacity below 0.1, are ignored: neither they nor what is predicted on them counts anywhere. IoU and recall are taken
per class over one scene and averaged over the classes *present in that scene*, then over scenes (macro mean).

Beside the protocol stand: all points, with the transparent ones; the answered points alone, with the share that was
answered (unknown as abstention; in the protocol it counts as wrong); and the flat mean, where each class's points of
all scenes are one pool, so that a class seen once weighs as much as one seen in every scene.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.errors import SceneError
from og_pointcloud.evaluate.metrics import Score, score_labels
from og_pointcloud.formats.ply import read_ply
from og_pointcloud.formats.tables import positions

__all__ = [
    "NAMES",
    "SCENES",
    "TASKS",
    "SceneScore",
    "TaskMean",
    "average",
    "read_truth",
    "score_scene",
    "scored_answers",
]

NAMES: Mapping[int, str] = {
    1: "wall", 2: "floor", 3: "cabinet", 4: "bed", 5: "chair", 6: "sofa", 7: "table", 8: "door", 9: "window",
    10: "bookshelf", 11: "picture", 12: "counter", 14: "desk", 16: "curtain", 24: "refrigerator",
    28: "shower curtain", 33: "toilet", 34: "sink", 36: "bathtub",
}  # fmt: skip
"""NYU40 ids and names of the 19 classes."""
TASKS: Mapping[int, tuple[int, ...]] = {
    19: tuple(NAMES),
    15: (1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 12, 14, 16, 33, 34),
    10: (1, 2, 4, 5, 6, 7, 8, 9, 10, 33),
}
"""NYU40 ids of each task, by its number of classes."""
SCENES = tuple(f"scene{number:04}_00" for number in (0, 62, 70, 97, 140, 200, 347, 400, 590, 645))
"""The ten scenes of the table."""
OPACITY_COUNTED = 0.1
NYU40_LARGEST = 40


@dataclass(frozen=True)
class SceneScore:
    """One scene, one task; class ids in the scores are NYU40's.

    protocol: as published, unknown counts as wrong. all_points: with the transparent ones. answered: points with a
    label alone, over the classes present among them; answered_share: of the protocol's points.
    hits, union: by NYU40 id, (41,) int64, points of the protocol, for the flat mean.
    """

    protocol: Score
    all_points: Score
    answered: Score
    answered_share: float
    hits: NDArray[np.int64]
    union: NDArray[np.int64]


@dataclass(frozen=True)
class TaskMean:
    """Over scenes: macro means of the protocol's mIoU and mAcc (as published), and the flat mIoU over pooled points.
    Scenes with no point of the task have no mean and are left out; NaN where none is left."""

    miou: float
    macc: float
    flat_miou: float
    scenes: int


def read_truth(file: str | Path) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """xyz (n, 3) and NYU40 ids (n,), 0 unlabelled, of a ``*.labels.ply``. SceneError names file and cure."""
    elements = read_ply(Path(file))
    vertices = elements.get("vertex")
    if vertices is None or "label" not in (vertices.dtype.names or ()):
        raise SceneError(f"{file} has no vertices with a property 'label'; expected ScanNet's *_vh_clean_2.labels.ply")
    labels = vertices["label"].astype(np.int64)
    if len(labels) and not 0 <= labels.min() <= labels.max() <= NYU40_LARGEST:
        raise SceneError(
            f"{file}: labels span {labels.min()}..{labels.max()}; expected NYU40 ids 0..{NYU40_LARGEST}: take the "
            "labels of ScanNet v2, not those of ScanNet200"
        )
    return positions(vertices), labels.astype(np.int32)


def score_scene(
    predicted: NDArray[np.integer], truth: NDArray[np.integer], task: int, opacity: NDArray[np.floating] | None = None
) -> SceneScore:
    """Score one scene.

    predicted: (n,) NYU40 ids, below 1 for unknown; an id outside the task is a wrong answer. truth: (n,) NYU40 ids.
    task: 19, 15 or 10. opacity: (n,) of each point's Gaussian; None counts all points.
    """
    if task not in TASKS:
        raise SceneError(f"the task is {task} classes; expected one of {', '.join(map(str, TASKS))}")
    truth = np.asarray(truth)
    predicted = np.asarray(predicted)
    for name, values in (("predictions", predicted), ("opacities", opacity)):
        if values is not None and values.shape != truth.shape:
            raise SceneError(f"{name} have shape {values.shape}, the labels {truth.shape}; expected one a point")
    of_task = np.where(np.isin(truth, TASKS[task]), truth, -1)
    called = np.where(predicted > 0, predicted, -1)
    opaque = np.ones(truth.shape, bool) if opacity is None else opacity >= OPACITY_COUNTED
    counted = opaque & (of_task > 0)
    answered = counted & (called > 0)
    hits = np.bincount(truth[counted & (called == truth)], minlength=NYU40_LARGEST + 1)
    called_there = np.bincount(called[answered & (called <= NYU40_LARGEST)], minlength=NYU40_LARGEST + 1)
    union = np.bincount(truth[counted], minlength=NYU40_LARGEST + 1) + called_there - hits
    return SceneScore(
        protocol=score_labels(called, of_task, scored=opaque, min_points=1),
        all_points=score_labels(called, of_task, min_points=1),
        answered=score_labels(called, of_task, scored=answered, min_points=1),
        answered_share=float(answered.sum() / counted.sum()) if counted.any() else float("nan"),
        hits=hits,
        union=union,
    )


def scored_answers(
    predicted: NDArray[np.integer], confidence: NDArray[np.floating], truth: NDArray[np.integer], task: int,
    opacity: NDArray[np.floating] | None = None,
) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:  # fmt: skip
    """Of the protocol's points, whether each is right, and how sure it is, -inf where unknown: what
    `spread.risk_coverage` takes. Arguments as for `score_scene`; confidence: (n,)."""
    counted = np.isin(truth, TASKS[task]) & (True if opacity is None else opacity >= OPACITY_COUNTED)
    surely = np.where(predicted > 0, np.asarray(confidence, np.float64), -np.inf)
    return (predicted == truth)[counted], surely[counted]


def average(scores: Sequence[SceneScore]) -> TaskMean:
    """The means of one task over scenes."""
    present = [score for score in scores if score.protocol.classes]
    if not present:
        return TaskMean(float("nan"), float("nan"), float("nan"), 0)
    hits, union = (np.sum([getattr(score, name) for score in present], axis=0) for name in ("hits", "union"))
    classes = sorted({class_id for score in present for class_id in score.protocol.classes})
    return TaskMean(
        miou=float(np.mean([score.protocol.miou for score in present])),
        macc=float(np.mean([score.protocol.macc for score in present])),
        flat_miou=float(np.mean(hits[classes] / union[classes])),
        scenes=len(present),
    )
