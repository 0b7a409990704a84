"""Instances + masks -> feature rows, and which instance is a part of which.

Feature rows: what the encoder saw of each instance, over all views (paper, Sec. 3.3). The paper matches each instance
with one mask per view by IoU and feature distance (Eq. 5) and averages. Here the masks of an instance are known from
grouping, and the mask table tells how much each shows of it, with true visibility. A mask counts by the
cube root of the pixels that it shows of the instance: by pixels, one close-up with a wrong name would outvote three
views from twice as far. (Powers from 1/4 to 1/2 label scenes within 0.004 mIoU of each other.) Where masks name an
instance in different ways, their mean would be like no word at all; those that are named as most are describe it, and
of these all but outliers.

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

MOSTLY = 0.5
"""A view shows a part in its parent where more than this share of what it shows of the part lies in one mask of the
parent; more than this share of the views must do so."""
SEEN_SHARE = 0.1
"""A view that shows less of an instance than this share of its typical view is no evidence about it."""
MOST_COMPARED = 2000
"""Masks of an instance that are compared pair by pair: of more, all describe it."""
CLEARLY = 1.5
"""Masks of one kind describe an instance where they have more than so many times the weight of any other kind."""
FEWEST_VIEWS = 2
"""At least so many views show a part in its parent: one alone could be a mask that spilled over."""


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
    # Masks that show nothing of their instance, or have no feature, say nothing of what it is.
    described = features.any(axis=1)
    of_instance = members_of(np.where((shown > 0) & described, group, -1), count)
    alike = _least_alike(features, of_instance, cosines_within_views(features[described], table.mask_view[described]))
    for instance, members in enumerate(of_instance):
        weight = np.cbrt(shown[members])
        main = main_kind(features[members], weight, alike)
        weight = weight[main]
        row, kept, cosines = robust_mean(features[members[main]], weight)
        if row is None:
            continue
        rows.append(row)
        owners.append(instance)
        agreement[instance] = np.average(cosines[kept], weights=weight[kept])
    # A view counts once, with however many masks it shows the instance.
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


def members_of(group: NDArray[np.int32], count: int) -> list[NDArray[np.intp]]:
    """The masks of each of ``count`` groups, ascending. group: (masks,) int32, the group of each mask, -1 none."""
    # The pieces before group 0 (no group) and after the last are dropped.
    order = np.argsort(group, kind="stable")
    return np.split(order, np.searchsorted(group[order], np.arange(count + 1)))[1:-1]


def directions(rows: NDArray[np.floating]) -> NDArray[np.float64]:
    """(n, D) rows of length 1, zero rows stay zero. In float64: lengths of 1e30 overflow float32, and directions that
    nearly cancel leave little more than its rounding."""
    wide = rows.astype(np.float64)
    length = np.linalg.norm(wide, axis=1, keepdims=True)
    return np.divide(wide, length, out=np.zeros_like(wide), where=length > 0)


def _least_alike(
    features: NDArray[np.float64], of_instance: list[NDArray[np.intp]], different: NDArray[np.float64]
) -> float:
    """The cosine above which masks of one instance are named alike: halfway between those of different things
    (``different``) and those of one instance in this scene, as medians. -1, all are, where these are not told apart."""
    # Each instance has one voice; pairs of all together would be gigabytes where views are thousands.
    compared = [features[members] for members in of_instance if 2 <= len(members) <= MOST_COMPARED]
    same = [np.median((rows @ rows.T)[np.triu_indices(len(rows), 1)]) for rows in compared]
    if not same or not len(different) or np.median(same) <= np.median(different):
        return -1.0
    return float(np.median(same) + np.median(different)) / 2


def main_kind(features: NDArray[np.float64], weight: NDArray[np.float64], alike: float) -> NDArray[np.bool_]:
    """Of unit rows those of the kind that has clearly most weight; all, where none has.

    Kinds are what average linkage joins down to a mean cosine of ``alike``.
    """
    everyone = np.ones(len(features), bool)
    # Of two, size alone would decide; of thousands, pairs are too many, and their mean is near the main kind anyway.
    if not 3 <= len(features) <= MOST_COMPARED:
        return everyone
    distance = np.maximum(1 - (features @ features.T)[np.triu_indices(len(features), 1)], 0)
    kind = fcluster(linkage(distance, "average"), 1 - alike, "distance")
    of_kind = np.bincount(kind, weight)
    *_, second, first = sorted(of_kind)  # of what no kind has the number 0, so there are two at least
    return kind == of_kind.argmax() if first > CLEARLY * second else everyone


def robust_mean(
    features: NDArray[np.float64], weight: NDArray[np.float64]
) -> tuple[NDArray[np.float64] | None, NDArray[np.bool_], NDArray[np.float64]]:
    """Weighted mean direction of unit rows without outliers: the mean (None if there is none), the rows kept, cosines.

    An outlier's cosine with the mean lies more than three robust deviations (1.4826 MAD) below the median.
    """
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

    mask_instance: (masks,) int32, the instance whose mask it is (`MaskGroups.group` or `Matching.mask_instance`), -1
    none. instance_ids: (n,) int32, below 0 none. Of several parents the one that holds the part in most of the views is
    taken, of equal ones the smallest: a handle is a part of the mug before it is one of the table.
    """
    rows, masks = np.flatnonzero(instance_ids >= 0), len(mask_instance)
    of_instance = csr_array((np.ones(len(rows)), (rows, instance_ids[rows])), shape=(len(instance_ids), count))
    of_view = csr_array((np.ones(masks), (table.mask_view, np.arange(masks))), shape=(table.outside.shape[0], masks))
    # What each mask, and each view, shows of each instance; which views show enough of it, and which have a mask of it.
    shown = (table.weights @ of_instance).tocoo()  # (masks, count), sparse: of ten thousand instances gigabytes
    seen = (table.outside @ of_instance + of_view @ shown).toarray()  # (views, count), in masks and outside
    sees = seen > SEEN_SHARE * _typical(seen)
    owned = np.flatnonzero(mask_instance >= 0)
    has_mask = np.zeros(seen.shape, bool)  # view, instance
    has_mask[table.mask_view[owned], mask_instance[owned]] = True

    # From here on an entry is a mask and an instance (part) that shows in it; whole is the instance of the mask.
    mask, part = shown.row, shown.col
    view, whole = table.mask_view[mask], mask_instance[mask]
    within = (shown.data > MOSTLY * seen[view, part]) & sees[view, part]
    has_own_mask = np.zeros(count, bool)
    has_own_mask[part[within & (whole == part)]] = True
    # A whole has more points than its part, so that there are no cycles.
    size = np.bincount(instance_ids[rows], minlength=count)
    holds = within & (whole >= 0) & sees[view, whole] & has_own_mask[part] & (size[whole] > size[part])
    # Of each pair (part, whole): the views that hold it, of those that could: they see both, and have a mask of b.
    pairs, held = np.unique(np.stack([part[holds], whole[holds]]), axis=1, return_counts=True)
    part, whole = pairs[:, held >= FEWEST_VIEWS]
    possible = [np.count_nonzero(sees[:, a] & sees[:, b] & has_mask[:, b]) for a, b in zip(part, whole, strict=True)]
    share = held[held >= FEWEST_VIEWS] / np.array(possible)

    # By part, then the largest share, the smallest whole, the lowest number.
    best = np.lexsort((whole, size[whole], -share, part))
    best = best[share[best] > MOSTLY]
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
