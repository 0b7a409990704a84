"""What each view says of each point, and how much its word counts.

A view speaks of every point it sees: so much of what shows of the point lies in this mask, so much outside. Its word
counts by how openly it sees the point: the part of the splat that reaches the camera (exposure), relative to the
view that sees the point best, squared. So

* what shines through a gap in front of a surface is not believed where another view looks at it openly: else a few
  points in front would be outweighed by the many behind them, and a floor seen through a table be called table;
* a point inside a thick, noisy surface, which no view sees openly, still has its say, because all views see it alike;
* near and far views count alike: pixels are not evidence.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array

from og_pointcloud.fitting.mask_table import MaskTable
from og_pointcloud.fitting.memory import scratch_like
from og_pointcloud.kernels import njit

__all__ = ["Testimony", "hear_views"]

OPENNESS_POWER = 2
"""Exponent of the relative exposure. 1 believes too much of what shines through, 4 too little of thick surfaces."""


@dataclass(frozen=True)
class Testimony:
    """inside: (masks, n) sparse float32, what a mask's view says for "in this mask". word: (views, n) sparse float32,
    all that a view says of a point, in masks or not, in (0, 1]. The masks' rows of a view sum to at most its word."""

    inside: csr_array
    word: csr_array


def hear_views(table: MaskTable) -> Testimony:
    """The testimony of all views of a table."""
    weights, outside, exposure = table.weights, table.outside, table.exposure
    word, inside = scratch_like(exposure.data, np.float32), scratch_like(weights.data, np.float32)
    _relative(exposure.indices, exposure.data, exposure.shape[1], word)
    first_mask = np.searchsorted(table.mask_view, np.arange(exposure.shape[0] + 1))
    _parts(
        first_mask,
        (weights.indptr, weights.indices, weights.data),
        (outside.indptr, outside.indices, outside.data),
        (exposure.indptr, exposure.indices, word),
        exposure.shape[1],
        inside,
    )
    return Testimony(
        csr_array((inside, weights.indices, weights.indptr), shape=weights.shape),
        csr_array((word, exposure.indices, exposure.indptr), shape=exposure.shape),
    )


@njit(cache=True)
def _relative(index, exposure, n, word):  # noqa: ANN001, ANN202
    """Write to ``word`` each exposure as a part of the point's best one, to the power above."""
    best = np.zeros(n, np.float32)
    for e in range(len(index)):
        best[index[e]] = max(best[index[e]], exposure[e])
    for e in range(len(index)):
        word[e] = (exposure[e] / best[index[e]]) ** OPENNESS_POWER


@njit(cache=True)
def _parts(first_mask, weights, outside, word, n, inside):  # noqa: ANN001, ANN202
    """Write to ``inside`` each mask weight as a part of what its view shows of the point, times the view's word."""
    weight_start, weight_index, weight = weights
    outside_start, outside_index, out = outside
    word_start, word_index, said = word
    seen = np.zeros(n)
    factor = np.zeros(n)
    for view in range(len(first_mask) - 1):
        first, last = weight_start[first_mask[view]], weight_start[first_mask[view + 1]]
        for e in range(first, last):
            seen[weight_index[e]] += weight[e]
        for e in range(outside_start[view], outside_start[view + 1]):
            seen[outside_index[e]] += out[e]
        for e in range(word_start[view], word_start[view + 1]):
            g = word_index[e]
            factor[g] = said[e] / seen[g]
            seen[g] = 0.0
        for e in range(first, last):
            inside[e] = weight[e] * factor[weight_index[e]]
