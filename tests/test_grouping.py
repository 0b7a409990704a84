"""Masks joined into groups: hand-made tables where the right answer is plain, and a slow literal reference."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from numpy.random import Generator
from numpy.typing import NDArray
from scipy.sparse import csr_array

from og_pointcloud.fitting.grouping import MaskGroups, group_masks, indicator, mask_shares, with_spanning
from og_pointcloud.fitting.mask_table import MaskTable
from og_pointcloud.fitting.view_votes import view_votes
from og_pointcloud.settings import GroupingSettings

SETTINGS = GroupingSettings()
ONE = np.array([1, 0, 0, 0, 0, 0, 0, 0], np.float32)
OTHER = np.array([0, 1, 0, 0, 0, 0, 0, 0], np.float32)

HandView = Sequence[tuple[Iterable[int], NDArray[np.float32]]]
"""Masks of a view: the points of each, and its feature."""


def hand_table(n: int, views: Sequence[HandView], unseen: Sequence[Iterable[int]] = ()) -> MaskTable:
    """A table in which every view sees every point openly, one pixel each, but those it is told not to see."""
    masks = [(index, list(points), feature) for index, view in enumerate(views) for points, feature in view]
    weights = np.zeros((len(masks), n), np.float32)
    for row, (_, points, _) in enumerate(masks):
        weights[row, points] = 1
    mask_view = np.array([index for index, _, _ in masks], np.int32)
    exposure = np.ones((len(views), n), np.float32)
    for index, points in enumerate(unseen):
        exposure[index, list(points)] = 0
    weights *= exposure[mask_view]
    outside = exposure.copy()
    for view in range(len(views)):
        outside[view] -= weights[mask_view == view].sum(axis=0)
    features = np.array([feature for _, _, feature in masks], np.float32).reshape(len(masks), len(ONE))
    return MaskTable(
        csr_array(weights),
        csr_array(np.maximum(outside, 0)),
        csr_array(exposure),
        mask_view,
        weights.sum(axis=1).astype(np.int32),
        features,
    )


def groups_of(table: MaskTable, settings: GroupingSettings = SETTINGS) -> NDArray[np.int32]:
    groups = group_masks(table, settings)
    assert groups.group.dtype == np.int32
    assert set(groups.group) - {-1} == set(range(groups.count))
    assert (groups.group[groups.spanning] == -1).all()
    return groups.group


A, B = range(50), range(50, 100)


PARTS = [(range(25), ONE), (range(25, 50), ONE)]
THIRD = range(80, 100), OTHER
NOTHING = np.zeros(8, np.float32)
PLAIN: dict[str, tuple[list[HandView], list[int]]] = {
    "two objects seen by all views are two groups": ([[(A, ONE), (B, OTHER)]] * 4, [0, 1] * 4),
    "objects with the same feature stay apart": ([[(A, ONE), (B, ONE)]] * 4, [0, 1] * 4),
    "objects without features stay apart": ([[(A, NOTHING), (B, NOTHING)]] * 3, [0, 1] * 3),
    "masks of one extent join whatever their features": ([[(A, ONE), (B, OTHER)], [(A, OTHER), (B, ONE)]], [0, 1] * 2),
    "groups are numbered by what they show": ([[(range(10), ONE), (range(10, 100), OTHER)]] * 3, [1, 0] * 3),
    "parts come together where other views show the whole": (
        [[*PARTS, (B, OTHER)], *[[(A, ONE), (B, OTHER)]] * 3], [0, 0, 1, 0, 1, 0, 1, 0, 1]
    ),
    "parts that no view shows whole stay apart": ([PARTS] * 4, [0, 1] * 4),
    "one other view is enough to show that a mask spans": (
        [[(range(90), ONE)], [(range(start, start + 30), ONE) for start in (0, 30, 60)]], [-1, 0, 1, 2]
    ),
    "views that have a mask of one thing alone outvote one that takes two for one": (
        [[(range(80), ONE), THIRD], *[[(range(40), ONE), THIRD], [(range(40, 80), ONE), THIRD]] * 3],
        [0, 1, 0, 1, 2, 1, 0, 1, 2, 1, 0, 1, 2, 1]
    ),
    "views that have a mask of neither say nothing": (
        [[*PARTS, (B, OTHER)], *[[(A, ONE), (B, OTHER)]] * 2, *[[(B, OTHER)]] * 5], [1, 1, 0, 1, 0, 1, 0, *[0] * 5]
    ),
    "a mask that shows nothing belongs to no group": ([[(A, ONE), ([], OTHER)], [(A, ONE)]], [0, -1, 0]),
    "one view gives one group a mask": ([[(range(start, 100, 3), ONE) for start in range(3)]], [0, 1, 2]),
}  # fmt: skip
"""What it shows -> views, and the group of each mask."""


@pytest.mark.parametrize("shows", PLAIN)
def test_groups_of_plain_views(shows: str) -> None:
    views, expected = PLAIN[shows]
    np.testing.assert_array_equal(groups_of(hand_table(100, views)), expected)


def test_masks_without_common_points_are_groups_of_their_own() -> None:
    np.testing.assert_array_equal(groups_of(hand_table(100, [[(A, ONE)], [(B, ONE)]], [B, A])), [0, 1])


@pytest.mark.parametrize("spanning_views", [1, 2])
@pytest.mark.parametrize("border", [50, 60, 80])
def test_masks_that_span_two_objects_in_a_minority_of_views_do_not_weld_them(spanning_views: int, border: int) -> None:
    separate = [(range(border), ONE), (range(border, 100), OTHER)]
    table = hand_table(100, [*[[(range(100), ONE)]] * spanning_views, *[separate] * 3])
    np.testing.assert_array_equal(groups_of(table)[spanning_views:], [0, 1] * 3)


def test_a_mask_that_spans_many_things_is_left_out() -> None:
    thirds = [(range(start, start + 30), ONE) for start in (0, 30, 60)]
    table = hand_table(90, [[(range(90), ONE)], thirds, thirds])
    groups = group_masks(table, SETTINGS)
    np.testing.assert_array_equal(groups.spanning, [True] + [False] * 6)
    np.testing.assert_array_equal(groups.group, [-1, 0, 1, 2, 0, 1, 2])


def test_a_spanning_mask_holds_nothing() -> None:
    """Two views show points 0..79 as one, the only view that sees 0..39 shows two alike things there: without the
    last view, which parts the rest, it would be outvoted."""
    features = np.eye(8, dtype=np.float32)
    spans = [(range(80), ONE)]
    parts = [(range(20), ONE), (range(20, 40), ONE), (range(40, 60), features[2])]
    rest = [(range(start, start + 10), features[3 + index]) for index, start in enumerate((40, 50, 60, 70))]
    table = hand_table(80, [spans, spans, parts, rest], [(), (), range(60, 80), range(40)])
    group = groups_of(table)
    np.testing.assert_array_equal(group[:2], -1)
    assert group[2] != group[3]


def test_one_mask_in_most_views_is_one_object() -> None:
    """Split by two views of six, and nothing known of the parts' features."""
    table = hand_table(100, [*[[(range(100), ONE)]] * 4, *[[(A, ONE), (B, ONE)]] * 2])
    assert set(groups_of(table)[:4]) == {0}


def cup_on_table(cup: NDArray[np.float32]) -> NDArray[np.int32]:
    """Three views missed the cup (points 80..99), two show it; the other masks tell how unlike things are here."""
    random = np.random.default_rng(3)
    others = [
        (range(100 + 10 * index, 110 + 10 * index), np.abs(random.normal(size=8)).astype(np.float32))
        for index in range(8)
    ]
    missed = [(range(100), ONE), *others]
    shown = [(range(80), ONE), (range(80, 100), cup), *others]
    group = groups_of(hand_table(180, [missed, missed, missed, shown, shown]))
    table_masks, cup_masks = [0, 9, 18, 27, 37], [28, 38]
    assert len(set(group[table_masks])) == 1
    assert len(set(group[cup_masks])) == 1
    return group[[0, 28]]


def test_a_cup_that_most_views_miss_is_not_welded_to_the_table() -> None:
    table, cup = cup_on_table(OTHER)
    assert table != cup


def test_a_part_with_the_feature_of_the_whole_is_joined() -> None:
    table, part = cup_on_table(ONE)
    assert table == part


def test_many_noisy_features_are_no_more_alike_than_pairs_of_them() -> None:
    """Sums of features have less noise, and sums of any two things are more alike than two masks of them."""
    random = np.random.default_rng(0)

    def feature(own: int, sign: float) -> NDArray[np.float32]:
        return (sign * 0.7 * np.eye(64)[own] + np.eye(64)[0] + 0.25 * random.normal(size=64)).astype(np.float32)

    def others() -> list[tuple[range, NDArray[np.float32]]]:
        return [(range(100 + 10 * k, 110 + 10 * k), feature(2 + k, 1)) for k in range(6)]

    # Ten views have a mask of each of two things alone; two views take them for one.
    views = [[(points, feature(1, 1 if points is A else -1)), *others()] for points in [A, B] * 10 + [range(100)] * 2]
    table = hand_table(160, [[(points, vector[:8]) for points, vector in view] for view in views])
    table = replace(table, mask_features=np.array([vector for view in views for _, vector in view]))
    group = groups_of(table, replace(SETTINGS, left_out_voice=0))
    assert group[0] == group[14] != group[7] == group[21]


def test_a_view_that_saw_a_sliver_is_no_witness() -> None:
    """View 0 sees five points of each object and shows them as one; two views show two objects."""
    views = [[(range(100), ONE)], [(A, ONE), (B, OTHER)], [(A, ONE), (B, OTHER)]]
    hidden = [[*range(45), *range(55, 100)]]
    table = hand_table(100, views, hidden)
    share = mask_shares(table, replace(SETTINGS, witness_share=0.2))[0].toarray()
    assert (share[1:, 0] == 0).all()
    assert (share[0, 1:] > 0).all()
    group = groups_of(table)
    assert group[1] == group[3] != group[2] == group[4]


def test_no_mask_at_all() -> None:
    table = hand_table(10, [[], []])
    groups = group_masks(table, SETTINGS)
    assert groups.count == len(groups.group) == len(groups.spanning) == 0


def test_cuts_at_different_places_keep_what_they_agree_on() -> None:
    left = [(range(60), ONE), (range(60, 100), OTHER)]
    right = [(range(40), ONE), (range(40, 100), OTHER)]
    group = groups_of(hand_table(100, [left, right] * 2))
    assert set(group[::2]) != set(group[1::2])
    assert len(set(group[::2])) == len(set(group[1::2])) == 1


def test_masks_that_contradict_each_other_everywhere_are_not_joined() -> None:
    even_odd = [(range(0, 100, 2), ONE), (range(1, 100, 2), ONE)]
    thirds = [(range(start, 100, 4), ONE) for start in range(4)]
    halves = [(A, ONE), (B, ONE)]
    group = groups_of(hand_table(100, [halves, even_odd]))
    assert len(set(group) - {-1}) == 4 or (group == -1).all()
    assert groups_of(hand_table(100, [thirds, halves])).shape == (6,)


def test_indicator() -> None:
    matrix = indicator(np.array([1, -1, 0, 1], np.int32), 3)
    np.testing.assert_array_equal(matrix.toarray(), [[0, 0, 1, 0], [1, 0, 0, 1], [0, 0, 0, 0]])


def random_table(random: Generator) -> MaskTable:
    """Five things, each of seven views with ragged edges, splits, merges, misses, partial sight and soft weights."""
    n = 120
    thing = np.sort(random.integers(0, 5, n))
    hand_views, unseen = [], []
    for _ in range(7):
        label = np.where(random.uniform(size=n) < 0.1, random.integers(0, 5, n), thing)
        if random.uniform() < 0.5:
            label[label == random.integers(5)] = random.integers(5)
        if random.uniform() < 0.5:
            label[(label == random.integers(5)) & (np.arange(n) % 2 == 0)] = 5
        kept = [value for value in np.unique(label) if random.uniform() < 0.85]
        features = [np.eye(8)[value] + 0.4 * random.normal(size=8) for value in kept]
        hand_views.append(
            [
                (np.flatnonzero(label == value), feature.astype(np.float32))
                for value, feature in zip(kept, features, strict=True)
            ]
        )
        unseen.append(np.flatnonzero(random.uniform(size=n) < 0.3))
    table = hand_table(n, hand_views, unseen)
    soft = table.weights.copy()
    soft.data *= random.uniform(0.2, 1, soft.nnz).astype(np.float32)
    exposure = table.exposure.copy()
    exposure.data *= random.uniform(0.3, 1, exposure.nnz).astype(np.float32)
    return replace(table, weights=soft, exposure=exposure)


@pytest.mark.parametrize("seed", range(8))
def test_groups_are_those_of_the_literal_reference(seed: int) -> None:
    table = random_table(np.random.default_rng(seed))
    np.testing.assert_array_equal(groups_of(table), reference_groups(table))


@pytest.mark.parametrize("seed", range(20))
def test_order_of_views_and_masks_does_not_matter(seed: int) -> None:
    random = np.random.default_rng(seed)
    table = HARD_TABLE if seed == 0 else random_table(random)
    view_order = random.permutation(table.outside.shape[0])
    order = np.concatenate([random.permutation(np.flatnonzero(table.mask_view == view)) for view in view_order])
    shuffled = MaskTable(
        table.weights[order],
        table.outside[view_order],
        table.exposure[view_order],
        np.argsort(view_order).astype(np.int32)[table.mask_view[order]],
        table.mask_pixels[order],
        table.mask_features[order],
    )
    assert as_sets(groups_of(shuffled), order) == as_sets(groups_of(table), np.arange(len(order)))


HARD_TABLE = hand_table(
    200,
    [
        [(range(100), ONE), (range(100, 150), OTHER), (range(150, 200), ONE)],
        [(range(100), ONE), (range(100, 150), OTHER), (range(150, 170), ONE), (range(170, 200), ONE)],
        [(range(80), ONE), (range(80, 100), OTHER), (range(100, 200), ONE)],
        [(range(80), ONE), (range(80, 100), OTHER), (range(102, 148), OTHER), (range(150, 200), ONE)],
        [(range(30), ONE), (range(30, 95), ONE), (range(100, 150), OTHER)],
    ],
)
"""A thing missed twice, a split, two welds and a miss."""


def as_sets(group: NDArray[np.int32], mask: NDArray[np.integer]) -> set[frozenset[int]]:
    return {frozenset(mask[group == number].tolist()) for number in np.unique(group[group >= 0])}


def test_order_of_points_does_not_matter() -> None:
    random = np.random.default_rng(0)
    table = random_table(random)
    order = random.permutation(table.weights.shape[1])
    shuffled = replace(
        table,
        weights=csr_array(table.weights[:, order]),
        outside=csr_array(table.outside[:, order]),
        exposure=csr_array(table.exposure[:, order]),
    )
    np.testing.assert_array_equal(groups_of(shuffled), groups_of(table))


def test_a_sample_of_the_points_gives_the_same_groups() -> None:
    table = hand_table(1000, [[(range(500), ONE), (range(500, 1000), OTHER)], [(range(1000), ONE)]] * 3)
    sampled = group_masks(table, SETTINGS, np.arange(0, 1000, 20))
    np.testing.assert_array_equal(sampled.group, groups_of(table))
    # It is the sample that is looked at: of one object alone, the other's masks share nothing.
    half = group_masks(table, SETTINGS, np.arange(500))
    assert not np.array_equal(half.group, sampled.group)


def test_what_shows_through_holes_says_which_masks_hold_the_same() -> None:
    """A vase whose one mask another view's plant just fails to hold, where what it sees through leaves counts."""
    plant, vase = range(100), range(100, 200)
    views = [[(plant, ONE), (vase, OTHER)], [(range(145), ONE), (range(145, 200), OTHER)]]
    table = hand_table(200, views)
    seen = table.exposure.toarray()
    openly, through = seen.copy(), np.zeros_like(seen)
    openly[1, 150:], through[1, 150:] = 0.1, 0.9
    holed = replace(table, exposure=csr_array(openly), doubted=csr_array(through))
    np.testing.assert_array_equal(groups_of(holed), groups_of(table))
    np.testing.assert_array_equal(groups_of(table), [0, 1, 0, 1])
    # Without it, what is left of the vase in that view is mostly the plant's.
    assert not np.array_equal(groups_of(replace(holed, doubted=None)), groups_of(table))


CUP, TABLE = range(80, 100), range(80)
APART: HandView = [(TABLE, ONE), (CUP, OTHER)]


@pytest.mark.parametrize(("held", "spans"), [(range(65, 100), True), (range(75, 100), False), (range(92), True)])
def test_a_mask_that_holds_most_of_two_groups_spans_them(held: range, spans: bool) -> None:
    """The last view sees 20 points of the table."""
    table = hand_table(100, [APART, APART, [(held, ONE)]], [[], [], range(60)])
    ids = np.repeat([0, 1], [80, 20]).astype(np.int32)
    groups = MaskGroups(np.array([0, 1, 0, 1, 0], np.int32), 2, np.zeros(5, bool))
    found = with_spanning(groups, view_votes(table), table.mask_view, ids, SETTINGS)
    assert found.spanning.tolist() == [False] * 4 + [spans]
    assert found.group.tolist() == groups.group.tolist()  # it keeps its name
    assert found.voting_group.tolist() == [0, 1, 0, 1, -1 if spans else 0]


def test_a_crumb_of_another_group_makes_no_mask_span() -> None:
    """All of it is in the mask, but it is little of the mask."""
    crumb = [(range(90), ONE), (range(90, 100), OTHER)]
    table = hand_table(100, [crumb, crumb, [(range(100), ONE)]])
    groups = MaskGroups(np.array([0, 1, 0, 1, 0], np.int32), 2, np.zeros(5, bool))
    votes, ids = view_votes(table), np.repeat([0, 1], [90, 10]).astype(np.int32)
    for share, spans in ((SETTINGS.spanning_share, False), (0.05, True)):
        found = with_spanning(groups, votes, table.mask_view, ids, replace(SETTINGS, spanning_share=share))
        assert found.spanning.tolist() == [False] * 4 + [spans]


@pytest.mark.parametrize("seed", range(6))
def test_masks_that_span_groups_are_those_of_the_literal_reference(seed: int) -> None:
    rng = np.random.default_rng(seed)
    table = random_table(rng)
    votes, masks, n = view_votes(table), *table.weights.shape
    groups = MaskGroups(rng.integers(-1, 3, masks).astype(np.int32), 3, rng.random(masks) < 0.2)
    ids = np.sort(rng.integers(-2, 3, n)).astype(np.int32)
    in_mask, vote = votes.in_mask.toarray().astype(float), votes.vote.toarray().astype(float)
    expected = groups.spanning.copy()
    for m in range(masks):
        spanned = 0
        for k in range(3):
            held, shown = in_mask[m, ids == k].sum(), vote[table.mask_view[m], ids == k].sum()
            spanned += held > SETTINGS.container_share * shown and held > SETTINGS.spanning_share * in_mask[m].sum()
        expected[m] |= spanned > 1 and groups.group[m] >= 0
    found = with_spanning(groups, votes, table.mask_view, ids, SETTINGS)
    np.testing.assert_array_equal(found.spanning, expected)


# The literal reference: the module's formulas with dense arrays and loops over pairs.


def reference_groups(table: MaskTable) -> NDArray[np.int32]:
    votes = view_votes(table)
    in_mask, vote = votes.in_mask.toarray().astype(float), votes.vote.toarray().astype(float)
    view = table.mask_view
    masks, views = len(view), len(vote)
    share, left_out = np.zeros((masks, masks)), np.zeros((masks, views), bool)
    for i in range(masks):
        for v in range(views):
            visible = in_mask[i] @ vote[v]
            if visible > SETTINGS.witness_share * (in_mask[i] @ in_mask[i]):
                left_out[i, v] = in_mask[i] @ in_mask[view == v].sum(axis=0) < 0.5 * visible
        for j in range(masks):
            visible = in_mask[i] @ vote[view[j]]
            if visible > SETTINGS.witness_share * (in_mask[i] @ in_mask[i]):
                share[i, j] = in_mask[i] @ in_mask[j] / visible
    spanning = reference_spanning(share, view, views)
    container = np.zeros((masks, views), int) - 1
    for i in range(masks):
        for v in range(views):
            holders = [
                j for j in np.flatnonzero(view == v) if share[i, j] > SETTINGS.container_share and not spanning[j]
            ]
            if holders:
                container[i, v] = max(holders, key=lambda j: share[i, j])
    group = reference_joins(share, container, left_out, table.unit_features.astype(float), view, ~spanning)
    shown = table.weights.toarray().sum(axis=1)
    by_mass = sorted({frozenset(members) for members in group}, key=lambda members: -shown[list(members)].sum())
    number = np.full(masks, -1, np.int32)
    for index, members in enumerate(by_mass):
        number[list(members)] = index
    return number


def reference_spanning(share: NDArray[np.float64], view: NDArray[np.int32], views: int) -> NDArray[np.bool_]:
    spanning = np.zeros(len(view), bool)
    for i in range(len(view)):
        split = whole = 0
        for v in range(views):
            others = np.flatnonzero(view == v)
            if v == view[i] or len(others) == 0:
                continue
            within = [j for j in others if share[j, i] > SETTINGS.container_share and share[i, j] > 0]
            parts = len(within)
            if share[i, others].max() >= SETTINGS.container_share:
                whole += 1
            elif parts >= 2 and share[i, within].sum() > SETTINGS.container_share:
                split += 1
        spanning[i] = split > whole
    return spanning


def reference_joins(
    share: NDArray[np.float64],
    container: NDArray[np.int_],
    left_out: NDArray[np.bool_],
    features: NDArray[np.float64],
    view: NDArray[np.int32],
    usable: NDArray[np.bool_],
) -> list[list[int]]:
    pairs = list(combinations(range(len(view)), 2))
    different = np.array([features[i] @ features[j] for i, j in pairs if view[i] == view[j]])

    def agreement(a: list[int], b: list[int]) -> tuple[float, float, float]:
        one = same = asked = 0.0
        for i in a:
            for j in b:
                both = (container[i] >= 0) & (container[j] >= 0)
                together = float((both & (container[i] == container[j])).sum())
                one += together
                same += together if min(share[i, j], share[j, i]) > SETTINGS.container_share else 0.0
                one_alone = ((container[i] >= 0) & left_out[j]) | ((container[j] >= 0) & left_out[i])
                asked += both.sum() + 0.5 * one_alone.sum()
        if asked == 0:
            return 0.0, 0.0, 0.0
        cosine = np.mean([features[i] @ features[j] for i in a for j in b])
        below = 0.5 * ((different < cosine - 1e-6).mean() + (different <= cosine + 1e-6).mean())
        return (same + (one - same) * below) / asked, asked, cosine

    groups = [[int(i)] for i in np.flatnonzero(usable)]
    while len(groups) > 1:
        scores = {(a, b): agreement(groups[a], groups[b]) for a, b in combinations(range(len(groups)), 2)}
        a, b = max(scores, key=lambda pair: scores[pair])
        if scores[a, b][0] <= SETTINGS.join_majority:
            break
        groups[a] += groups.pop(b)
    return groups


def with_tracks(table: MaskTable, tracks: Sequence[int]) -> MaskTable:
    return replace(table, mask_track=np.array(tracks, np.int64))


def front_and_back(features: Sequence[NDArray[np.float32]] = (ONE, ONE)) -> MaskTable:
    """Two views of each side of a thing; nothing is seen from both sides."""
    front, back = [(A, features[0])], [(B, features[1])]
    return hand_table(100, [front, front, back, back], [B, B, A, A])


@pytest.mark.parametrize("features", [(ONE, ONE), (ONE, OTHER)])
def test_a_track_joins_what_no_view_sees_together(features: Sequence[NDArray[np.float32]]) -> None:
    table = front_and_back(features)
    np.testing.assert_array_equal(groups_of(table), [0, 0, 1, 1])
    np.testing.assert_array_equal(groups_of(with_tracks(table, [7, 7, 7, 7])), [0, 0, 0, 0])
    np.testing.assert_array_equal(groups_of(with_tracks(table, [7, 7, 9, 9])), [0, 0, 1, 1])


def test_unknown_tracks_say_nothing() -> None:
    table = front_and_back()
    np.testing.assert_array_equal(groups_of(with_tracks(table, [-1, 7, -1, 7])), [0, 0, 0, 0])
    np.testing.assert_array_equal(groups_of(with_tracks(table, [-1, 7, -1, -1])), groups_of(table))
    for track in (-1, -5):
        np.testing.assert_array_equal(groups_of(with_tracks(table, [track] * 4)), groups_of(table))


@pytest.mark.parametrize("views", [2, 3, 5])
def test_a_tracker_is_one_witness_among_the_views(views: int) -> None:
    """That took two things for one, which all views show apart; and one thing for two, which they show as one."""
    table = hand_table(100, [[(A, ONE), (B, OTHER)]] * views)
    np.testing.assert_array_equal(groups_of(with_tracks(table, [3, 3] * views)), [0, 1] * views)
    np.testing.assert_array_equal(groups_of(with_tracks(table, [3, 4] * views)), [0, 1] * views)
    table = hand_table(50, [[(A, ONE)]] * views)
    np.testing.assert_array_equal(groups_of(with_tracks(table, range(views))), [0] * views)


@pytest.mark.parametrize(("beside", "joined"), [(9, True), (2, False)])
def test_tracks_are_two_things_only_where_an_image_has_both(beside: int, joined: bool) -> None:
    """A mask holds another of the other view, tracks 1 and 2; that view says one thing. Where track 2 is in the first
    image too, the tracker says two."""
    side = (range(100, 130), OTHER)
    table = hand_table(130, [[(range(100), ONE), side], [(range(30), ONE), side]])
    group = groups_of(with_tracks(table, [1, beside, 2, 7]))
    assert (group[0] == group[2]) == joined


def test_names_of_tracks_do_not_matter() -> None:
    table = front_and_back()
    for names in ([5, 5, 2, 5], [1 << 40, 1 << 40, 0, 1 << 40]):
        np.testing.assert_array_equal(groups_of(with_tracks(table, names)), groups_of(with_tracks(table, [0, 0, 1, 0])))
