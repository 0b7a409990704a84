"""Pieces of one thing become one, where the views that see their border show none."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.sparse import csr_array
from test_grouping import ONE, OTHER, HandView, hand_table
from test_membership import groups, on_a_line, random_case

from og_pointcloud.fitting import labellers
from og_pointcloud.fitting.fragments import (
    HIDDEN_BORDER_VIEWS,
    _Borders,
    _borders,
    _each_others_best,
    _log_ratio,
    _Looks,
    _shares,
    join_fragments,
)
from og_pointcloud.fitting.grouping import MaskGroups
from og_pointcloud.fitting.mask_table import MaskTable
from og_pointcloud.fitting.membership import assign_and_correct_groups
from og_pointcloud.fitting.view_votes import view_votes
from og_pointcloud.journal import Journal
from og_pointcloud.rendering.geometry import Neighborhood, neighborhood
from og_pointcloud.settings import FitSettings, GeometrySettings

THIRD = np.array([0, 0, 1, 0, 0, 0, 0, 0], np.float32)
BACK, LEGS, FLOOR = range(50), range(50, 100), range(100, 150)
N = 150
IN_PIECES: HandView = [(BACK, ONE), (LEGS, ONE), (FLOOR, OTHER)]
WHOLE: HandView = [(range(100), ONE), (FLOOR, OTHER)]
BEHIND_A_TABLE = range(47, 53)
"""Points that no view sees, about the border of back and legs."""


def around(xyz: NDArray[np.float32]) -> Neighborhood:
    return neighborhood(xyz, GeometrySettings())


def joined(
    views: list[HandView], numbers: list[int], hidden: range = range(0), n: int = N
) -> tuple[list[int], NDArray[np.int32]]:
    """The group of each mask, and of each point, of a line of back, legs and floor."""
    table = hand_table(n, views, [hidden] * len(views))
    ids = np.arange(n, dtype=np.int32) // 50
    visible = np.ones(n, np.float32)
    result, ids = join_fragments(groups(numbers), table, view_votes(table), ids, around(on_a_line(n)), visible)
    assert result.count == max(result.group) + 1
    return result.group.tolist(), ids


def test_pieces_that_a_table_parts_in_every_view_are_one_thing() -> None:
    numbers, ids = joined([IN_PIECES] * 4, [0, 1, 2] * 4, BEHIND_A_TABLE)
    assert numbers == [0, 0, 1] * 4
    assert ids.tolist() == [0] * 100 + [1] * 50


def test_pieces_that_the_views_of_their_border_show_whole_are_one_thing() -> None:
    numbers, _ = joined([IN_PIECES] + [WHOLE] * 2, [0, 1, 2, 0, 2, 0, 2])
    assert numbers == [0, 0, 1, 0, 1, 0, 1]


APART: dict[str, tuple[list[HandView], list[int], range]] = {
    "views see their border": ([IN_PIECES] * 4, [0, 1, 2] * 4, range(0)),
    "most views of their border see it": ([IN_PIECES] * 3 + [WHOLE], [0, 1, 2] * 3 + [0, 2], range(0)),
    "they are not alike": ([[(BACK, ONE), (LEGS, OTHER), (FLOOR, ONE)]] * 4, [0, 1, 2] * 4, BEHIND_A_TABLE),
    "one has no feature": ([[(BACK, ONE), (LEGS, 0 * ONE), (FLOOR, OTHER)]] * 4, [0, 1, 2] * 4, BEHIND_A_TABLE),
    "masks reach over all borders, so that these tell nothing": (
        [[(BACK, ONE), (range(50, 110), ONE), (range(110, 150), OTHER)]] * 4, [0, 1, 2] * 4, BEHIND_A_TABLE
    ),
}  # fmt: skip


@pytest.mark.parametrize("because", APART)
def test_two_things_stay_two(because: str) -> None:
    views, numbers, hidden = APART[because]
    found, ids = joined(views, numbers, hidden)
    assert found == numbers
    assert ids.tolist() == [0] * 50 + [1] * 50 + [2] * 50


def test_without_another_thing_nothing_tells_what_a_border_looks_like() -> None:
    pieces: HandView = [(BACK, ONE), (LEGS, ONE)]
    assert joined([pieces] * 4, [0, 1] * 4, BEHIND_A_TABLE, 100)[0] == [0, 1] * 4


def test_no_group_at_all() -> None:
    table = hand_table(3, [[(range(3), ONE)]])
    nothing = MaskGroups(np.array([-1], np.int32), 0, np.array([True]))
    ids = np.full(3, -1, np.int32)
    result, found = join_fragments(nothing, table, view_votes(table), ids, around(on_a_line(3)), np.ones(3, np.float32))
    assert (result.count, result.group.tolist(), found.tolist()) == (0, [-1], [-1] * 3)


def test_the_joined_thing_is_decided_as_one() -> None:
    """Its hidden middle takes its id, and it keeps the masks of all its pieces."""
    table = hand_table(N, [IN_PIECES] * 4, [BEHIND_A_TABLE] * 4)
    inputs = table, view_votes(table), groups([0, 1, 2] * 4), around(on_a_line(N))
    result, membership = assign_and_correct_groups(*inputs, FitSettings())
    ids = membership.instance_ids
    assert result.group.tolist() == [0, 0, 1] * 4
    assert set(ids[:96]) == {0}
    assert set(ids[104:]) == {1}
    assert len(membership.expected_iou) == len(membership.dismissed) == 2


def case(seed: int) -> tuple[MaskTable, NDArray[np.int32], NDArray[np.float32]]:
    """Soft random weights, five states along a line with gaps, and how openly points are seen."""
    random = np.random.default_rng(seed)
    table, _ = random_case(random)
    ids = np.repeat(np.arange(-2, 8, dtype=np.int32), 20)
    return table, ids, random.uniform(0, 1, len(ids)).astype(np.float32)


@pytest.mark.parametrize("seed", range(3))
def test_what_views_show_at_borders_is_that_of_the_literal_reference(seed: int) -> None:
    table, ids, visibility = case(seed)
    votes, near = view_votes(table), around(on_a_line(len(ids)))
    in_mask = votes.in_mask.toarray().astype(float)
    expected: dict[tuple[int, int], list[tuple[float, float]]] = {}
    for g in range(len(ids)):
        beside = [h for h, adjoins in zip(near.index[g], near.adjoining[g], strict=True) if adjoins and ids[h] >= 0]
        if ids[g] < 0 or all(ids[h] == ids[g] for h in beside):
            continue
        for h in beside:
            one = two = 0.0
            for a in np.flatnonzero(in_mask[:, g]):
                for b in np.flatnonzero(in_mask[:, h]):
                    product = in_mask[a, g] * in_mask[b, h] * float(visibility[g]) * float(visibility[h])
                    if a == b:
                        one += product
                    elif table.mask_view[a] == table.mask_view[b]:
                        two += product
            first, second = sorted((int(ids[g]), int(ids[h])))
            expected.setdefault((first, second), []).append((one, two))
    borders = _borders(votes.by_point, table.mask_view, ids, near, visibility)
    assert list(zip(borders.first.tolist(), borders.second.tolist(), strict=True)) == sorted(expected)
    means = np.array([np.mean(expected[pair], axis=0) for pair in sorted(expected)])
    np.testing.assert_allclose(borders.views.T, means, rtol=1e-4, atol=1e-6)
    assert len(expected) == 8 + 7
    assert (means > 0).any(axis=0).all()


def borders_of(pairs: list[tuple[int, int]], one: list[float], two: list[float]) -> _Borders:
    """Borders of two pairs of points each, in ascending order."""
    return _Borders.between(np.array(pairs), 2 * np.array([one, two]).T, np.full(len(pairs), 2.0))


def test_the_log_ratio_is_its_formula() -> None:
    """Two borders inside of groups, two of unlike ones, one of these hidden, and three of alike ones."""
    pairs = [(0, 0), (0, 1), (1, 1), (1, 2), (2, 3), (3, 4), (4, 5)]
    one, two = [4.0, 1.0, 2.0, 0.01, 3.0, 0.0, 1.0], [0.0, 3.0, 0.5, 0.0, 0.0, 0.0, 2.0]
    borders, alike = borders_of(pairs, one, two), np.array([False] * 4 + [True] * 3)
    w, a = 0.9, 0.25  # the median of 4/4 and 2/2.5; the one that is seen
    assert _shares(borders, alike) == pytest.approx((w, a))
    expected = (np.array(one) + HIDDEN_BORDER_VIEWS) * np.log(w / a) + np.array(two) * np.log((1 - w) / (1 - a))
    np.testing.assert_allclose(_log_ratio(borders, w, a), expected, rtol=1e-12)


def test_borders_of_joined_groups_count_together() -> None:
    borders = borders_of([(0, 1), (0, 2), (1, 2), (2, 3)], [1.0, 2.0, 4.0, 8.0], [0.0, 0.0, 2.0, 0.0])
    joined = borders.joined(np.array([0, 0, 2, 3]))
    assert (joined.first.tolist(), joined.second.tolist()) == ([0, 0, 2], [0, 2, 3])
    np.testing.assert_allclose(joined.views, [[1, 3, 8], [0, 1, 0]])
    assert joined.size.tolist() == [2, 4, 2]


def test_pairs_are_each_others_best() -> None:
    """Two has a better partner than one; three and four would be best, but are not alike; five and six are too weak."""
    borders = borders_of([(0, 1), (1, 2), (2, 3), (3, 4), (5, 6)], [1.0] * 5, [0.0] * 5)
    ratio, alike = np.array([1.0, 2.0, 3.0, 9.0, 0.05]), np.array([True, True, True, False, True])
    first, second = _each_others_best(borders, ratio, alike)
    assert (first.tolist(), second.tolist()) == ([2], [3])
    first, second = _each_others_best(borders, np.array([1.0, 1.0, 1.0, 9.0, 0.5]), alike)  # the lowest numbers first
    assert sorted(zip(first.tolist(), second.tolist(), strict=True)) == [(0, 1), (5, 6)]


def test_things_are_not_joined_by_a_piece_of_both() -> None:
    """Back and legs of two colors, and a piece between them that looks like either: it is joined with one of them."""
    angles = np.radians([0, 30, 60])
    back, between, legs = np.stack([np.cos(angles), np.sin(angles), *[0 * angles] * 6], axis=1).astype(np.float32)
    chain: HandView = [(range(40), back), (range(40, 60), between), (range(60, 100), legs), (FLOOR, THIRD)]
    seams = [*range(37, 43), *range(57, 63)]
    table, line = hand_table(N, [chain] * 4, [seams] * 4), on_a_line(N)
    ids = np.repeat(np.arange(4, dtype=np.int32), [40, 20, 40, 50])
    visible, near = np.ones(N, np.float32), around(line)
    result, _ = join_fragments(groups([0, 1, 2, 3] * 4), table, view_votes(table), ids, near, visible)
    assert result.count == 3
    assert result.group[0] != result.group[2]


def test_alike_is_what_is_much_nearer_to_one_group_than_to_different_things() -> None:
    """Masks of a group have a cosine of 1, those of a view 0, 0.6 and 0.8: of three masks, 0.61 of the way to 1 are at
    0.84."""
    turned, further = np.array([[0.6, 0.8, *[0] * 6], [0.28, 0.96, *[0] * 6]], np.float32)
    table = hand_table(30, [[(range(10), ONE), (range(10, 20), OTHER), (range(20, 30), turned)]] * 3)
    borders = borders_of([(0, 0), (0, 1), (0, 2), (1, 2)], [1.0] * 4, [0.0] * 4)
    looks = _Looks.of_groups(groups([0, 1, 2] * 3), table)
    assert (looks.own, looks.different) == (pytest.approx(1), pytest.approx(0.6))
    assert looks.alike(borders).tolist() == [False, False, False, False]
    table = replace(table, mask_features=np.tile(np.stack([ONE, OTHER, further]), (3, 1)))
    looks = _Looks.of_groups(groups([0, 1, 2] * 3), table)
    assert looks.alike(borders).tolist() == [False, False, False, True]
    looks.join(np.array([0]), np.array([1]))  # the mean over pairs of masks is what counts
    assert looks.alike(borders_of([(0, 2)], [1.0], [0.0])).tolist() == [False]


def test_few_masks_may_differ_more_than_many() -> None:
    turned = np.array([np.sqrt(1 - 0.88**2), 0.88, *[0] * 6], np.float32)
    view: HandView = [(range(10), ONE), (range(10, 20), OTHER), (range(20, 30), turned)]
    between = borders_of([(1, 2)], [1.0], [0.0])
    few, many = (_Looks.of_groups(groups([0, 1, 2] * n), hand_table(30, [view] * n)) for n in (3, 30))
    assert few.alike(between).tolist() == [True]
    assert many.alike(between).tolist() == [False]


@pytest.mark.parametrize("hidden", [BEHIND_A_TABLE, range(0)])
def test_order_of_points_and_masks_does_not_matter(hidden: range) -> None:
    random = np.random.default_rng(0)
    table = hand_table(N, [IN_PIECES] * 4, [hidden] * 4)
    table = replace(
        table, exposure=csr_array(table.exposure.multiply(random.uniform(0.5, 1, (4, N)).astype(np.float32)))
    )
    ids, visible, line = np.arange(N, dtype=np.int32) // 50, random.uniform(0, 1, N).astype(np.float32), on_a_line(N)
    plain, of_plain = join_fragments(groups([0, 1, 2] * 4), table, view_votes(table), ids, around(line), visible)
    points = random.permutation(N)
    masks = np.concatenate([random.permutation(3) + 3 * view for view in range(4)])
    moved = replace(
        table,
        weights=csr_array(table.weights[masks][:, points]), outside=csr_array(table.outside[:, points]),
        exposure=csr_array(table.exposure[:, points]), mask_features=table.mask_features[masks],
    )  # fmt: skip
    numbers = np.array([0, 1, 2] * 4)[masks].tolist()
    near, votes = around(line[points]), view_votes(moved)
    found, of_found = join_fragments(groups(numbers), moved, votes, ids[points], near, visible[points])
    np.testing.assert_array_equal(found.group, plain.group[masks])
    np.testing.assert_array_equal(of_found, of_plain[points])
    assert plain.count == (2 if hidden else 3)


def test_a_joined_leaf_has_the_coarse_cluster_of_its_largest_piece() -> None:
    table = hand_table(N, [IN_PIECES] * 4, [BEHIND_A_TABLE] * 4)
    points: Any = SimpleNamespace(rgb=None)
    surface: Any = SimpleNamespace(scene=SimpleNamespace(points=points), neighborhood=around(on_a_line(N)))
    coarse, settings = np.array([7, 8, 9], np.int32), FitSettings()
    inputs = table, view_votes(table), groups([0, 1, 2] * 4), surface, settings, Journal(progress=False)
    assert labellers._decided_by_views(*inputs, coarse).instances.coarse.tolist() == [7, 9]
