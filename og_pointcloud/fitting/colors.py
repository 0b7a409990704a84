"""Colors of adjoining points -> how much likelier these are of one thing than of two, as this scene has it.

Votes are torn along borders: rays slip past edges, masks are ragged, and noise puts a point of the wall before the
lamp. A point's color is its own, wherever the noise put it. How much a difference of color says depends on the scene
(textures, light, how well colors and points fit each other), so it is counted there, on adjoining points of whose
states views are sure: how often is a difference as large within one state, and how often between two?
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import isotonic_regression

from og_pointcloud.kernels import njit, prange
from og_pointcloud.rendering.geometry import Neighborhood

DIFFERENCES = 443
"""Rounded Euclidean distances of two 8-bit colors: 0 to 442."""
LIKE_ALL = 30
"""Cases in which colors are like those of all, which are added to either of two that are to be told apart: a few that
were counted say little. 0 and 100 label scenes within 0.0001 mIoU of it."""
SURENESS_POWER = 4
"""A pair of points counts by this power of the sureness of both: where views disagree, the border lies elsewhere."""
MOST = 9.0
"""No difference counts as more than this many times likelier within one thing than between two, or the reverse."""


def color_ratios(
    rgb: NDArray[np.uint8] | None, ids: NDArray[np.int32], sureness: NDArray[np.float64], around: Neighborhood
) -> NDArray[np.float32]:
    """(443,) float32: how many times likelier each difference of color is between adjoining points of one state than of
    two. It falls with the difference, from at most MOST to at least 1 / MOST; 1 throughout where colors say nothing.

    rgb: (n, 3) or None. ids: (n,) the state of each point. sureness: (n,) in [0, 1], how sure views are of it.
    """
    if rgb is None:
        return np.ones(DIFFERENCES, np.float32)
    # In steps of 1/256 the products, and so their sums in float64, are exact: the points' order does not matter.
    voice = np.rint(256 * sureness**SURENESS_POWER) / 256
    return likelihood_ratios(*_counted(np.ascontiguousarray(rgb), ids, voice, around.index, around.adjoining))


def likelihood_ratios(one: NDArray[np.float64], other: NDArray[np.float64]) -> NDArray[np.float32]:
    """(443,) float32: how many times likelier each difference of color is in one case than in another. It falls with
    the difference, from at most MOST to at least 1 / MOST; 1 throughout where either was never seen.

    one, other: (443,) how often each difference was seen in either.
    """
    total = one + other
    if not total.any():
        return np.ones(DIFFERENCES, np.float32)
    # Few cases say little: either gets LIKE_ALL more that are like all of both.
    prior = total * (LIKE_ALL / total.sum())
    one, other = one + prior, other + prior
    # The chance of the one case given the difference, as if both were equally frequent: most neighbors are of one
    # state, say, which tells nothing about colors.
    one, both = one / one.sum(), one / one.sum() + other / other.sum()
    seen = np.flatnonzero(both)
    # Counts are noisy; a larger difference never speaks more for the one. Differences not seen are interpolated.
    chance = isotonic_regression(one[seen] / both[seen], weights=both[seen], increasing=False).x
    chance = np.clip(np.interp(np.arange(DIFFERENCES), seen, chance), 1 / (1 + MOST), MOST / (1 + MOST))
    return (chance / (1 - chance)).astype(np.float32)


def neighbor_weights(
    rgb: NDArray[np.uint8] | None, around: Neighborhood, ratios: NDArray[np.float32]
) -> NDArray[np.float32]:
    """(n, k) float32: for each point and neighbor the ratio of their difference; 0 for those that do not adjoin."""
    if rgb is None or (ratios == 1).all():
        return around.adjoining.astype(np.float32)
    return _weights(np.ascontiguousarray(rgb), around.index, around.adjoining, ratios)


@njit(cache=True)
def color_difference(a, b):  # noqa: ANN001, ANN201
    """Euclidean distance of two colors, rounded. In float64: differences of uint8 would wrap around."""
    total = 0.0
    for channel in range(3):
        total += (float(a[channel]) - float(b[channel])) ** 2
    return int(np.rint(np.sqrt(total)))


@njit(cache=True)
def _counted(rgb, ids, voice, neighbors, adjoining):  # noqa: ANN001, ANN202
    """(2, DIFFERENCES): pairs of adjoining points by their difference, of one state and of two, by both voices."""
    count = np.zeros((2, DIFFERENCES))
    for g in range(len(ids)):
        if voice[g] == 0:
            continue
        # Two points that are each other's neighbor count twice: shares are what is used, not numbers.
        for k in range(neighbors.shape[1]):
            other = neighbors[g, k]
            if adjoining[g, k] and voice[other] > 0:
                count[int(ids[g] != ids[other]), color_difference(rgb[g], rgb[other])] += voice[g] * voice[other]
    return count


@njit(cache=True, parallel=True)
def _weights(rgb, neighbors, adjoining, ratios):  # noqa: ANN001, ANN202
    weights = np.zeros(neighbors.shape, np.float32)
    for g in prange(len(neighbors)):
        for k in range(neighbors.shape[1]):
            if adjoining[g, k]:
                weights[g, k] = ratios[color_difference(rgb[g], rgb[neighbors[g, k]])]
    return weights
