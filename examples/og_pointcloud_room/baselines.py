"""What labelling a point could be at its plainest and at its best: direct uplift, and the ceiling of true instances.

Both read the mask table of the visibility stage: ``weights`` (masks, points) sparse, how much blending weight each
mask puts on each point, and ``features`` (masks, D), one row per mask in the same order.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

__all__ = ["ceiling", "direct_uplift"]


def direct_uplift(
    weights: sparse.csr_matrix | sparse.csr_array, features: NDArray[np.floating], texts: NDArray[np.floating]
) -> NDArray[np.int32]:
    """Each point gets the mean feature of the masks that reach it, by weight, and the text closest to that.

    weights: (M, n), features: (M, D), texts: (C, D). Returns (n,) int32 class ids. A point is -1 only where no mask
    reaches it: uplift knows no background, and labels what a mask's rays slip through to.
    """
    similarity = _unit(features) @ _unit(texts).T
    scores = np.asarray(weights.T @ similarity)
    reached = np.asarray(weights.sum(axis=0)).ravel() > 0
    return np.where(reached, scores.argmax(axis=1), -1).astype(np.int32)


def ceiling(
    weights: sparse.csr_matrix | sparse.csr_array, features: NDArray[np.floating], texts: NDArray[np.floating],
    instances: NDArray[np.integer], background: NDArray[np.bool_],
) -> NDArray[np.int32]:  # fmt: skip
    """True instances, each with the mean feature of the masks that lie mostly on it, and the text closest to that.

    instances: (n,) true ids, -1 none; background: (n,) bool. A mask belongs to the instance that holds the largest part
    of its weight on points of known truth; one that lies mostly on background belongs to none. Returns (n,) int32
    class ids, -1 off the instances and for an instance without a mask.
    """
    count = int(instances.max(initial=-1)) + 1
    owner = np.where(background, count, instances)
    onehot = (owner[:, None] == np.arange(count + 1)).astype(np.float32)
    overlap = np.asarray(weights @ onehot)
    of_mask = np.where(overlap.max(axis=1, initial=0) > 0, overlap.argmax(axis=1), count)
    label_of = np.full(count + 1, -1, np.int32)
    similarity = _unit(features) @ _unit(texts).T
    for instance in np.unique(of_mask[of_mask < count]):
        label_of[instance] = similarity[of_mask == instance].mean(axis=0).argmax()
    return label_of[np.where(instances >= 0, instances, count)]


def _unit(rows: NDArray[np.floating]) -> NDArray[np.float64]:
    rows = np.asarray(rows, np.float64)
    return rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-12)
