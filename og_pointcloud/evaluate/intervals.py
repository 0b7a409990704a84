"""Bootstrap intervals of scores.

Scenes, or pairs of frame and object, are resampled one by one (`bootstrap`). Points of one cloud are not: an instance
with a wrong label is wrong at all of its points, so an interval from points drawn one by one would be many times too
narrow. For the mean IoU of one cloud, whole cubes of space are resampled instead (`miou_interval`). How large a cube
must be to hold correlated errors is unknown, so several are tried: edges double from 8 point spacings while at least
half of the classes lie in at least 20 cubes each, and the widest of the intervals is returned. With larger cubes, many
draws would hold only the fringe of a class, and their mean would no longer estimate the score. Classes are those of the
whole cloud; a draw without a point of a class, called or true, leaves that class out.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.errors import OgPointcloudError
from og_pointcloud.evaluate.truth import Truth

Doubles = NDArray[np.float64]
Integers = NDArray[np.integer]

DRAWS, BLOCK_DRAWS = 10_000, 2_000
NUMBERS_PER_CHUNK = 1 << 21
"""Numbers drawn at once; bounds memory."""
MIN_EDGE_SPACINGS = 8.0
"""Edge of the smallest cubes tried, in point spacings."""
MIN_BLOCKS = 20
"""If the median class lies in fewer cubes, they are too large."""


@dataclass(frozen=True)
class Interval:
    """A mean and the middle 95 % of its bootstrap distribution (Efron's percentile interval)."""

    mean: float
    low: float
    high: float


@dataclass(frozen=True)
class BlockInterval(Interval):
    """mean: of all points. edge: of a cube, in scene units. blocks: number of cubes."""

    edge: float
    blocks: int


def bootstrap(scores: NDArray[np.floating]) -> Interval:
    """Interval of the mean of n items' scores (scenes, or frame-object pairs), resampled with replacement.

    An item that is not finite has no score and is left out first. A single item has no spread; no item is an error.
    """
    values = np.asarray(scores, np.float64)
    values = values[np.isfinite(values)]
    if values.ndim != 1 or len(values) == 0:
        raise OgPointcloudError("no finite score to draw from; expected at least one")
    means = [values[drawn].mean(axis=1) for drawn in _draws(len(values), DRAWS)]
    low, high = np.percentile(np.concatenate(means), (2.5, 97.5))
    return Interval(float(values.mean()), float(low), float(high))


def miou_interval(
    called: Integers, truth: Truth, xyz: NDArray[np.floating], spacing: float, classes: tuple[int, ...],
    less: Integers | None = None,
) -> BlockInterval:  # fmt: skip
    """Interval of the mean IoU of `score_labels`; or of the difference between two labellings, ``called`` minus
    ``less``. Both are then scored on the same draws, since what is hard for one is hard for the other.

    called, less: (n,) classes of the truth, below 0 unknown (`Truth.class_of`). xyz: (n, 3). spacing: of its points,
    same unit. classes: those that the score averages; OgPointcloudError if there are none.
    """
    if not classes:
        raise OgPointcloudError("no class has enough points to be scored, so the mean has no interval; expected one")
    evaluated = truth.scored & np.isin(truth.cls, classes)
    counted = evaluated if truth.background is None else evaluated | truth.background
    points, true = np.asarray(xyz, np.float64)[counted], np.where(evaluated, truth.cls, -1)[counted]
    labellings = [labels[counted] for labels in (called, less) if labels is not None]
    intervals: list[BlockInterval] = []
    edge = MIN_EDGE_SPACINGS * spacing
    while True:
        block = _cubes(points, edge)
        present = _points_per_block(block, true, classes)
        # Cubes are too large now: return the widest interval so far. The smallest edge is always used.
        if intervals and np.median((present > 0).sum(axis=0)) < MIN_BLOCKS:
            return max(intervals, key=lambda interval: interval.high - interval.low)
        # IoU of a draw only needs sums of intersections and unions over its blocks, (blocks, classes) each.
        hits = [_points_per_block(block, np.where(labels == true, true, -1), classes) for labels in labellings]
        unions = [
            present + _points_per_block(block, labels, classes) - hit
            for labels, hit in zip(labellings, hits, strict=True)
        ]
        intervals.append(_interval(hits, unions, edge))
        edge *= 2


def _cubes(xyz: Doubles, edge: float) -> NDArray[np.intp]:
    """(n,) the cube that each point lies in, numbered from 0."""
    # 21 bits per coordinate; points farther out than 2^20 cubes share the last one.
    cube = np.floor(np.minimum((xyz - xyz.min(axis=0)) / edge, 1 << 20)).astype(np.int64)
    return np.unique((cube[:, 0] << 42) | (cube[:, 1] << 21) | cube[:, 2], return_inverse=True)[1]


def _points_per_block(block: NDArray[np.intp], ids: Integers, classes: tuple[int, ...]) -> Doubles:
    """(blocks, classes) number of points of each class in each block. block, ids: (n,)."""
    counts = np.zeros((int(block.max()) + 1, len(classes)))
    for column, class_id in enumerate(classes):
        counts[:, column] = np.bincount(block[ids == class_id], minlength=len(counts))
    return counts


def _interval(hits: list[Doubles], unions: list[Doubles], edge: float) -> BlockInterval:
    """Interval of one labelling's mean IoU, or of the first's minus the second's. hits, unions: (blocks, classes)."""
    blocks = len(hits[0])

    def score(weights: Doubles) -> Doubles:
        """(draws,) for weights (draws, blocks), how often each block was drawn."""
        mious = []
        for hit, union in zip(hits, unions, strict=True):
            drawn_union = weights @ union
            iou = np.divide(weights @ hit, drawn_union, out=np.zeros_like(drawn_union), where=drawn_union > 0)
            mious.append(iou.sum(axis=1) / np.maximum((drawn_union > 0).sum(axis=1), 1))
        return mious[0] if len(mious) == 1 else mious[0] - mious[1]

    drawn = []
    for picked in _draws(blocks, BLOCK_DRAWS):
        # How often each draw contains each block: one histogram of the pairs (draw, block).
        rows = np.arange(len(picked))[:, None] * blocks + picked
        weights = np.bincount(rows.ravel(), minlength=picked.size).reshape(picked.shape)
        drawn.append(score(weights.astype(np.float64)))
    low, high = np.percentile(np.concatenate(drawn), (2.5, 97.5))
    return BlockInterval(float(score(np.ones((1, blocks)))[0]), float(low), float(high), edge, blocks)


def _draws(items: int, draws: int) -> Iterator[NDArray[np.int64]]:
    """(some draws, items) rows of items drawn with replacement, in parts that fit into memory; the seed is fixed."""
    random = np.random.default_rng(0)
    step = max(1, NUMBERS_PER_CHUNK // items)
    for start in range(0, draws, step):
        yield random.integers(0, items, (min(step, draws - start), items))
