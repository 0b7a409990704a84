"""A labelled scene against its capture's ground truth: scores of labels, their intervals, and scores of instances.

Labels are scored as everywhere in this library: a point without a label is a miss, a class called on known background
a false alarm. Labelled points are also scored alone, to show the effect of abstaining. Intervals are over blocks of
space (`intervals`). If the truth has instances, the scene's are compared with them as partitions of the points.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.ask.labelled_scene import SceneLike, as_scene, segment
from og_pointcloud.errors import SceneError
from og_pointcloud.evaluate.intervals import BlockInterval, miou_interval
from og_pointcloud.evaluate.metrics import Score, adjusted_rand_index, score_labels
from og_pointcloud.evaluate.truth import Truth


@dataclass(frozen=True)
class Answer:
    """A scene's answer for each of its points. called: (n,) classes of the truth, -1 unknown, len(names) for a word
    that the truth lacks. instances: (n,), below 0 none. xyz: (n, 3). spacing: point spacing, in their unit."""

    called: NDArray[np.integer]
    instances: NDArray[np.integer]
    xyz: NDArray[np.float32]
    spacing: float


@dataclass(frozen=True)
class CaptureScore:
    """labels: unknown counts as wrong. interval: of its mIoU. answered: only points with a label, over the classes
    present among them, without background; answered_share: of the scored points. rand: adjusted Rand index of the
    instances, over points of things with a known class, where points without an instance form one part; None where the
    truth has no such things."""

    labels: Score
    interval: BlockInterval
    answered: Score
    answered_share: float
    rand: float | None


def ask(scene: SceneLike, truth: Truth, text_features: Path | None = None) -> Answer:
    """Label a scene with the names of text_features, or with all of its own words. SceneError where its points are not
    those of the truth, or where it has no words."""
    scene = as_scene(scene)
    cloud = scene.cloud
    if len(cloud) != len(truth.cls):
        raise SceneError(
            f"{scene.path} has {len(cloud)} points, the truth {len(truth.cls)}; expected the truth's points in the "
            "same order: fit the capture's own cloud, without --gaussians, or write gt.npz for this file's points"
        )
    if text_features is None and not (scene.vocabulary and scene.vocabulary.names):
        raise SceneError(
            f"{scene.path} has no words; expected the capture's text_features.npz, --text-features F.npz, or words in "
            "the file (og-pointcloud vocabulary add)"
        )
    result = segment(scene, None, text_features=text_features)
    return Answer(truth.class_of(result.labels, result.names), result.instances, cloud.xyz, cloud.spacing)


def score_capture(answer: Answer, truth: Truth) -> CaptureScore:
    """All scores of one answer. SceneError where no class of the truth has enough points to be scored."""
    labels = truth.score(answer.called)
    if not labels.classes:
        raise SceneError("no class of the truth has 30 points that can be scored; expected at least one")
    counted = truth.scored & np.isin(truth.cls, labels.classes)
    answered = answer.called >= 0
    return CaptureScore(
        labels=labels,
        interval=miou_interval(answer.called, truth, answer.xyz, answer.spacing, labels.classes),
        answered=score_labels(answer.called, truth.cls, scored=counted & answered, min_points=1),
        answered_share=float(answered[counted].mean()),
        rand=_rand_of_things(answer, truth),
    )


def difference(first: Answer, second: Answer, truth: Truth) -> BlockInterval:
    """Interval of one answer's mIoU minus another's, for the same points: paired, over the same blocks of space."""
    classes = truth.score(first.called).classes
    return miou_interval(first.called, truth, first.xyz, first.spacing, classes, less=second.called)


def _rand_of_things(answer: Answer, truth: Truth) -> float | None:
    if truth.instance is None:
        return None
    things = truth.scored & (truth.cls >= 0) & (truth.instance >= 0)
    if not things.any():
        return None
    return adjusted_rand_index(np.maximum(answer.instances, -1)[things], truth.instance[things])
