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
seen. Groups whose masks are alike, and whose ratio exceeds MIN_LOG_RATIO, become one. Alike is what is nearly as like
as masks of one group: one false pair, of two brown things say, names both wrongly.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.fitting.grouping import MaskGroups, cosines_within_views, indicator, ordered
from og_pointcloud.fitting.mask_table import MaskTable
from og_pointcloud.fitting.view_votes import FIXED_POINT_SCALE, PointVotes, ViewVotes
from og_pointcloud.kernels import njit, prange
from og_pointcloud.rendering.geometry import Neighborhood

HIDDEN_BORDER_VIEWS = 0.1
"""Every border counts as if so much of a view, besides those that see it, showed one thing there."""
MIN_LOG_RATIO = 0.1
"""Groups are joined from this log-likelihood ratio on."""
ALIKE_SHARE = 0.9
"""Masks of two groups are alike from this share of the way on from the typical cosine of different things to that of
one group, less what follows."""
ALIKE_SHARE_LESS = 0.5
"""The share is less by this, over the root of the number of masks of the smaller group: few differ more by chance."""
MIN_SHARE = 0.01
"""No share w or a is nearer to 0 or 1 than this."""


@dataclass(frozen=True)
class _Borders:
    """Where groups adjoin. first, second: (borders,) int64, the two groups, the lower first; equal for the pairs of
    points of one group that lie beside a border. shown: (borders, 2) float64, sums of one and two over these pairs of
    points. size: (borders,) float64, their number."""

    first: NDArray[np.int64]
    second: NDArray[np.int64]
    shown: NDArray[np.float64]
    size: NDArray[np.float64]

    @classmethod
    def between(cls, groups: NDArray[np.integer], shown: NDArray[np.float64], size: NDArray[np.float64]) -> _Borders:
        """Sums over all rows of the same two groups. groups: (rows, 2), in any order."""
        low, high = np.sort(groups, axis=1).astype(np.int64).T
        count = int(high.max(initial=0)) + 1
        key, border = np.unique(low * count + high, return_inverse=True)
        sums = np.array([np.bincount(border, column, len(key)) for column in (*shown.T, size)], np.float64)
        first, second = np.divmod(key, count)
        return cls(first, second, sums[:2].T, sums[2])

    def joined(self, whole: NDArray[np.int64]) -> _Borders:
        """The borders of larger groups. whole: (groups,) the larger group that each belongs to."""
        return _Borders.between(whole[np.stack([self.first, self.second], axis=1)], self.shown, self.size)

    @property
    def inside(self) -> NDArray[np.bool_]:
        """(borders,) whether both points of the pairs lie in one group."""
        return self.first == self.second

    @property
    def views(self) -> NDArray[np.float64]:
        """(2, borders) one and two, as above."""
        return self.shown.T / self.size


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

    Pairs that are each other's best are joined, then their masks and borders count together, until none is left.
    ids: (n,) int32, the group of each point as decided so far, below 0 none. visibility: (n,) in [0, 1], how openly
    points are seen.
    """
    borders = _borders(votes.by_point, table.mask_view, ids, around, visibility)
    looks = _Looks.of_groups(groups, table)
    shares = _shares(borders, looks.alike(borders))
    whole = np.arange(groups.count)
    while shares:
        first, second = _each_others_best(borders, _log_ratio(borders, *shares), looks.alike(borders))
        if not len(first):
            break
        looks.join(first, second)
        merged = np.arange(groups.count)
        merged[second] = first
        whole, borders = merged[whole], borders.joined(merged)
    grouped = groups.group >= 0
    group = np.where(grouped, whole[groups.group], -1) if groups.count else groups.group
    group, count = ordered(group, np.asarray(table.weights.sum(axis=1), np.float64).ravel())
    if count == groups.count:
        return groups, ids
    number = np.full(groups.count, -1, np.int32)
    number[groups.group[grouped]] = group[grouped]
    return MaskGroups(group, count, groups.spanning), np.where(ids >= 0, number[ids], ids)


def _shares(borders: _Borders, alike: NDArray[np.bool_]) -> tuple[float, float] | None:
    """w and a, medians over borders; None where the scene has none to tell."""
    one, two = borders.views
    seen = one + two > HIDDEN_BORDER_VIEWS
    within, across = seen & borders.inside, seen & ~borders.inside & ~alike
    if not within.any() or not across.any():
        return None
    share = one / np.maximum(one + two, np.finfo(np.float64).tiny)
    w = float(np.clip(np.median(share[within]), MIN_SHARE, 1 - MIN_SHARE))
    return w, float(np.clip(np.median(share[across]), MIN_SHARE, w))


def _log_ratio(borders: _Borders, w: float, a: float) -> NDArray[np.float64]:
    """(borders,) the log-likelihood ratio of one thing to two."""
    one, two = borders.views
    return (one + HIDDEN_BORDER_VIEWS) * np.log(w / a) + two * np.log((1 - w) / (1 - a))


def _each_others_best(
    borders: _Borders, ratio: NDArray[np.float64], alike: NDArray[np.bool_]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Pairs of alike groups with a sufficient ratio, of which each has no better partner (ties: the lowest numbers)."""
    usable = np.flatnonzero(alike & (ratio > MIN_LOG_RATIO))
    usable = usable[np.argsort(-ratio[usable], kind="stable")]
    first, second = borders.first[usable], borders.second[usable]
    # Where a group occurs for the first time, best pairs first, is its best pair.
    occurring, earliest = np.unique(np.stack([first, second], axis=1), return_index=True)
    best = np.full(int(occurring.max(initial=-1)) + 1, -1)
    best[occurring] = earliest // 2
    mutual = (best[first] == np.arange(len(usable))) & (best[second] == np.arange(len(usable)))
    return first[mutual], second[mutual]


@dataclass
class _Looks:
    """What the encoder says of groups. total: (groups, D) float64, sums of the unit features of their masks. masks:
    (groups,) how many these are. own, different: typical cosines of masks of one group, and of different things."""

    total: NDArray[np.float64]
    masks: NDArray[np.float64]
    own: float
    different: float

    @classmethod
    def of_groups(cls, groups: MaskGroups, table: MaskTable) -> _Looks:
        """None are alike where masks of one group are not more alike than those of one view."""
        features = table.unit_features.astype(np.float64)
        described = features.any(axis=1)
        member = indicator(np.where(described, groups.group, -1), groups.count)
        total, masks = member @ features, np.asarray(member.sum(axis=1), np.float64)
        several = masks > 1
        own = ((total**2).sum(axis=1) - masks)[several] / (masks * (masks - 1))[several]
        different = cosines_within_views(features[described], table.mask_view[described])
        if not len(own) or not len(different):
            return cls(total, masks, 0.0, 0.0)
        return cls(total, masks, float(np.median(own)), float(np.median(different)))

    def alike(self, borders: _Borders) -> NDArray[np.bool_]:
        """(borders,) whether the masks of two groups are alike. Cosines are means over pairs of masks: sums of features
        have less noise, so any two are more alike."""
        masks = np.stack([self.masks[borders.first], self.masks[borders.second]])
        pairs = masks.prod(axis=0)
        usable = ~borders.inside & (pairs > 0) & (self.own > self.different)
        cosine = (self.total[borders.first] * self.total[borders.second]).sum(axis=1) / np.maximum(pairs, 1)
        share = ALIKE_SHARE - ALIKE_SHARE_LESS / np.sqrt(np.maximum(masks.min(axis=0), 1))
        return usable & (cosine > self.different + share * (self.own - self.different))

    def join(self, first: NDArray[np.int64], second: NDArray[np.int64]) -> None:
        """The masks of the second groups become those of the first."""
        self.total[first] += self.total[second]
        self.masks[first] += self.masks[second]


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
    shown = np.rint(shown * FIXED_POINT_SCALE) / FIXED_POINT_SCALE
    return _Borders.between(ids[pairs], shown, np.ones(len(pairs)))


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
