"""Average precision of a cloud whose points carry one instance id each.

Average precision follows ScanNet's benchmark, class by class. A true instance is found at a threshold if a prediction's
IoU with it is *above* the threshold; of several, the surest is the hit and the others are false. True instances of
fewer than 100 points, and unlabelled points, are void: a prediction that finds nothing is false only if at most the
share ``threshold`` of its points is void. Predictions of fewer than 100 points are not looked at. Precision is
integrated over recall with each step weighted by half the distance of its neighbours. AP is the mean over the
thresholds 0.5, 0.55, ... 0.95 (0.25 is apart); a class without a true instance has none.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.errors import OgPointcloudError

__all__ = ["AveragePrecision", "average_precision"]

Integers = NDArray[np.integer]
Doubles = NDArray[np.float64]

THRESHOLDS = tuple(round(0.5 + 0.05 * step, 2) for step in range(10))
SMALLEST_INSTANCE = 100


@dataclass(frozen=True)
class AveragePrecision:
    """Means over classes. ap: over the thresholds 0.5 to 0.95. ap50, ap25: at one. NaN without true instances."""

    ap: float
    ap50: float
    ap25: float


def average_precision(
    predicted: Integers, truth: Integers, confidence: NDArray[np.floating],
    predicted_class: Integers | None = None, truth_class: Integers | None = None, min_points: int = SMALLEST_INSTANCE,
) -> AveragePrecision:  # fmt: skip
    """Average precision of instance ids.

    predicted, truth: (n,) ids of each point, below 0 for none. confidence: (P,) by predicted id. predicted_class (P,),
    truth_class (T,): by id; None, both, asks for things of any kind.
    """
    shared = _shared_points(predicted, truth, len(confidence))
    predictions, true_instances = shared.shape[0] - 1, shared.shape[1] - 1
    of_predicted = np.zeros(predictions, int) if predicted_class is None else np.asarray(predicted_class)
    of_truth = np.zeros(true_instances, int) if truth_class is None else np.asarray(truth_class)[:true_instances]
    table = []
    for class_id in np.unique(of_truth):
        true, large = of_truth == class_id, shared[:, :-1].sum(axis=0) >= min_points
        if not (true & large).any():
            continue
        looked_at = (of_predicted == class_id) & (shared[:-1].sum(axis=1) >= min_points)
        rows, columns = np.flatnonzero(looked_at), np.flatnonzero(true & large)
        iou = _iou(shared)[np.ix_(rows, columns)]
        void = shared[rows][:, :-1][:, true & ~large].sum(axis=1) + shared[rows, -1]
        void_share = void / shared[rows].sum(axis=1)
        surely = np.asarray(confidence, np.float64)[rows]
        table.append([_precision_at(threshold, iou, void_share, surely) for threshold in (0.25, *THRESHOLDS)])
    if not table:
        return AveragePrecision(float("nan"), float("nan"), float("nan"))
    means = np.mean(table, axis=0)
    return AveragePrecision(ap=float(means[1:].mean()), ap50=float(means[1]), ap25=float(means[0]))


def _shared_points(predicted: Integers, truth: Integers, predictions: int) -> NDArray[np.int64]:
    """(P + 1, T + 1) points that each pair of ids shares; the last row and column are points without an id."""
    predicted, truth = np.asarray(predicted, np.int64), np.asarray(truth, np.int64)
    if predicted.shape != truth.shape or predicted.ndim != 1:
        raise OgPointcloudError(f"ids have shapes {predicted.shape} and {truth.shape}; expected one each a point")
    if np.max(predicted, initial=-1) >= predictions:
        raise OgPointcloudError(f"instance {predicted.max()} is predicted, of {predictions} with a confidence or class")
    true = int(np.max(truth, initial=-1)) + 1
    rows, columns = np.where(predicted < 0, predictions, predicted), np.where(truth < 0, true, truth)
    size = (predictions + 1) * (true + 1)
    return np.bincount(rows * (true + 1) + columns, minlength=size).reshape(predictions + 1, true + 1)


def _iou(shared: NDArray[np.int64]) -> Doubles:
    """(P, T)."""
    both = shared[:-1, :-1]
    union = shared[:-1].sum(axis=1)[:, None] + shared[:, :-1].sum(axis=0)[None, :] - both
    return both / np.maximum(union, 1)


def _precision_at(threshold: float, iou: Doubles, void_share: Doubles, confidence: Doubles) -> float:
    """Area under precision over recall. iou: (P, T). void_share, confidence: (P,)."""
    found = iou > threshold
    surest = np.where(found, confidence[:, None], -np.inf)
    # Several predictions may find one thing at 0.25, none finds two at 0.5; a prediction serves the first it finds.
    hit = np.zeros(len(iou), bool)
    for column in range(iou.shape[1]):
        candidates = np.flatnonzero(found[:, column] & ~hit)
        if len(candidates):
            hit[candidates[np.argmax(surest[candidates, column])]] = True
    false = ~hit & (found.any(axis=1) | (void_share <= threshold))
    if not hit.any():
        return 0.0
    counted = hit | false
    levels = np.unique(confidence[counted])
    above = confidence[counted][None, :] >= levels[:, None]
    hits = (above & hit[counted]).sum(axis=1)
    precision, recall = np.append(hits / above.sum(axis=1), 1.0), np.append(hits / iou.shape[1], 0.0)
    steps = np.convolve(np.concatenate([recall[:1], recall, [0.0]]), (-0.5, 0.0, 0.5), "valid")
    return float(precision @ steps)
