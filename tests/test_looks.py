"""Groups of masks that show two things are taken apart, point by point."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from test_grouping import ONE, OTHER, HandView, hand_table

from og_pointcloud.fitting.looks import by_look, looks_of_groups
from og_pointcloud.fitting.view_votes import view_votes


def noisy(feature: NDArray[np.float32], random: np.random.Generator) -> NDArray[np.float32]:
    return (feature + 0.1 * random.normal(size=len(feature))).astype(np.float32)


def couch_with_suitcase(seed: int) -> list[HandView]:
    """Points 0-5: four views show all as ONE, two show 0-3 so; one shows all as OTHER, five show 4-5 so."""
    random = np.random.default_rng(seed)
    views: list[HandView] = [[([0, 1, 2, 3, 4, 5], noisy(ONE, random))] for _ in range(4)]
    views += [[([0, 1, 2, 3], noisy(ONE, random))] for _ in range(2)]
    views += [[([0, 1, 2, 3, 4, 5], noisy(OTHER, random))]]
    return [*views, *([([4, 5], noisy(OTHER, random))] for _ in range(5))]


@pytest.mark.parametrize("seed", range(5))
def test_points_take_the_look_that_more_of_their_votes_are_for(seed: int) -> None:
    views = couch_with_suitcase(seed)
    order = np.random.default_rng(seed).permutation(len(views))
    table = hand_table(7, [views[view] for view in order])
    ids = np.array([0, 0, 0, 0, 0, 0, -1], np.int32)
    looks = looks_of_groups(table, np.zeros(len(views), np.int32), ids, 1)
    np.testing.assert_array_equal(looks.group, [0, 0])
    first = looks.look[np.argsort(order)][0]
    np.testing.assert_array_equal(looks.look[np.argsort(order)], np.where(np.arange(len(views)) < 6, first, 1 - first))
    found = by_look(view_votes(table), ids, looks)
    np.testing.assert_array_equal(found, [first] * 4 + [1 - first] * 2 + [-1])


@pytest.mark.parametrize("seed", range(5))
def test_noise_and_few_wrong_masks_are_no_second_look(seed: int) -> None:
    """Features spread evenly, and three masks of twelve that say something else."""
    random = np.random.default_rng(seed)
    even = random.normal(size=(12, 128)) + np.tile(2 * ONE, 16)  # noise in few numbers is not even
    wrong = np.stack([noisy(OTHER if view < 3 else ONE, random) for view in range(12)])
    ids = np.zeros(2, np.int32)
    for features in (even, wrong):
        table = replace(hand_table(2, [[([0, 1], ONE)]] * 12), mask_features=features.astype(np.float32))
        looks = looks_of_groups(table, np.zeros(12, np.int32), ids, 1)
        np.testing.assert_array_equal(looks.group, [0])
        np.testing.assert_array_equal(by_look(view_votes(table), ids, looks), ids)


@pytest.mark.parametrize("seed", range(5))
def test_two_sides_of_a_thing_are_one_look_unless_all_things_are_as_alike(seed: int) -> None:
    """Six masks of the front, six of the back, of cosine 0.8; beside them, in each view, a mask of something else."""
    random = np.random.default_rng(seed)
    back = (0.8 * ONE + 0.6 * OTHER).astype(np.float32)
    for beside, count in ((np.roll(ONE, 2), 1), (back, 2)):
        views: list[HandView] = [
            [([0, 1], noisy(ONE if view < 6 else back, random)), ([2, 3], beside)] for view in range(12)
        ]
        group = np.tile(np.array([0, -1], np.int32), 12)
        looks = looks_of_groups(hand_table(4, views), group, np.array([0, 0, -1, -1], np.int32), 1)
        assert len(looks.group) == count


def test_masks_of_no_group_and_without_a_feature_keep_what_they_have() -> None:
    views = [*couch_with_suitcase(0), [([6], ONE)], [([0, 1], 0 * ONE)]]
    group = np.zeros(len(views), np.int32)
    group[-2] = -1
    table = hand_table(7, views)
    looks = looks_of_groups(table, group, np.array([0, 0, 0, 0, 0, 0, -1], np.int32), 1)
    assert looks.look[-2] == -1
    assert looks.look[-1] == 0
