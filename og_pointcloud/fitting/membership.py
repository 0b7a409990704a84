"""Groups of masks -> one state per point: an instance, background, or unobserved. Decided from all views together.

A mask covers a point or it does not; what matters is what the *other* views say. Let, for point g and instance k,

    for_k(g)       votes for "in a mask of k" (see `view_votes`)
    possible_k(g)  votes on g of the views that have a mask of k
    share          for_k / possible_k

A view in which the proposer missed k has no vote about k; a view that has a mask of k and shows g outside it votes "not
k". So a share near 1 means "k", near 0 "seen, and not k", however often the proposer misses. A point in masks of
several groups is asked of the one with the most votes. But proposers let large things swallow small ones: where that
group's own views contradict it and a smaller one is sure, the smaller one is asked.

Points whose state is clear from that are those that views see openly and agree on. Where no view sees a point openly,
all votes on it are hearsay: rays that slip through a surface agree about what lies behind it, and are wrong. What
counts as openly is measured by the scene's other points: in surfaces of several noisy layers little is seen anywhere.
The clear points show what each view reports of each instance and of background, and these reports, with neighbors and
colors, say what every point is likeliest of (view_reports.py).

Where a proposer misses a cup, its pixels may lie in the mask of its table. What the points then are shows it: such a
mask holds most of what its view sees of two groups. It is named as its own group still, but from then on tells points
only that they are of one of the two, and they choose once more.

Torn mask edges leave middling shares on the rim of an object, and views that tear it alike call it background. So do
rays that slip past an edge on what lies behind. The two are told apart by place and color: a background point with a
middling share becomes one of the instance where it adjoins points that are (hysteresis, as in Canny's edges). And by
who sees it well: what rays slip past is in masks of views that see it badly and outside those of views that see it
openly, where of a rim all say alike. So a middling share counts only where it stays one when each vote counts by
itself once more.

What one view alone has a mask of, and the others show outside all masks, is a thing only if as many views may well have
missed one: how often they do, the scene's other groups tell.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from og_pointcloud.cloud import BACKGROUND, UNOBSERVED
from og_pointcloud.fitting.colors import color_ratios, neighbor_weights
from og_pointcloud.fitting.grouping import MaskGroups, with_spanning
from og_pointcloud.fitting.mask_table import MaskTable
from og_pointcloud.fitting.view_reports import ViewReports, likely_states
from og_pointcloud.fitting.view_votes import ViewVotes, VotesOfPoints, votes_of_points
from og_pointcloud.kernels import njit, prange
from og_pointcloud.rendering.geometry import Neighborhood
from og_pointcloud.settings import FitSettings, MembershipSettings


@dataclass(frozen=True)
class SceneVotes:
    """What all votes of a scene say, for points that are a part of it. typical_openness: as of `ViewVotes`.
    reports: what each view reports of each state."""

    typical_openness: float
    reports: ViewReports


@dataclass(frozen=True)
class Membership:
    """instance_ids: (n,) int32, a group, BACKGROUND or UNOBSERVED. certainty: (n,) float32 in [0, 1], how likely views
    make the state that a point is given, times the part of its neighbors that are in it; 0 where no view sees it.
    expected_iou: (groups,) float64, of the points given to each group with those that are of it, as far as views tell.
    detection_rate: (groups,) float32, the part of a group's visible weight that lies in views that have a mask of it.
    dismissed: (groups,) bool, groups that the scene's views contradict as a whole. scene: what all votes said."""

    instance_ids: NDArray[np.int32]
    certainty: NDArray[np.float32]
    expected_iou: NDArray[np.float64]
    detection_rate: NDArray[np.float32]
    dismissed: NDArray[np.bool_]
    scene: SceneVotes


def settled_points(
    table: MaskTable,
    votes: ViewVotes,
    groups: MaskGroups,
    around: Neighborhood,
    settings: FitSettings,
    rgb: NDArray[np.uint8] | None = None,
) -> tuple[MaskGroups, Membership]:
    """Decide the state of every point of a scene, then once more with the masks that these states show to span two
    groups, which tell of neither. Returns the groups with these masks marked, too."""
    asked = around, settings.membership, rgb
    first = assign_points(table, votes, groups, *asked)
    known = with_spanning(groups, votes, table.mask_view, first.instance_ids, settings.grouping)
    if (known.spanning == groups.spanning).all():
        return groups, first
    return known, assign_points(table, votes, known, *asked)


def assign_points(
    table: MaskTable,
    votes: ViewVotes,
    groups: MaskGroups,
    around: Neighborhood,
    settings: MembershipSettings,
    rgb: NDArray[np.uint8] | None = None,
    scene: SceneVotes | None = None,
) -> Membership:
    """Decide the state of every point. Groups keep their numbers, of which a later one is smaller; a dismissed group
    ends with no point.

    rgb: (n, 3), or None: colors are not asked. scene: of which these points are a part; None: they are all of it.
    """
    has_mask = views_with_masks(table, groups)
    # Points choose twice: among all groups, which shows those that are noise, and among the others.
    of_points = votes_of_points(votes)
    asked = of_points, groups.told, table.mask_view, has_mask
    support = _support(*asked, np.ones(groups.count, np.bool_), settings)
    rate, dismissed = _contradicted(support, votes, has_mask.sum(axis=1), settings)
    support = _support(*asked, ~dismissed, settings)

    typical = scene.typical_openness if scene else votes.typical_openness
    openly = _openly(votes.openness, settings.open_share * typical)
    clear = _clear(support, openly, settings)
    weights = neighbor_weights(rgb, around, color_ratios(rgb, clear, support.of_state(clear), around))
    # What each mask reports: its group, nothing, or that it spans several, under a number of its own after the groups.
    reporting = np.append(np.where(dismissed, -1, np.arange(groups.count)), -1)[groups.told]
    reporting[groups.spanning] = groups.count + np.arange(np.count_nonzero(groups.spanning))
    of_masks, size = (reporting, table.mask_view), (votes.vote.shape[0], groups.count)
    likely, reports = likely_states(
        of_points, of_masks, size, clear, support.group, openly, around, weights, scene.reports if scene else None
    )
    possible = (support.share > settings.possible_share) & (support.share_openly > settings.possible_openly)
    ids = _completed(likely.ids, support, possible, (table, groups.told), around, weights, settings)
    certainty = likely.probability_of(ids) * _agreeing(ids, around.index, around.adjoining)
    return Membership(
        ids, certainty.astype(np.float32), likely.expected_iou(ids), rate.astype(np.float32), dismissed,
        SceneVotes(typical, reports),
    )  # fmt: skip


def assign_by_votes_alone(
    table: MaskTable, votes: ViewVotes, groups: MaskGroups, around: Neighborhood, settings: MembershipSettings
) -> NDArray[np.int32]:
    """(n,) the states of points that views agree on and of possible ones that adjoin them, as if they were seen
    openly alike. For a few views of many: they tell nothing of what each of them reports."""
    has_mask = views_with_masks(table, groups)
    asked = votes_of_points(votes), groups.told, table.mask_view, has_mask
    support = _support(*asked, np.ones(groups.count, np.bool_), settings)
    _, dismissed = _contradicted(support, votes, has_mask.sum(axis=1), replace(settings, missed_chance=0.0))
    support = _support(*asked, ~dismissed, settings)
    ids = np.where(support.share > settings.sure_share, support.group, BACKGROUND)
    ids = np.where(support.total > 0, ids, UNOBSERVED).astype(np.int32)
    weights = around.adjoining.astype(np.float32)
    possible = support.share > settings.possible_share
    return _completed(ids, support, possible, (table, groups.told), around, weights, settings)


def views_with_masks(table: MaskTable, groups: MaskGroups) -> NDArray[np.bool_]:
    """(groups, views): whether a view has a mask of a group."""
    has_mask = np.zeros((groups.count, table.outside.shape[0]), np.bool_)
    told = groups.told
    has_mask[told[told >= 0], table.mask_view[told >= 0]] = True
    return has_mask


@dataclass(frozen=True)
class _Support:
    """What speaks for the group that a point is of, if it is of any. group: (n,) int32, -1 where there is none.
    votes: (n,) float64, votes for it. possible: (n,) all votes of views that have a mask of it. total: (n,) all votes.
    share_openly: (n,) the part of the possible votes that it has where each counts by itself once more: of two views
    that differ, the one that sees the point more openly knows better.
    """

    group: NDArray[np.int32]
    votes: NDArray[np.float64]
    possible: NDArray[np.float64]
    total: NDArray[np.float64]
    share_openly: NDArray[np.float64]

    @property
    def share(self) -> NDArray[np.float64]:
        """(n,) the part of the possible votes that the group has."""
        return self.votes / np.maximum(self.possible, 1e-12)

    def of_state(self, ids: NDArray[np.int32]) -> NDArray[np.float64]:
        """(n,) in [0, 1]: the part of the possible votes that is for each point's state; 0 where that is UNOBSERVED."""
        share = np.where((self.group >= 0) & (ids == self.group), self.share, 1 - self.share)
        return np.where(ids != UNOBSERVED, np.clip(share, 0, 1), 0)


def _openly(openness: NDArray[np.float32], least: float) -> NDArray[np.float32]:
    """(n,) in [0, 1] how openly points are seen: 1 from an openness of ``least`` on. 0 where no view sees them."""
    return np.minimum(1, openness / max(least, np.finfo(np.float32).tiny)).astype(np.float32)


def _clear(support: _Support, openly: NDArray[np.float32], settings: MembershipSettings) -> NDArray[np.int32]:
    """(n,) the state of each point that is seen openly and that views agree on; UNOBSERVED of all others.

    Nor is a point clear that hardly any of its votes are for an instance, though no view that has a mask of it speaks
    against it: one ray that slips through would decide.
    """
    ids = np.where(support.share < settings.possible_share, BACKGROUND, UNOBSERVED)
    agreed = (support.share > settings.sure_share) & (support.votes > settings.sure_votes * support.total)
    ids = np.where(agreed, support.group, ids)
    return np.where(openly == 1, ids, UNOBSERVED).astype(np.int32)


def _completed(
    ids: NDArray[np.int32],
    support: _Support,
    possible: NDArray[np.bool_],
    shown: tuple[MaskTable, NDArray[np.int32]],
    around: Neighborhood,
    weights: NDArray[np.float32],
    settings: MembershipSettings,
) -> NDArray[np.int32]:
    """The states with what only their place tells: possible points of an instance that adjoin it, pieces that are seen
    through it, and what no view sees. shown: the mask table, and the group of each mask."""
    ids = _grow(ids, support.group, possible, around.index, weights, settings.growth_votes)
    # What is seen through an instance is no part of it; what no view saw is as its neighbors are.
    ids = _without_islands(ids, support.share, instance_area(*shown, ids), around, settings.island_share)
    return _fill_unobserved(ids, around)


def _support(
    of_points: VotesOfPoints,
    group: NDArray[np.int32],
    mask_view: NDArray[np.int32],
    has_mask: NDArray[np.bool_],
    allowed: NDArray[np.bool_],
    settings: MembershipSettings,
) -> _Support:
    """The support of all points.

    group: (masks,) the group of each mask, groups by what they show, largest first. mask_view: (masks,) the view of
    each. has_mask: (groups, views), whether a view has a mask of a group. allowed: (groups,) those that may be chosen.
    """
    found = []
    for some in of_points:
        votes = some()
        best, *of_best = _best_group(*votes, group, has_mask, allowed, settings.sure_share)
        found.append((best, *of_best, _share_openly(*votes, group, mask_view, has_mask, best)))
    return _Support(*(np.concatenate(parts) for parts in zip(*found, strict=True)))


@njit(cache=True, parallel=True)
def _best_group(masks, views, group, has_mask, allowed, sure_share):  # noqa: ANN001, ANN202
    """Per point: the allowed group with the most votes (ties: the lower); `_Support`'s votes, possible and total.

    Where views that have a mask of that group contradict it, and a smaller group is sure, that one is taken: proposers
    let a shelf swallow the book on it in half of the views; no view that knows the book shows it as shelf.
    """
    (mask_start, of_mask), (view_start, of_view) = masks, views
    n = len(mask_start) - 1
    best = np.full(n, -1, np.int32)
    votes = np.zeros(n)
    possible = np.zeros(n)
    total = np.zeros(n)
    for g in prange(n):
        begin, end = mask_start[g], mask_start[g + 1]
        for e in range(view_start[g], view_start[g + 1]):
            total[g] += of_view[e].vote
        sure, of_sure, asked_sure = -1, 0.0, 0.0
        for e in range(begin, end):
            k = group[of_mask[e].row]
            if k < 0 or not allowed[k]:
                continue
            # A point lies in few masks: the votes of all masks of a group are added up at the first of them.
            before = begin
            while before < e and group[of_mask[before].row] != k:
                before += 1
            if before < e:
                continue
            # Of the views, those that have a mask of the group could have voted for it.
            of_group, asked = 0.0, 0.0
            for other in range(e, end):
                if group[of_mask[other].row] == k:
                    of_group += of_mask[other].vote
            for view in range(view_start[g], view_start[g + 1]):
                if has_mask[k, of_view[view].row]:
                    asked += of_view[view].vote
            if of_group > votes[g] or (of_group == votes[g] and k < best[g]):
                best[g], votes[g], possible[g] = k, of_group, asked
            if of_group > sure_share * asked and (of_group > of_sure or (of_group == of_sure and k < sure)):
                sure, of_sure, asked_sure = k, of_group, asked
        if sure > best[g] and votes[g] <= sure_share * possible[g]:
            best[g], votes[g], possible[g] = sure, of_sure, asked_sure
    return best, votes, possible, total


@njit(cache=True, parallel=True)
def _share_openly(masks, views, group, mask_view, has_mask, best):  # noqa: ANN001, ANN202
    """(n,) `_Support.share_openly` of each point's ``best`` group; 0 where it has none. Masks ascend by view."""
    (mask_start, of_mask), (view_start, of_view) = masks, views
    share = np.zeros(len(best))
    for g in prange(len(best)):
        if best[g] < 0:
            continue
        e, of_group, asked = mask_start[g], 0.0, 0.0
        for view in range(view_start[g], view_start[g + 1]):
            inside = 0.0
            while e < mask_start[g + 1] and mask_view[of_mask[e].row] <= of_view[view].row:
                if group[of_mask[e].row] == best[g]:
                    inside += of_mask[e].vote
                e += 1
            of_group += inside * of_view[view].vote
            if has_mask[best[g], of_view[view].row]:
                asked += of_view[view].vote ** 2
        share[g] = of_group / asked if asked > 0 else 0.0
    return share


def _contradicted(
    support: _Support, votes: ViewVotes, views: NDArray[np.integer], settings: MembershipSettings
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Detection rate per group, and the groups that are noise of the proposer. views: (groups,) how many have a mask of
    each.

    How often the proposer misses is a property of the scene's masks: a detector may find a chair in a third of the
    views, a mask that one view of seventy shows is noise. The rate of the scene is the median over covered weight.
    Noise too is what a single view has a mask of and no other shows in any, where the chance that all of these missed a
    thing is small. That chance is of all groups, and of one more that was never found: few tell no rate exactly.
    """
    count, sure = len(views), (support.group >= 0) & (support.share > 0.5)
    group = support.group[sure]

    def of_group(values: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.bincount(group, values[sure], count).astype(np.float64, copy=False)

    visible, mass = of_group(support.total), of_group(support.votes)
    rate = of_group(support.possible) / np.maximum(visible, 1e-12)
    if mass.sum() == 0:
        return rate, np.ones(count, bool)
    masked = np.asarray(votes.in_mask.sum(axis=0), np.float64).ravel()  # votes for any mask
    order = np.argsort(rate, kind="stable")
    typical = rate[order[np.searchsorted(np.cumsum(mass[order]), 0.5 * mass.sum())]]
    points = np.maximum(np.bincount(group, minlength=count), 1)
    alone = (views == 1) & (of_group(masked - support.votes) < 0.5 * points)
    found = np.average(rate, weights=mass) * count / (count + 1)
    chance = (1 - found) ** (of_group(support.total - masked) / points)
    return rate, (rate < settings.rate_share * typical) | (mass == 0) | (alone & (chance < settings.missed_chance))


@njit(cache=True)
def _grow(ids, best, possible, neighbors, weights, votes):  # noqa: ANN001, ANN202
    """Hysteresis: possible points join their best group while a share ``votes`` of the adjoining points, by weight, is
    in it.

    Rounds, not a flood in index order: the result does not depend on how the points are ordered.
    """
    # In a round all waiting points look at the states before it; those that join are seen by the next.
    waiting = np.flatnonzero(possible & (ids < 0))
    while len(waiting):
        joins = np.zeros(len(waiting), np.bool_)
        for i in range(len(waiting)):
            g = waiting[i]
            joined, total = 0.0, 0.0
            for k in range(neighbors.shape[1]):
                total += weights[g, k]
                if ids[neighbors[g, k]] == best[g]:
                    joined += weights[g, k]
            joins[i] = joined > 0 and joined >= votes * total
        if not joins.any():
            break
        for i in range(len(waiting)):
            if joins[i]:
                ids[waiting[i]] = best[waiting[i]]
        waiting = waiting[~joins]
    return ids


@njit(cache=True, parallel=True)
def _agreeing(ids, neighbors, adjoining):  # noqa: ANN001, ANN202
    """(n,) float64: the part of each point's adjoining points that have its state; 1 where none adjoins."""
    agreeing = np.ones(len(ids))
    for g in prange(len(ids)):
        same, count = 0, 0
        for k in range(neighbors.shape[1]):
            if adjoining[g, k]:
                count += 1
                same += ids[neighbors[g, k]] == ids[g]
        if count:
            agreeing[g] = same / count
    return agreeing


def instance_area(table: MaskTable, group: NDArray[np.int32], ids: NDArray[np.int32]) -> NDArray[np.float64]:
    """(n,) float64: pixels of blending weight that the masks of each point's own instance put on it."""
    weights = table.weights
    area = np.zeros(len(ids))
    _add_area(weights.indptr, weights.indices, weights.data, group, ids, area)
    return area


@njit(cache=True)
def _add_area(indptr, indices, data, group, ids, area):  # noqa: ANN001, ANN202
    """Adds to ``area`` what each mask shows of points of its own group; masks without a group are passed over."""
    for row in range(len(indptr) - 1):
        for e in range(indptr[row] if group[row] >= 0 else indptr[row + 1], indptr[row + 1]):
            if ids[indices[e]] == group[row]:
                area[indices[e]] += data[e]


def _without_islands(
    ids: NDArray[np.int32],
    share: NDArray[np.float64],
    area: NDArray[np.float64],
    neighborhood: Neighborhood,
    least: float,
) -> NDArray[np.int32]:
    """Take from each instance the connected pieces beside its main one that are not of it by a majority of votes, or
    whose points show less than ``least`` of what the main piece's do.

    A floor that no view sees but through the table top above it has only votes for the table; but of the pixels of the
    table's masks nearly all the weight stays on the top. A part of the object cut off by an occluder is seen as openly
    as the rest of it.
    """
    # Pieces: connected components of adjoining points of one instance. density: what masks show of a point, on average.
    n = len(ids)
    source = np.repeat(np.arange(n), neighborhood.index.shape[1])
    target = neighborhood.index.ravel()
    linked = neighborhood.adjoining.ravel() & (ids[source] >= 0) & (ids[source] == ids[target])
    links = csr_array((np.ones(linked.sum(), bool), (source[linked], target[linked])), shape=(n, n))
    pieces, piece = connected_components(links, directed=False)
    labelled = np.flatnonzero(ids >= 0)
    piece_area, points = np.bincount(piece, area, pieces), np.bincount(piece, minlength=pieces)
    density, majority = piece_area / points, np.bincount(piece, share, pieces) > 0.5 * points
    # The main piece of each instance is the one its masks show most of: written last, it stays.
    order = labelled[np.argsort(piece_area[piece[labelled]], kind="stable")]
    main = np.zeros(int(ids.max(initial=-1)) + 1, np.int64)
    main[ids[order]] = piece[order]
    own, main_piece = piece[labelled], main[ids[labelled]]
    island = (own != main_piece) & (~majority[own] | (density[own] < least * density[main_piece]))
    kept = ids.copy()
    kept[labelled[island]] = UNOBSERVED
    return kept


def _fill_unobserved(ids: NDArray[np.int32], neighborhood: Neighborhood) -> NDArray[np.int32]:
    """Points that no view saw copy the state of their nearest adjoining observed point; the rest stay unobserved."""
    if neighborhood.index.shape[1] == 0:
        return ids  # one point has no neighbors
    hidden = np.flatnonzero(ids == UNOBSERVED)
    near = ids[neighborhood.index[hidden]]
    usable = neighborhood.adjoining[hidden] & (near != UNOBSERVED)
    first = np.argmax(usable, axis=1)
    filled = ids.copy()
    filled[hidden] = np.where(usable.any(axis=1), near[np.arange(len(hidden)), first], UNOBSERVED)
    return filled
