"""What labelling a point could be at its plainest and at its best: direct uplift, and the ceiling of true instances.

Uplift reads the mask table of the visibility stage: ``weights`` (masks, points) sparse, how much blending weight each
mask puts on each point, and ``features`` (masks, D), one row per mask in the same order. The ceiling reads the truth.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse import csr_array

from og_pointcloud.evaluate.baselines import uplift

__all__ = ["ceiling", "direct_uplift"]


def direct_uplift(
    weights: sparse.csr_matrix | sparse.csr_array, features: NDArray[np.floating], texts: NDArray[np.floating]
) -> NDArray[np.int32]:
    """Each point gets the mean feature of the masks that reach it, by weight, and the text closest to that.

    weights: (M, n), features: (M, D), texts: (C, D). Returns (n,) int32 class ids. A point is -1 only where no mask
    reaches it: uplift knows no background, and labels what a mask's rays slip through to.
    """
    return uplift(csr_array(weights), _unit(features), texts).astype(np.int32)


def ceiling(
    features: NDArray[np.floating], mask_instance: NDArray[np.integer], texts: NDArray[np.floating],
    instances: NDArray[np.integer],
) -> NDArray[np.int32]:  # fmt: skip
    """True instances, each with the mean feature of the masks that show mostly it, and the text closest to that.

    features: (M, D); mask_instance: (M,) the true instance that each mask mostly shows, -1 for background; texts:
    (C, D); instances: (n,) true instance of each point, -1 none. Returns (n,) int32 class ids, -1 off the instances and
    for an instance without a mask.
    """
    count = int(max(instances.max(initial=-1), mask_instance.max(initial=-1))) + 1
    label_of = np.full(count + 1, -1, np.int32)
    similarity = _unit(features) @ _unit(texts).T
    for instance in np.unique(mask_instance[mask_instance >= 0]):
        label_of[instance] = similarity[mask_instance == instance].mean(axis=0).argmax()
    return label_of[np.where(instances >= 0, instances, count)]


def _unit(rows: NDArray[np.floating]) -> NDArray[np.float64]:
    rows = np.asarray(rows, np.float64)
    return rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-12)
