"""What views say of points, and the state of every point decided from it: points on a line, masks made by hand."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from numpy.random import Generator
from numpy.typing import NDArray
from scipy.sparse import csr_array, random_array
from test_grouping import ONE, HandView, hand_table

from og_pointcloud.cloud import BACKGROUND, UNOBSERVED
from og_pointcloud.fitting.grouping import MaskGroups
from og_pointcloud.fitting.mask_table import MaskTable
from og_pointcloud.fitting.membership import (
    Membership,
    _best_group,
    _clear,
    _reweighted_share,
    _Support,
    _without_islands,
    assign_by_votes_alone,
    assign_points,
    instance_area,
)
from og_pointcloud.fitting.see_through import _front_run, without_see_through
from og_pointcloud.fitting.view_votes import OPENNESS_POWER, view_votes
from og_pointcloud.rendering.geometry import neighborhood
from og_pointcloud.rendering.splatting import Gaussians
from og_pointcloud.scene import Camera
from og_pointcloud.settings import GeometrySettings, MembershipSettings

SETTINGS = MembershipSettings()
N = 100
OBJECT = range(50)


def on_a_line(n: int = N) -> NDArray[np.float32]:
    """Points one apart, so the three nearest are 4/3 away: each adjoins four on either side."""
    return np.stack([np.arange(n), np.zeros(n), np.zeros(n)], axis=1).astype(np.float32)


def groups(numbers: Sequence[int]) -> MaskGroups:
    number = np.array(numbers, np.int32)
    return MaskGroups(number, int(number.max(initial=-1)) + 1, np.zeros(len(number), bool))


def decide(
    table: MaskTable,
    numbers: Sequence[int],
    xyz: NDArray[np.float32] | None = None,
    settings: MembershipSettings = SETTINGS,
) -> Membership:
    xyz = on_a_line(table.weights.shape[1]) if xyz is None else xyz
    around = neighborhood(xyz, GeometrySettings())
    result = assign_points(table, view_votes(table), groups(numbers), around, settings)
    assert result.instance_ids.dtype == np.int32
    assert result.certainty.dtype == result.detection_rate.dtype == np.float32
    assert result.instance_ids.shape == result.certainty.shape == (len(xyz),)
    assert ((result.certainty >= 0) & (result.certainty <= 1)).all()
    return result


def ids_of(views: Sequence[HandView], numbers: Sequence[int], unseen: Sequence[Iterable[int]] = ()) -> list[int]:
    return decide(hand_table(N, views, unseen), numbers).instance_ids.tolist()


ON_A_LINE: dict[str, tuple[list[HandView], list[int], list[tuple[int, int]]]] = {
    "inside the masks is the instance, outside is background": ([[(OBJECT, ONE)]] * 4, [0] * 4, [(0, 50), (-1, 50)]),
    "two instances": (
        [[(range(30), ONE), (range(30, 70), ONE)]] * 4, [0, 1] * 4, [(0, 30), (1, 40), (-1, 30)]
    ),
    "a detector that misses in seven views of ten keeps its instance: they say nothing": (
        [*[[(OBJECT, ONE)]] * 3, *[[]] * 7], [0] * 3, [(0, 50), (-1, 50)]
    ),
    "background that masks cover in one view of seven, or three of seven far away, stays background": (
        [[(range(60), ONE)], *[[([*OBJECT, *range(80, 90)], ONE)]] * 3, *[[(OBJECT, ONE)]] * 3], [0] * 7,
        [(0, 50), (-1, 50)],
    ),
    "a rim that two views of four cut off joins the instance that it adjoins": (
        [*[[(range(45), ONE)]] * 2, *[[(OBJECT, ONE)]] * 2], [0] * 4, [(0, 50), (-1, 50)]
    ),
    "a point amid background, shown in half of the masks by rays that slip past the object, is let go": (
        [[([*OBJECT, 80], ONE)], [(OBJECT, ONE)]] * 2, [0] * 4, [(0, 50), (-1, 50)]
    ),
    "points amid background that all masks show stay": (
        [[([*OBJECT, 80, 81], ONE)]] * 4, [0] * 4, [(0, 50), (-1, 30), (0, 2), (-1, 18)]
    ),
    "points at share 0.5 in a row are reached from the sure ones, those at 0.17 behind them are not": (
        [[(range(N), ONE)], *[[(range(90), ONE)]] * 2, *[[(OBJECT, ONE)]] * 3], [0] * 6, [(0, 90), (-1, 10)]
    ),
    "masks without a group have no say: a point that they alone show follows the object beside it": (
        [[(OBJECT, ONE), (range(50, N), ONE)]] * 3, [0, -1] * 3, [(0, 51), (-1, 49)]
    ),
    "of groups that cover a point alike the lower is taken": ([[(OBJECT, ONE)]] * 2, [1, 0], [(0, 50), (-1, 50)]),
}  # fmt: skip
"""What it shows -> views, the group of each mask, and the ids of the line: which, and of how many points."""


@pytest.mark.parametrize("shows", ON_A_LINE)
def test_states_of_points_on_a_line(shows: str) -> None:
    views, numbers, runs = ON_A_LINE[shows]
    assert ids_of(views, numbers) == [state for state, count in runs for _ in range(count)]


def test_growth_does_not_jump_over_a_gap() -> None:
    """Three points at share 0.5, of whose nearest points most are the object's, but out of reach."""
    xyz = on_a_line(43)
    xyz[40:] += 20
    views: list[HandView] = [[(range(43), ONE)], [(range(40), ONE)]] * 2
    ids = decide(hand_table(43, views), [0] * 4, xyz).instance_ids
    assert ids.tolist() == [0] * 40 + [BACKGROUND] * 3


def test_points_that_no_view_sees_copy_their_neighbors_within_reach() -> None:
    xyz = np.concatenate([on_a_line(50), [[50, 0, 0], [51.5, 0, 0], [70, 0, 0]]]).astype(np.float32)
    table = hand_table(53, [[(range(40), ONE)]] * 3, [range(50, 53)] * 3)
    ids = decide(table, [0] * 3, xyz).instance_ids
    assert ids.tolist() == [0] * 40 + [BACKGROUND] * 12 + [UNOBSERVED]
    table = hand_table(53, [[(OBJECT, ONE)]] * 3, [range(50, 53)] * 3)
    ids = decide(table, [0] * 3, xyz).instance_ids
    assert ids.tolist() == [0] * 52 + [UNOBSERVED]


def test_a_group_that_nearly_all_views_contradict_is_dismissed() -> None:
    """Ten views show the object, one of them a mask of nothing."""
    views: list[HandView] = [[(OBJECT, ONE)]] * 9 + [[(OBJECT, ONE), (range(70, 90), ONE)]]
    result = decide(hand_table(N, views), [0] * 10 + [1])
    assert result.dismissed.tolist() == [False, True]
    assert result.instance_ids.tolist() == [0] * 50 + [BACKGROUND] * 50
    np.testing.assert_allclose(result.detection_rate, [1, 0.1], rtol=1e-6)


def test_a_group_of_which_no_point_is_sure_is_dismissed() -> None:
    """Points of group 1 lie in masks of group 0 far more often."""
    views: list[HandView] = [[(OBJECT, ONE)]] * 4 + [[(range(10), ONE), (range(10, 50), ONE)]]
    result = decide(hand_table(N, views), [0] * 4 + [1, 0])
    assert result.dismissed.tolist() == [False, True]
    assert result.instance_ids.tolist() == [0] * 50 + [BACKGROUND] * 50


def test_a_part_of_a_scene_without_a_sure_point_of_a_thing_is_decided_as_in_the_scene() -> None:
    """Far from the points that views agree on, one view of two that see the thing has it in a mask."""
    n, thing, doubtful = 1000, range(840), range(640, 840)
    views = [[(thing, ONE)], [(range(40), ONE)], [(range(640), ONE)]]
    table = hand_table(n, views, [(), (), doubtful])
    around = partial(neighborhood, settings=GeometrySettings())
    whole = assign_points(table, view_votes(table), groups([0, 0, 0]), around(on_a_line(n)), SETTINGS)
    part = np.arange(740, n)
    of_part, alone = table.of_points(part), replace(SETTINGS, rate_share=0.0, missed_chance=0.0)
    decided = assign_points(
        of_part, view_votes(of_part), groups([0, 0, 0]), around(on_a_line(n)[part]), alone, None, whole.scene
    )
    assert (whole.instance_ids[740:800] == 0).all()
    np.testing.assert_array_equal(decided.instance_ids[:60], whole.instance_ids[740:800])


@pytest.mark.parametrize("numbers", [[], [-1, -1]])
def test_no_group_at_all(numbers: list[int]) -> None:
    views: list[HandView] = [[(OBJECT, ONE)], [(OBJECT, ONE)]] if numbers else [[], []]
    hidden = [range(90, 100)] * 2
    ids = ids_of(views, numbers, hidden)
    assert ids == [BACKGROUND] * 94 + [UNOBSERVED] * 6


@pytest.mark.parametrize("n", [1, 2, 3])
def test_few_points(n: int) -> None:
    assert decide(hand_table(n, [[(range(n), ONE)]] * 2), [0, 0]).instance_ids.tolist() == [0] * n
    assert decide(hand_table(n, [[]] * 2), []).instance_ids.tolist() == [BACKGROUND] * n
    unseen = hand_table(n, [[([], ONE)]] * 2, [range(n)] * 2)
    assert decide(unseen, [-1, -1]).instance_ids.tolist() == [UNOBSERVED] * n


def two_pieces(shown: float) -> list[int]:
    """Forty points, and far from them ten that the same masks show ``shown`` as much of."""
    xyz = on_a_line(50)
    xyz[40:] += 100
    table = hand_table(50, [[(range(50), ONE)]] * 4)
    weights = table.weights.toarray()
    weights[:, 40:] *= np.float32(shown)
    exposure = table.exposure.toarray()
    exposure[:, 40:] *= np.float32(shown)
    dimmed = replace(table, weights=csr_array(weights), exposure=csr_array(exposure))
    return decide(dimmed, [0] * 4, xyz).instance_ids.tolist()


def test_a_piece_that_was_only_seen_through_its_instance_is_taken_from_it() -> None:
    assert two_pieces(0.05) == [0] * 40 + [UNOBSERVED] * 10


def test_a_piece_that_is_shown_as_openly_as_the_rest_stays() -> None:
    assert two_pieces(0.5) == [0] * 50


def dimly(shown: float, views: list[HandView]) -> Membership:
    """Membership of a line of points of which every view sees those from 40 on ``shown`` as openly as the others."""
    table = hand_table(N, views)
    exposure = table.exposure.toarray()
    exposure[:, 40:60] *= np.float32(shown)
    return decide(replace(table, exposure=csr_array(exposure)), [0] * len(views))


def test_the_less_openly_all_views_see_a_thing_the_less_sure_it_is_until_it_is_as_what_is_about_it() -> None:
    """Twenty points that every view's mask holds, amid background: the floor under a car, seen through its roof."""
    sure = []
    for shown in (0.69, 0.28, 0.14, 0.07):
        found = dimly(shown, [[(range(40, 60), ONE)]] * 4)
        assert found.instance_ids.tolist() == [BACKGROUND] * 40 + [0] * 20 + [BACKGROUND] * 40
        sure.append(float(found.certainty[50]))
    assert sure[0] > 0.99 > sure[1] > sure[2] > sure[3] > 0.5
    assert set(dimly(0.01, [[(range(40, 60), ONE)]] * 4).instance_ids) == {BACKGROUND}


def test_what_no_view_sees_openly_joins_the_instance_that_it_adjoins() -> None:
    found = dimly(0.1, [[(range(20, 80), ONE)]] * 4).instance_ids
    assert found.tolist() == [BACKGROUND] * 20 + [0] * 60 + [BACKGROUND] * 20


def test_a_scene_that_no_view_sees_openly_is_believed_as_a_whole() -> None:
    """Surfaces of many noisy layers: little of every point reaches the camera."""
    table = hand_table(N, [[(OBJECT, ONE)]] * 4)
    dim = replace(table, exposure=csr_array(table.exposure.toarray() * np.float32(0.1)))
    assert decide(dim, [0] * 4).instance_ids.tolist() == [0] * 50 + [BACKGROUND] * 50


def test_order_of_points_does_not_matter() -> None:
    random = np.random.default_rng(0)
    table, numbers = torn_case(random)
    xyz = on_a_line(200)
    order = random.permutation(len(xyz))
    shuffled = replace(
        table,
        weights=csr_array(table.weights[:, order]),
        outside=csr_array(table.outside[:, order]),
        exposure=csr_array(table.exposure[:, order]),
    )
    plain, moved = decide(table, numbers, xyz), decide(shuffled, numbers, xyz[order])
    np.testing.assert_array_equal(moved.instance_ids, plain.instance_ids[order])
    np.testing.assert_allclose(moved.certainty, plain.certainty[order], rtol=1e-5)
    assert len(set(plain.instance_ids)) > 4


def test_points_are_surest_inside_and_not_at_all_where_no_view_looks() -> None:
    unseen = [range(95, 100)] * 4
    result = decide(hand_table(N, [[(OBJECT, ONE)]] * 4, unseen), [0] * 4)
    np.testing.assert_allclose(result.certainty[[10, 80]], 1, atol=1e-4)
    np.testing.assert_allclose(result.certainty[49:51], 0.5, atol=0.1)
    assert (result.certainty[95:] == 0).all()


def test_order_of_masks_does_not_matter() -> None:
    random = np.random.default_rng(1)
    table, numbers = random_case(random)
    order = np.concatenate([random.permutation(np.flatnonzero(table.mask_view == view)) for view in range(6)])
    shuffled = replace(table, weights=csr_array(table.weights[order]))
    plain, moved = decide(table, numbers), decide(shuffled, [numbers[mask] for mask in order])
    np.testing.assert_array_equal(moved.instance_ids, plain.instance_ids)


def random_case(random: Generator, n: int = 200, views: int = 6, masks: int = 4) -> tuple[MaskTable, list[int]]:
    """Soft random weights of ``masks`` masks in each of the views, of which some have no group."""
    sparse = [
        csr_array(random_array((rows, n), density=share, rng=random, dtype=np.float32))
        for rows, share in ((views * masks, 0.1), (views, 0.5))
    ]
    mask_view = np.repeat(np.arange(views), masks).astype(np.int32)
    seen = sparse[1].toarray() > 0
    for view in range(views):
        seen[view] |= (sparse[0].toarray()[mask_view == view] > 0).any(axis=0)
    exposure = csr_array(np.where(seen, random.uniform(0.05, 1, seen.shape), 0).astype(np.float32))
    numbers = random.integers(-1, 5, views * masks).tolist()
    features = np.tile(ONE, (views * masks, 1))
    return MaskTable(*sparse, exposure, mask_view, np.full(views * masks, 10, np.int32), features), numbers


def torn_case(random: Generator) -> tuple[MaskTable, list[int]]:
    """Five things of 40 points each on a line. Of every point a third of six views have a mask of another, or none; one
    view shows the third as the fourth. Of one mask the group is not known."""
    true, views = np.repeat(np.arange(5), 40), 6
    said = np.where(random.uniform(size=(views, 200)) < 0.3, random.integers(0, 6, (views, 200)), true)
    said[1][true == 2] = 3
    mask_view, thing = np.repeat(np.arange(views), 5), np.tile(np.arange(5), views)
    exposure = np.where(random.uniform(size=(views, 200)) < 0.8, random.uniform(0.05, 1, (views, 200)), 0)
    weights = np.where(said[mask_view] == thing[:, None], random.uniform(0.2, 1, (30, 200)), 0) * exposure[mask_view]
    outside = exposure * random.uniform(0.05, 0.6, (views, 200))
    dense = (csr_array(part.astype(np.float32)) for part in (weights, outside, exposure))
    numbers = np.where(np.arange(30) == 11, -1, thing).tolist()
    areas, features = np.full(30, 10, np.int32), np.tile(ONE, (30, 1))
    return MaskTable(*dense, mask_view.astype(np.int32), areas, features), numbers


@pytest.mark.parametrize("seed", range(3))
def test_votes_are_their_formula(seed: int) -> None:
    table, _ = random_case(np.random.default_rng(seed))
    votes = view_votes(table)
    weights, outside, exposure = (m.toarray().astype(float) for m in (table.weights, table.outside, table.exposure))
    best = exposure.max(axis=0)
    vote = (exposure / np.where(best > 0, best, 1)) ** OPENNESS_POWER
    np.testing.assert_allclose(votes.vote.toarray(), vote, rtol=1e-5)
    expected = np.zeros_like(weights)
    for mask, view in enumerate(table.mask_view):
        seen = weights[table.mask_view == view].sum(axis=0) + outside[view]
        expected[mask] = weights[mask] / np.where(seen > 0, seen, 1) * vote[view]
    np.testing.assert_allclose(votes.in_mask.toarray(), expected, rtol=1e-5, atol=1e-9)
    by_view = np.add.reduceat(votes.in_mask.toarray(), np.arange(0, 24, 4), axis=0)
    assert (by_view <= votes.vote.toarray() + 1e-6).all()


def test_a_view_that_looks_openly_outweighs_views_through_a_gap() -> None:
    """Three views glimpse point 0 in a mask, at a tenth of what the fourth sees of it, outside."""
    table = hand_table(1, [[([0], ONE)]] * 3 + [[([], ONE)]])
    exposure = csr_array(np.array([[0.1], [0.1], [0.1], [1.0]], np.float32))
    vote = view_votes(replace(table, exposure=exposure)).vote.toarray().ravel()
    np.testing.assert_allclose(vote, [0.01, 0.01, 0.01, 1], rtol=1e-5)


@pytest.mark.parametrize("seed", range(3))
def test_best_group_is_that_of_the_literal_reference(seed: int) -> None:
    random = np.random.default_rng(seed)
    table, numbers = random_case(random)
    group = np.array(numbers, np.int32)
    votes = view_votes(table)
    has_mask = random.uniform(size=(5, 6)) < 0.5
    allowed = np.array([True, True, False, True, True])
    columns = votes.by_point
    actual = _best_group(*columns, group, has_mask, allowed, 0.45, 0.1)
    in_mask, vote = votes.in_mask.toarray().astype(float), votes.vote.toarray().astype(float)
    per_group = np.array([in_mask[group == k].sum(axis=0) if allowed[k] else 0 * in_mask[0] for k in range(5)])
    most = np.where(per_group.max(axis=0) > 0, per_group.argmax(axis=0), -1)
    asked = has_mask @ vote
    sure = np.where(per_group > np.maximum(0.45 * asked, 0.1), per_group, 0)
    surest = sure.argmax(axis=0)
    points = np.arange(200)
    smaller = (most >= 0) & (sure[most, points] == 0) & (sure.max(axis=0) > 0) & (surest > most)
    best = np.where(smaller, surest, most)
    of_best = np.where(best >= 0, per_group[best, points], 0), np.where(best >= 0, asked[best, points], 0)
    for value, expected in zip(actual, (best, *of_best, vote.sum(axis=0)), strict=True):
        np.testing.assert_allclose(value, expected, rtol=1e-5, atol=1e-9)
    assert (best == -1).any()
    assert smaller.any()


@pytest.mark.parametrize("seed", range(3))
def test_the_share_of_open_views_is_that_of_the_literal_reference(seed: int) -> None:
    random = np.random.default_rng(seed)
    table, numbers = random_case(random)
    group, best = np.array(numbers, np.int32), random.integers(-1, 5, 200).astype(np.int32)
    votes, has_mask = view_votes(table), random.uniform(size=(5, 6)) < 0.5
    columns = votes.by_point
    share = _reweighted_share(*columns, group, table.mask_view, has_mask, best)
    in_mask, vote = votes.in_mask.toarray().astype(float), votes.vote.toarray().astype(float)
    of_view = votes_of_views(in_mask, group, table.mask_view)
    for point, k in enumerate(best):
        said, weight = of_view[k, :, point], vote[:, point]
        asked = (has_mask[k] * weight**2).sum() if k >= 0 else 0
        np.testing.assert_allclose(share[point], weight @ said / asked if asked else 0, rtol=1e-5)


def votes_of_views(in_mask: NDArray[np.float64], group: NDArray[np.int32], mask_view: NDArray[np.int32]) -> NDArray:
    """(5 groups, 6 views, n) votes for each group in each view."""
    found = np.zeros((5, 6, in_mask.shape[1]))
    np.add.at(found, (group[group >= 0], mask_view[group >= 0]), in_mask[group >= 0])
    return found


def test_a_piece_that_one_view_alone_tears_off_stays_with_the_whole() -> None:
    """Two views mask the whole, two end early. The piece between them is a thing of its own once two views say so."""
    whole, rest, piece = (range(60), ONE), (range(45), ONE), (range(45, 60), ONE)
    assert ids_of([[whole], [whole], [rest], [rest, piece]], [0, 0, 0, 0, 1]) == [0] * 60 + [BACKGROUND] * 40
    apart = ids_of([[whole], [whole], [rest, piece], [rest, piece]], [0, 0, 0, 1, 0, 1])
    assert apart == [0] * 45 + [1] * 15 + [BACKGROUND] * 40
    # Where a few of many views stand for all, one of them says as much as several.
    table, one_alone = hand_table(N, [[whole], [whole], [rest], [rest, piece]]), groups([0, 0, 0, 0, 1])
    around = neighborhood(on_a_line(N), GeometrySettings())
    by_few = assign_by_votes_alone(table, view_votes(table), one_alone, around, SETTINGS)
    assert by_few.tolist() == [0] * 45 + [1] * 15 + [BACKGROUND] * 40


def test_what_slips_past_an_edge_is_not_grown_over() -> None:
    """Beside the object, four of five views see points less openly, past its edge; one sees them openly, outside. Where
    all see them alike, as on a rim of torn masks, they are the object's."""
    edge, table = range(50, 54), hand_table(N, [[(range(54), ONE)]] * 4 + [[(OBJECT, ONE)]] * 5)
    shown = np.ones((9, N), np.float32)
    assert decide(table, [0] * 9).instance_ids.tolist() == [0] * 54 + [BACKGROUND] * 46
    shown[:4, edge] = 0.7
    past = replace(table, exposure=csr_array(shown))
    assert decide(past, [0] * 9).instance_ids.tolist() == [0] * 50 + [BACKGROUND] * 50


def test_points_are_clear_that_views_see_openly_and_agree_on() -> None:
    """In order: all votes are for it; 4 of 5; half; one in ten; none; no group; one ray that slips through, and what
    other views say of which no one has a mask of it; all, but hardly seen; seen by no view."""
    votes, possible = np.array([[4, 4], [4, 5], [2, 4], [0.4, 4], [0, 4], [0, 0], [0.2, 0.2], [4, 4], [0, 0]], float).T
    group = np.array([0, 0, 0, 0, 0, -1, 0, 0, -1], np.int32)
    total = np.array([4, 5, 4, 4, 4, 4, 4, 4, 0], float)
    openly = np.array([*[1] * 7, 0.9, 0], np.float32)
    clear = _clear(_Support(group, votes, possible, total, votes), openly, SETTINGS)
    assert clear.dtype == np.int32
    assert clear.tolist() == [0, 0, UNOBSERVED, *[BACKGROUND] * 3, *[UNOBSERVED] * 3]


def test_the_word_of_one_view_alone_is_noise_where_the_others_would_hardly_all_miss_a_thing() -> None:
    """All views find the object; one finds something where no other has any mask."""
    seen, blob = (OBJECT, ONE), (range(70, 90), ONE)
    views: list[HandView] = [[seen, blob], *[[seen]] * 5]
    assert ids_of(views, [0, 1, *[0] * 5]) == [0] * 50 + [BACKGROUND] * 50
    # Two views may well have missed a thing; so may five that miss the object as often.
    assert set(ids_of(views[:3], [0, 1, 0, 0])[70:90]) == {1}
    assert set(ids_of([views[0], *[[]] * 5], [0, 1])[70:90]) == {1}


@pytest.mark.parametrize("colors", ["alike", "its own", "none"])
def test_what_one_view_alone_has_a_mask_of_is_noise_where_colors_do_not_change_at_its_outline(colors: str) -> None:
    """That three views missed it is nearly too unlikely; that they missed what looks like all around it, entirely."""
    rgb = np.full((N, 3), 90, np.uint8)
    rgb[OBJECT] = 200, 40, 40
    rgb[70:90] = (40, 40, 200) if colors == "its own" else (90, 90, 90)
    seen, blob = (OBJECT, ONE), (range(70, 90), ONE)
    table, numbers = hand_table(N, [[seen, blob], *[[seen]] * 3]), groups([0, 1, 0, 0, 0])
    around = neighborhood(on_a_line(), GeometrySettings())
    settings, given = replace(SETTINGS, missed_chance=0.045), None if colors == "none" else rgb  # that it is: 0.054
    result = assign_points(table, view_votes(table), numbers, around, settings, given)
    assert result.dismissed.tolist() == [False, colors == "alike"]
    assert set(result.instance_ids[70:90]) == ({BACKGROUND} if colors == "alike" else {1})


def test_what_two_views_of_twenty_have_a_mask_of_is_noise_where_the_scene_misses_little() -> None:
    seen, blob = (OBJECT, ONE), (range(70, 90), ONE)
    views: list[HandView] = [*[[seen, blob]] * 2, *[[seen]] * 18]
    result = decide(hand_table(N, views), [0, 1, 0, 1, *[0] * 18])
    assert result.dismissed.tolist() == [False, True]
    assert result.instance_ids.tolist() == [0] * 50 + [BACKGROUND] * 50
    assert set(ids_of(views[:10], [0, 1, 0, 1, *[0] * 8])[70:90]) == {1}


def test_what_another_view_has_a_mask_of_too_is_no_word_of_one_view() -> None:
    """The blob of one view lies in a mask of another too, which was left out for showing several things."""
    seen: HandView = [(range(25), ONE), (range(25, 50), ONE)]
    views: list[HandView] = [[*seen, (range(70, 90), ONE)]] * 2 + [seen] * 4
    assert set(ids_of(views, [0, 1, 2, 0, 1, -1, *[0, 1] * 4])[70:90]) == {2}


def test_a_small_thing_that_half_of_the_views_let_a_large_one_swallow_keeps_its_points() -> None:
    """A book on a shelf: four views have a mask of it, five show it within the shelf's; a tie would do as well."""
    book, shelf = range(80, 100), range(100)
    known: HandView = [(range(80), ONE), (book, ONE)]
    table = hand_table(100, [known] * 4 + [[(shelf, ONE)]] * 5)
    ids = decide(table, [0, 1] * 4 + [0] * 5).instance_ids
    assert ids.tolist() == [0] * 80 + [1] * 20


def test_instance_area_is_what_the_masks_of_its_instance_show_of_a_point() -> None:
    table = hand_table(3, [[([0, 1], ONE), ([2], ONE)], [([0, 1, 2], ONE)]])
    area = instance_area(table, np.array([0, 1, 0], np.int32), np.array([0, BACKGROUND, 1], np.int32))
    np.testing.assert_array_equal(area, [2, 0, 1])


def at_depths(depth: Sequence[float]) -> Gaussians:
    xyz = np.zeros((len(depth), 3), np.float32)
    xyz[:, 2] = depth
    return Gaussians(xyz, np.ones_like(xyz), np.ones((len(xyz), 4), np.float32), np.ones(len(xyz), np.float32))


ALONG_Z = Camera(10, 10, 10.0, 10.0, 5.0, 5.0, np.eye(4))


@pytest.mark.parametrize("seed", range(20))
def test_the_object_of_a_mask_is_that_of_the_literal_reference(seed: int) -> None:
    rng = np.random.default_rng(seed)
    depth = np.sort(rng.integers(1, 6, 60) + 0.5 * rng.random(60))
    weight = rng.random(60).astype(np.float32)
    gap_share, front_share = float(rng.uniform(0.02, 0.08)), float(rng.uniform(0.05, 0.9))
    reached = np.cumsum(weight, dtype=np.float64)
    middle = depth[np.searchsorted(reached, 0.5 * reached[-1])]
    run = np.concatenate([[0], np.cumsum(np.diff(depth) > gap_share * middle)])
    mass = np.bincount(run, weight)
    assert len(mass) > 1
    begin, end = _front_run(depth, weight, gap_share, front_share)
    np.testing.assert_array_equal(
        np.flatnonzero(run == np.argmax(mass >= front_share * mass.sum())), np.arange(begin, end)
    )


def front_of(depth: Sequence[float], views: int = 1) -> tuple[MaskTable, MaskTable, float]:
    """A mask of n pixels, so sqrt(n) / 10 wide at depth 1 with a focal length of 10 px, over points at these depths:
    the table before, after, and the share taken."""
    n = len(depth)
    table = hand_table(n, [[(range(n), ONE)]] * views)
    return table, *without_see_through(table, at_depths(depth), [ALONG_Z] * views, SETTINGS)


@pytest.mark.parametrize("views", [1, 20])
def test_to_what_lies_far_behind_the_object_its_view_is_blind(views: int) -> None:
    """Nine pixels: 0.3 wide at depth 1, so a gap of 0.15 times the depth parts object and background."""
    before, after, share = front_of([1, 1.1, 1.2, 1.3, 1.4, 1.2, 5, 5, 6], views)
    seen = [1] * 6 + [0] * 3
    np.testing.assert_array_equal(after.weights.toarray(), [seen] * views)
    np.testing.assert_array_equal(after.exposure.toarray() > 0, np.array([seen] * views, bool))
    assert (after.outside != before.outside).nnz == 0
    assert share == pytest.approx(3 / 9)


def test_a_view_keeps_as_much_of_its_word_as_is_not_behind_an_object() -> None:
    """Of two points behind, a quarter lies outside of the mask, or in a second mask, whose object is at their depth."""
    depth, first = [1.0, 1, 1, 1, 5, 5], [1, 1, 1, 1, 0.75, 0.75]
    table = hand_table(6, [[(range(6), ONE), ([5], ONE)]])
    weights = np.array([first, [0, 0, 0, 0, 0, 0.25]], np.float32)
    outside = np.array([[0, 0, 0, 0, 0.25, 0]], np.float32)
    table = replace(table, weights=csr_array(weights), outside=csr_array(outside))
    after, share = without_see_through(table, at_depths(depth), [ALONG_Z], SETTINGS)
    assert share == pytest.approx(1.5 / 5.75)
    np.testing.assert_allclose(after.weights.toarray(), [[1, 1, 1, 1, 0, 0], weights[1]])
    np.testing.assert_allclose(after.exposure.toarray(), [[1, 1, 1, 1, 0.25, 0.25]])
    np.testing.assert_array_equal(after.outside.toarray(), outside)


def test_a_few_specks_in_front_are_not_the_object() -> None:
    _, after, share = front_of([1, 5, 5, 5, 5, 5, 5, 5.5, 30])
    np.testing.assert_array_equal(after.weights.toarray()[0, 1:], [1] * 7 + [0])
    assert 0 < share < 0.3


def test_an_object_in_one_piece_is_kept_whole() -> None:
    before, after, share = front_of([1, 1.1, 1.2, 1.3, 1.4, 1.5])
    assert after is before
    assert share == 0


@pytest.mark.parametrize(("votes", "stays"), [(0.6, True), (0.4, False)])
def test_a_piece_apart_stays_by_the_majority_of_its_votes(votes: float, stays: bool) -> None:
    grid = np.stack([*np.meshgrid(np.arange(12.0), np.arange(12.0)), np.zeros((12, 12))], axis=-1).reshape(-1, 3)
    xyz = np.concatenate([grid, grid[:40] + np.array([100.0, 0, 0])]).astype(np.float32)
    apart = np.arange(len(xyz)) >= len(grid)
    share, around = np.where(apart, votes, 0.9), neighborhood(xyz, GeometrySettings())
    kept = _without_islands(np.zeros(len(xyz), np.int32), share, np.ones(len(xyz)), around, min_share=0.1)
    assert (kept[~apart] == 0).all()
    assert (kept[apart] == (0 if stays else UNOBSERVED)).all()
