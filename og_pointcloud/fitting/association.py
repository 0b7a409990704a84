"""Instances + masks -> feature rows, and which instance is a part of which.

Feature rows: what the encoder saw of each instance, over all views (paper, Sec. 3.3). The paper matches each instance
with one mask per view by IoU and feature distance (Eq. 5) and averages. Here the masks of an instance are known from
grouping, and the mask table tells how much each shows of it, with true visibility. A mask is weighted by the cube root
of the pixels that it shows of the instance: weighted by pixels, one close-up with a wrong name would outvote three
views from twice as far. (Powers from 1/4 to 1/2 label scenes within 0.004 mIoU of each other.) Where masks name an
instance in different ways, their mean would be like no word at all: the largest kind describes it, without outliers.

Parts: a handle has masks of its own in some views, while most views show it within the mask of the mug. So, for
instances a and b, over the views that see both and have a mask of b:

    held     views in which most of what shows of a lies in a mask of b
    a is a part of b where held is a majority of these views, and some view shows a in a mask of its own

A parent is always an instance too: where masks never show the parent, or never the part, nothing is found. Groups of
masks and the leaves of a codebook are treated alike.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.sparse import csr_array

from og_pointcloud.cloud import InstanceTable
from og_pointcloud.fitting.grouping import cosines_within_views
from og_pointcloud.fitting.mask_table import MaskTable

MAJORITY_SHARE = 0.5
"""A view shows a part within its parent if more than this share of what it shows of the part lies in one mask of the
parent; more than this share of the views must do so."""
MIN_VISIBLE_SHARE = 0.1
"""A view that shows less of an instance than this share of its typical view is no evidence about it."""
MAX_COMPARED_MASKS = 2000
"""With more masks than this, an instance is described by all of them, without comparing pairs."""
SAME_KIND_BOUND = 2 / 3
"""Masks are of one kind from this far on between the cosines of different things (0) and of one instance (1) in the
scene. It is nearer to the latter, which wrongly named masks of instances lower."""
DOMINANT_WEIGHT_RATIO = 1.5
"""One kind of masks describes an instance if it has more than this many times the weight of any other kind."""
MIN_PART_VIEWS = 2
"""At least this many views must show a part within its parent: one alone could be a mask that spilled over."""


def describe_instances(
    table: MaskTable,
    group: NDArray[np.int32],
    instance_ids: NDArray[np.int32],
    count: int,
) -> InstanceTable:
    """One unit feature row per instance with its evidence, and the instance that it is a part of.

    group: (masks,) int32, the instance of each mask, -1 none. instance_ids: (n,) int32, below 0 none.
    Masks without a feature (zero rows) count as evidence of the instance but not in its row; an instance whose masks
    all lack features gets no row.
    """
    shown = shown_of_instance(table, group, instance_ids)
    features = directions(table.mask_features)
    rows, owners = [], []
    agreement = np.zeros(count, np.float32)
    # Masks that show nothing of their instance, or have no feature, do not describe it.
    described = features.any(axis=1)
    of_instance = members_of(np.where((shown > 0) & described, group, -1), count)
    different = cosines_within_views(features[described], table.mask_view[described])
    min_cosine = _same_kind_cosine(features, of_instance, different)
    for instance, members in enumerate(of_instance):
        weight = np.cbrt(shown[members])
        main = main_kind(features[members], weight, min_cosine)
        weight = weight[main]
        row, kept, cosines = robust_mean(features[members[main]], weight)
        if row is None:
            continue
        rows.append(row)
        owners.append(instance)
        agreement[instance] = np.average(cosines[kept], weights=weight[kept])
    # A view counts once, however many of its masks show the instance.
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
        part_of=part_of(table, group, instance_ids, count),
    )


def shown_of_instance(
    table: MaskTable, group: NDArray[np.int32], instance_ids: NDArray[np.int32]
) -> NDArray[np.float64]:
    """(masks,) float64: blending weight, in pixels, that each mask puts on the points of its own instance."""
    weights: csr_array = table.weights
    shown = np.zeros(weights.shape[0])
    for mask in np.flatnonzero(group >= 0):  # one by one: the table may be larger than memory
        part = slice(weights.indptr[mask], weights.indptr[mask + 1])
        on_instance = instance_ids[weights.indices[part]] == group[mask]
        shown[mask] = weights.data[part][on_instance].sum(dtype=np.float64)
    return shown


def members_of(group: NDArray[np.int32], count: int) -> list[NDArray[np.intp]]:
    """The masks of each of ``count`` groups, ascending. group: (masks,) int32, the group of each mask, -1 none."""
    # The pieces before group 0 (no group) and after the last are dropped.
    order = np.argsort(group, kind="stable")
    return np.split(order, np.searchsorted(group[order], np.arange(count + 1)))[1:-1]


def directions(rows: NDArray[np.floating]) -> NDArray[np.float64]:
    """(n, D) rows of length 1, zero rows stay zero. In float64: lengths of 1e30 overflow float32, and sums of nearly
    opposite directions are lost in its rounding."""
    wide = rows.astype(np.float64)
    length = np.linalg.norm(wide, axis=1, keepdims=True)
    return np.divide(wide, length, out=np.zeros_like(wide), where=length > 0)


def _same_kind_cosine(
    features: NDArray[np.float64], of_instance: list[NDArray[np.intp]], different: NDArray[np.float64]
) -> float:
    """The cosine above which masks of one instance are of one kind: SAME_KIND_BOUND, between the median cosines of
    different things (``different``) and of one instance in this scene. -1 (all are) where these cannot be told
    apart."""
    # Each instance counts once; pairs of all together would be gigabytes with thousands of views.
    compared = [features[members] for members in of_instance if 2 <= len(members) <= MAX_COMPARED_MASKS]
    same = [np.median((rows @ rows.T)[np.triu_indices(len(rows), 1)]) for rows in compared]
    if not same or not len(different) or np.median(same) <= np.median(different):
        return -1.0
    return float(SAME_KIND_BOUND * np.median(same) + (1 - SAME_KIND_BOUND) * np.median(different))


def main_kind(features: NDArray[np.float64], weight: NDArray[np.float64], min_cosine: float) -> NDArray[np.bool_]:
    """(n,) the unit rows of the kind that clearly has the most weight; all rows if none has.

    Kinds are the clusters of average linkage down to a mean cosine of ``min_cosine``.
    """
    all_rows = np.ones(len(features), bool)
    # Of two, size alone would decide; thousands have too many pairs, and their mean is near the main kind anyway.
    if not 3 <= len(features) <= MAX_COMPARED_MASKS:
        return all_rows
    distance = np.maximum(1 - (features @ features.T)[np.triu_indices(len(features), 1)], 0)
    kind = fcluster(linkage(distance, "average"), 1 - min_cosine, "distance")
    of_kind = np.bincount(kind, weight)
    *_, second, first = sorted(of_kind)  # kinds count from 1: the weight of number 0 makes two at least
    return kind == of_kind.argmax() if first > DOMINANT_WEIGHT_RATIO * second else all_rows


def robust_mean(
    features: NDArray[np.float64], weight: NDArray[np.float64]
) -> tuple[NDArray[np.float64] | None, NDArray[np.bool_], NDArray[np.float64]]:
    """Weighted mean direction of unit rows without outliers: the mean (None if there is none), the rows kept, and all
    cosines with it. An outlier's cosine lies more than three robust deviations (1.4826 MAD) below the median."""
    kept = np.ones(len(features), bool)
    cosines = np.zeros(len(features))
    mean = None
    # Twice: with all rows, to find the outliers, and without them.
    for _ in range(2):
        total = weight[kept] @ features[kept]
        length = np.linalg.norm(total)
        if length < 1e-12:  # no row, or rows that cancel
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

    mask_instance: (masks,) int32, the instance of each mask (`MaskGroups.group` or `Matching.mask_instance`), -1 none.
    instance_ids: (n,) int32, below 0 none. Of several parents the one that holds the part in the largest share of views
    is taken, of equal ones the smallest: a handle is a part of the mug before it is one of the table.
    """
    rows, masks = np.flatnonzero(instance_ids >= 0), len(mask_instance)
    of_instance = csr_array((np.ones(len(rows)), (rows, instance_ids[rows])), shape=(len(instance_ids), count))
    of_view = csr_array((np.ones(masks), (table.mask_view, np.arange(masks))), shape=(table.outside.shape[0], masks))
    # What each mask, and each view, shows of each instance; which views show enough of it, and which have a mask of it.
    shown = (table.weights @ of_instance).tocoo()  # (masks, count), sparse: gigabytes if dense
    seen = (table.outside @ of_instance + of_view @ shown).toarray()  # (views, count), in masks and outside
    sees = seen > MIN_VISIBLE_SHARE * _typical(seen)
    owned = np.flatnonzero(mask_instance >= 0)
    has_mask = np.zeros(seen.shape, bool)  # view, instance
    has_mask[table.mask_view[owned], mask_instance[owned]] = True

    # From here on an entry is a mask and an instance (part) that shows in it; whole is the mask's own instance.
    mask, part = shown.row, shown.col
    view, whole = table.mask_view[mask], mask_instance[mask]
    within = (shown.data > MAJORITY_SHARE * seen[view, part]) & sees[view, part]
    has_own_mask = np.zeros(count, bool)
    has_own_mask[part[within & (whole == part)]] = True
    # A whole must have more points than its part, so that there are no cycles.
    size = np.bincount(instance_ids[rows], minlength=count)
    holds = within & (whole >= 0) & sees[view, whole] & has_own_mask[part] & (size[whole] > size[part])
    # For each pair (part, whole): views that hold it, of those that could: that see both and have a mask of the whole.
    pairs, held = np.unique(np.stack([part[holds], whole[holds]]), axis=1, return_counts=True)
    part, whole = pairs[:, held >= MIN_PART_VIEWS]
    possible = [np.count_nonzero(sees[:, a] & sees[:, b] & has_mask[:, b]) for a, b in zip(part, whole, strict=True)]
    share = held[held >= MIN_PART_VIEWS] / np.array(possible)

    # By part, then the largest share, the smallest whole, the lowest number.
    best = np.lexsort((whole, size[whole], -share, part))
    best = best[share[best] > MAJORITY_SHARE]
    parent = np.full(count, -1, np.int32)
    parent[part[best[::-1]]] = whole[best[::-1]]  # of several wholes, the first is written last
    return parent


def _typical(seen: NDArray[np.float64]) -> NDArray[np.float64]:
    """Per instance, the median over the views that show it at all."""
    shows = np.where(seen > 0, seen, np.nan)
    typical = np.zeros(seen.shape[1])
    known = (seen > 0).any(axis=0)
    typical[known] = np.nanmedian(shows[:, known], axis=0)
    return typical
