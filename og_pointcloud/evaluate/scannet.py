"""ScanNet point segmentation as OpenGaussian's table has it: NYU40 classes of ``*_vh_clean_2.labels.ply``.

Rules. A task is 19, 15 or 10 classes, asked by their bare names. Points of other classes, and points whose Gaussian has
an opacity below 0.1, are ignored: neither they nor what is predicted on them counts anywhere. IoU and recall are taken
per class over one scene and averaged over the classes *present in that scene*, then over scenes (macro mean).

Beside the protocol stand the answered points alone, with the share that was answered (unknown as abstention; in the
protocol it counts as wrong); and the flat mean, where each class's points of all scenes are one pool, so that a class
seen once weighs as much as one seen in every scene.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.ask.choosing import Chooser
from og_pointcloud.ask.labelled_scene import as_scene, segment
from og_pointcloud.bundle.vocabulary import carried_encoder
from og_pointcloud.errors import SceneError
from og_pointcloud.evaluate.captures import sure
from og_pointcloud.evaluate.intervals import RiskCoverage, risk_coverage
from og_pointcloud.evaluate.metrics import Score, score_labels
from og_pointcloud.evaluate.truth import read_arrays
from og_pointcloud.formats.ply import read_ply
from og_pointcloud.formats.tables import positions
from og_pointcloud.text.words import resolve_labels

__all__ = [
    "NAMES",
    "SCENES",
    "TASKS",
    "Prediction",
    "SceneScore",
    "TaskMean",
    "average",
    "read_prediction",
    "read_truth",
    "risk_over_scenes",
    "score_scene",
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
NOT_OF_THE_TABLE = 40
"""NYU40's "other property", which no task asks for: a name that is no class stays an answer, and a wrong one."""


@dataclass(frozen=True)
class Prediction:
    """ids: (n,) NYU40, below 1 unknown. confidence: (n,) larger is surer. forced: (n,) as ids, but every instance with
    a feature takes a class. Both None for stored labels."""

    ids: NDArray[np.int64]
    confidence: NDArray[np.floating] | None
    forced: NDArray[np.int64] | None


@dataclass(frozen=True)
class SceneScore:
    """One scene, one task; class ids in the scores are NYU40's.

    protocol: as published, unknown counts as wrong. answered: points with a label alone, over the classes present among
    them; answered_share: of the protocol's points.
    hits, union: by NYU40 id, (41,) int64, points of the protocol, for the flat mean.
    correct, confidence: (k,) of the protocol's points, whether each is right and how sure it is, -inf where unknown;
    confidence is None where the prediction has none. forced_miou: of `Prediction.forced`, None where that is.
    """

    protocol: Score
    answered: Score
    answered_share: float
    hits: NDArray[np.int64]
    union: NDArray[np.int64]
    correct: NDArray[np.bool_]
    confidence: NDArray[np.float64] | None
    forced_miou: float | None


@dataclass(frozen=True)
class TaskMean:
    """Means over scenes: macro means of the protocol's mIoU and mAcc (as published), and the flat mIoU over pooled
    points; of the mIoU with forced answers (None where a scene has none) and of the answered points, with their share.
    Scenes with no point of the task have no mean and are left out; NaN where none is left."""

    miou: float
    macc: float
    flat_miou: float
    forced_miou: float | None
    answered: float
    answered_share: float
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


def read_prediction(file: Path, xyz: NDArray[np.float64], task: int, text_features: Path | None = None) -> Prediction:
    """What a file says of a scene's vertices: a .ogpc is asked for the task's names, labels of a .npz are taken by
    their names. xyz: (n, 3) world coordinates. SceneError where the labels are not one each vertex, or damaged."""
    if file.suffix != ".ogpc":
        return Prediction(_stored_labels(file, len(xyz)), None, None)
    scene, ids = as_scene(file), np.array([*TASKS[task], 0])  # the last is what label -1 takes: unknown
    names = [NAMES[class_id] for class_id in TASKS[task]]
    words = resolve_labels(names, text_features, scene.vocabulary, scene.feature_space, carried_encoder(scene.path))
    result = segment(xyz, words, scene=scene)
    # Of a scene that may not say that none fits: the largest cosine.
    forced = Chooser(scene.cloud.instances).choose(words.vectors).at(result.instances)[0]
    confidence = sure(result.scores, result.calibrated, result.certainty)
    return Prediction(ids[np.maximum(result.labels, -1)], confidence, ids[np.maximum(forced, -1)])


def _stored_labels(file: Path, points: int) -> NDArray[np.int64]:
    """(n,) NYU40 ids of an .npz as ``segment -o`` writes it: labels index names, below 0 is unknown."""
    arrays = read_arrays(file)
    missing = [name for name in ("labels", "names") if name not in arrays]
    if missing:
        raise SceneError(f"{file} lacks '{missing[0]}'; expected labels and names: segment the scene again")
    labels, names = arrays["labels"], arrays["names"]
    if labels.shape != (points,) or labels.dtype.kind not in "iu" or names.ndim != 1 or names.dtype.kind != "U":
        raise SceneError(
            f"{file}: labels are {labels.dtype} {labels.shape}, names {names.dtype} {names.shape}; expected whole "
            f"numbers ({points},), one for each of the scene's points, and strings (names,)"
        )
    if labels.max(initial=-1) >= len(names):
        raise SceneError(f"{file}: label {labels.max()} has no name (there are {len(names)})")
    ids = {name: class_id for class_id, name in NAMES.items()}
    id_of_label = np.array([*(ids.get(name, NOT_OF_THE_TABLE) for name in names.tolist()), 0])
    return id_of_label[np.maximum(labels.astype(np.int64), -1)]


def score_scene(
    predicted: NDArray[np.integer], truth: NDArray[np.integer], task: int, opacity: NDArray[np.floating] | None = None,
    confidence: NDArray[np.floating] | None = None, forced: NDArray[np.integer] | None = None,
) -> SceneScore:  # fmt: skip
    """Score one scene.

    predicted: (n,) NYU40 ids, below 1 for unknown; an id outside the task is a wrong answer. truth: (n,) NYU40 ids.
    task: 19, 15 or 10. opacity: (n,) of each point's Gaussian; None counts all points. confidence, forced: (n,), as of
    `Prediction`.
    """
    if task not in TASKS:
        raise SceneError(f"the task is {task} classes; expected one of {', '.join(map(str, TASKS))}")
    truth, predicted = np.asarray(truth), np.asarray(predicted)
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
    surely = None if confidence is None else np.where(called > 0, np.asarray(confidence, np.float64), -np.inf)[counted]
    return SceneScore(
        protocol=score_labels(called, of_task, scored=opaque, min_points=1),
        answered=score_labels(called, of_task, scored=answered, min_points=1),
        answered_share=float(answered.sum() / counted.sum()) if counted.any() else float("nan"),
        hits=hits,
        union=np.bincount(truth[counted], minlength=NYU40_LARGEST + 1) + called_there - hits,
        correct=(called == truth)[counted],
        confidence=surely,
        forced_miou=None if forced is None else score_scene(forced, truth, task, opacity).protocol.miou,
    )


def average(scores: Sequence[SceneScore]) -> TaskMean:
    """The means of one task over scenes."""
    present = [score for score in scores if score.protocol.classes]
    flat = float("nan")
    if present:
        hits, union = (np.sum([getattr(score, name) for score in present], axis=0) for name in ("hits", "union"))
        classes = sorted({class_id for score in present for class_id in score.protocol.classes})
        flat = float(np.mean(hits[classes] / union[classes]))
    forced = [score.forced_miou for score in scores if score.forced_miou is not None]
    return TaskMean(
        miou=_mean([score.protocol.miou for score in scores]),
        macc=_mean([score.protocol.macc for score in scores]),
        flat_miou=flat,
        forced_miou=_mean(forced) if len(forced) == len(scores) else None,
        answered=_mean([score.answered.miou for score in scores]),
        answered_share=_mean([score.answered_share for score in scores]),
        scenes=len(present),
    )


def risk_over_scenes(scores: Sequence[SceneScore]) -> tuple[RiskCoverage | None, float]:
    """Risk against coverage of the protocol's points of all scenes together, None where a scene has no confidences or
    none has a point; and the share of these points that is answered, NaN where there is none."""
    correct = np.concatenate([score.correct for score in scores])
    if len(correct) == 0:
        return None, float("nan")
    answered = sum(score.answered.points for score in scores) / len(correct)
    known = [score.confidence for score in scores if score.confidence is not None]
    return risk_coverage(correct, np.concatenate(known)) if len(known) == len(scores) else None, answered


def _mean(values: Sequence[float]) -> float:
    """Of the scenes that have the figure."""
    finite = [value for value in values if np.isfinite(value)]
    return float(np.mean(finite)) if finite else float("nan")
