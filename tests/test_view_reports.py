"""What views report of states, and what points are likeliest of by it: points on a line, masks made by hand.

The literal form in float64 is among the hard cases (hard_cases/votes.py).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from numpy.typing import NDArray
from test_grouping import ONE, OTHER, HandView, hand_table
from test_membership import decide, groups, on_a_line, torn_case

from og_pointcloud.cloud import BACKGROUND, UNOBSERVED
from og_pointcloud.fitting.grouping import MaskGroups
from og_pointcloud.fitting.mask_table import MaskTable
from og_pointcloud.fitting.membership import Membership, assign_and_correct_groups, assign_points
from og_pointcloud.fitting.view_reports import MIN_REPORT_PROBABILITY, PRIOR_COUNT
from og_pointcloud.fitting.view_votes import view_votes
from og_pointcloud.rendering.geometry import neighborhood
from og_pointcloud.settings import FitSettings, GeometrySettings, MembershipSettings

N = 60
BOOK, SHELF = range(20, 40), [*range(20), *range(40, 60)]
KNOWS: HandView = [(SHELF, ONE), (BOOK, OTHER)]
SWALLOWS: HandView = [([*range(38), *range(40, 60)], ONE), (range(38, 40), OTHER)]
"""All of the book is shelf, but for a scrap with a mask of the book."""


def told(
    table: MaskTable, numbers: Sequence[int], points: slice = slice(None), whole: Membership | None = None,
    rgb: NDArray[np.uint8] | None = None,
) -> Membership:  # fmt: skip
    """Some points of a line, decided by themselves or by what the whole knows."""
    xyz = on_a_line(table.weights.shape[1])[points]
    part = table.of_points(np.arange(table.weights.shape[1])[points])
    around = neighborhood(xyz, GeometrySettings())
    scene = None if whole is None else whole.scene
    return assign_points(part, view_votes(part), groups(numbers), around, MembershipSettings(), rgb, scene)


def test_a_view_that_calls_the_whole_book_shelf_does_not_count_against_the_book() -> None:
    """Four views know the book. Three swallow it, and so say nothing of book and shelf."""
    table = hand_table(N, [KNOWS] * 4 + [SWALLOWS] * 3)
    found = decide(table, [0, 1] * 7)
    assert found.instance_ids.tolist() == [0] * 20 + [1] * 20 + [0] * 20
    assert (found.certainty[24:36] > 0.99).all()


def test_masks_that_swallow_a_thing_tell_of_neither_once_points_have_chosen() -> None:
    """Two views know shelf and book, three show both in one mask: of two groups, whose names they keep."""
    both: HandView = [(range(N), ONE)]
    table = hand_table(N, [KNOWS] * 2 + [both] * 3)
    before = MaskGroups(np.array([0, 1, 0, 1, 0, 0, 1], np.int32), 2, np.zeros(7, bool))
    around, settings = neighborhood(on_a_line(N), GeometrySettings()), FitSettings()
    known, found = assign_and_correct_groups(table, view_votes(table), before, around, settings)
    assert known.spanning.tolist() == [False] * 4 + [True] * 3
    assert known.group.tolist() == before.group.tolist()
    assert found.instance_ids.tolist() == [0] * 20 + [1] * 20 + [0] * 20
    assert found.scene.reports.spanned.tolist() == [[True, True]] * 3


def test_where_no_mask_spans_two_things_points_choose_once() -> None:
    table = hand_table(N, [KNOWS] * 3)
    before, around = groups([0, 1] * 3), neighborhood(on_a_line(N), GeometrySettings())
    known, found = assign_and_correct_groups(table, view_votes(table), before, around, FitSettings())
    assert known is before
    assert found.instance_ids.tolist() == [0] * 20 + [1] * 20 + [0] * 20


def test_what_views_report_is_counted_on_clear_points() -> None:
    """One view calls the whole book shelf, and has a mask of nothing else; it sees what is beside both, too."""
    table = hand_table(N + 40, [KNOWS] * 3 + [[(range(N), ONE)]])
    reports = decide(table, [0, 1] * 3 + [0]).scene.reports
    assert reports.report_column.tolist() == [[0, 1, 2]] * 3 + [[0, -1, 1]]
    first = reports.table_start[3]
    shelf, book, background = reports.probability[first : reports.table_start[4]].reshape(3, 2)

    def chance(counted: float, total: float) -> float:
        return MIN_REPORT_PROBABILITY + (1 - MIN_REPORT_PROBABILITY) * counted / (total + PRIOR_COUNT)

    # The points are all but certain: as if counted on them.
    np.testing.assert_allclose(shelf, [chance(40 + PRIOR_COUNT, 40), MIN_REPORT_PROBABILITY], atol=0.02)
    np.testing.assert_allclose(book, [chance(20, 20), chance(PRIOR_COUNT, 20)], atol=0.02)
    np.testing.assert_allclose(background, [MIN_REPORT_PROBABILITY, chance(40 + PRIOR_COUNT, 40)], atol=0.02)


def test_points_that_adjoin_an_instance_may_be_of_it_though_no_mask_of_it_holds_them() -> None:
    """Two views say nothing of its last points: these lie in a mask without a group."""
    views: list[HandView] = [[(range(56), ONE), (range(56, N), OTHER)]] * 2
    found = decide(hand_table(N, views), [0, -1] * 2)
    assert found.instance_ids.tolist() == [0] * N
    assert (found.certainty[57:] < found.certainty[10]).all()


@pytest.mark.parametrize("spans", [range(N), range(50)])
def test_what_a_mask_that_spans_two_things_alone_shows_is_of_one_of_them(spans: range) -> None:
    """Three views know two things, but do not see where they meet. A fourth sees all, and shows both as one."""
    views: list[HandView] = [[(range(30), ONE), (range(30, N), OTHER)]] * 3
    table = hand_table(N, [*views, [(spans, ONE)]], [range(20, 40)] * 3)
    numbers, spanning = np.array([0, 1] * 3 + [-1], np.int32), np.arange(7) == 6
    around = neighborhood(on_a_line(N), GeometrySettings())
    found = assign_points(table, view_votes(table), MaskGroups(numbers, 2, spanning), around, MembershipSettings())
    ids = found.instance_ids.tolist()
    assert ids == sorted(ids)
    assert set(ids[:26]) == {0}
    assert set(ids[-22:]) == {1}
    assert found.expected_iou.shape == (2,)
    assert found.scene.reports.spanned.tolist() == [[True, True]]


@pytest.mark.parametrize("numbers", [[], [-1] * 3])
def test_without_any_group_all_that_is_seen_is_background(numbers: list[int]) -> None:
    views: list[HandView] = [[(range(30), ONE)]] * 3 if numbers else [[]] * 3
    found = decide(hand_table(N, views, [range(50, 60)] * 3), numbers)
    assert set(found.instance_ids[:50]) == {BACKGROUND}
    assert found.instance_ids[-1] == UNOBSERVED


def test_colors_decide_where_views_do_not() -> None:
    """Two views draw a border at 30 and two at 32; colors say where it is."""
    early, late = ([(range(border), ONE), (range(border, N), OTHER)] for border in (30, 32))
    table = hand_table(N, [early, early, late, late])
    for border in (30, 32):
        rgb = np.where(np.arange(N) < border, 40, 200).astype(np.uint8)[:, None].repeat(3, axis=1)
        found = told(table, [0, 1] * 4, rgb=rgb)
        assert found.instance_ids.tolist() == [0] * border + [1] * (N - border)


def test_a_part_of_a_scene_is_decided_as_within_it() -> None:
    """Farther from its ends than points hear in all rounds."""
    table, numbers = torn_case(np.random.default_rng(3))
    whole = told(table, numbers)
    alone, part = (told(table, numbers, slice(40, 160), scene) for scene in (None, whole))
    assert part.scene.reports is whole.scene.reports
    np.testing.assert_array_equal(part.instance_ids[40:80], whole.instance_ids[80:120])
    np.testing.assert_allclose(part.certainty[40:80], whole.certainty[80:120], rtol=1e-5)
    assert not np.allclose(alone.certainty[40:80], whole.certainty[80:120], rtol=1e-3)


def test_a_thing_too_small_for_the_sample_that_reports_were_counted_on_is_found() -> None:
    table = hand_table(N, [[(range(30), ONE), (range(50, 55), OTHER)]] * 4)
    sample = told(table, [0, 1] * 4, slice(50))
    assert (sample.scene.reports.report_column[:, 1] == -1).all()
    found = told(table, [0, 1] * 4, whole=sample).instance_ids
    assert found.tolist() == [0] * 30 + [BACKGROUND] * 20 + [1] * 5 + [BACKGROUND] * 5
