"""Groups of masks -> one state per point: an instance, background, or unobserved. Decided from all views together.

Whether one mask covers a point matters less than what the *other* views say. Let, for point g and instance k,

    for_k(g)       votes for "in a mask of k" (see `view_votes`)
    possible_k(g)  votes on g of the views that have a mask of k
    share          for_k / possible_k

A view in which the proposer missed k has no vote about k; a view that has a mask of k and shows g outside it votes "not
k". So a share near 1 means "k", near 0 "seen, and not k", however often the proposer misses. A point in masks of
several groups is tested for the one with the most votes. But proposers let large things swallow small ones: where that
group's own views contradict it and a smaller group is sure, the smaller one is taken. Not on the word of one view,
though: no other could contradict that, and proposers tear a wall into pieces, too.

Points are clear if views see them openly and agree on them. Where no view sees a point openly, its votes are
unreliable: rays that slip through a surface agree about what lies behind it, and are wrong. Openness is relative to the
scene's other points: in surfaces of several noisy layers nothing is seen very openly. The clear points show what each
view reports of each instance and of background. These reports, with neighbors and colors, give every point's most
probable state (view_reports.py).

Where a proposer misses a cup, its pixels may lie in the mask of its table. The states of the points reveal this: such a
mask holds most of what its view sees of two groups. It still describes its own group, but from then on votes only for
"one of the two". The states also show which groups are pieces of one thing (fragments.py). Both corrected, all points
are decided once more.

Torn mask edges leave middling shares on the rim of an object, and views that tear it alike call it background. Rays
that slip past an edge leave the same on what lies behind. Place and color tell the two apart: a background point with a
middling share joins the instance where it adjoins points of it (hysteresis, as in Canny's edge detector). Openness
helps too: the surface behind an edge is in masks of views that see it badly and outside the masks of views that see it
openly, while all views say the same of a rim. So a middling share counts only if it remains one when each vote is
weighted by itself once more.

If one view alone has a mask of something that the others show outside all masks, it is a thing only if that many views
may well have missed it: the scene's other groups tell how often views miss. Its colors have a say, too: across the
outline of a thing they differ as between two things, across that of a stain or a glitch as within one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from og_pointcloud.cloud import BACKGROUND, UNOBSERVED
from og_pointcloud.fitting.colors import MAX_COLOR_RATIO, color_ratios, outline_ratios
from og_pointcloud.fitting.fragments import join_fragments
from og_pointcloud.fitting.grouping import MaskGroups, with_spanning
from og_pointcloud.fitting.mask_table import MaskTable
from og_pointcloud.fitting.view_reports import ViewReports, likely_states
from og_pointcloud.fitting.view_votes import PointVotes, ViewVotes
from og_pointcloud.kernels import njit, prange
from og_pointcloud.rendering.geometry import Neighborhood
from og_pointcloud.settings import FitSettings, MembershipSettings


@dataclass(frozen=True)
class SceneVotes:
    """What all votes of a scene say, for deciding some of its points. typical_openness: see `ViewVotes`. reports: what
    each view reports of each state. kept: (groups,) bool, those with sure points that the views do not contradict."""

    typical_openness: float
    reports: ViewReports
    kept: NDArray[np.bool_]


@dataclass(frozen=True)
class Membership:
    """instance_ids: (n,) int32, a group, BACKGROUND or UNOBSERVED. certainty: (n,) float32 in [0, 1], probability of
    the point's state given the views, times the share of its neighbors with that state; 0 where no view sees it.
    expected_iou: (groups,) float64, expected IoU of each group's points with its true points, given the views.
    detection_rate: (groups,) float32, the share of a group's visible weight that lies in views that have a mask of it.
    dismissed: (groups,) bool, groups that the scene's views contradict as a whole. scene: what all votes said."""

    instance_ids: NDArray[np.int32]
    certainty: NDArray[np.float32]
    expected_iou: NDArray[np.float64]
    detection_rate: NDArray[np.float32]
    dismissed: NDArray[np.bool_]
    scene: SceneVotes


def assign_and_correct_groups(
    table: MaskTable,
    votes: ViewVotes,
    groups: MaskGroups,
    around: Neighborhood,
    settings: FitSettings,
    rgb: NDArray[np.uint8] | None = None,
) -> tuple[MaskGroups, Membership]:
    """Decide the state of every point of a scene, correct the groups by what these states show (which are pieces of one
    thing, and which masks span two), and decide once more. Returns the corrected groups, too."""
    inputs = around, settings.membership, rgb
    first = assign_points(table, votes, groups, *inputs)
    visibility = _visibility(votes.openness, settings.membership.open_share * votes.typical_openness)
    joined, ids = join_fragments(groups, table, votes, first.instance_ids, around, visibility)
    corrected = with_spanning(joined, votes, table.mask_view, ids, settings.grouping)
    if corrected.count == groups.count and (corrected.spanning == groups.spanning).all():
        return groups, first
    return corrected, assign_points(table, votes, corrected, *inputs)


def assign_points(
    table: MaskTable,
    votes: ViewVotes,
    groups: MaskGroups,
    around: Neighborhood,
    settings: MembershipSettings,
    rgb: NDArray[np.uint8] | None = None,
    scene: SceneVotes | None = None,
) -> Membership:
    """Decide the state of every point. Groups keep their numbers, which run from large to small; a dismissed group ends
    with no point.

    rgb: (n, 3), or None: colors are not used. scene: the scene that these points are part of; None: they are all of it.
    """
    has_mask = views_with_masks(table, groups)
    # First among all groups, which shows the groups that are noise, then among the others.
    inputs = votes.by_point, groups.voting_group, table.mask_view, has_mask
    support = _support(*inputs, np.ones(groups.count, np.bool_), settings)
    rate, dismissed, p_missed = _contradicted(support, votes, has_mask.sum(axis=1), settings)
    typical = scene.typical_openness if scene else votes.typical_openness
    visibility = _visibility(votes.openness, settings.open_share * typical)
    clear = _clear(support, visibility, settings)
    dismissed |= _noise_of_one_view(p_missed, support, clear, around, rgb, settings.missed_chance)
    if scene:  # a thing may have no sure point in this part of the scene
        dismissed &= ~scene.kept
    if dismissed.any():
        support = _support(*inputs, ~dismissed, settings)
        clear = _clear(support, visibility, settings)
    # What each mask reports: its group, -1 for nothing, or, if it spans several, a number of its own after the groups.
    report = np.append(np.where(dismissed, -1, np.arange(groups.count)), -1)[groups.voting_group]
    report[groups.spanning] = groups.count + np.arange(np.count_nonzero(groups.spanning))
    mask_reports, size = (report, table.mask_view), (votes.vote.shape[0], groups.count)
    known = scene.reports if scene else None
    likely, reports, weights = likely_states(
        votes.by_point, mask_reports, size, clear, support.group, visibility, around, rgb, known
    )
    possible = (support.share > settings.possible_share) & (support.reweighted_share > settings.possible_openly)
    ids = _refined(likely.ids, support, possible, (table, groups.voting_group), around, weights, settings)
    certainty = likely.probability_of(ids) * _neighbor_agreement(ids, around.index, around.adjoining)
    return Membership(
        ids, certainty.astype(np.float32), likely.expected_iou(ids), rate.astype(np.float32), dismissed,
        SceneVotes(typical, reports, ~dismissed),
    )  # fmt: skip


def assign_by_votes_alone(
    table: MaskTable, votes: ViewVotes, groups: MaskGroups, around: Neighborhood, settings: MembershipSettings
) -> NDArray[np.int32]:
    """(n,) the states of points that views agree on and of possible ones that adjoin them, as if all were seen equally
    openly. For a few of many views: too few to count what each of them reports, or to doubt what one alone shows."""
    has_mask, settings = views_with_masks(table, groups), replace(settings, swallowed_votes=0.0)
    inputs = votes.by_point, groups.voting_group, table.mask_view, has_mask
    support = _support(*inputs, np.ones(groups.count, np.bool_), settings)
    _, dismissed, _ = _contradicted(support, votes, has_mask.sum(axis=1), settings)
    support = _support(*inputs, ~dismissed, settings)
    ids = np.where(support.share > settings.sure_share, support.group, BACKGROUND)
    ids = np.where(support.total > 0, ids, UNOBSERVED).astype(np.int32)
    weights = around.adjoining.astype(np.float32)
    possible = support.share > settings.possible_share
    return _refined(ids, support, possible, (table, groups.voting_group), around, weights, settings)


def views_with_masks(table: MaskTable, groups: MaskGroups) -> NDArray[np.bool_]:
    """(groups, views): whether a view has a mask of a group."""
    has_mask = np.zeros((groups.count, table.outside.shape[0]), np.bool_)
    group = groups.voting_group
    has_mask[group[group >= 0], table.mask_view[group >= 0]] = True
    return has_mask


@dataclass(frozen=True)
class _Support:
    """Support for the best group of each point. group: (n,) int32, -1 where there is none. votes: (n,) float64, votes
    for it. possible: (n,) all votes of views that have a mask of it. total: (n,) all votes. reweighted_share: (n,) its
    share of the possible votes when each is weighted by itself once more: of two views that differ, the one that sees
    the point more openly knows better."""

    group: NDArray[np.int32]
    votes: NDArray[np.float64]
    possible: NDArray[np.float64]
    total: NDArray[np.float64]
    reweighted_share: NDArray[np.float64]

    @property
    def share(self) -> NDArray[np.float64]:
        """(n,) the group's share of the possible votes."""
        return self.votes / np.maximum(self.possible, 1e-12)

    @property
    def sure(self) -> NDArray[np.bool_]:
        """(n,) whether a majority of the possible votes is for the group."""
        return (self.group >= 0) & (self.share > 0.5)


def _visibility(openness: NDArray[np.float32], full_openness: float) -> NDArray[np.float32]:
    """(n,) in [0, 1] how openly points are seen: 1 from ``full_openness`` on, 0 where no view sees them."""
    return np.minimum(1, openness / max(full_openness, np.finfo(np.float32).tiny)).astype(np.float32)


def _clear(support: _Support, visibility: NDArray[np.float32], settings: MembershipSettings) -> NDArray[np.int32]:
    """(n,) the state of each point that is seen openly and that views agree on; UNOBSERVED for all others.

    A point is not clear either where hardly any of all votes are for its group, even if no view that has a mask of the
    group contradicts it: one ray that slips through would decide.
    """
    ids = np.where(support.share < settings.possible_share, BACKGROUND, UNOBSERVED)
    agreed = (support.share > settings.sure_share) & (support.votes > settings.sure_votes * support.total)
    ids = np.where(agreed, support.group, ids)
    return np.where(visibility == 1, ids, UNOBSERVED).astype(np.int32)


def _refined(
    ids: NDArray[np.int32],
    support: _Support,
    possible: NDArray[np.bool_],
    masks: tuple[MaskTable, NDArray[np.int32]],
    around: Neighborhood,
    weights: NDArray[np.float32],
    settings: MembershipSettings,
) -> NDArray[np.int32]:
    """The states corrected by place: possible points join an instance that they adjoin, pieces seen through an instance
    leave it, unseen points are filled in. masks: the mask table, and the group of each mask."""
    ids = _grow(ids, support.group, possible, around.index, weights, settings.growth_votes)
    # What is seen through an instance is no part of it; what no view saw takes the state of its neighbors.
    ids = _without_islands(ids, support.share, instance_area(*masks, ids), around, settings.island_share)
    return _fill_unobserved(ids, around)


def _support(
    point_votes: PointVotes,
    group: NDArray[np.int32],
    mask_view: NDArray[np.int32],
    has_mask: NDArray[np.bool_],
    allowed: NDArray[np.bool_],
    settings: MembershipSettings,
) -> _Support:
    """The support of all points.

    group: (masks,) the group of each mask; groups are sorted by what they show, largest first. mask_view: (masks,) the
    view of each. has_mask: (groups, views), whether a view has a mask of a group. allowed: (groups,) those to choose
    from.
    """
    best, votes, possible, total = _best_group(
        *point_votes, group, has_mask, allowed, settings.sure_share, settings.swallowed_votes
    )
    reweighted_share = _reweighted_share(*point_votes, group, mask_view, has_mask, best)
    return _Support(best, votes, possible, total, reweighted_share)


@njit(cache=True, parallel=True)
def _best_group(masks, views, group, has_mask, allowed, sure_share, swallowed_votes):  # noqa: ANN001, ANN202
    """Per point: the allowed group with the most votes (ties: the lower); `_Support`'s votes, possible and total.

    Where views that have a mask of that group contradict it, and a smaller group is sure, and has more votes than
    ``swallowed_votes``, the smaller one is taken: proposers let a shelf swallow the book on it in half of the views; no
    view that knows the book shows it as shelf.
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
        sure, sure_votes, sure_possible = -1, swallowed_votes, 0.0
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
            # Only views that have a mask of the group could have voted for it.
            votes_k, possible_k = 0.0, 0.0
            for later in range(e, end):
                if group[of_mask[later].row] == k:
                    votes_k += of_mask[later].vote
            for view in range(view_start[g], view_start[g + 1]):
                if has_mask[k, of_view[view].row]:
                    possible_k += of_view[view].vote
            if votes_k > votes[g] or (votes_k == votes[g] and k < best[g]):
                best[g], votes[g], possible[g] = k, votes_k, possible_k
            if votes_k > sure_share * possible_k and (votes_k > sure_votes or (votes_k == sure_votes and k < sure)):
                sure, sure_votes, sure_possible = k, votes_k, possible_k
        if sure > best[g] and votes[g] <= sure_share * possible[g]:
            best[g], votes[g], possible[g] = sure, sure_votes, sure_possible
    return best, votes, possible, total


@njit(cache=True, parallel=True)
def _reweighted_share(masks, views, group, mask_view, has_mask, best):  # noqa: ANN001, ANN202
    """(n,) `_Support.reweighted_share` of each point's ``best`` group; 0 where it has none. Masks ascend by view."""
    (mask_start, of_mask), (view_start, of_view) = masks, views
    share = np.zeros(len(best))
    for g in prange(len(best)):
        if best[g] < 0:
            continue
        e, group_votes, possible = mask_start[g], 0.0, 0.0
        for view in range(view_start[g], view_start[g + 1]):
            inside = 0.0
            while e < mask_start[g + 1] and mask_view[of_mask[e].row] <= of_view[view].row:
                if group[of_mask[e].row] == best[g]:
                    inside += of_mask[e].vote
                e += 1
            group_votes += inside * of_view[view].vote
            if has_mask[best[g], of_view[view].row]:
                possible += of_view[view].vote ** 2
        share[g] = group_votes / possible if possible > 0 else 0.0
    return share


def _contradicted(
    support: _Support, votes: ViewVotes, views: NDArray[np.integer], settings: MembershipSettings
) -> tuple[NDArray[np.float64], NDArray[np.bool_], NDArray[np.float64]]:
    """Detection rate per group, the groups that are noise of the proposer, and of groups that one view alone has a mask
    of the probability that all others missed them (1 for other groups). views: (groups,) number of views with a mask of
    each.

    How often the proposer misses is a property of the scene's masks: a detector may find a chair in a third of the
    views, a mask that one view of seventy shows is noise. The rate of the scene is the median over covered weight. The
    probability follows from the detection rate of all groups and one more that was never detected: few groups give no
    exact rate.
    """
    count, sure = len(views), support.sure
    group = support.group[sure]

    def per_group(values: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.bincount(group, values[sure], count).astype(np.float64, copy=False)

    visible, mass = per_group(support.total), per_group(support.votes)
    rate = per_group(support.possible) / np.maximum(visible, 1e-12)
    if mass.sum() == 0:
        return rate, np.ones(count, bool), np.ones(count)
    masked = np.asarray(votes.in_mask.sum(axis=0), np.float64).ravel()  # votes for any mask
    order = np.argsort(rate, kind="stable")
    typical = rate[order[np.searchsorted(np.cumsum(mass[order]), 0.5 * mass.sum())]]
    points = np.maximum(np.bincount(group, minlength=count), 1)
    single = (views == 1) & (per_group(masked - support.votes) < 0.5 * points)
    detected = np.average(rate, weights=mass) * count / (count + 1)
    p_missed = (1 - detected) ** (per_group(support.total - masked) / points)
    return rate, (rate < settings.rate_share * typical) | (mass == 0), np.where(single, p_missed, 1.0)


def _noise_of_one_view(
    p_missed: NDArray[np.float64],
    support: _Support,
    clear: NDArray[np.int32],
    around: Neighborhood,
    rgb: NDArray[np.uint8] | None,
    missed_chance: float,
) -> NDArray[np.bool_]:
    """(groups,) whether one view alone has a mask of a group that is no thing: others would hardly have missed a thing,
    or the colors across its outline differ as little as within one.

    p_missed: from `_contradicted`. missed_chance: dismissed is what has less than this, times how much likelier the
    colors are within one thing than between two.
    """
    in_doubt = p_missed < missed_chance * MAX_COLOR_RATIO
    if not in_doubt.any():  # nothing that colors could dismiss
        return in_doubt
    # What is in doubt is left out of the count of what differs between two things.
    known = (clear != UNOBSERVED) & ~np.append(in_doubt, False)[clear]
    ratios = color_ratios(rgb, clear, known.astype(np.float64), around)
    group = np.where(support.sure & in_doubt[support.group], support.group, -1).astype(np.int32)
    return in_doubt & (p_missed < missed_chance * outline_ratios(rgb, group, len(p_missed), around, ratios))


@njit(cache=True)
def _grow(ids, best, possible, neighbors, weights, min_share):  # noqa: ANN001, ANN202
    """Hysteresis: possible points join their best group while at least ``min_share`` of the adjoining points, by
    weight, are in it.

    Rounds, not a flood in index order: the result does not depend on how the points are ordered.
    """
    # In a round all waiting points look at the states before it; those that join count from the next round on.
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
            joins[i] = joined > 0 and joined >= min_share * total
        if not joins.any():
            break
        for i in range(len(waiting)):
            if joins[i]:
                ids[waiting[i]] = best[waiting[i]]
        waiting = waiting[~joins]
    return ids


@njit(cache=True, parallel=True)
def _neighbor_agreement(ids, neighbors, adjoining):  # noqa: ANN001, ANN202
    """(n,) float64: the share of each point's adjoining points that have its state; 1 where none adjoins."""
    agreement = np.ones(len(ids))
    for g in prange(len(ids)):
        same, count = 0, 0
        for k in range(neighbors.shape[1]):
            if adjoining[g, k]:
                count += 1
                same += ids[neighbors[g, k]] == ids[g]
        if count:
            agreement[g] = same / count
    return agreement


def instance_area(table: MaskTable, group: NDArray[np.int32], ids: NDArray[np.int32]) -> NDArray[np.float64]:
    """(n,) float64: blending weight, in pixels, that the masks of each point's own instance put on it."""
    weights = table.weights
    area = np.zeros(len(ids))
    _add_area(weights.indptr, weights.indices, weights.data, group, ids, area)
    return area


@njit(cache=True)
def _add_area(indptr, indices, data, group, ids, area):  # noqa: ANN001, ANN202
    """Adds to ``area`` what each mask shows of points of its own group; masks without a group are skipped."""
    for row in range(len(indptr) - 1):
        for e in range(indptr[row] if group[row] >= 0 else indptr[row + 1], indptr[row + 1]):
            if ids[indices[e]] == group[row]:
                area[indices[e]] += data[e]


def _without_islands(
    ids: NDArray[np.int32],
    share: NDArray[np.float64],
    area: NDArray[np.float64],
    neighborhood: Neighborhood,
    min_share: float,
) -> NDArray[np.int32]:
    """Take from each instance the connected pieces, other than its main one, that have no majority of votes for it, or
    whose points show less than ``min_share`` of what those of the main piece do.

    A floor that views only see through the table top above it has votes for the table alone, but nearly all the weight
    of the table's masks stays on the top. A part of the object cut off by an occluder is seen as openly as the rest.
    """
    # Pieces: connected components of adjoining points of one instance. density: mean area of a piece's points.
    labelled = np.flatnonzero(ids >= 0)
    own, near = ids[labelled], neighborhood.index[labelled]
    linked = neighborhood.adjoining[labelled] & (ids[near] == own[:, None])
    number = np.cumsum(ids >= 0) - 1  # of each labelled point among them
    target, starts = number[near[linked]], np.append(0, np.cumsum(np.count_nonzero(linked, axis=1)))
    links = csr_array((np.ones(len(target), bool), target, starts), shape=(len(labelled), len(labelled)))
    pieces, part = connected_components(links, directed=False)
    piece_area, points = np.bincount(part, area[labelled], pieces), np.bincount(part, minlength=pieces)
    density, majority = piece_area / points, np.bincount(part, share[labelled], pieces) > 0.5 * points
    # The main piece of each instance is the one that its masks show most of: it is written last.
    order = np.argsort(piece_area[part], kind="stable")
    main = np.zeros(int(own.max(initial=-1)) + 1, np.int64)
    main[own[order]] = part[order]
    main_part = main[own]
    island = (part != main_part) & (~majority[part] | (density[part] < min_share * density[main_part]))
    kept = ids.copy()
    kept[labelled[island]] = UNOBSERVED
    return kept


def _fill_unobserved(ids: NDArray[np.int32], neighborhood: Neighborhood) -> NDArray[np.int32]:
    """Points that no view saw copy the state of their nearest adjoining observed point; others stay unobserved."""
    if neighborhood.index.shape[1] == 0:
        return ids  # one point has no neighbors
    hidden = np.flatnonzero(ids == UNOBSERVED)
    neighbor_ids = ids[neighborhood.index[hidden]]
    usable = neighborhood.adjoining[hidden] & (neighbor_ids != UNOBSERVED)
    first = np.argmax(usable, axis=1)
    filled = ids.copy()
    filled[hidden] = np.where(usable.any(axis=1), neighbor_ids[np.arange(len(hidden)), first], UNOBSERVED)
    return filled
