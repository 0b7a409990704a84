"""Which state each point is likeliest in, by what every view is known to report of each state.

Views do not only miss things: one shows the book as shelf, another the two halves of a sofa as one, a third puts the
wall behind the lamp into the lamp's mask. What a view says of a point then depends on what the point is of, and how is
seen on all its other points: a view that calls the whole book "shelf" tells nothing of book and shelf, and its votes
for the shelf should not count against the book. So views are treated as observers of whom none is right throughout
(Dawid and Skene, 1979). A state is an instance, or background. With

    c_v(k, r)   how often view v, of what it sees of state k, reports r: a mask of some instance, or none
    p_v(g)      how far view v sees point g: its vote (`view_votes`), as far as the point is seen openly at all

view v, which reports r of point g, makes "g is in state k" likely by

    p_v(g) c_v(k, r) + (1 - p_v(g)) HIDDEN

as what stands before a hidden point may be anything. A mask that spans several things is a report of its own, of which
no state expects anything: a view that gives it tells that the point is of one of the things that lie in it. The
logarithms are added up over views, but count as ENOUGH independent views at most: views that look alike err alike.
Points adjoin others, of which they are the likelier of one thing the more their colors say so (colors.py); each hears
how likely its neighbors are in each state (mean field). What views report is counted on points whose state is clear
without it, and anew on the states that this makes likely.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.cloud import BACKGROUND, UNOBSERVED
from og_pointcloud.fitting.view_votes import VotesOfPoints
from og_pointcloud.kernels import njit, prange
from og_pointcloud.rendering.geometry import Neighborhood

HIDDEN = 0.5
"""Chance of any report about a point that the view does not see."""
LEAST = 0.03
"""No report is less likely than this: any view may err anywhere."""
ENOUGH = 3.0
"""Views whose words add up; of more, the mean counts as that of so many."""
EXPECTED = 10.0
"""Points as which it counts, before any is looked at, that a view shows an instance in its own masks of it, and
background, and what it has no mask of, in none."""
UNSEEN = 2.0
"""What it costs an instance, in the logarithm of its likelihood, that no view has a mask of it on the point."""
MORE_LIKELY = 0.2
"""What background has in that logarithm before any view is asked: a wrong name is worse than none."""
SMOOTHNESS = 0.6
"""What a sure neighbor adds to the logarithm of its state, times the ratio of its color (colors.py), less APART."""
APART = 0.5
"""A neighbor is not heard whose color is only so many times likelier within one thing than between two: the less colors
say in a scene, the less its points follow their neighbors."""
ROUNDS = 5
"""Times that points hear their neighbors."""
COUNTED = 2
"""Times that it is counted what views report."""

_EXACT = float(1 << 24)
"""In steps of its reciprocal the sums of what views report are exact in float64: the points' order does not matter."""


@dataclass(frozen=True)
class ViewReports:
    """c_v(k, r) of a scene, whose numbers are its groups, its masks that span several, which are reports but no states,
    and, as the last, background. column: (views, numbers) int32, the column of a report in view v, -1 where v has no
    mask of it; background's is "no mask", the last. seat: (views, numbers) int32, the row of a state, -1 where v sees
    no point that may be in it. first: (views + 1,) int64, where each view's table begins in ``chance``: (rows times
    columns of all,) float32. spanned: (spanning masks, groups) bool, whether clear points of a group lie in the mask.
    """

    column: NDArray[np.int32]
    seat: NDArray[np.int32]
    first: NDArray[np.int64]
    chance: NDArray[np.float32]
    spanned: NDArray[np.bool_]


@dataclass(frozen=True)
class LikelyStates:
    """The states that each point may be in: state[start[g] : start[g + 1]], groups, and background as the last number;
    none where no view sees it. They are background, the groups in whose masks it lies, those that a mask in which it
    lies spans, and those of points that adjoin it. masked: (all,) bool, not of the last alone. likely: (all,) float64,
    of sum 1 a point. groups: how many. background: its number."""

    start: NDArray[np.int64]
    state: NDArray[np.int32]
    masked: NDArray[np.bool_]
    likely: NDArray[np.float64]
    groups: int
    background: int

    @property
    def ids(self) -> NDArray[np.int32]:
        """(n,) the likeliest group of each point (ties: the lowest) or BACKGROUND; UNOBSERVED where it has no state."""
        return _likeliest(self.start, self.state, self.likely, self.background)

    def of(self, ids: NDArray[np.int32]) -> NDArray[np.float64]:
        """(n,) how likely each point is in the state of ``ids``; 0 where that is none it may be in."""
        return _likely_in(self.start, self.state, self.likely, np.where(ids == BACKGROUND, self.background, ids))

    def expected_iou(self, ids: NDArray[np.int32]) -> NDArray[np.float64]:
        """(groups,) the IoU that each group's points in ``ids`` have with all that is of it, as far as states are as
        likely as found; 0 where nothing is."""
        count, grouped = self.groups, ids >= 0
        of_group = np.bincount(self.state, self.likely, self.background + 1)[:count]
        right = np.bincount(ids[grouped], self.of(ids)[grouped], count)
        either = np.bincount(ids[grouped], minlength=count) + of_group - right
        return np.divide(right, either, out=np.zeros(count), where=either > 0)


def likely_states(
    of_points: VotesOfPoints,
    of_masks: tuple[NDArray[np.int32], NDArray[np.int32]],
    size: tuple[int, int],
    clear: NDArray[np.int32],
    asked: NDArray[np.int32],
    openly: NDArray[np.float32],
    around: Neighborhood,
    weights: NDArray[np.float32],
    reports: ViewReports | None = None,
) -> tuple[LikelyStates, ViewReports]:
    """How likely points are in each state, and what views report.

    of_masks: the group of each mask, -1 none, which says nothing, or, of one that spans several, a number of its own
    after the groups; and its view. size: views and groups. clear: (n,) the states of points that are clear, UNOBSERVED
    of others. asked: (n,) the group that each point is asked of, -1 none: points that adjoin it may be of that group
    too. openly: (n,) in [0, 1], what counts of votes on each point. weights: of neighbors, as of `neighbor_weights`.
    reports: of the scene that these points are a part of; None: they are all of it, and it is counted on them.
    """
    spanned = _spanned(of_points, of_masks[0], size[1], clear) if reports is None else reports.spanned
    found = _candidates(of_points, of_masks[0], spanned, clear, asked, around)

    def settled_by(reports: ViewReports) -> LikelyStates:
        return _settled(_evidence(of_points, of_masks, found, openly, reports), found, around, weights, openly)

    if reports is not None:
        return settled_by(reports), reports
    reports, states = _nothing_reported(of_points, of_masks, size[0], spanned, found), found
    for _ in range(COUNTED):
        reports = _learned(of_points, of_masks, states, openly, reports)
        states = settled_by(reports)
    return states, reports


# States that points may be in ----------------------------------------------------------------------------------------


def _spanned(
    of_points: VotesOfPoints, group: NDArray[np.int32], groups: int, clear: NDArray[np.int32]
) -> NDArray[np.bool_]:
    """`ViewReports.spanned`."""
    spanned, low = np.zeros((max(int(group.max(initial=-1)) + 1 - groups, 0), groups), np.bool_), 0
    for some in of_points if len(spanned) else ():
        low = _mark_spanned(*some()[0], low, group, clear, spanned)
    return spanned


@njit(cache=True)
def _mark_spanned(mask_start, of_mask, low, group, clear, spanned):  # noqa: ANN001, ANN202
    """Marks what masks span of the points from ``low`` on. Returns the point after the last."""
    groups = spanned.shape[1]
    for i in range(len(mask_start) - 1):
        for e in range(mask_start[i], mask_start[i + 1]):
            if group[of_mask[e].row] >= groups and clear[low + i] >= 0:
                spanned[group[of_mask[e].row] - groups, clear[low + i]] = True
    return low + len(mask_start) - 1


def _candidates(
    of_points: VotesOfPoints,
    group: NDArray[np.int32],
    spanned: NDArray[np.bool_],
    clear: NDArray[np.int32],
    asked: NDArray[np.int32],
    around: Neighborhood,
) -> LikelyStates:
    """Those of each point; a clear one is likely in its state alone, and others in none. group: (masks,)."""
    (spanning, groups), low, found = spanned.shape, 0, []
    background = groups + spanning
    clear = np.where(clear == BACKGROUND, background, clear)  # as candidates are numbered
    spans = np.concatenate([[0], np.cumsum(spanned.sum(axis=1))]), np.nonzero(spanned)[1].astype(np.int32)
    near = asked, around.index, around.adjoining
    for some in of_points:
        masks, views = some()
        found.append(_of_each_point(masks, views[0], low, group, groups, spans, near))
        low += len(masks[0]) - 1
    counts, state, masked = (np.concatenate(parts) for parts in zip(*found, strict=True))
    start, likely = np.concatenate([[0], np.cumsum(counts)]), (state == np.repeat(clear, counts)).astype(np.float64)
    return LikelyStates(start, state, masked, likely, groups, background)


@njit(cache=True)
def _of_each_point(masks, view_start, low, group, groups, spans, near):  # noqa: ANN001, ANN202
    """(n,) how many candidates each of the points from ``low`` on has; and (all,) which, and which of them it lies in
    a mask of. spans: (start, groups) of spanning masks. near: as of `likely_states`, with neighbors."""
    (mask_start, of_mask), (first, within), (asked, neighbors, adjoining) = masks, spans, near
    n, most = len(mask_start) - 1, 0
    for e in range(len(of_mask)):
        k = group[of_mask[e].row] - groups
        most += 1 if k < 0 else first[k + 1] - first[k]
    count = np.zeros(n, np.int64)
    # A point has background, and at most one for each mask, or each that a mask spans, and each neighbor.
    found = np.empty(n * (neighbors.shape[1] + 1) + most, np.int32)
    masked = np.empty(len(found), np.bool_)
    end = 0
    for i in range(n):
        if view_start[i] == view_start[i + 1]:
            continue
        begin, g = end, low + i
        for e in range(mask_start[i], mask_start[i + 1]):
            k = group[of_mask[e].row]
            if 0 <= k < groups and not _holds(found, begin, end, k):
                found[end], masked[end] = k, True
                end += 1
            for s in range(first[k - groups], first[k - groups + 1]) if k >= groups else range(0):
                if not _holds(found, begin, end, within[s]):
                    found[end], masked[end] = within[s], True
                    end += 1
        for j in range(neighbors.shape[1]):
            k = asked[neighbors[g, j]]
            if adjoining[g, j] and k >= 0 and not _holds(found, begin, end, k):
                found[end], masked[end] = k, False
                end += 1
        found[end], masked[end] = groups + len(first) - 1, True
        end += 1
        count[i] = end - begin
    return count, found[:end].copy(), masked[:end].copy()


@njit(cache=True)
def _holds(found, begin, end, k):  # noqa: ANN001, ANN202
    for c in range(begin, end):  # noqa: SIM110 - numba has no generators
        if found[c] == k:
            return True
    return False


# What views report ---------------------------------------------------------------------------------------------------


def _nothing_reported(
    of_points: VotesOfPoints,
    of_masks: tuple[NDArray[np.int32], NDArray[np.int32]],
    views: int,
    spanned: NDArray[np.bool_],
    found: LikelyStates,
) -> ViewReports:
    """The tables of all views, empty."""
    group, mask_view = of_masks
    shown = np.zeros((views, found.background + 1), np.bool_)
    shown[mask_view[group >= 0], group[group >= 0]] = True
    shown[:, found.background] = True
    column = np.where(shown, np.cumsum(shown, axis=1) - 1, -1).astype(np.int32)
    seen, low = np.zeros(shown.shape, np.bool_), 0
    for some in of_points:
        low = _mark_seen(*some()[1], low, found.start, found.state, seen)
    seat = np.where(seen, np.cumsum(seen, axis=1) - 1, -1).astype(np.int32)
    first = np.concatenate([[0], np.cumsum(seen.sum(axis=1) * shown.sum(axis=1))]).astype(np.int64)
    return ViewReports(column, seat, first, np.zeros(first[-1], np.float32), spanned)


@njit(cache=True)
def _mark_seen(view_start, of_view, low, start, state, seen):  # noqa: ANN001, ANN202
    """Marks in (views, states) of what a view sees candidates. Returns the point after the last."""
    for i in range(len(view_start) - 1):
        for e in range(view_start[i], view_start[i + 1]):
            for c in range(start[low + i], start[low + i + 1]):
                seen[of_view[e].row, state[c]] = True
    return low + len(view_start) - 1


def _learned(
    of_points: VotesOfPoints,
    of_masks: tuple[NDArray[np.int32], NDArray[np.int32]],
    found: LikelyStates,
    openly: NDArray[np.float32],
    tables: ViewReports,
) -> ViewReports:
    """What each view reports of the points in each state, these being as likely in it as found."""
    column, seat, first = table = tables.column, tables.seat, tables.first
    counted, low = np.zeros(first[-1]), 0
    for some in of_points:
        low = _count(*some(), low, of_masks, (found.start, found.state, found.likely), openly, table, counted)
    chance = np.empty(first[-1], np.float32)
    _share(column, seat, first, counted, chance)
    return replace(tables, chance=chance)


@njit(cache=True)
def _report(of_mask, e, end, group, mask_view, view, vote):  # noqa: ANN001, ANN202
    """What a view with this vote on a point says of it: where its masks end, from e on, the part of its vote that
    counts, and what of that is for "no mask". What lies in masks without a group says nothing."""
    grouped, lost = 0.0, 0.0
    while e < end and mask_view[of_mask[e].row] <= view:
        if group[of_mask[e].row] >= 0:
            grouped += of_mask[e].vote
        else:
            lost += of_mask[e].vote
        e += 1
    counts = max(vote - lost, grouped)
    return e, counts, counts - grouped


@njit(cache=True)
def _count(masks, views, low, of_masks, candidates, openly, table, counted):  # noqa: ANN001, ANN202
    """Adds to ``counted`` what views report of the points from ``low`` on, by the square of how far they see these.
    Returns the point after the last."""
    (mask_start, of_mask), (view_start, of_view), (group, mask_view) = masks, views, of_masks
    (start, state, likely), (column, seat, first) = candidates, table
    background = column.shape[1] - 1
    for i in range(len(mask_start) - 1):
        g, e = low + i, mask_start[i]
        for v in range(view_start[i], view_start[i + 1]):
            view, here = of_view[v].row, e
            e, counts, none = _report(of_mask, e, mask_start[i + 1], group, mask_view, view, of_view[v].vote)
            last = column[view, background]
            for c in range(start[g], start[g + 1]):
                if likely[c] == 0:
                    continue
                weight = _EXACT * likely[c] * counts * openly[g] ** 2
                row = first[view] + seat[view, state[c]] * (last + 1)
                for m in range(here, e):
                    k = group[of_mask[m].row]
                    if k >= 0:
                        counted[row + column[view, k]] += np.rint(weight * of_mask[m].vote) / _EXACT
                counted[row + last] += np.rint(weight * none) / _EXACT
    return low + len(mask_start) - 1


@njit(cache=True)
def _share(column, seat, first, counted, chance):  # noqa: ANN001, ANN202
    """Writes to ``chance`` the part of each report in all of a state, EXPECTED among them."""
    background = column.shape[1] - 1
    for view in range(len(column)):
        width = column[view, background] + 1
        for k in range(seat.shape[1]):
            if seat[view, k] < 0:
                continue
            row = first[view] + seat[view, k] * width
            total = counted[row : row + width].sum() + EXPECTED
            for r in range(width):
                expected = EXPECTED if r == _expected(column[view, k], width) else 0.0
                chance[row + r] = _at_least((counted[row + r] + expected) / total)


@njit(cache=True)
def _expected(column, width):  # noqa: ANN001, ANN202
    """The column of what a view that errs nowhere reports of a state."""
    return column if column >= 0 else width - 1


@njit(cache=True)
def _at_least(chance):  # noqa: ANN001, ANN202
    return (1 - LEAST) * chance + LEAST


# Points --------------------------------------------------------------------------------------------------------------


def _evidence(
    of_points: VotesOfPoints,
    of_masks: tuple[NDArray[np.int32], NDArray[np.int32]],
    found: LikelyStates,
    openly: NDArray[np.float32],
    reports: ViewReports,
) -> NDArray[np.float64]:
    """(candidates,) the logarithm of how likely views make each, but for what all of a point have in common."""
    evidence, low = np.where(found.masked, 0, -UNSEEN), 0
    evidence[found.state == found.background] = MORE_LIKELY
    table = reports.column, reports.seat, reports.first, reports.chance
    for some in of_points:
        votes = some()
        _add_evidence(*votes, low, of_masks, (found.start, found.state), openly, table, evidence)
        low += len(votes[0][0]) - 1
    return evidence


@njit(cache=True, parallel=True)
def _add_evidence(masks, views, low, of_masks, candidates, openly, reports, evidence):  # noqa: ANN001, ANN202
    """Adds to the evidence what views report of the points from ``low`` on."""
    (mask_start, of_mask), (view_start, of_view), (group, mask_view) = masks, views, of_masks
    (start, state), (column, seat, first, chance) = candidates, reports
    background = column.shape[1] - 1
    for i in prange(len(mask_start) - 1):
        g, e = low + i, mask_start[i]
        begin, end = start[g], start[g + 1]
        if end - begin < 2:
            continue  # nothing is to be told apart
        seen, likely = 0.0, np.zeros(end - begin)
        for v in range(view_start[i], view_start[i + 1]):
            view, here = of_view[v].row, e
            e, counts, none = _report(of_mask, e, mask_start[i + 1], group, mask_view, view, of_view[v].vote)
            if counts <= 0:
                continue
            sees, width = counts * openly[g], column[view, background] + 1
            for c in range(begin, end):
                k, total = state[c], 0.0
                for m in range(here, e + 1):
                    # Last of all: in no mask.
                    said, part, r = background, none, width - 1
                    if m < e:
                        said, part = group[of_mask[m].row], of_mask[m].vote
                        r = column[view, said] if said >= 0 else -1
                    if said < 0 or part <= 0:
                        continue
                    if r < 0:  # a group of which the points that reports were counted on show nothing
                        reported = _at_least(1.0 if k == said else 0.0)
                    elif seat[view, k] >= 0:
                        reported = chance[first[view] + seat[view, k] * width + r]
                    else:
                        reported = _at_least(1.0 if r == _expected(column[view, k], width) else 0.0)
                    total += part / counts * np.log(sees * reported + (1 - sees) * HIDDEN)
                likely[c - begin] += total
            seen += sees
        for c in range(begin, end):
            evidence[c] += likely[c - begin] / max(1.0, seen / ENOUGH)


def _settled(
    evidence: NDArray[np.float64],
    found: LikelyStates,
    around: Neighborhood,
    weights: NDArray[np.float32],
    openly: NDArray[np.float32],
) -> LikelyStates:
    """How likely states are by their evidence, and once points have heard their neighbors ROUNDS times."""
    likely = np.zeros_like(evidence)
    for loudness in (0.0, *[SMOOTHNESS] * ROUNDS):  # at first no neighbor says anything
        likely = _heard(found.start, found.state, evidence, likely, around.index, weights, openly, loudness)
    return replace(found, likely=likely)


@njit(cache=True, parallel=True)
def _heard(start, state, evidence, likely, neighbors, weights, openly, loudness):  # noqa: ANN001, ANN202
    """(candidates,) how likely each is by its evidence and by how likely it was of the points that adjoin."""
    heard = np.ones(len(likely))
    for g in prange(len(start) - 1):
        begin, end = start[g], start[g + 1]
        if end - begin < 2:
            continue
        value = evidence[begin:end].copy()
        for j in range(neighbors.shape[1] if loudness > 0 else 0):
            other = neighbors[g, j]
            voice = loudness * max(weights[g, j] - APART, 0) * openly[other]
            if voice == 0:
                continue
            for o in range(start[other], start[other + 1]):
                for c in range(begin, end):
                    if state[c] == state[o]:
                        value[c - begin] += voice * likely[o]
                        break
        value = np.exp(value - value.max())
        heard[begin:end] = value / value.sum()
    return heard


@njit(cache=True)
def _likeliest(start, state, likely, background):  # noqa: ANN001, ANN202
    """`LikelyStates.ids`."""
    ids = np.full(len(start) - 1, UNOBSERVED, np.int32)
    for g in range(len(ids)):
        best, most = background, -1.0
        for c in range(start[g], start[g + 1]):
            if likely[c] > most or (likely[c] == most and state[c] < best):
                best, most = state[c], likely[c]
        if most >= 0:
            ids[g] = BACKGROUND if best == background else best
    return ids


@njit(cache=True)
def _likely_in(start, state, likely, ids):  # noqa: ANN001, ANN202
    """`LikelyStates.of`, background by its number."""
    found = np.zeros(len(ids))
    for g in range(len(ids)):
        for c in range(start[g], start[g + 1]):
            if state[c] == ids[g]:
                found[g] = likely[c]
    return found
