"""How each view votes on each point, and how much its vote counts.

A view votes on every point it sees: how much of what it shows of the point lies in each mask, and how much outside. Its
vote counts by how openly it sees the point: the part of the splat that reaches the camera (exposure), relative to the
view that sees the point best, squared. So

* what shines through a gap in a surface does not count where another view sees it openly: otherwise the few points in
  front would be outweighed by the many behind them, and a floor seen through a table would be labelled table;
* a point inside a thick, noisy surface, which no view sees openly, is still decided, because all views see it alike;
* near and far views count alike: pixels are not evidence.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from og_pointcloud.fitting.mask_table import MaskTable
from og_pointcloud.fitting.memory import scratch_like
from og_pointcloud.kernels import njit

OPENNESS_POWER = 2
"""Exponent of the relative exposure. 1 trusts too much of what shines through, 4 too little of thick surfaces."""

ENTRIES_AT_ONCE = 1 << 26
"""Votes that are sorted by point at once, half a gigabyte: more are sorted in passes, each writing to one region."""
FIXED_POINT_SCALE = float(1 << 24)
"""Counts of votes are rounded to multiples of its reciprocal, so that their float64 sums are exact and do not depend on
the order of points."""
VOTE = np.dtype([("row", np.int32), ("vote", np.float32)])
"""A vote on a point, and the mask or view that casts it: used together, they share a cache line."""
_ByPoint = tuple[NDArray[np.int64], NDArray[Any]]
"""(start, votes): the votes on point g are votes[start[g] : start[g + 1]], rows ascending."""
PointVotes = tuple[_ByPoint, _ByPoint]
"""Votes in masks, and all votes of views, by point."""


@dataclass(frozen=True)
class ViewVotes:
    """vote: (views, n) sparse float32 in (0, 1], how much the vote of each view counts on each point that it sees.
    in_mask: (masks, n) sparse float32, the part of its view's vote that is for "in this mask". The rows of a view's
    masks sum to at most its vote; the rest is for "in no mask". openness: (n,) float32, exposure of each point in the
    view that sees it best, 0 where none does."""

    in_mask: csr_array
    vote: csr_array
    openness: NDArray[np.float32]

    @property
    def typical_openness(self) -> float:
        """The median of ``openness`` over points that are seen at all; 0 without one."""
        seen = self.openness[self.openness > 0]
        return float(np.median(seen)) if len(seen) else 0.0

    @cached_property
    def by_point(self) -> PointVotes:
        """The votes in masks, and the votes of views, sorted by point; in files where the votes are."""
        return _by_point(self.in_mask), _by_point(self.vote)


def view_votes(table: MaskTable) -> ViewVotes:
    """The votes of all views of a table."""
    weights, outside, exposure = table.weights, table.outside, table.exposure
    vote, in_mask = scratch_like(exposure.data, np.float32), scratch_like(weights.data, np.float32)
    openness = _relative_exposure(exposure.indices, exposure.data, exposure.shape[1], vote)
    first_mask = np.searchsorted(table.mask_view, np.arange(exposure.shape[0] + 1))
    _split_votes(
        first_mask,
        (weights.indptr, weights.indices, weights.data),
        (outside.indptr, outside.indices, outside.data),
        (exposure.indptr, exposure.indices, vote),
        exposure.shape[1],
        in_mask,
    )
    return ViewVotes(
        csr_array((in_mask, weights.indices, weights.indptr), shape=weights.shape),
        csr_array((vote, exposure.indices, exposure.indptr), shape=exposure.shape),
        openness,
    )


@njit(cache=True)
def _relative_exposure(index, exposure, n, vote):  # noqa: ANN001, ANN202
    """Writes to ``vote`` each exposure relative to the point's best, to OPENNESS_POWER. Returns the best, (n,)."""
    best = np.zeros(n, np.float32)
    for e in range(len(index)):
        best[index[e]] = max(best[index[e]], exposure[e])
    for e in range(len(index)):
        vote[e] = (exposure[e] / best[index[e]]) ** OPENNESS_POWER
    return best


@njit(cache=True)
def _split_votes(first_mask, weights, outside, votes, n, in_mask):  # noqa: ANN001, ANN202
    """Writes to ``in_mask`` each mask weight as a share of what its view shows of the point, times the view's vote."""
    weight_start, weight_index, weight = weights
    outside_start, outside_index, outside_weight = outside
    vote_start, vote_index, vote = votes
    seen = np.zeros(n)
    factor = np.zeros(n)
    for view in range(len(first_mask) - 1):
        # All that this view shows of each point, in masks and outside.
        first, last = weight_start[first_mask[view]], weight_start[first_mask[view + 1]]
        for e in range(first, last):
            seen[weight_index[e]] += weight[e]
        for e in range(outside_start[view], outside_start[view + 1]):
            seen[outside_index[e]] += outside_weight[e]
        # The vote per unit of weight; ``seen`` is zero again for the next view, which shows only some points.
        for e in range(vote_start[view], vote_start[view + 1]):
            g = vote_index[e]
            factor[g] = vote[e] / seen[g]
            seen[g] = 0.0
        # A view exposes all that its masks show: each factor read here was written just above.
        for e in range(first, last):
            in_mask[e] = weight[e] * factor[weight_index[e]]


def _by_point(matrix: csr_array) -> _ByPoint:
    n, runs = matrix.shape[1], 1 + matrix.nnz // ENTRIES_AT_ONCE
    start, votes = _starts(matrix.indices, n), scratch_like(matrix.data, VOTE)
    for low, high in pairwise(n * run // runs for run in range(runs + 1)):
        _sort_columns(matrix.indptr, matrix.indices, matrix.data, (low, high), start[low:high], votes)
    return start, votes


@njit(cache=True)
def _starts(columns, n):  # noqa: ANN001, ANN202
    """(n + 1,) where the entries of each column begin if they are sorted by column."""
    start = np.zeros(n + 1, np.int64)
    for column in columns:
        start[column + 1] += 1
    return np.cumsum(start)


@njit(cache=True)
def _sort_columns(indptr, indices, data, columns, start, votes):  # noqa: ANN001, ANN202
    """Writes the entries of ``columns``, from the first to before the last, to ``votes``, where each column's begin at
    ``start``."""
    (low, high), end = columns, start.copy()
    for row in range(len(indptr) - 1):
        for e in range(indptr[row], indptr[row + 1]):
            if low <= indices[e] < high:
                vote = votes[end[indices[e] - low]]
                vote["row"], vote["vote"] = row, data[e]
                end[indices[e] - low] += 1
