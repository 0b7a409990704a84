"""How likely each point is in each state, given what every view is known to report of each state.

Views do not only miss things: one shows the book as shelf, another the two halves of a sofa as one, a third puts the
wall behind the lamp into the lamp's mask. So a report about a point is judged by what the view reports of other points
of the same thing: a view that calls the whole book "shelf" cannot tell book from shelf, and its votes for the shelf
should not count against the book. Views are therefore treated as observers none of which is always right (Dawid and
Skene, 1979). A state is an instance, or background. With

    c_v(k, r)   the share of what view v sees of state k that it reports as r: a mask of some instance, or none
    p_v(g)      the probability that view v sees point g: its vote (`view_votes`) times the point's visibility

the likelihood of "g is in state k", where view v reports r of point g, is

    p_v(g) c_v(k, r) + (1 - p_v(g)) HIDDEN_REPORT_PROBABILITY

because anything may stand in front of a hidden point. A mask that spans several things is a report of its own, which is
not the expected one of any state: it says that the point belongs to one of the things in the mask. Log-likelihoods are
summed over views, but count as MAX_INDEPENDENT_VIEWS independent views at most: views that look alike err alike.
Adjoining points are the likelier to share a state the more alike their colors are (colors.py); each is influenced by
the state probabilities of its neighbors (mean field), but not by more than MAX_INFLUENCE in all: neighbors err alike,
too. Reports and color ratios are first counted on points whose state is clear without them, then again on the resulting
state probabilities (EM).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.cloud import BACKGROUND, UNOBSERVED
from og_pointcloud.fitting.colors import color_ratios, neighbor_weights
from og_pointcloud.fitting.view_votes import FIXED_POINT_SCALE, PointVotes
from og_pointcloud.kernels import njit, prange
from og_pointcloud.rendering.geometry import Neighborhood

HIDDEN_REPORT_PROBABILITY = 0.5
"""Probability of any report about a point that the view does not see."""
MIN_REPORT_PROBABILITY = 0.03
"""No report is less likely than this: any view may err anywhere."""
MAX_INDEPENDENT_VIEWS = 3.0
"""Log-likelihoods of up to this many views add up; more views count as this many times their mean."""
PRIOR_COUNT = 10.0
"""Pseudo-count, in points, of the report that a view without errors gives: its own mask of an instance, and no mask for
background and for instances that it has no mask of."""
BACKGROUND_LOG_PRIOR = 0.2
"""Log-prior of background over any instance: a wrong name is worse than none."""
SMOOTHNESS = 0.6
"""What a neighbor that is sure of its state adds to the logarithm of that state, times its color ratio (colors.py) less
MIN_COLOR_RATIO."""
MIN_COLOR_RATIO = 0.5
"""Neighbors have no influence at or below this color ratio (how much likelier their color difference is within one
thing than between two): the less colors say in a scene, the less its points follow their neighbors."""
MAX_INFLUENCE = 12.0
"""Neighbors that together add more than this to a state's logarithm count proportionally less."""
MEAN_FIELD_ROUNDS = 5
"""Rounds in which points are updated by their neighbors."""
EM_ROUNDS = 2
"""Rounds in which reports and color ratios are counted and states updated."""


@dataclass(frozen=True)
class ViewReports:
    """c_v(k, r) of a scene. States and reports share their numbers: groups, then masks that span several groups (which
    are reports only), then background. report_column: (views, numbers) int32, the column of a report in view v's table,
    -1 where v has no such mask; background's is the last, "no mask". state_row: (views, numbers) int32, the row of a
    state, -1 where v sees no point that may be in it. table_start: (views + 1,) int64, where each view's table begins
    in ``probability``: (rows times columns of all,) float32. spanned: (spanning masks, groups) bool, whether clear
    points of a group lie in the mask."""

    report_column: NDArray[np.int32]
    state_row: NDArray[np.int32]
    table_start: NDArray[np.int64]
    probability: NDArray[np.float32]
    spanned: NDArray[np.bool_]


@dataclass(frozen=True)
class LikelyStates:
    """The candidate states of each point: state[start[g] : start[g + 1]], groups and, last, the background number; none
    where no view sees the point. Candidates are the groups of the masks that the point lies in, the groups that
    spanning masks around it span, the groups of adjoining points, and background. probability: (all,) float64, sums to
    1 for each point. group_count: number of groups. background: its number."""

    start: NDArray[np.int64]
    state: NDArray[np.int32]
    probability: NDArray[np.float64]
    group_count: int
    background: int

    @property
    def ids(self) -> NDArray[np.int32]:
        """(n,) each point's most probable group (ties: the lowest) or BACKGROUND; UNOBSERVED without candidates."""
        return _most_probable(self.start, self.state, self.probability, self.background)

    def probability_of(self, ids: NDArray[np.int32]) -> NDArray[np.float64]:
        """(n,) the probability that each point is in its state of ``ids``; 0 where that is no candidate."""
        states = np.where(ids == BACKGROUND, self.background, ids)
        return _probability_in(self.start, self.state, self.probability, states)

    def expected_iou(self, ids: NDArray[np.int32]) -> NDArray[np.float64]:
        """(groups,) the expected IoU of each group's points in ``ids`` with its true points under these probabilities;
        0 where it has no points."""
        count, grouped = self.group_count, ids >= 0
        of_group = np.bincount(self.state, self.probability, self.background + 1)[:count]
        right = np.bincount(ids[grouped], self.probability_of(ids)[grouped], count)
        either = np.bincount(ids[grouped], minlength=count) + of_group - right
        return np.divide(right, either, out=np.zeros(count), where=either > 0)


def likely_states(
    point_votes: PointVotes,
    mask_reports: tuple[NDArray[np.int32], NDArray[np.int32]],
    size: tuple[int, int],
    clear: NDArray[np.int32],
    best_group: NDArray[np.int32],
    visibility: NDArray[np.float32],
    around: Neighborhood,
    rgb: NDArray[np.uint8] | None,
    known: ViewReports | None = None,
) -> tuple[LikelyStates, ViewReports, NDArray[np.float32]]:
    """The probability of each candidate state of each point, what views report, and the weights of neighbors.

    mask_reports: for each mask what it reports, a group, -1 for nothing, or, if it spans several groups, a number of
    its own after the groups; and its view. size: numbers of views and groups. clear: (n,) the state of each clear
    point, UNOBSERVED for others. best_group: (n,) the group with the most votes on each point, -1 none; it is a
    candidate for adjoining points too. visibility: (n,) in [0, 1], scales the votes on each point. rgb: (n, 3) or None.
    known: reports of the whole scene that these points are part of; None: counted on them.
    """
    spanned = _spanned_groups(point_votes, mask_reports[0], size[1], clear) if known is None else known.spanned
    candidates = _candidates(point_votes, mask_reports[0], spanned, clear, best_group, around)
    reports = _empty_tables(point_votes, mask_reports, size[0], spanned, candidates) if known is None else known
    unary = _unary_potentials(point_votes, mask_reports, candidates, visibility, reports) if known else np.empty(0)
    states, weights = candidates, around.adjoining.astype(np.float32)
    for _ in range(EM_ROUNDS):
        ids = states.ids
        weights = neighbor_weights(rgb, around, color_ratios(rgb, ids, states.probability_of(ids), around))
        if known is None:
            reports = _estimated_reports(point_votes, mask_reports, states, visibility, reports)
            unary = _unary_potentials(point_votes, mask_reports, candidates, visibility, reports)
        states = _mean_field(unary, candidates, around.index, _influences(weights, visibility, around.index))
    return states, reports, weights


# Candidate states ----------------------------------------------------------------------------------------------------


def _spanned_groups(
    point_votes: PointVotes, group: NDArray[np.int32], groups: int, clear: NDArray[np.int32]
) -> NDArray[np.bool_]:
    """`ViewReports.spanned`."""
    spanned = np.zeros((max(int(group.max(initial=-1)) + 1 - groups, 0), groups), np.bool_)
    if len(spanned):
        _mark_spanned(*point_votes[0], group, clear, spanned)
    return spanned


@njit(cache=True)
def _mark_spanned(mask_start, of_mask, group, clear, spanned):  # noqa: ANN001, ANN202
    """Marks the groups that masks span."""
    groups = spanned.shape[1]
    for g in range(len(clear)):
        for e in range(mask_start[g], mask_start[g + 1]):
            if group[of_mask[e].row] >= groups and clear[g] >= 0:
                spanned[group[of_mask[e].row] - groups, clear[g]] = True


def _candidates(
    point_votes: PointVotes,
    group: NDArray[np.int32],
    spanned: NDArray[np.bool_],
    clear: NDArray[np.int32],
    best_group: NDArray[np.int32],
    around: Neighborhood,
) -> LikelyStates:
    """The candidates of all points, with probability 1 for the state of a clear point, else 0. group: (masks,)."""
    spanning, groups = spanned.shape
    background = groups + spanning
    clear = np.where(clear == BACKGROUND, background, clear)  # as candidates are numbered
    span = np.concatenate([[0], np.cumsum(spanned.sum(axis=1))]), np.nonzero(spanned)[1].astype(np.int32)
    adjacency = best_group, around.index, around.adjoining
    masks, (view_start, _) = point_votes
    start, state = _candidates_of_points(masks, view_start, group, groups, span, adjacency)
    probability = (state == np.repeat(clear, np.diff(start))).astype(np.float64)
    return LikelyStates(start, state, probability, groups, background)


@njit(cache=True)
def _candidates_of_points(masks, view_start, group, groups, span, adjacency):  # noqa: ANN001, ANN202
    """(n + 1,) where the candidates of each point start, and (all,) the candidates. span: (start, groups) of spanning
    masks. adjacency: (best group, neighbors, adjoining)."""
    (mask_start, of_mask), (span_start, span_group), (best_group, neighbors, adjoining) = masks, span, adjacency
    n, capacity = len(mask_start) - 1, 0
    for e in range(len(of_mask)):
        k = group[of_mask[e].row] - groups
        capacity += 1 if k < 0 else span_start[k + 1] - span_start[k]
    start = np.zeros(n + 1, np.int64)
    # Background, and at most one for each mask (or each group that it spans) and each neighbor.
    found = np.empty(n * (neighbors.shape[1] + 1) + capacity, np.int32)
    end = 0
    for g in range(n):
        begin = start[g] = end
        if view_start[g] == view_start[g + 1]:
            continue
        for e in range(mask_start[g], mask_start[g + 1]):
            k = group[of_mask[e].row]
            if 0 <= k < groups and not _contains(found, begin, end, k):
                found[end] = k
                end += 1
            for s in range(span_start[k - groups], span_start[k - groups + 1]) if k >= groups else range(0):
                if not _contains(found, begin, end, span_group[s]):
                    found[end] = span_group[s]
                    end += 1
        for j in range(neighbors.shape[1]):
            k = best_group[neighbors[g, j]]
            if adjoining[g, j] and k >= 0 and not _contains(found, begin, end, k):
                found[end] = k
                end += 1
        found[end] = groups + len(span_start) - 1
        end += 1
    start[n] = end
    return start, found[:end].copy()


@njit(cache=True)
def _contains(found, begin, end, k):  # noqa: ANN001, ANN202
    for c in range(begin, end):  # noqa: SIM110 - numba has no generators
        if found[c] == k:
            return True
    return False


# What views report ---------------------------------------------------------------------------------------------------


def _empty_tables(
    point_votes: PointVotes,
    mask_reports: tuple[NDArray[np.int32], NDArray[np.int32]],
    views: int,
    spanned: NDArray[np.bool_],
    candidates: LikelyStates,
) -> ViewReports:
    """The tables of all views, filled with zeros."""
    shown = _possible_reports(mask_reports, (views, candidates.background + 1))
    report_column = np.where(shown, np.cumsum(shown, axis=1) - 1, -1).astype(np.int32)
    seen = np.zeros(shown.shape, np.bool_)
    _mark_seen(*point_votes[1], candidates.start, candidates.state, seen)
    state_row = np.where(seen, np.cumsum(seen, axis=1) - 1, -1).astype(np.int32)
    table_start = np.concatenate([[0], np.cumsum(seen.sum(axis=1) * shown.sum(axis=1))]).astype(np.int64)
    return ViewReports(report_column, state_row, table_start, np.zeros(table_start[-1], np.float32), spanned)


def _possible_reports(
    mask_reports: tuple[NDArray[np.int32], NDArray[np.int32]], shape: tuple[int, int]
) -> NDArray[np.bool_]:
    """(views, numbers), whether a view has a mask that reports this number; the last, "no mask", every view has."""
    group, mask_view = mask_reports
    possible = np.zeros(shape, np.bool_)
    possible[mask_view[group >= 0], group[group >= 0]] = True
    possible[:, -1] = True
    return possible


@njit(cache=True)
def _mark_seen(view_start, of_view, start, state, seen):  # noqa: ANN001, ANN202
    """Marks in (views, states) the candidates of the points that each view sees."""
    for g in range(len(view_start) - 1):
        for e in range(view_start[g], view_start[g + 1]):
            for c in range(start[g], start[g + 1]):
                seen[of_view[e].row, state[c]] = True


def _estimated_reports(
    point_votes: PointVotes,
    mask_reports: tuple[NDArray[np.int32], NDArray[np.int32]],
    candidates: LikelyStates,
    visibility: NDArray[np.float32],
    tables: ViewReports,
) -> ViewReports:
    """What each view reports of each state, counted on points by their state probabilities (M step)."""
    report_column, state_row, table_start = table = tables.report_column, tables.state_row, tables.table_start
    states = candidates.start, candidates.state, candidates.probability
    counts = np.zeros(table_start[-1])
    _add_counts(*point_votes, mask_reports, states, visibility, table, counts)
    probability = np.empty(table_start[-1], np.float32)
    _normalize(report_column, state_row, table_start, counts, probability)
    return replace(tables, probability=probability)


@njit(cache=True)
def _view_report(of_mask, e, end, group, mask_view, view, vote):  # noqa: ANN001, ANN202
    """What a view with this vote reports of a point: the end of its masks, which begin at e; the part of its vote that
    counts; and the part of that for "no mask". Votes in masks without a group do not count."""
    grouped, ungrouped = 0.0, 0.0
    while e < end and mask_view[of_mask[e].row] <= view:
        if group[of_mask[e].row] >= 0:
            grouped += of_mask[e].vote
        else:
            ungrouped += of_mask[e].vote
        e += 1
    used = max(vote - ungrouped, grouped)
    return e, used, used - grouped


@njit(cache=True)
def _add_counts(masks, views, mask_reports, candidates, visibility, table, counts):  # noqa: ANN001, ANN202
    """Adds to ``counts`` what views report of the points, weighted by visibility squared."""
    (mask_start, of_mask), (view_start, of_view), (group, mask_view) = masks, views, mask_reports
    (start, state, probability), (report_column, state_row, table_start) = candidates, table
    background = report_column.shape[1] - 1
    for g in range(len(mask_start) - 1):
        e = mask_start[g]
        for v in range(view_start[g], view_start[g + 1]):
            view, first_mask = of_view[v].row, e
            e, used_vote, no_mask = _view_report(of_mask, e, mask_start[g + 1], group, mask_view, view, of_view[v].vote)
            no_mask_column = report_column[view, background]
            for c in range(start[g], start[g + 1]):
                if probability[c] == 0:
                    continue
                weight = FIXED_POINT_SCALE * probability[c] * used_vote * visibility[g] ** 2
                row = table_start[view] + state_row[view, state[c]] * (no_mask_column + 1)
                for m in range(first_mask, e):
                    k = group[of_mask[m].row]
                    if k >= 0:
                        counts[row + report_column[view, k]] += np.rint(weight * of_mask[m].vote) / FIXED_POINT_SCALE
                counts[row + no_mask_column] += np.rint(weight * no_mask) / FIXED_POINT_SCALE


@njit(cache=True)
def _normalize(report_column, state_row, table_start, counts, probability):  # noqa: ANN001, ANN202
    """Writes to ``probability`` the share of each report among all of a state, PRIOR_COUNT included."""
    background = report_column.shape[1] - 1
    for view in range(len(report_column)):
        width = report_column[view, background] + 1
        for k in range(state_row.shape[1]):
            if state_row[view, k] < 0:
                continue
            row = table_start[view] + state_row[view, k] * width
            total = counts[row : row + width].sum() + PRIOR_COUNT
            for r in range(width):
                prior = PRIOR_COUNT if r == _ideal_column(report_column[view, k], width) else 0.0
                probability[row + r] = _with_floor((counts[row + r] + prior) / total)


@njit(cache=True)
def _ideal_column(column, width):  # noqa: ANN001, ANN202
    """The column of the report that a view without errors gives of a state."""
    return column if column >= 0 else width - 1


@njit(cache=True)
def _with_floor(probability):  # noqa: ANN001, ANN202
    return (1 - MIN_REPORT_PROBABILITY) * probability + MIN_REPORT_PROBABILITY


# State probabilities -------------------------------------------------------------------------------------------------


def _unary_potentials(
    point_votes: PointVotes,
    mask_reports: tuple[NDArray[np.int32], NDArray[np.int32]],
    candidates: LikelyStates,
    visibility: NDArray[np.float32],
    reports: ViewReports,
) -> NDArray[np.float64]:
    """(candidates,) log-prior plus log-likelihood of each, up to a constant for each point."""
    unary = np.where(candidates.state == candidates.background, BACKGROUND_LOG_PRIOR, 0.0)
    possible = _possible_reports(mask_reports, reports.report_column.shape)
    table = reports.report_column, reports.state_row, reports.table_start, reports.probability, possible
    states = candidates.start, candidates.state
    _add_log_likelihood(*point_votes, mask_reports, states, visibility, table, unary)
    return unary


@njit(cache=True, parallel=True)
def _add_log_likelihood(masks, views, mask_reports, candidates, visibility, reports, unary):  # noqa: ANN001, ANN202
    """Adds to ``unary`` the log-likelihood of what views report of the points."""
    (mask_start, of_mask), (view_start, of_view), (group, mask_view) = masks, views, mask_reports
    (start, state), (report_column, state_row, table_start, probability, possible) = candidates, reports
    background = report_column.shape[1] - 1
    for g in prange(len(mask_start) - 1):
        e, begin, end = mask_start[g], start[g], start[g + 1]
        if end - begin < 2:
            continue  # one candidate at most: nothing to decide
        total_seen, log_likelihood = 0.0, np.zeros(end - begin)
        for v in range(view_start[g], view_start[g + 1]):
            view, first_mask = of_view[v].row, e
            e, used_vote, no_mask = _view_report(of_mask, e, mask_start[g + 1], group, mask_view, view, of_view[v].vote)
            if used_vote <= 0:
                continue
            p_seen, width = used_vote * visibility[g], report_column[view, background] + 1
            for c in range(begin, end):
                k, total = state[c], 0.0
                for m in range(first_mask, e + 1):
                    # The last one: in no mask.
                    report, vote, col = background, no_mask, width - 1
                    if m < e:
                        report, vote = group[of_mask[m].row], of_mask[m].vote
                        col = report_column[view, report] if report >= 0 else -1
                    if report < 0 or vote <= 0:
                        continue
                    if col < 0:  # a group unseen among the points that reports were counted on
                        p_report = _with_floor(1.0 if k == report else 0.0)
                    elif state_row[view, k] >= 0:
                        p_report = probability[table_start[view] + state_row[view, k] * width + col]
                    elif possible[view, k] and report_column[view, k] < 0:
                        p_report = _with_floor(0.0)  # of such a group the view would report its own mask
                    else:
                        p_report = _with_floor(1.0 if col == _ideal_column(report_column[view, k], width) else 0.0)
                    total += vote / used_vote * np.log(p_seen * p_report + (1 - p_seen) * HIDDEN_REPORT_PROBABILITY)
                log_likelihood[c - begin] += total
            total_seen += p_seen
        for c in range(begin, end):
            unary[c] += log_likelihood[c - begin] / max(1.0, total_seen / MAX_INDEPENDENT_VIEWS)


def _mean_field(
    unary: NDArray[np.float64],
    candidates: LikelyStates,
    neighbors: NDArray[np.int32],
    influence: NDArray[np.float32],
) -> LikelyStates:
    """State probabilities from the unary potentials, then MEAN_FIELD_ROUNDS updates by the neighbors."""
    start, state = candidates.start, candidates.state
    probability = _mean_field_round(start, state, unary, unary, neighbors[:, :0], influence[:, :0])  # without neighbors
    for _ in range(MEAN_FIELD_ROUNDS):
        probability = _mean_field_round(start, state, unary, probability, neighbors, influence)
    return replace(candidates, probability=probability)


@njit(cache=True, parallel=True)
def _influences(weights, visibility, neighbors):  # noqa: ANN001, ANN202
    """(n, k) what each neighbor adds to the logarithm of a state that it is sure of."""
    influence = np.zeros(neighbors.shape, np.float32)
    for g in prange(len(neighbors)):
        total = 0.0
        for j in range(neighbors.shape[1]):
            other = neighbors[g, j]
            influence[g, j] = SMOOTHNESS * max(weights[g, j] - MIN_COLOR_RATIO, 0) * visibility[other]
            total += influence[g, j]
        for j in range(neighbors.shape[1] if total > MAX_INFLUENCE else 0):
            influence[g, j] *= MAX_INFLUENCE / total
    return influence


@njit(cache=True, parallel=True)
def _mean_field_round(start, state, unary, probability, neighbors, influence):  # noqa: ANN001, ANN202
    """(candidates,) the probability of each from its unary potential and the previous probabilities of neighbors."""
    updated = np.ones(len(probability))
    for g in prange(len(start) - 1):
        begin, end = start[g], start[g + 1]
        if end - begin < 2:
            continue
        value = unary[begin:end].copy()
        for j in range(neighbors.shape[1]):
            other = neighbors[g, j]
            if influence[g, j] == 0:
                continue
            for o in range(start[other], start[other + 1]):
                for c in range(begin, end):
                    if state[c] == state[o]:
                        value[c - begin] += influence[g, j] * probability[o]
                        break
        value = np.exp(value - value.max())
        updated[begin:end] = value / value.sum()
    return updated


@njit(cache=True)
def _most_probable(start, state, probability, background):  # noqa: ANN001, ANN202
    """`LikelyStates.ids`."""
    ids = np.full(len(start) - 1, UNOBSERVED, np.int32)
    for g in range(len(ids)):
        best, highest = background, -1.0
        for c in range(start[g], start[g + 1]):
            if probability[c] > highest or (probability[c] == highest and state[c] < best):
                best, highest = state[c], probability[c]
        if highest >= 0:
            ids[g] = BACKGROUND if best == background else best
    return ids


@njit(cache=True)
def _probability_in(start, state, probability, ids):  # noqa: ANN001, ANN202
    """`LikelyStates.of`, background by its number."""
    found = np.zeros(len(ids))
    for g in range(len(ids)):
        for c in range(start[g], start[g + 1]):
            if state[c] == ids[g]:
                found[g] = probability[c]
    return found
