"""Instances + masks -> feature rows, and which instance is a part of which.

Feature rows: what the encoder saw of each instance, over all views (paper, Sec. 3.3). The paper matches each instance
with one mask per view by IoU and feature distance (Eq. 5) and averages. Here the masks of an instance are known from
grouping, and how much each shows of it is a product with the mask table, with true visibility. A mask counts by the
side of what it shows of the instance, the root of the pixels: by pixels, one close-up with a wrong name would outvote
three views from twice as far. Masks that disagree with the rest are left out.

Parts: a handle has masks of its own in some views, while most views show it within the mask of the mug. So, for
instances a and b, over the views that see both and have a mask of b:

    held     views in which most of what shows of a lies in a mask of b
    a is a part of b where held / all of them is a majority, and some view shows a in a mask of its own

No mask is needed that no view has: a parent is always an instance too. Where masks never show the parent, or never the
part, nothing is found. Works alike for groups of masks and for the leaves of a codebook.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from og_pointcloud.cloud import InstanceTable
from og_pointcloud.fitting.mask_table import MaskTable, weights_by_instance

MOSTLY = 0.5
"""A part lies mostly in one mask of its parent: more than this share of what a view shows of it, in more than this
share of the views."""
SEEN_SHARE = 0.1
"""A view that shows less of an instance than this share of its typical view is no evidence about it."""
FEWEST_VIEWS = 2
"""Views that show a part in its parent at least: one alone could be a mask that spilled over."""


def describe_instances(
    table: MaskTable,
    group: NDArray[np.int32],
    instance_ids: NDArray[np.int32],
    count: int,
) -> InstanceTable:
    """One unit feature row per instance with its evidence.

    group: (masks,) int32, the instance of each mask, -1 none. instance_ids: (n,) int32, -1 and below none.
    Masks without a feature (zero rows) count as evidence of the instance but not in its row; an instance of which no
    mask has a feature gets no row.
    """
    shown = shown_of_instance(table, group, instance_ids)
    features = directions(table.mask_features)
    rows, owners = [], []
    agreement = np.zeros(count, np.float32)
    for instance in range(count):
        members = np.flatnonzero((group == instance) & (shown > 0) & features.any(axis=1))
        weight = np.sqrt(shown[members])
        row, kept, cosines = robust_mean(features[members], weight)
        if row is None:
            continue
        rows.append(row)
        owners.append(instance)
        agreement[instance] = np.average(cosines[kept], weights=weight[kept])
    grouped = group >= 0
    pairs = np.unique(np.stack([group[grouped], table.mask_view[grouped]]), axis=1)
    return InstanceTable(
        descriptors=np.array(rows, np.float32).reshape(-1, features.shape[1]),
        descriptor_instance=np.array(owners, np.int32),
        points=np.bincount(instance_ids[instance_ids >= 0], minlength=count).astype(np.int32),
        views=np.bincount(pairs[0], minlength=count).astype(np.int32),
        masks=np.bincount(group[grouped], minlength=count).astype(np.int32),
        agreement=agreement,
        visible_area=np.bincount(group[grouped], shown[grouped], count).astype(np.float32),
    )


def shown_of_instance(
    table: MaskTable, group: NDArray[np.int32], instance_ids: NDArray[np.int32]
) -> NDArray[np.float64]:
    """(masks,) float64: pixels of blending weight that each mask puts on the points of its own instance."""
    weights: csr_array = table.weights
    shown = np.zeros(weights.shape[0])
    for mask in np.flatnonzero(group >= 0):  # one by one: the table may be larger than memory
        part = slice(weights.indptr[mask], weights.indptr[mask + 1])
        own = instance_ids[weights.indices[part]] == group[mask]
        shown[mask] = weights.data[part][own].sum(dtype=np.float64)
    return shown


def directions(rows: NDArray[np.floating]) -> NDArray[np.float64]:
    """(n, D) rows of length 1, zero rows stay zero. In float64: lengths of 1e30 overflow float32, and directions that
    nearly cancel leave little more than its rounding."""
    wide = rows.astype(np.float64)
    length = np.linalg.norm(wide, axis=1, keepdims=True)
    return np.divide(wide, length, out=np.zeros_like(wide), where=length > 0)


def robust_mean(
    features: NDArray[np.float64], weight: NDArray[np.float64]
) -> tuple[NDArray[np.float64] | None, NDArray[np.bool_], NDArray[np.float64]]:
    """Weighted mean direction of unit rows without outliers: the mean (None if there is none), the rows kept, cosines.

    An outlier's cosine with the mean lies more than three robust deviations (1.4826 MAD) below the median.
    """
    kept = np.ones(len(features), bool)
    cosines = np.zeros(len(features))
    mean = None
    for _ in range(2):
        total = weight[kept] @ features[kept]
        length = np.linalg.norm(total)
        if length < 1e-12:
            return None, kept, cosines
        mean = total / length
        cosines = features @ mean
        middle = np.median(cosines)
        spread = 1.4826 * np.median(np.abs(cosines - middle))
        kept = cosines >= middle - 3 * max(spread, 1e-6)
    return mean, kept, cosines


def part_of(
    table: MaskTable, mask_instance: NDArray[np.int32], instance_ids: NDArray[np.int32], count: int
) -> NDArray[np.int32]:
    """(count,) int32: the instance that each is a part of, -1 none. No cycles: a parent has more points than its parts.

    mask_instance: (masks,) int32, the instance whose mask it is (`MaskGroups.group` or `Matching.mask_instance`), -1
    none. instance_ids: (n,) int32, below 0 none. Of several parents the one that holds the part in most of the views is
    taken, of equal ones the smallest: a handle is a part of the mug before it is one of the table.
    """
    shown = weights_by_instance(table.weights, instance_ids, count)
    seen = weights_by_instance(table.outside, instance_ids, count)
    np.add.at(seen, table.mask_view, shown)  # (views, count): all that each view shows of each instance
    sees = seen > SEEN_SHARE * _typical(seen)
    has_mask = np.zeros((count, len(seen)), bool)  # instance, view
    has_mask[mask_instance[mask_instance >= 0], table.mask_view[mask_instance >= 0]] = True

    within = (shown > MOSTLY * seen[table.mask_view]) & sees[table.mask_view]
    masks, parts = np.nonzero(within)
    owners = mask_instance[masks]
    has_own_mask = np.zeros(count, bool)
    has_own_mask[parts[owners == parts]] = True
    other = (owners >= 0) & (owners != parts)
    other &= sees[table.mask_view[masks], owners]
    held = np.zeros((count, count))  # part, parent
    np.add.at(held, (parts[other], owners[other]), 1)
    possible = sees.T.astype(np.float64) @ (has_mask.T & sees)

    size = np.bincount(instance_ids[instance_ids >= 0], minlength=count)
    share = held / np.maximum(possible, 1)
    candidate = (share > MOSTLY) & (held >= FEWEST_VIEWS) & has_own_mask[:, None] & (size[None] > size[:, None])
    parent = np.full(count, -1, np.int32)
    for part in np.flatnonzero(candidate.any(axis=1)):
        parents = np.flatnonzero(candidate[part])
        parent[part] = parents[np.lexsort((parents, size[parents], -share[part, parents]))[0]]
    return parent


def _typical(seen: NDArray[np.float64]) -> NDArray[np.float64]:
    """Per instance, the median over the views that show it at all."""
    shows = np.where(seen > 0, seen, np.nan)
    typical = np.zeros(seen.shape[1])
    known = (seen > 0).any(axis=0)
    typical[known] = np.nanmedian(shows[:, known], axis=0)
    return typical
