"""How sure a mean IoU over the points of one cloud is: its bootstrap over blocks of space.

Points are not drawn independently: an instance with a wrong label is wrong at all of its points, and an interval from
points drawn one by one would be many times too narrow. Whole cubes of the cloud are drawn again instead. How large a
cube must be to hold what errs together is not known, so it is tried: edges double from 8 point spacings while half of
the classes or more lie in at least 20 cubes each, and the widest of their intervals is the one given. With larger cubes
many draws would hold nothing of a class but its fringe, and their mean would be another figure than the score. Classes
are those of the whole cloud; a draw without a point of a class, called or true, leaves that class out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.errors import OgPointcloudError
from og_pointcloud.evaluate.truth import Truth

__all__ = ["BlockInterval", "miou_difference", "miou_interval"]

Doubles = NDArray[np.float64]

SMALLEST_EDGE = 8.0
"""In point spacings."""
FEWEST_BLOCKS = 20
DRAWS = 2_000
CHUNK = 1 << 21
"""Numbers drawn at once."""


@dataclass(frozen=True)
class BlockInterval:
    """mean: of all points. low, high: middle 95 % of the draws. edge: of a cube, in scene units. blocks: how many."""

    mean: float
    low: float
    high: float
    edge: float
    blocks: int


@dataclass(frozen=True)
class _Counts:
    """(blocks, classes) points of each block: hits, and union = true + called - hits."""

    hits: Doubles
    union: Doubles

    def miou(self, weights: Doubles) -> Doubles:
        """(draws,) for weights (draws, blocks), how often each block was drawn."""
        union = weights @ self.union
        iou = np.divide(weights @ self.hits, union, out=np.zeros_like(union), where=union > 0)
        return iou.sum(axis=1) / np.maximum((union > 0).sum(axis=1), 1)


def miou_interval(
    called: NDArray[np.integer], truth: Truth, xyz: NDArray[np.floating], spacing: float, classes: tuple[int, ...],
    seed: int = 0,
) -> BlockInterval:  # fmt: skip
    """Of the mean IoU that `score_labels` gives.

    called: (n,) classes of the truth, below 0 unknown (`Truth.class_of`). xyz: (n, 3). spacing: of its points, same
    unit. classes: those that the score is a mean over. Raises OgPointcloudError where there are none, or no spacing.
    """
    return _widest([called], truth, xyz, spacing, classes, seed)


def miou_difference(
    first: NDArray[np.integer], second: NDArray[np.integer], truth: Truth, xyz: NDArray[np.floating], spacing: float,
    classes: tuple[int, ...], seed: int = 0,
) -> BlockInterval:  # fmt: skip
    """Of the difference first - second of two labellings of one cloud: both are scored on the same draws, since what is
    hard is hard for both. Arguments as for `miou_interval`."""
    return _widest([first, second], truth, xyz, spacing, classes, seed)


def _widest(
    labellings: list[NDArray[np.integer]], truth: Truth, xyz: NDArray[np.floating], spacing: float,
    classes: tuple[int, ...], seed: int,
) -> BlockInterval:  # fmt: skip
    if not classes:
        raise OgPointcloudError("no class has enough points to be scored; expected one or more")
    if not (np.isfinite(spacing) and spacing > 0):
        raise OgPointcloudError(f"the point spacing is {spacing:g}; expected a length above 0, in the points' unit")
    evaluated = truth.scored & np.isin(truth.cls, classes)
    counted = evaluated if truth.background is None else evaluated | truth.background
    points, own = np.asarray(xyz, np.float64)[counted], evaluated[counted]
    intervals = []
    edge = SMALLEST_EDGE * spacing
    while True:
        block = _cubes(points, edge)
        spread = [len(np.unique(block[own & (truth.cls[counted] == class_id)])) for class_id in classes]
        if intervals and np.median(spread) < FEWEST_BLOCKS:
            return max(intervals, key=lambda interval: interval.high - interval.low)
        counts = [_count(called, truth.cls, evaluated, counted, block, classes) for called in labellings]
        intervals.append(_interval(counts, edge, seed))
        edge *= 2


def _cubes(xyz: Doubles, edge: float) -> NDArray[np.intp]:
    """(n,) the cube that each point lies in, numbered from 0."""
    cube = np.floor(np.minimum((xyz - xyz.min(axis=0)) / edge, 1 << 20)).astype(np.int64)
    return np.unique((cube[:, 0] << 42) | (cube[:, 1] << 21) | cube[:, 2], return_inverse=True)[1]


def _count(
    called: NDArray[np.integer], cls: NDArray[np.integer], evaluated: NDArray[np.bool_], counted: NDArray[np.bool_],
    block: NDArray[np.intp], classes: tuple[int, ...],
) -> _Counts:  # fmt: skip
    blocks, width = int(block.max()) + 1, len(classes)
    order = np.asarray(classes)  # ascending, as score_labels has them

    def tally(rows: NDArray[np.bool_], ids: NDArray[np.integer]) -> Doubles:
        rows = rows[counted] & np.isin(ids[counted], order)
        cell = block[rows] * width + np.searchsorted(order, ids[counted][rows])
        return np.bincount(cell, minlength=blocks * width).reshape(blocks, width).astype(np.float64)

    hits = tally(evaluated & (called == cls), cls)
    return _Counts(hits, tally(evaluated, cls) + tally(counted, called) - hits)


def _interval(counts: list[_Counts], edge: float, seed: int) -> BlockInterval:
    """Of the one, or of the first less the second."""
    blocks = len(counts[0].hits)
    random = np.random.default_rng(seed)

    def score(weights: Doubles) -> Doubles:
        scores = [one.miou(weights) for one in counts]
        return scores[0] if len(scores) == 1 else scores[0] - scores[1]

    drawn = []
    step = max(1, CHUNK // blocks)
    for start in range(0, DRAWS, step):
        picked = random.integers(0, blocks, (min(step, DRAWS - start), blocks))
        rows = np.arange(len(picked))[:, None] * blocks + picked
        weights = np.bincount(rows.ravel(), minlength=picked.size).reshape(picked.shape)
        drawn.append(score(weights.astype(np.float64)))
    low, high = np.percentile(np.concatenate(drawn), (2.5, 97.5))
    return BlockInterval(float(score(np.ones((1, blocks)))[0]), float(low), float(high), edge, blocks)
