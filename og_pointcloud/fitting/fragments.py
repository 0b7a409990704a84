"""Groups of masks that are pieces of one thing -> one group, where the views that see their border show none.

What stands in front cuts a thing into pieces: behind a table a chair's back and its legs are two masks in nearly every
view. Grouping (grouping.py) counts each such view as a witness for two things. Only the points tell that the pieces
adjoin, and which views see where they do. So once points have states, every pair of adjoining points in masks of two
groups is looked at in the views that see both:

    one, two    how openly the views that show the two points in one mask, and in two, see them, on average over the
                pairs of points of a border

How much that says depends on the scene: on noisy points, or where poses are off, masks of one thing hold the rim of the
next. So it is compared with what the same views show of pairs within one group, a share w in one mask, and of pairs of
groups whose masks are not alike, a share a. The log-likelihood ratio of one thing to two is then

    (one + HIDDEN_BORDER_VIEWS) log(w / a) + two log((1 - w) / (1 - a))

where the constant speaks for borders that hardly any view sees: two things of one kind mostly touch where they can be
seen. Groups whose masks are alike, and whose ratio exceeds MIN_LOG_RATIO, become one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from og_pointcloud.fitting.grouping import MaskGroups, cosines_within_views, indicator, ordered
from og_pointcloud.fitting.mask_table import MaskTable
from og_pointcloud.fitting.view_votes import PointVotes, ViewVotes
from og_pointcloud.kernels import njit, prange
from og_pointcloud.rendering.geometry import Neighborhood

HIDDEN_BORDER_VIEWS = 0.1
"""Every border counts as if so much of a view, besides those that see it, showed one thing there."""
MIN_LOG_RATIO = 0.1
"""Groups are joined from this log-likelihood ratio on."""
ALIKE_SHARE = 0.5
"""Masks are alike from this share of the way on from the typical cosine of different things to that of one group."""
MIN_SHARE = 0.01
"""No share w or a is nearer to 0 or 1 than this."""

_FIXED_POINT_SCALE = float(1 << 24)
"""Counts are rounded to multiples of its reciprocal, so that their float64 sums are exact and do not depend on the
order of points."""


@dataclass(frozen=True)
class _Borders:
    """Where groups adjoin. first, second: (borders,) int32, the two groups, the lower first; equal for the pairs of
    points of one group that lie beside a border. one, two: (borders,) float64, means over pairs of points, as above.
    """

    first: NDArray[np.int32]
    second: NDArray[np.int32]
    one: NDArray[np.float64]
    two: NDArray[np.float64]


def join_fragments(
    groups: MaskGroups,
    table: MaskTable,
    votes: ViewVotes,
    ids: NDArray[np.int32],
    around: Neighborhood,
    visibility: NDArray[np.float32],
) -> tuple[MaskGroups, NDArray[np.int32]]:
    """The groups, with those made one that are pieces of one thing, ordered by what they show, as before; and the group
    of each point.

    ids: (n,) int32, the group of each point as decided so far, below 0 none. visibility: (n,) in [0, 1], how openly
    points are seen.
    """
    borders = _borders(votes.by_point, table.mask_view, ids, around, visibility)
    alike = _alike(groups, table, borders.first, borders.second)
    joined = alike & (_log_ratio(borders, alike) > MIN_LOG_RATIO)
    if not joined.any():
        return groups, ids
    ones, pieces = np.ones(np.count_nonzero(joined)), (borders.first[joined], borders.second[joined])
    links: csr_array = csr_array((ones, pieces), shape=(groups.count, groups.count))
    whole = connected_components(links, directed=False)[1]
    grouped = np.flatnonzero(groups.group >= 0)
    group = np.where(groups.group >= 0, whole[groups.group], -1)
    group, count = ordered(group, np.asarray(table.weights.sum(axis=1), np.float64).ravel())
    number = np.full(groups.count, -1, np.int32)
    number[groups.group[grouped]] = group[grouped]
    return MaskGroups(group, count, groups.spanning), np.where(ids >= 0, number[ids], ids)


def _log_ratio(borders: _Borders, alike: NDArray[np.bool_]) -> NDArray[np.float64]:
    """(borders,) the log-likelihood ratio of one thing to two; 0 where the borders of the scene say nothing."""
    one, two, inside = borders.one, borders.two, borders.first == borders.second
    seen = one + two > HIDDEN_BORDER_VIEWS
    share = one / np.maximum(one + two, np.finfo(np.float64).tiny)
    if not (seen & inside).any() or not (seen & ~inside & ~alike).any():
        return np.zeros(len(one))
    within = float(np.clip(np.median(share[seen & inside]), MIN_SHARE, 1 - MIN_SHARE))
    across = float(np.clip(np.median(share[seen & ~inside & ~alike]), MIN_SHARE, within))
    return (one + HIDDEN_BORDER_VIEWS) * np.log(within / across) + two * np.log((1 - within) / (1 - across))


def _alike(
    groups: MaskGroups, table: MaskTable, first: NDArray[np.int32], second: NDArray[np.int32]
) -> NDArray[np.bool_]:
    """(borders,) whether the masks of two groups are alike. Cosines are means over pairs of masks: sums of features
    have less noise, so any two are more alike. Never, where masks of one group are not more alike than others."""
    features = table.unit_features.astype(np.float64)
    described = features.any(axis=1)
    member = indicator(np.where(described, groups.group, -1), groups.count)
    total, masks = member @ features, np.asarray(member.sum(axis=1), np.float64)
    several = masks > 1
    own = ((total**2).sum(axis=1) - masks)[several] / (masks * (masks - 1))[several]
    different = cosines_within_views(features[described], table.mask_view[described])
    if not len(own) or not len(different) or np.median(own) <= np.median(different):
        return np.zeros(len(first), np.bool_)
    cosine = (total[first] * total[second]).sum(axis=1) / np.maximum(masks[first] * masks[second], 1)
    least = ALIKE_SHARE * np.median(own) + (1 - ALIKE_SHARE) * np.median(different)
    return (first != second) & (masks[first] * masks[second] > 0) & (cosine > least)


def _borders(
    point_votes: PointVotes,
    mask_view: NDArray[np.int32],
    ids: NDArray[np.int32],
    around: Neighborhood,
    visibility: NDArray[np.float32],
) -> _Borders:
    """What views show of the points at borders, each with all points that it adjoins."""
    states = ids[around.index]
    foreign = around.adjoining & (states != ids[:, None]) & (states >= 0) & (ids >= 0)[:, None]
    at_border = np.flatnonzero(foreign.any(axis=1))
    usable = around.adjoining[at_border] & (states[at_border] >= 0)
    pairs = np.stack([np.repeat(at_border, usable.sum(axis=1)), around.index[at_border][usable]], axis=1)
    shown = _shown_together(pairs, point_votes[0], mask_view) * visibility[pairs].prod(axis=1, keepdims=True)
    # Rounded so that sums are exact and do not depend on the order of points.
    shown = np.rint(shown * _FIXED_POINT_SCALE) / _FIXED_POINT_SCALE
    groups, border = np.unique(np.sort(ids[pairs], axis=1), axis=0, return_inverse=True)
    size = np.bincount(border, minlength=len(groups))
    one, two = (np.bincount(border, column, len(groups)) / size for column in shown.T)
    return _Borders(groups[:, 0], groups[:, 1], one, two)


@njit(cache=True, parallel=True)
def _shown_together(pairs, masks, mask_view):  # noqa: ANN001, ANN202
    """(pairs, 2) products of the votes on two points, summed over views: in one mask, and in two of a view."""
    start, of_mask = masks
    shown = np.zeros((len(pairs), 2))
    for p in prange(len(pairs)):
        e, f = start[pairs[p, 0]], start[pairs[p, 1]]
        e_end, f_end = start[pairs[p, 0] + 1], start[pairs[p, 1] + 1]
        while e < e_end and f < f_end:
            view = mask_view[of_mask[e].row]
            if mask_view[of_mask[f].row] < view:
                f += 1
                continue
            # All masks of this view around the first point, with each of its masks around the second.
            other = f
            while other < f_end and mask_view[of_mask[other].row] == view:
                both = of_mask[e].vote * of_mask[other].vote
                shown[p, 0 if of_mask[e].row == of_mask[other].row else 1] += both
                other += 1
            e += 1
    return shown
