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
    """ids: (n,) NYU40, below 1 unknown. confidence: (n,) larger is surer; None where a file of labels has none. forced:
    (n,) as ids, but every instance with a feature takes a class; None for stored labels. foreign: names said that are
    no class of the table."""

    ids: NDArray[np.int64]
    confidence: NDArray[np.floating] | None
    forced: NDArray[np.int64] | None
    foreign: frozenset[str]


@dataclass(frozen=True)
class SceneScore:
    """One scene, one task; class ids in the scores are NYU40's.

    protocol: as published, unknown counts as wrong. all_points: with the transparent ones. answered: points with a
    label alone, over the classes present among them; answered_share: of the protocol's points.
    hits, union: by NYU40 id, (41,) int64, points of the protocol, for the flat mean.
    correct, confidence: (k,) of the protocol's points, whether each is right and how sure it is, -inf where unknown;
    confidence is None where the prediction has none. forced_miou: of `Prediction.forced`, None where that is.
    """

    protocol: Score
    all_points: Score
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
    points; of the mIoU with forced answers (None where a scene has none), of all points, and of the answered ones, with
    their share. Scenes with no point of the task have no mean and are left out; NaN where none is left."""

    miou: float
    macc: float
    flat_miou: float
    forced_miou: float | None
    all_points: float
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
    forced = None
    if file.suffix == ".ogpc":
        asked = [NAMES[class_id] for class_id in TASKS[task]]
        labels, confidence, forced = _asked_labels(file, xyz, asked, text_features)
    else:
        labels, confidence, asked = _stored_labels(file)
    if len(labels) != len(xyz):
        raise SceneError(f"{file} has {len(labels)} labels, the scene {len(xyz)} points; expected one each")
    if len(labels) and labels.max() >= len(asked):
        raise SceneError(f"{file}: label {labels.max()} has no name (there are {len(asked)})")
    ids = {name: class_id for class_id, name in NAMES.items()}
    id_of_label = np.array([*(ids.get(name, NOT_OF_THE_TABLE) for name in asked), 0])
    foreign = frozenset(asked[label] for label in np.unique(labels[labels >= 0]) if asked[label] not in ids)
    forced_ids = None if forced is None else id_of_label[np.maximum(forced, -1)]
    return Prediction(id_of_label[np.maximum(labels, -1)], confidence, forced_ids, foreign)


def _asked_labels(
    file: Path, xyz: NDArray[np.float64], names: list[str], text_features: Path | None
) -> tuple[NDArray[np.integer], NDArray[np.floating], NDArray[np.integer]]:
    """(n,) labels, how sure they are, and the labels of a scene that may not say that none fits: the largest cosine."""
    scene = as_scene(file)
    words = resolve_labels(names, text_features, scene.vocabulary, scene.feature_space, carried_encoder(scene.path))
    result = segment(xyz, words, scene=scene)
    forced = Chooser(scene.cloud.instances).choose(words.vectors).at(result.instances)[0]
    return result.labels, sure(result.scores, result.calibrated, result.certainty), forced


def _stored_labels(file: Path) -> tuple[NDArray[np.integer], NDArray[np.floating] | None, list[str]]:
    """(n,) indices of names, below 0 unknown; (n,) how sure they are, if that is known; the names. As ``segment -o``
    writes: scores, and where it is known the certainty of each point."""
    arrays = read_arrays(file)
    missing = [name for name in ("labels", "names") if name not in arrays]
    if missing:
        raise SceneError(f"{file} lacks '{missing[0]}'; expected labels and names: segment the scene again")
    labels, names, scores, certainty = (arrays.get(name) for name in ("labels", "names", "scores", "certainty"))
    assert labels is not None
    assert names is not None
    if labels.ndim != 1 or labels.dtype.kind not in "iu" or names.ndim != 1 or names.dtype.kind != "U":
        raise SceneError(
            f"{file}: labels are {labels.dtype} {labels.shape}, names {names.dtype} {names.shape}; expected whole "
            "numbers (points,) and strings (names,)"
        )
    for name, numbers in (("scores", scores), ("certainty", certainty)):
        if numbers is None:
            continue
        if numbers.shape != labels.shape or numbers.dtype.kind != "f" or np.isnan(numbers).any():
            raise SceneError(f"{file}: {name} are {numbers.dtype} {numbers.shape}; expected numbers {labels.shape}")
    if scores is not None and certainty is not None:
        scores = sure(scores, bool(arrays.get("calibrated", False)), certainty)
    return labels.astype(np.int64), scores, names.tolist()


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
        all_points=score_labels(called, of_task, min_points=1),
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
        all_points=_mean([score.all_points.miou for score in scores]),
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
