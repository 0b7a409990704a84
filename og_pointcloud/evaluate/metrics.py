"""Scores of point labels against ground truth: a point left unknown is a miss, a label on background a false alarm."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.errors import OgPointcloudError


@dataclass(frozen=True)
class Score:
    """Scores of one labelling. All shares are in [0, 1]; NaN where there was nothing to score.

    miou, macc: mean IoU and mean recall over ``classes``. unknown_share: of the scored points, those labelled -1.
    background_called: share of the true background that was given a class; None where no background is known.
    points: points scored. classes: ids with enough points. class_iou, class_accuracy: per entry of ``classes``.
    """

    miou: float
    macc: float
    unknown_share: float
    background_called: float | None
    points: int
    classes: tuple[int, ...]
    class_iou: tuple[float, ...]
    class_accuracy: tuple[float, ...]


def score_labels(
    labels: NDArray[np.integer], truth: NDArray[np.integer], *, background: NDArray[np.bool_] | None = None,
    scored: NDArray[np.bool_] | None = None, min_points: int = 30,
) -> Score:  # fmt: skip
    """Mean IoU and recall over the classes of the truth.

    labels, truth: (n,) class ids, -1 unknown; the same ids in both. background: (n,) bool, points known to be of
    no class: a class called there is a false positive of that class. scored: (n,) bool, labelled points that count
    (default: all). Classes with fewer than ``min_points`` such points are left out, and so are their points.

    Raises OgPointcloudError where the arrays differ in length.

    >>> score_labels(np.array([0, 0, 1, -1]), np.array([0, 0, 1, 1]), min_points=1).class_iou
    (1.0, 0.5)
    """
    labels, truth = np.asarray(labels), np.asarray(truth)
    others = {"truth": truth, "background": background, "scored": scored}
    for name, values in others.items():
        if values is not None and values.shape != labels.shape:
            raise OgPointcloudError(f"{name} is {values.shape}, the labels are {labels.shape}; expected one per point")
    evaluated = truth >= 0 if scored is None else (truth >= 0) & scored
    ids, counts = np.unique(truth[evaluated], return_counts=True)
    classes = ids[counts >= min_points]
    evaluated &= np.isin(truth, classes)
    # A class called on background counts in its union, as a false alarm; recall is over the class's own points.
    counted = evaluated if background is None else evaluated | background
    ious, accuracies = [], []
    for class_id in classes:
        called, true = (labels == class_id) & counted, (truth == class_id) & evaluated
        hits = int((called & true).sum())
        ious.append(hits / int((called | true).sum()))
        accuracies.append(hits / int(true.sum()))
    has_background = background is not None and bool(background.any())
    return Score(
        miou=_mean(ious),
        macc=_mean(accuracies),
        unknown_share=_mean(labels[evaluated] < 0),
        background_called=_mean(labels[background] >= 0) if has_background else None,
        points=int(evaluated.sum()),
        classes=tuple(classes.tolist()),
        class_iou=tuple(ious),
        class_accuracy=tuple(accuracies),
    )


def matched_shares(ids: NDArray[np.integer], things: NDArray[np.integer], min_points: int = 30) -> tuple[float, float]:
    """Recall and precision of instances: the shares of true things, and of instances, that match one of the other with
    an IoU above 0.5. Then none matches two (Kirillov et al., Panoptic Segmentation, CVPR 2019).

    ids, things: (n,) small whole numbers, the instance and the true thing of each point, below 0 none. Those with fewer
    than ``min_points`` points are not asked for. NaN where none is left.

    >>> matched_shares(np.array([0, 0, 0, 1, 2, 2]), np.array([0, 0, 0, 0, 1, 1]), min_points=1)
    (1.0, 0.6666666666666666)
    """
    points_of_id, points_of_thing = (np.bincount(part[part >= 0]) for part in (ids, things))
    both = (ids >= 0) & (things >= 0)
    (found, thing), shared = np.unique(np.stack([ids[both], things[both]]), axis=1, return_counts=True)
    matched = 2 * shared > points_of_id[found] + points_of_thing[thing] - shared
    recall = np.isin(np.flatnonzero(points_of_thing >= min_points), thing[matched])
    precision = np.isin(np.flatnonzero(points_of_id >= min_points), found[matched])
    return _mean(recall), _mean(precision)


def adjusted_rand_index(first: NDArray[np.integer], second: NDArray[np.integer]) -> float:
    """Agreement of two partitions of the same points, 1 for equal, about 0 for unrelated ones (Hubert & Arabie 1985).

    first, second: (n,) ids of any value; every id, including negative ones, is a part. NaN for n = 0.
    """
    first, second = np.asarray(first), np.asarray(second)
    if first.shape != second.shape:
        raise OgPointcloudError(f"partitions have shapes {first.shape} and {second.shape}; expected an id per point")
    _, rows = np.unique(first, return_inverse=True)
    _, columns = np.unique(second, return_inverse=True)
    if len(rows) == 0:
        return float("nan")
    # Sizes of the parts' intersections, the entries of the contingency table that are not 0.
    cells = np.unique(rows.astype(np.int64) * (columns.max() + 1) + columns, return_counts=True)[1]
    together = _pairs(cells)
    in_first, in_second = _pairs(np.bincount(rows)), _pairs(np.bincount(columns))
    all_pairs = _pairs(np.array([len(rows)]))
    expected = in_first * in_second / all_pairs if all_pairs else 0.0
    largest = (in_first + in_second) / 2
    return 1.0 if largest == expected else (together - expected) / (largest - expected)


def _pairs(counts: NDArray[np.integer]) -> float:
    """Number of pairs of points in the same part, from the parts' sizes; float64, as products may overflow int64."""
    sizes = counts.astype(np.float64)
    return float((sizes * (sizes - 1) / 2).sum())


def _mean(values: list[float] | NDArray[np.bool_]) -> float:
    return float(np.mean(values)) if len(values) else float("nan")
