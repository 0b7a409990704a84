"""Masks of different views -> instances, without training: masks are one object where most views say so.

Two masks of two views show the same thing to the extent that they share Gaussians that both views see. Let

    N_ij = sum_g A_ig A_jg            mass that mask i and mask j share
    N_ib = sum_g A_ig s_bg            mass of mask i that view b sees at all (s = masked + unmasked weight)

so that ``N_ij / N_ib`` is the share of mask i that lies in mask j of view b. This gives, for each mask and view, the
mask's *container*: the one mask of that view that holds most of it, if any. Each view is thus a witness for every pair
of masks that have containers in it: "one thing" (the same container) or "two" (different ones). A view that sees both
but has a mask of only one says "two" with half weight: proposers mostly miss whole things, but sometimes parts. A view
that missed both says nothing. Masks are joined bottom-up while a majority of the witnesses pooled over both groups says
"one thing": a mask that spans two objects is outvoted; parts of one object are joined when other views show it whole.

Where masks have tracks, the tracker is one more witness. It says "one thing" of two masks with the same track, even of
the front and the back of a thing, which no view sees together, and "two" where their tracks were in one image. About
other pairs it says nothing: what was out of sight comes back with another number.

The idea of view consensus is that of MaskClustering (Yan et al., CVPR 2024); the soft, visibility-weighted form is
ours.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from og_pointcloud.fitting.mask_table import MaskTable
from og_pointcloud.fitting.view_votes import ViewVotes, view_votes
from og_pointcloud.kernels import njit
from og_pointcloud.settings import GroupingSettings

UNKNOWN_LIKENESS = 0.5
"""Likeness where features say nothing: the middle rank (`_likeness`)."""


@dataclass(frozen=True)
class MaskGroups:
    """group: (masks,) int32, the group of each mask, -1 where the mask was left out (it spans objects, or shows
    nothing). count: number of groups. spanning: (masks,) bool, masks that most views show as several things, and those
    that `with_spanning` marks, which keep their group and describe it."""

    group: NDArray[np.int32]
    count: int
    spanning: NDArray[np.bool_]

    @property
    def voting_group(self) -> NDArray[np.int32]:
        """(masks,) int32, the group that each mask votes for, -1 none: spanning masks vote for no single group."""
        return np.where(self.spanning, -1, self.group).astype(np.int32)


def group_masks(table: MaskTable, settings: GroupingSettings, sample: NDArray[np.int64] | None = None) -> MaskGroups:
    """Group the masks of a table. Group numbers are ordered by shown mass, largest first, and deterministic.

    sample: the columns that overlaps are measured on; thousands of points are enough for their means. None: all.
    """
    share, left_out = mask_shares(table if sample is None else table.of_points(sample), settings)
    spanning = _spanning_masks(share, table.mask_view, settings)
    container = _containers(share, table.mask_view, spanning, settings)
    witnesses = _witnesses(share, container, left_out, table, settings)
    shown = np.asarray(table.weights.sum(axis=1), np.float64).ravel()
    usable = ~spanning & (shown > 0)
    group = _agglomerate(witnesses, table.unit_features, table.mask_view, usable, settings)
    return MaskGroups(*ordered(group, shown), spanning)


def with_spanning(
    groups: MaskGroups,
    votes: ViewVotes,
    mask_view: NDArray[np.int32],
    ids: NDArray[np.int32],
    settings: GroupingSettings,
) -> MaskGroups:
    """The groups, with masks marked that span two of them: where a proposer misses a cup, its table's mask may hold it.

    A mask spans two groups if it holds most of what its view shows of each, and each is a good part of the mask. ids:
    (n,) int32, the group of each point as decided so far, below 0 none.
    """
    of_group = indicator(ids, groups.count).T
    held = (votes.in_mask @ of_group).tocoo()  # (masks, groups)
    mask, group = held.row, held.col
    shown = (votes.vote @ of_group).toarray()[mask_view[mask], group]
    total = np.asarray(votes.in_mask.sum(axis=1), np.float64)
    spans = (held.data > settings.container_share * shown) & (held.data > settings.spanning_share * total[mask])
    several = np.bincount(mask[spans], minlength=len(total)) > 1
    return replace(groups, spanning=groups.spanning | (several & (groups.group >= 0)))


def mask_shares(table: MaskTable, settings: GroupingSettings) -> tuple[csr_array, NDArray[np.bool_]]:
    """(masks, masks) sparse: entry (i, j) is the share of what mask i shows, and j's view sees, that lies in j. And
    (masks, views): whether a view sees what a mask shows, most of it outside the view's own masks.

    These votes ignore holes and colors: what shows through a plant's leaves lies in its masks too, and is as good a
    measure of their overlap as the leaves.
    """
    votes = view_votes(table.with_doubted())
    weights, seen = votes.in_mask, votes.vote
    shared = (weights @ weights.T).tocoo()  # N_ij
    visible = (weights @ seen.T).toarray()  # N_ib
    mask_mass = np.asarray(weights.multiply(weights).sum(axis=1)).ravel()
    rows, cols = shared.row, shared.col
    base = visible[rows, table.mask_view[cols]]
    # A view that sees only a sliver of a mask is no witness for it.
    sees = visible > settings.witness_share * mask_mass[:, None]
    kept = sees[rows, table.mask_view[cols]]
    share = csr_array((shared.data[kept] / base[kept], (rows[kept], cols[kept])), shape=shared.shape)
    in_masks = (share @ indicator(table.mask_view, visible.shape[1]).T).toarray()
    return share, sees & (in_masks < 1 - settings.container_share)


def indicator(owner: NDArray[np.int32], count: int) -> csr_array:
    """(count, len(owner)) sparse with a one at (owner[i], i); negative owners have none."""
    index = np.flatnonzero(owner >= 0)
    return csr_array((np.ones(len(index), np.float32), (owner[index], index)), shape=(count, len(owner)))


def _spanning_masks(share: csr_array, mask_view: NDArray[np.int32], settings: GroupingSettings) -> NDArray[np.bool_]:
    """Masks that most of the witnessing views show as two things or more.

    A view shows mask i as several things when none of its masks holds i, but two or more of its masks lie within i and
    together cover it.
    """
    entries = share.tocoo()
    views = int(mask_view.max(initial=-1)) + 1
    inside = _lookup(share, entries.col, entries.row)  # share of j in i
    part = inside > settings.container_share
    # A cell for each mask i and view: how much of i that view's largest mask holds, and how much its parts of i cover.
    cell = entries.row.astype(np.int64) * views + mask_view[entries.col]
    size = len(mask_view) * views
    largest = np.zeros(size)
    np.maximum.at(largest, cell, entries.data)
    parts = np.bincount(cell[part], minlength=size)
    covered = np.bincount(cell[part], entries.data[part], size)
    split = (largest < settings.container_share) & (parts >= 2) & (covered > settings.container_share)
    held = largest >= settings.container_share
    held[np.arange(len(mask_view)) * views + mask_view] = False  # a mask is no witness of itself
    shape = len(mask_view), views
    return split.reshape(shape).sum(axis=1) > held.reshape(shape).sum(axis=1)


def _lookup(matrix: csr_array, rows: NDArray[np.int32], cols: NDArray[np.int32]) -> NDArray[np.float64]:
    """Entries of a sparse matrix, 0 where it has none."""
    matrix.sort_indices()  # so that keys, row by row, ascend
    entries = matrix.tocoo()
    width = np.int64(matrix.shape[1])
    keys = entries.row * width + entries.col
    wanted = rows * width + cols
    found = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
    if len(keys) == 0:
        return np.zeros(len(wanted))
    return np.where(keys[found] == wanted, entries.data[found], 0.0)


def _containers(
    share: csr_array, mask_view: NDArray[np.int32], spanning: NDArray[np.bool_], settings: GroupingSettings
) -> csr_array:
    """(masks, masks) sparse of ones: (i, m) where m is the mask of its view that holds most of mask i."""
    entries = share.tocoo()
    holds = (entries.data > settings.container_share) & ~spanning[entries.col]
    rows, cols, value = entries.row[holds], entries.col[holds], entries.data[holds]
    # At most one mask of a view can hold more than half of a mask, so the container is unique with one level of masks;
    # of overlapping levels the one that holds most is kept.
    order = np.lexsort((cols, -value, mask_view[cols], rows))
    rows, cols = rows[order], cols[order]
    first = np.ones(len(rows), bool)
    first[1:] = (np.diff(rows) != 0) | (np.diff(mask_view[cols]) != 0)
    rows, cols = rows[first], cols[first]
    return csr_array((np.ones(len(rows), np.float32), (rows, cols)), shape=share.shape)


@dataclass(frozen=True)
class _Witnesses:
    """What views, and the tracker, say about pairs of masks.

    rows, cols: the pairs that any witness shows as one thing, both ways, rows ascending. agree: how many say so.
    same_extent: how many of these count whatever the features say: all if the two masks have the same extent, else the
    tracker alone. left, right: (masks, ...); left[i] @ right[j] is the number of witnesses for the pair (i, j): views
    in which both have a container, or one has and the other is left out; and the tracker where both tracks are the same
    or were in one image.
    """

    rows: NDArray[np.int32]
    cols: NDArray[np.int32]
    agree: NDArray[np.float64]
    same_extent: NDArray[np.float64]
    left: NDArray[np.float64]
    right: NDArray[np.float64]


def _witnesses(
    share: csr_array,
    container: csr_array,
    left_out: NDArray[np.bool_],
    table: MaskTable,
    settings: GroupingSettings,
) -> _Witnesses:
    views = left_out.shape[1]
    held = (container @ indicator(table.mask_view, views).T).toarray().astype(np.float64)
    # (h + l)(h' + l') - l l' is hh' + hl' + lh': views that hold both, or hold one and leave out the other.
    absent = settings.left_out_voice * left_out.astype(np.float64)
    left, right = np.column_stack([held + absent, absent]), np.column_stack([held + absent, -absent])
    tracked = indicator(np.full(len(held), -1, np.int32), len(held))  # no pair
    if table.mask_track is not None:
        # Tracks as 0, 1, ..., -1 none: np.unique counts -1 as a value, the subtraction takes it away again.
        track = np.unique(np.maximum(table.mask_track, -1), return_inverse=True)[1] - (table.mask_track < 0).any()
        tracks = indicator(track.astype(np.int32), int(track.max(initial=-1)) + 1)
        tracked = csr_array(tracks.T @ tracks)
        in_view = tracks @ indicator(table.mask_view, views).T
        together = (in_view @ in_view.T).toarray() > 0  # tracks in one image, each with itself too
        # On the left a mask has its own track's column, on the right those of all tracks that were in an image with it.
        left, right = np.column_stack([left, tracks.T.toarray()]), np.column_stack([right, tracks.T @ together])
    pairs = csr_array(container @ container.T + tracked).tocoo()
    off_diagonal = pairs.row != pairs.col
    rows, cols, agree = pairs.row[off_diagonal], pairs.col[off_diagonal], pairs.data[off_diagonal].astype(np.float64)
    # The same extent: each lies mostly in the other.
    smaller = np.minimum(_lookup(share, rows, cols), _lookup(share, cols, rows))
    certain = np.where(smaller > settings.container_share, agree, _lookup(tracked, rows, cols))
    return _Witnesses(rows, cols, agree, certain, left, right)


def _agglomerate(
    witnesses: _Witnesses,
    features: NDArray[np.float32],
    mask_view: NDArray[np.int32],
    usable: NDArray[np.bool_],
    settings: GroupingSettings,
) -> NDArray[np.int64]:
    """Join the pair of groups with the most agreement until no majority is left; a group number per mask, -1 unused.

    The agreement of two groups is the share of their pooled witnesses that say "one thing". Masks of the same extent
    are one thing whatever their features say. A mask that only lies within another may be a part of it, or a cup on a
    table in a view that missed the cup: its witnesses are weighted by the likeness of the features.
    Of pairs with equal agreement the one with more witnesses comes first, then the one with more similar features: the
    order of views and masks does not matter.
    """
    # A group's number is that of its lowest mask. Sums and numbers of features are kept, for means over pairs.
    w, numbers = witnesses, np.arange(len(usable) + 1)
    kept = np.flatnonzero(usable[w.rows] & usable[w.cols])
    links = np.searchsorted(w.rows[kept], numbers), w.cols[kept].astype(np.int64), w.agree[kept], w.same_extent[kept]
    group, total = np.where(usable, numbers[:-1], -1), features.astype(np.float64)
    sums = w.left, w.right, total, features.any(axis=1).astype(np.float64)  # of the witnesses, who are needed no more
    _merge_groups(group, links, sums, cosines_within_views(features, mask_view), settings.join_majority)
    return _roots(group)


def cosines_within_views(features: NDArray[np.floating], mask_view: NDArray[np.int32]) -> NDArray[np.float64]:
    """Cosines of the features of two masks of the same view, ascending. Such masks mostly show different things, which
    calibrates the cosines of any encoder."""
    cosines = [np.zeros(0)]
    for view in np.unique(mask_view):
        rows = features[mask_view == view][:200]  # 20,000 pairs of a view are enough
        cosines.append((rows @ rows.T)[np.triu_indices(len(rows), 1)])
    return np.sort(np.concatenate(cosines))


@njit(cache=True)
def _merge_groups(group, links, sums, different, majority):  # noqa: ANN001, ANN202
    """Writes to ``group``, at first each mask's own number or -1, the lower number that it was joined with.

    links: sparse rows of masks: (start, other masks, agree, same extent). sums: (left, right, features, number of
    features) of each mask; here they become the sums of groups. different: `cosines_within_views`.
    """
    start, others, agree, same_extent = links
    left, right, features, described = sums
    rows = [slice(start[a], start[a + 1]) for a in range(len(group))]
    links_of = [(others[row], agree[row], same_extent[row]) for row in rows]
    version, place = np.zeros(len(group), np.int64), np.full(len(group), -1)
    # Pairs of groups, the best on top: minus agreement, witnesses and cosine; the two groups and their versions when
    # pushed. (An empty list of a known type, which numba needs.)
    heap = [(0.0, 0.0, 0.0, 0, 0, 0, 0) for _ in range(0)]
    for a in range(len(group)):
        _push_pairs(heap, a, a, links_of[a], sums, version, different, majority)
    while len(heap):
        _, _, _, a, b, seen_a, seen_b = heapq.heappop(heap)
        # Stale: one of the two has grown or joined another since it was pushed; its present pairs were pushed then.
        if version[a] != seen_a or version[b] != seen_b or group[a] != a or group[b] != b:
            continue
        # The higher number joins the lower one, which takes on the sums of both.
        group[b] = a
        version[a] += 1
        left[a] += left[b]
        right[a] += right[b]
        features[a] += features[b]
        described[a] += described[b]
        links_of[a] = _merged_links(links_of[a], links_of[b], a, group, place)
        links_of[b] = others[:0], agree[:0], same_extent[:0]
        _push_pairs(heap, a, -1, links_of[a], sums, version, different, majority)


@njit(cache=True)
def _push_pairs(heap, a, above, links, sums, version, different, majority):  # noqa: ANN001, ANN202
    """Pushes the pairs of group a and each linked group numbered above ``above`` that a majority of witnesses joins."""
    left, right, features, described = sums
    for b, agree, same_extent in zip(*links):  # noqa: B905
        witnesses = np.dot(left[b], right[a])
        if b <= above or agree / witnesses <= majority:  # features only ever take agreement away
            continue
        # The mean over pairs of masks, comparable with ``different``: sums have less noise, so any two are more alike.
        pairs = described[a] * described[b]
        cosine = np.dot(features[a], features[b]) / pairs if pairs > 0 else 0.0
        likeness = _likeness(cosine, different) if pairs > 0 else UNKNOWN_LIKENESS
        agreement = (same_extent + (agree - same_extent) * likeness) / witnesses
        if agreement > majority:
            low, high = min(a, b), max(a, b)
            heapq.heappush(heap, (-agreement, -witnesses, -cosine, low, high, version[low], version[high]))


@njit(cache=True)
def _likeness(cosine, different):  # noqa: ANN001, ANN202
    """The share of different things that are less alike than this."""
    if not len(different):
        return UNKNOWN_LIKENESS
    # The mean of the ranks with and without equal ones; cosines within rounding are equal.
    below = np.searchsorted(different, cosine - 1e-6, "left") + np.searchsorted(different, cosine + 1e-6, "right")
    return 0.5 * below / len(different)


@njit(cache=True)
def _merged_links(first, second, a, group, place):  # noqa: ANN001, ANN202
    """The links of group a, summed over its two parts, each other group once. place: (masks,) all -1, before and
    after."""
    capacity = len(first[0]) + len(second[0])
    others, agree, same_extent = np.empty(capacity, np.int64), np.zeros(capacity), np.zeros(capacity)
    count = 0
    for links in (first, second):
        for b, b_agree, b_same_extent in zip(*links):  # noqa: B905
            while group[b] != b:  # has joined another since
                b = group[b]
            if b == a:
                continue
            if place[b] < 0:
                place[b], others[count], count = count, b, count + 1
            agree[place[b]] += b_agree
            same_extent[place[b]] += b_same_extent
    place[others[:count]] = -1
    return others[:count], agree[:count], same_extent[:count]


def _roots(group: NDArray[np.int64]) -> NDArray[np.int64]:
    """Follow each mask to the group it ended in."""
    while True:
        parent = np.where(group >= 0, group[group], -1)
        if (parent == group).all():
            return group
        group = parent


def ordered(group: NDArray[np.integer], shown: NDArray[np.floating]) -> tuple[NDArray[np.int32], int]:
    """The group of each mask, numbered by the mass that groups show, largest first (ties: the lower), and their number.

    group: (masks,) any numbers below that of masks, -1 none. shown: (masks,) the mass that each shows.
    """
    roots = np.unique(group[group >= 0])
    mass = np.bincount(group[group >= 0], shown[group >= 0], len(group))[roots]
    order = roots[np.lexsort((roots, -mass))]
    number = np.full(len(group), -1, np.int32)
    number[order] = np.arange(len(order), dtype=np.int32)
    return np.where(group >= 0, number[group], -1).astype(np.int32), len(order)
