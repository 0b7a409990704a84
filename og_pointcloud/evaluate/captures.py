"""A labelled scene against its capture's own truth: labels, how sure their score is, what abstaining buys, instances.

Labels are scored as everywhere in this library: a point without a label is a miss, a class called on known background
a false alarm. Beside that stands unknown as abstention: the answered points alone, and risk against coverage. Intervals
are over blocks of space (`intervals`). Where the truth knows instances, those of the scene are scored as things of any
kind, and as things of the right class.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.ask.labelled_scene import SceneLike, as_scene, segment
from og_pointcloud.errors import SceneError
from og_pointcloud.evaluate.instance_scores import AveragePrecision, average_precision
from og_pointcloud.evaluate.intervals import BlockInterval, RiskCoverage, miou_interval, risk_coverage
from og_pointcloud.evaluate.metrics import Score, adjusted_rand_index, score_labels
from og_pointcloud.evaluate.truth import Truth

__all__ = ["Answer", "CaptureScore", "InstanceScore", "ask", "difference", "score_capture", "sure"]

Integers = NDArray[np.integer]


@dataclass(frozen=True)
class Answer:
    """What a scene says of each of its points. called: (n,) classes of the truth, -1 unknown, len(names) a word that
    the truth lacks. confidence: (n,) float32, 0 to 1, that the instance is what it is called. instances: (n,), below 0
    none. xyz: (n, 3); spacing: of the points. certainty: (n,) float32, 0 to 1, that a point is part of its instance;
    None where the scene does not know it."""

    called: Integers
    confidence: NDArray[np.float32]
    instances: Integers
    xyz: NDArray[np.float32]
    spacing: float
    certainty: NDArray[np.float32] | None = None

    @property
    def sureness(self) -> NDArray[np.float32]:
        """(n,) that the point is what it is called, -inf where it is called nothing."""
        return np.where(self.called >= 0, sure(self.confidence, True, self.certainty), np.float32(-np.inf))


@dataclass(frozen=True)
class InstanceScore:
    """Over points of things whose class is known. any_kind: whatever they are called. of_class: of the right class.
    rand: adjusted Rand index; points without an instance are one part."""

    any_kind: AveragePrecision
    of_class: AveragePrecision
    rand: float


@dataclass(frozen=True)
class CaptureScore:
    """labels: unknown counts as wrong. interval: of its mIoU. answered: points with a label alone, over the classes
    present among them, background left out; answered_share: of the scored points. curve: risk against coverage of the
    scored points, unknown ones last and wrong. instances: None where the truth knows none."""

    labels: Score
    interval: BlockInterval
    answered: Score
    answered_share: float
    curve: RiskCoverage
    instances: InstanceScore | None


def ask(scene: SceneLike, truth: Truth, text_features: Path | None = None) -> Answer:
    """Ask a scene for the names of text_features, or for all of its own words. SceneError where its points are not
    those of the truth."""
    scene = as_scene(scene)
    cloud = scene.cloud
    if len(cloud) != len(truth.cls):
        raise SceneError(
            f"{scene.path} has {len(cloud)} points, the truth {len(truth.cls)}; expected one each: fit that capture"
        )
    result = segment(scene, None, text_features=text_features)
    called = truth.class_of(result.labels, result.names)
    confidence = sure(result.scores, result.calibrated)
    return Answer(called, confidence, result.instances, cloud.xyz, cloud.spacing, result.certainty)


def sure(
    scores: NDArray[np.floating], calibrated: bool, certainty: NDArray[np.floating] | None = None
) -> NDArray[np.float32]:
    """(n,) float32 in [0, 1], larger where an answer is surer. scores: (n,) probabilities if ``calibrated``, else
    cosines, of which only the order counts. certainty: (n,) that a point is part of its instance, None if not known."""
    confidence = scores if calibrated else (1 + scores) / 2
    return np.asarray(confidence if certainty is None else confidence * certainty, np.float32)


def score_capture(answer: Answer, truth: Truth, seed: int = 0) -> CaptureScore:
    """All scores of one answer. SceneError where no class of the truth has enough points to be scored."""
    labels = score_labels(answer.called, truth.cls, scored=truth.scored, background=truth.background)
    if not labels.classes:
        raise SceneError("no class of the truth has 30 points that can be scored; expected one or more")
    counted = truth.scored & np.isin(truth.cls, labels.classes)
    answered = answer.called >= 0
    return CaptureScore(
        labels=labels,
        interval=miou_interval(answer.called, truth, answer.xyz, answer.spacing, labels.classes, seed),
        answered=score_labels(answer.called, truth.cls, scored=counted & answered, min_points=1),
        answered_share=float(answered[counted].mean()),
        curve=risk_coverage((answer.called == truth.cls)[counted], answer.sureness[counted]),
        instances=None if truth.instance is None else score_instances(answer, truth),
    )


def difference(first: Answer, second: Answer, truth: Truth, seed: int = 0) -> BlockInterval:
    """Of the mIoU of one answer less that of another, of the same points: paired, over the same blocks of space."""
    classes = score_labels(first.called, truth.cls, scored=truth.scored).classes
    return miou_interval(first.called, truth, first.xyz, first.spacing, classes, seed, less=second.called)


def score_instances(answer: Answer, truth: Truth) -> InstanceScore | None:
    """Instances of an answer; None where no thing has a class. A thing has the class of most of its points."""
    assert truth.instance is not None
    counted = truth.scored & (truth.cls >= 0) & (truth.instance >= 0)
    if not counted.any():
        return None
    things = np.full(len(truth.cls), -1)
    _, things[counted] = np.unique(truth.instance[counted], return_inverse=True)
    true_class = _most_common(things[counted], truth.cls[counted])
    predicted = np.maximum(answer.instances, -1)
    ids, first = np.unique(predicted, return_index=True)
    ids, first = ids[ids >= 0], first[ids >= 0]
    count = int(predicted.max(initial=-1)) + 1
    confidence, called = np.zeros(count), np.full(count, -1)
    confidence[ids], called[ids] = answer.confidence[first], answer.called[first]
    # What has no name is a thing of some kind, but of no class.
    named = np.where((predicted >= 0) & (np.append(called, -1)[predicted] >= 0), predicted, -1)
    return InstanceScore(
        any_kind=average_precision(predicted, things, confidence),
        of_class=average_precision(named, things, confidence, called, true_class),
        rand=adjusted_rand_index(predicted[counted], things[counted]),
    )


def _most_common(groups: Integers, values: Integers) -> Integers:
    """(groups,) the value that most entries of each group have, of equals the smallest."""
    table = np.zeros((int(groups.max()) + 1, int(values.max()) + 1), np.int64)
    np.add.at(table, (groups, values), 1)
    return table.argmax(axis=1)
