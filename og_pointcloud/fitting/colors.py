"""Colors of adjoining points -> how much likelier these belong to one thing than to two, measured in this scene.

Votes are torn along borders: rays slip past edges, masks are ragged, and noise puts a point of the wall in front of the
lamp. A point keeps its color wherever noise puts it. How much a color difference says depends on the scene (textures,
light, how well colors and points fit each other), so it is counted there, on adjoining points whose states are sure:
how often is a difference that large within one state, and how often between two?
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import isotonic_regression

from og_pointcloud.kernels import njit, prange
from og_pointcloud.rendering.geometry import Neighborhood

COLOR_DIFFERENCE_BINS = 443
"""Rounded Euclidean distances of two 8-bit colors: 0 to 442."""
PRIOR_COUNT = 30
"""Pseudo-count with the color differences of all cases, added to both cases that are compared: a few counted ones say
little. 0 and 100 label scenes within 0.0001 mIoU of it."""
SURENESS_POWER = 4
"""A pair of points counts by the probabilities of both states to this power: where views disagree, the border lies
elsewhere."""
MAX_COLOR_RATIO = 9.0
"""No difference counts as more than this many times likelier within one thing than between two, or vice versa."""


def color_ratios(
    rgb: NDArray[np.uint8] | None, ids: NDArray[np.int32], probability: NDArray[np.float64], around: Neighborhood
) -> NDArray[np.float32]:
    """(443,) float32: how many times likelier each color difference is between adjoining points of one state than of
    two. Decreasing, within 1 / MAX_COLOR_RATIO and MAX_COLOR_RATIO; 1 throughout where colors say nothing.

    rgb: (n, 3) or None. ids: (n,) the state of each point. probability: (n,) in [0, 1], that it is in this state.
    """
    if rgb is None:
        return np.ones(COLOR_DIFFERENCE_BINS, np.float32)
    # In steps of 1/256 the products, and so their sums in float64, are exact: the order of points does not matter.
    weight = np.rint(256 * probability**SURENESS_POWER) / 256
    return likelihood_ratios(*_pair_counts(np.ascontiguousarray(rgb), ids, weight, around.index, around.adjoining))


def likelihood_ratios(first: NDArray[np.float64], second: NDArray[np.float64]) -> NDArray[np.float32]:
    """(443,) float32: how many times likelier each color difference is in the first case than in the second.
    Decreasing, within 1 / MAX_COLOR_RATIO and MAX_COLOR_RATIO; 1 throughout if either case was never seen.

    first, second: (443,) how often each difference was seen in each case.
    """
    total = first + second
    if not total.any():
        return np.ones(COLOR_DIFFERENCE_BINS, np.float32)
    # Few counts say little: each case gets PRIOR_COUNT more, distributed as both cases together.
    prior = total * (PRIOR_COUNT / total.sum())
    first, second = first + prior, second + prior
    # The probability of the first case given the difference, as if both cases were equally frequent: that most
    # neighbors share a state, say, tells nothing about colors.
    first, both = first / first.sum(), first / first.sum() + second / second.sum()
    seen = np.flatnonzero(both)
    # Counts are noisy, but a larger difference is never more evidence for the first. Unseen ones are interpolated.
    chance = isotonic_regression(first[seen] / both[seen], weights=both[seen], increasing=False).x
    highest = MAX_COLOR_RATIO / (1 + MAX_COLOR_RATIO)
    chance = np.clip(np.interp(np.arange(COLOR_DIFFERENCE_BINS), seen, chance), 1 / (1 + MAX_COLOR_RATIO), highest)
    return (chance / (1 - chance)).astype(np.float32)


def neighbor_weights(
    rgb: NDArray[np.uint8] | None, around: Neighborhood, ratios: NDArray[np.float32]
) -> NDArray[np.float32]:
    """(n, k) float32: the ratio of the color difference of each point and neighbor; 0 for those that do not adjoin."""
    if rgb is None or (ratios == 1).all():
        return around.adjoining.astype(np.float32)
    return _weights(np.ascontiguousarray(rgb), around.index, around.adjoining, ratios)


def outline_ratios(
    rgb: NDArray[np.uint8] | None, group: NDArray[np.int32], count: int, around: Neighborhood,
    ratios: NDArray[np.float32],
) -> NDArray[np.float64]:  # fmt: skip
    """(count,) float64: of each group, the mean ratio of the color differences across its outline, between its points
    and adjoining ones that are not in it; 1 without any. group: (n,) int32, -1 none."""
    if rgb is None or (ratios == 1).all():
        return np.ones(count)
    # Counts are whole numbers: their sums do not depend on the order of points.
    counts = _outline_counts(np.ascontiguousarray(rgb), group, count, around.index, around.adjoining)
    pairs = counts.sum(axis=1)
    return np.where(pairs > 0, counts @ ratios.astype(np.float64) / np.maximum(pairs, 1), 1.0)


@njit(cache=True)
def color_difference(a, b):  # noqa: ANN001, ANN201
    """Euclidean distance of two colors, rounded. In float64: differences of uint8 would wrap around."""
    total = 0.0
    for channel in range(3):
        total += (float(a[channel]) - float(b[channel])) ** 2
    return int(np.rint(np.sqrt(total)))


@njit(cache=True)
def _pair_counts(rgb, ids, weight, neighbors, adjoining):  # noqa: ANN001, ANN202
    """(2, 443): pairs of adjoining points by color difference, of one state and of two, weighted by both weights."""
    count = np.zeros((2, COLOR_DIFFERENCE_BINS))
    for g in range(len(ids)):
        if weight[g] == 0:
            continue
        # Two points that are each other's neighbor count twice: only shares are used, not numbers.
        for k in range(neighbors.shape[1]):
            other = neighbors[g, k]
            if adjoining[g, k] and weight[other] > 0:
                count[int(ids[g] != ids[other]), color_difference(rgb[g], rgb[other])] += weight[g] * weight[other]
    return count


@njit(cache=True)
def _outline_counts(rgb, group, count, neighbors, adjoining):  # noqa: ANN001, ANN202
    """(count, 443): pairs of a point of each group and an adjoining one outside it, by color difference."""
    counts = np.zeros((count, COLOR_DIFFERENCE_BINS), np.int64)
    for g in np.flatnonzero(group >= 0):
        for k in range(neighbors.shape[1]):
            if adjoining[g, k] and group[neighbors[g, k]] != group[g]:
                counts[group[g], color_difference(rgb[g], rgb[neighbors[g, k]])] += 1
    return counts


@njit(cache=True, parallel=True)
def _weights(rgb, neighbors, adjoining, ratios):  # noqa: ANN001, ANN202
    weights = np.zeros(neighbors.shape, np.float32)
    for g in prange(len(neighbors)):
        for k in range(neighbors.shape[1]):
            if adjoining[g, k]:
                weights[g, k] = ratios[color_difference(rgb[g], rgb[neighbors[g, k]])]
    return weights
