"""Instance features -> clusters: the two-level codebook (paper, Sec. 3.2, Eq. 3 and 4), without rendering.

Eq. 4 asks that the map rendered from cluster centres c is near the one rendered from the features f themselves. As
blending is linear and its weights are positive, ``|W f - W c| <= sum_g w_g |f_g - c_g|``: a k-means weighted by how
much each Gaussian shows, which needs neither pixels nor gradients.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from og_pointcloud.errors import OgPointcloudError

__all__ = ["kmeans", "seed_centres"]

CHUNKS = 64
"""Partial sums of `kmeans`: a fixed number, so that the result does not depend on the number of threads."""
BLOCK = 256
"""Points whose distances are taken side by side."""
SLACK = np.float32(1e-5)
"""Distances of values in -1..1 are known to better than this in float32."""
SEED_POINTS = 1 << 15
"""`seed_centres` draws from at most this many of the points."""


def kmeans(
    values: NDArray[np.float32],
    weight: NDArray[np.floating],
    centres: NDArray[np.floating],
    rounds: int,
    *,
    reseed: bool,
) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """Lloyd's weighted k-means from the given centres, until nothing changes or ``rounds`` updates are done.

    values: (n, d) finite. weight: (n,) not negative; points of weight 0 are assigned but move no centre.
    centres: (k, d). reseed: a cluster without weight starts again at the point that is farthest from its own centre,
    distance squared times weight; it stays where it is where no point is off its centre, or without ``reseed``.

    Returns (n,) int32, the nearest of the returned centres (lowest of equals), and those centres (k, d) float32.
    The same input gives the same answer on any number of threads. Distances are taken about the middle of the values and
    in units of the largest, so neither offset nor unit matters.
    """
    _check(values, weight, centres)
    if len(centres) == 0:
        raise OgPointcloudError("k-means got 0 centres; expected at least one: do all points have weight 0?")
    n = len(values)
    if n == 0:
        return np.zeros(0, np.int32), centres.astype(np.float32)
    weight = np.ascontiguousarray(weight, np.float64)
    middle = np.median(values[:: -(-n // 1000)], axis=0)
    points = np.subtract(values, middle, dtype=np.float32)
    unit = max(float(points.max()), -float(points.min())) or 1.0
    points /= np.float32(unit)
    moving = (centres.astype(np.float64) - middle) / unit
    own, upper, lower = np.zeros(n, np.int32), np.full(n, np.inf, np.float32), np.zeros(n, np.float32)
    _reassign(points, moving.astype(np.float32), np.zeros(len(moving), np.float32), own, upper, lower)
    for _ in range(rounds):
        sums, mass = _cluster_sums(points, weight, own, len(moving))
        filled = mass > 0
        moved = moving.copy()
        moved[filled] = sums[filled] / mass[filled, None]
        if reseed and not filled.all():
            moved = _reseeded(points, weight, own, moved, np.flatnonzero(~filled))
        shift = np.linalg.norm(moved.astype(np.float32) - moving.astype(np.float32), axis=1)
        moving = moved
        if not shift.any():
            break
        _reassign(points, moving.astype(np.float32), shift, own, upper, lower)
    return own, (moving * unit + middle).astype(np.float32)


def seed_centres(
    values: NDArray[np.float32], weight: NDArray[np.floating], k: int, rng: np.random.Generator
) -> NDArray[np.float32]:
    """Up to k of the values as first centres, each drawn with a chance of weight x squared distance to the others.

    That is k-means++ (Arthur & Vassilvitskii 2007), weighted. Fewer than k, (m, d) with m < k, where the points that
    have weight lie in only m places; none if no point has weight.
    """
    _check(values, weight, values[:0])
    candidates = np.flatnonzero(weight > 0)
    if len(candidates) > SEED_POINTS:
        candidates = np.sort(rng.choice(candidates, SEED_POINTS, replace=False))
    points = values[candidates].astype(np.float64)
    chance = weight[candidates].astype(np.float64)
    squared = np.full(len(points), np.inf)
    chosen: list[int] = []
    while len(chosen) < k and chance.any():
        reached = np.cumsum(chance)
        chosen.append(int(np.searchsorted(reached, rng.random() * reached[-1], side="right")))
        squared = np.minimum(squared, ((points - points[chosen[-1]]) ** 2).sum(axis=1))
        chance = weight[candidates] * squared
    return values[candidates[chosen]]


def _check(values: NDArray[np.floating], weight: NDArray[np.floating], centres: NDArray[np.floating]) -> None:
    if values.ndim != 2 or weight.shape != (len(values),) or centres.shape[1:] != values.shape[1:]:
        raise OgPointcloudError(
            f"values {values.shape}, weight {weight.shape} and centres {centres.shape} do not fit; expected (n, d), "
            "(n,) and (k, d)"
        )
    if not np.isfinite(values).all() or not np.isfinite(weight).all() or (weight < 0).any():
        raise OgPointcloudError("values and weights of a codebook must be finite, weights at least 0")


def _reseeded(
    points: NDArray[np.float32],
    weight: NDArray[np.float64],
    own: NDArray[np.int32],
    centres: NDArray[np.float64],
    empty: NDArray[np.intp],
) -> NDArray[np.float64]:
    """The centres with empty clusters moved to the worst represented points, one after the other."""
    squared = ((points - centres[own]) ** 2).sum(axis=1)
    for cluster in empty:
        worst = int(np.argmax(weight * squared))
        if not weight[worst] * squared[worst] > 0:
            break
        centres[cluster] = points[worst]
        squared = np.minimum(squared, ((points - centres[cluster]) ** 2).sum(axis=1))
    return centres


@njit(cache=True, fastmath={"contract"})
def _two_nearest(points, block, centres, own, upper, lower):  # noqa: ANN001, ANN202
    """Set own centre, its distance and the second nearest's for the points listed in ``block``.

    Points side by side, without branches: the compiler makes vector code of that.
    """
    size, d = len(block), points.shape[1]
    columns = np.empty((d, size), np.float32)
    for b in range(size):
        for i in range(d):
            columns[i, b] = points[block[b], i]
    best = np.zeros(size, np.int32)
    first, second = np.full(size, np.float32(np.inf)), np.full(size, np.float32(np.inf))
    squared = np.empty(size, np.float32)
    for j in range(len(centres)):
        squared[:] = 0.0
        for i in range(d):
            value, column = centres[j, i], columns[i]
            for b in range(size):
                difference = column[b] - value
                squared[b] += difference * difference
        for b in range(size):
            this, least, next_least = squared[b], first[b], second[b]
            nearer = this < least
            loser = least if nearer else this
            second[b] = loser if loser < next_least else next_least
            best[b] = np.int32(j) if nearer else best[b]
            first[b] = this if nearer else least
    for b in range(size):
        own[block[b]], upper[block[b]], lower[block[b]] = best[b], np.sqrt(first[b]), np.sqrt(second[b])


@njit(cache=True, parallel=True)
def _reassign(points, centres, shift, own, upper, lower):  # noqa: ANN001, ANN202
    """Nearest centres after these have moved by ``shift``, in place.

    upper, lower: at least the distance to the own centre, at most that to any other. A point whose own centre is surely
    still the nearest is not looked at (Hamerly 2010).
    """
    n = len(points)
    farthest = shift.max()
    for chunk in prange(CHUNKS):
        block, size = np.empty(BLOCK, np.int32), 0
        for p in range(chunk * n // CHUNKS, (chunk + 1) * n // CHUNKS):
            upper[p] += shift[own[p]]
            lower[p] -= farthest
            if upper[p] >= lower[p] - SLACK:
                block[size] = p
                size += 1
            if size == BLOCK:
                _two_nearest(points, block, centres, own, upper, lower)
                size = 0
        _two_nearest(points, block[:size], centres, own, upper, lower)


@njit(cache=True, parallel=True)
def _cluster_sums(points, weight, own, k):  # noqa: ANN001, ANN202
    """Weighted sum (k, d) and weight (k,) of every cluster in float64, in an order that threads do not change."""
    n, d = points.shape
    sums = np.zeros((CHUNKS, k, d))
    mass = np.zeros((CHUNKS, k))
    for chunk in prange(CHUNKS):
        for p in range(chunk * n // CHUNKS, (chunk + 1) * n // CHUNKS):
            mass[chunk, own[p]] += weight[p]
            for i in range(d):
                sums[chunk, own[p], i] += weight[p] * points[p, i]
    return sums.sum(axis=0), mass.sum(axis=0)
