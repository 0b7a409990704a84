"""Part-of relations from masks, and what a table of instances accepts of them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hostile_files import forged
from labelled_clouds import room
from numpy.typing import NDArray
from og_pointcloud_export import write_bundle
from test_grouping import ONE, OTHER, HandView, hand_table

from og_pointcloud.bundle.read import read_bundle
from og_pointcloud.cloud import InstanceTable
from og_pointcloud.errors import BundleError, OgPointcloudError
from og_pointcloud.fitting.association import part_of
from og_pointcloud.formats.npy import npy_bytes

MUG, HANDLE, TABLE = range(60), range(60, 80), range(80, 200)
IDS = np.repeat([0, 1, 2], [60, 20, 120]).astype(np.int32)
WHOLE_MUG = [*MUG, *HANDLE]
WHOLE = "arrays/instances/whole.npy"
TOGETHER: HandView = [(WHOLE_MUG, ONE), (TABLE, OTHER)]
APART: HandView = [(MUG, ONE), (HANDLE, ONE), (TABLE, OTHER)]


def wholes(views: list[HandView], owners: list[int], unseen=(), ids: NDArray[np.int32] = IDS) -> list[int]:
    table = hand_table(len(ids), views, unseen)
    whole = part_of(table, np.array(owners, np.int32), ids, int(ids.max()) + 1)
    assert whole.dtype == np.int32
    return whole.tolist()


def test_what_most_views_show_within_the_mug_is_a_part_of_it() -> None:
    assert wholes([TOGETHER] * 4 + [APART] * 2, [0, 2] * 4 + [0, 1, 2] * 2) == [-1, 0, -1]


def test_what_most_views_show_apart_is_no_part() -> None:
    assert wholes([TOGETHER] * 2 + [APART] * 4, [0, 2] * 2 + [0, 1, 2] * 4) == [-1, -1, -1]
    assert wholes([TOGETHER] * 3 + [APART] * 3, [0, 2] * 3 + [0, 1, 2] * 3) == [-1, -1, -1]


def test_one_view_alone_makes_no_part() -> None:
    only_handle: HandView = [(HANDLE, ONE)]
    assert wholes([TOGETHER, only_handle], [0, 2, 1]) == [-1, -1, -1]


def test_what_never_has_a_mask_of_its_own_is_not_known_to_be_a_part() -> None:
    assert wholes([TOGETHER] * 5, [0, 2] * 5) == [-1, -1, -1]


def test_views_without_a_mask_of_the_whole_say_nothing() -> None:
    """Nine views missed the mug; of the three that did not, two show the handle within it."""
    missed: HandView = [(HANDLE, ONE), (TABLE, OTHER)]
    views = [TOGETHER] * 2 + [APART] + [missed] * 9
    assert wholes(views, [0, 2] * 2 + [0, 1, 2] + [1, 2] * 9) == [-1, 0, -1]


def test_views_that_do_not_see_the_part_say_nothing() -> None:
    """Five views from the other side show the mug, and nothing of its handle."""
    views = [TOGETHER] * 2 + [APART] + [[(MUG, ONE)]] * 5
    unseen = [()] * 3 + [HANDLE] * 5
    assert wholes(views, [0, 2] * 2 + [0, 1, 2] + [0] * 5, unseen) == [-1, 0, -1]


def test_the_larger_is_the_whole() -> None:
    """Masks of the handle that spill over the mug make it no part of its handle."""
    spilled: HandView = [(WHOLE_MUG, ONE)]
    assert wholes([spilled] * 4 + [APART] * 2, [1] * 4 + [0, 1, 2] * 2) == [-1, -1, -1]


def test_masks_of_no_instance_make_no_whole() -> None:
    assert wholes([TOGETHER] * 4 + [APART] * 2, [-1, 2] * 4 + [0, 1, 2] * 2) == [-1, -1, -1]


def test_a_chain_names_the_nearest_whole() -> None:
    """All three in one mask of the table, handle and mug in one of the mug: as often, so the smaller whole is named."""
    everything: HandView = [(range(200), OTHER)]
    views = [TOGETHER] * 6 + [everything] * 7 + [APART]
    owners = [0, 2] * 6 + [2] * 7 + [0, 1, 2]
    # Of the views with a mask of the mug, 6 of 7 hold the handle; of those with one of the table, 7 of 14: no majority.
    assert wholes(views, owners) == [-1, 0, -1]
    assert wholes([*views, everything, everything], [*owners, 2, 2]) == [2, 0, -1]


def test_of_two_wholes_the_one_that_holds_it_more_often_is_named() -> None:
    """The table holds the handle in all 4 views that have a mask of the table, the mug in 6 of 7."""
    on_table: HandView = [([*HANDLE, *TABLE], OTHER)]
    views = [[(WHOLE_MUG, ONE)]] * 6 + [on_table] * 4 + [[(MUG, ONE), (HANDLE, ONE)]]
    assert wholes(views, [0] * 6 + [2] * 4 + [0, 1]) == [-1, 2, -1]


def test_of_wholes_that_hold_it_as_often_the_smallest_is_named() -> None:
    on_table: HandView = [([*HANDLE, *TABLE], OTHER)]
    views = [[(WHOLE_MUG, ONE)]] * 4 + [on_table] * 4 + [[(HANDLE, ONE)]]
    assert wholes(views, [0] * 4 + [2] * 4 + [1]) == [-1, 0, -1]


def test_a_mask_with_less_than_half_of_it_does_not_hold_it() -> None:
    a_third: HandView = [([*MUG, *range(60, 67)], ONE)]
    assert wholes([a_third] * 5 + [APART], [0] * 5 + [0, 1, 2]) == [-1, -1, -1]


def test_a_view_that_hardly_sees_the_whole_says_nothing() -> None:
    """A mask over the handle and two points of the mug, of which that view sees no more."""
    sliver: HandView = [([0, 1, *HANDLE], ONE)]
    views, unseen = [sliver] * 2 + [APART] * 3, [range(2, 60)] * 2 + [()] * 3
    assert wholes(views, [0] * 2 + [0, 1, 2] * 3, unseen) == [-1, -1, -1]


def test_a_view_that_hardly_sees_the_part_says_nothing() -> None:
    glimpse: HandView = [([*MUG, 60], ONE)]
    views, unseen = [glimpse] * 2 + [APART] * 3, [range(61, 80)] * 2 + [()] * 3
    assert wholes(views, [0] * 2 + [0, 1, 2] * 3, unseen) == [-1, -1, -1]


def test_order_and_numbers_do_not_matter() -> None:
    swapped = np.array([1, 0, 2], np.int32)[IDS]
    assert wholes([TOGETHER] * 4 + [APART] * 2, [1, 2] * 4 + [1, 0, 2] * 2, ids=swapped) == [1, -1, -1]
    assert wholes([APART, TOGETHER] * 2 + [TOGETHER] * 2, [0, 1, 2, 0, 2] * 2 + [0, 2] * 2) == [-1, 0, -1]


def test_points_of_no_instance_and_instances_without_points() -> None:
    ids = np.where(np.arange(200) >= 80, -1, IDS).astype(np.int32)
    table = hand_table(200, [TOGETHER] * 4 + [APART] * 2)
    owners = np.array([0, -1] * 4 + [0, 1, -1] * 2, np.int32)
    np.testing.assert_array_equal(part_of(table, owners, ids, 5), [-1, 0, -1, -1, -1])
    assert part_of(table, np.full(14, -1, np.int32), np.full(200, -1, np.int32), 0).shape == (0,)


def test_in_a_crowd_as_by_looping_over_pairs() -> None:
    """The definition at the head of association.py, an instance, a view and a mask at a time."""
    random = np.random.default_rng(0)
    ids = np.repeat(np.arange(12), random.integers(3, 9, 12)).astype(np.int32)
    views, owners = [], []
    for _ in range(40):
        starts = np.flatnonzero(random.random(12) < 0.2).tolist()  # a mask covers one instance, or two or three
        masks = [np.flatnonzero((ids >= k) & (ids <= k + random.integers(3))).tolist() for k in starts]
        views.append([(mask, ONE) for mask in masks if mask])
        owners += [k for k, mask in zip(starts, masks, strict=True) if mask]
    table = hand_table(len(ids), views)
    shown = np.stack([table.weights.toarray()[:, ids == k].sum(axis=1) for k in range(12)], axis=1)
    seen = np.stack([shown[table.mask_view == v].sum(axis=0) for v in range(40)])
    seen += np.stack([table.outside.toarray()[:, ids == k].sum(axis=1) for k in range(12)], axis=1)
    typical = [np.median(column[column > 0]) if column.any() else 0 for column in seen.T]
    sees, size, expected = seen > 0.1 * np.array(typical), np.bincount(ids), []
    for part in range(12):
        own, found = False, []
        held = dict.fromkeys(range(12), 0)
        for mask, (view, whole) in enumerate(zip(table.mask_view, owners, strict=True)):
            if sees[view, part] and sees[view, whole] and shown[mask, part] > 0.5 * seen[view, part]:
                own |= whole == part
                held[whole] += 1
        for whole in range(12):
            of_whole = {view for view, owner in zip(table.mask_view, owners, strict=True) if owner == whole}
            possible = sum(sees[v, part] and sees[v, whole] for v in of_whole)
            if size[whole] > size[part] and held[whole] >= 2 and held[whole] > 0.5 * possible:
                found.append((-held[whole] / possible, size[whole], whole))
        expected.append(min(found)[2] if own and found else -1)
    assert part_of(table, np.array(owners, np.int32), ids, 12).tolist() == expected
    assert len({*expected} - {-1}) > 1


def instances(coarse: list[int] | None = None, whole: list[int] | None = None, count: int = 3) -> InstanceTable:
    extra = {
        name: np.array(value, np.int32) for name, value in (("coarse", coarse), ("part_of", whole)) if value is not None
    }
    numbers, ratios = np.zeros(count, np.int32), np.zeros(count, np.float32)
    nothing = np.zeros((0, 4), np.float32), np.zeros(0, np.int32)
    return InstanceTable(*nothing, numbers, numbers, numbers, ratios, ratios, **extra)


def test_a_table_without_hierarchy_has_none() -> None:
    table = instances()
    np.testing.assert_array_equal(table.coarse, [-1, -1, -1])
    np.testing.assert_array_equal(table.part_of, [-1, -1, -1])
    assert table.part_of.dtype == np.int32
    assert len(instances(count=0).part_of) == 0


def test_a_table_keeps_its_hierarchy() -> None:
    table = instances([4, 4, -1], [1, 2, -1])
    np.testing.assert_array_equal(table.coarse, [4, 4, -1])
    np.testing.assert_array_equal(table.part_of, [1, 2, -1])
    longest = instances(whole=[*range(1, 64), -1], count=64)
    assert longest.part_of[0] == 1


@pytest.mark.parametrize(
    ("coarse", "whole", "message"),
    [
        (None, [0, -1, -1], "is part of itself"),
        (None, [1, 2, 0], "is part of itself"),
        (None, [-1, 2, 1], "instance 1 is part of itself"),
        (None, [3, -1, -1], "part_of spans"),
        (None, [-2, -1, -1], "part_of spans"),
        ([-2, 0, 0], None, "coarse"),
        ([0, 0], None, "coarse"),
        (None, [-1, -1], "part_of"),
    ],
)
def test_a_hierarchy_that_is_none_is_refused(coarse: list[int] | None, whole: list[int] | None, message: str) -> None:
    with pytest.raises(OgPointcloudError, match=message):
        instances(coarse, whole)


def test_the_hierarchy_comes_back_from_its_file(tmp_path: Path) -> None:
    cloud = room(200)
    coarse, whole = np.arange(9, dtype=np.int32) // 2, np.array([3, -1, 3, 8, -1, -1, 0, -1, -1], np.int32)
    related = replace(cloud, instances=replace(cloud.instances, coarse=coarse, part_of=whole))
    back = read_bundle(write_bundle(related, tmp_path / "room.ogpc")).cloud.instances
    np.testing.assert_array_equal(back.coarse, coarse)
    np.testing.assert_array_equal(back.part_of, whole)
    assert back.coarse.dtype == back.part_of.dtype == np.int32


def test_files_with_a_damaged_hierarchy_are_refused(tmp_path: Path) -> None:
    file = write_bundle(room(200), tmp_path / "room.ogpc")
    for bad, says in ((np.arange(9, dtype=np.int32), "is part of itself"), (np.zeros(8, np.int32), "whole.npy")):
        with pytest.raises(BundleError, match=says):
            read_bundle(forged(file, tmp_path / "bad.ogpc", {WHOLE: npy_bytes(bad)}))
