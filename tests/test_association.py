"""Feature rows of instances: means weighted by what masks show, without outliers."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from test_grouping import ONE, OTHER, HandView, hand_table

from og_pointcloud.cloud import BACKGROUND, UNOBSERVED, InstanceTable
from og_pointcloud.fitting.association import describe_instances

FOURTH = np.eye(8, dtype=np.float32)[5]


def describe(views: list[HandView], group: list[int], ids: list[int]) -> InstanceTable:
    table = hand_table(len(ids), views)
    count = max([*ids, -1]) + 1
    return describe_instances(table, np.array(group, np.int32), np.array(ids, np.int32), count)


def unit(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    return vector / np.linalg.norm(vector)


def test_a_row_is_the_mean_weighted_by_the_cube_root_of_what_masks_show_of_the_instance() -> None:
    """Masks show 3 and 1 of the instance's points: the roots of these count, nothing else that they cover, nor a
    feature's length."""
    views: list[HandView] = [[([0, 1, 2], 5 * ONE)], [([2, 3, 4, 5], 0.1 * OTHER)]]
    result = describe(views, [0, 0], [0, 0, 0, BACKGROUND, BACKGROUND, UNOBSERVED])
    root = np.cbrt(3)
    np.testing.assert_allclose(result.descriptors, [unit(root * ONE + OTHER)], rtol=1e-6)
    assert result.descriptors.dtype == np.float32
    np.testing.assert_allclose(result.agreement, (root * root + 1) / (root + 1) / np.sqrt(root**2 + 1), rtol=1e-6)


def test_evidence_is_counted() -> None:
    views: list[HandView] = [
        [([0, 1], ONE), ([2, 3], OTHER)],
        [([0], ONE), ([1], ONE), ([2, 3, 4], OTHER)],
        [([0, 1, 4], ONE)],
    ]
    result = describe(views, [0, 1, 0, 0, 1, -1], [0, 0, 1, 1, BACKGROUND])
    np.testing.assert_array_equal(result.points, [2, 2])
    np.testing.assert_array_equal(result.masks, [3, 2])
    np.testing.assert_array_equal(result.views, [2, 2])
    np.testing.assert_allclose(result.visible_area, [4, 4])
    np.testing.assert_array_equal(result.descriptor_instance, [0, 1])
    np.testing.assert_allclose(result.agreement, 1, rtol=1e-6)
    assert len(result) == 2


@pytest.mark.parametrize(("kinds", "clear"), [((4, 2, 2), True), ((2, 4, 2), True), ((3, 2, 2), False)])
def test_masks_that_name_a_thing_in_several_ways_leave_it_what_clearly_most_of_them_say(
    kinds: tuple[int, ...], clear: bool
) -> None:
    """Four masks to two and two describe it alone: no two of the kinds are one. Three say too little, and all do."""
    random = np.random.default_rng(0)
    looks = np.repeat(np.eye(8)[:3], kinds, axis=0)
    views: list[HandView] = [
        [([0, 1], (look + 0.05 * random.normal(size=8)).astype(np.float32)), ([2, 3], FOURTH)] for look in looks
    ]
    result = describe(views, [0, 1] * len(looks), [0, 0, 1, 1])
    cosines = result.descriptors[0][:3]
    assert cosines.argmax() == np.argmax(kinds)
    assert (cosines.max() > 0.98) == clear
    assert (np.sort(cosines)[0] > 0.3) != clear
    np.testing.assert_array_equal(result.masks, [len(looks)] * 2)  # all stay evidence of the instance


def test_names_of_a_thing_that_looks_like_itself_all_the_same_are_kinds() -> None:
    """Cosines: 1 of masks of a thing with one name, 0.54 of different things, 0.8 of one thing with two names, as it
    still looks like itself. That is beyond the middle, 0.77, but not beyond two thirds, 0.85."""
    axes = np.eye(8)
    common, look, others = np.sqrt(0.54) * axes[0], np.sqrt(0.26) * axes[1], np.sqrt(0.46) * axes[2:4]
    wall, cabinet, picture = (common + look + np.sqrt(0.2) * axis for axis in axes[4:7])
    views: list[HandView] = [
        [([0], name.astype(np.float32)), *(([k + 1], (common + others[k]).astype(np.float32)) for k in range(2))]
        for name in [wall] * 6 + [cabinet] * 3 + [picture] * 3
    ]
    result = describe(views, [0, 1, 2] * len(views), [0, 1, 2])
    np.testing.assert_allclose(result.descriptors[0], wall, atol=1e-6)


def test_an_outlier_is_left_out() -> None:
    random = np.random.default_rng(0)
    near = [(ONE + 0.02 * random.normal(size=8)).astype(np.float32) for _ in range(9)]
    views: list[HandView] = [[([0, 1], feature)] for feature in [*near, OTHER]]
    result = describe(views, [0] * 10, [0, 0])
    without = describe(views[:9], [0] * 9, [0, 0])
    np.testing.assert_allclose(result.descriptors, without.descriptors, atol=5e-3)
    assert abs(result.descriptors[0] @ OTHER) < 0.03
    assert result.agreement[0] > 0.99
    assert result.masks[0] == 10  # still evidence of the instance


def test_masks_that_agree_exactly_are_all_kept() -> None:
    result = describe([[([0], ONE)]] * 5, [0] * 5, [0])
    np.testing.assert_allclose(result.descriptors, [ONE])
    assert result.agreement[0] == pytest.approx(1)


def test_masks_without_a_feature_are_evidence_but_not_in_the_row() -> None:
    nothing = np.zeros(8, np.float32)
    result = describe([[([0, 1], nothing)], [([0, 1], ONE)]], [0, 0], [0, 0])
    np.testing.assert_allclose(result.descriptors, [ONE])
    assert result.masks[0] == 2
    assert result.visible_area[0] == 4
    assert result.agreement[0] == pytest.approx(1)


def test_an_instance_without_any_feature_has_no_row() -> None:
    nothing = np.zeros(8, np.float32)
    result = describe([[([0], nothing), ([1], ONE)]] * 2, [0, 1, 0, 1], [0, 1])
    np.testing.assert_array_equal(result.descriptor_instance, [1])
    assert result.agreement[0] == 0
    assert len(result) == 2


def test_features_that_cancel_give_no_row() -> None:
    result = describe([[([0], ONE)], [([0], -ONE)]], [0, 0], [0])
    assert len(result.descriptors) == 0
    assert np.isfinite(result.agreement).all()


def test_an_instance_whose_masks_show_none_of_its_points_has_no_row() -> None:
    result = describe([[([0], ONE)]], [0], [BACKGROUND, 0])
    assert len(result.descriptors) == 0
    assert result.visible_area[0] == 0


def test_no_instance() -> None:
    result = describe([[([0], ONE)]], [-1], [BACKGROUND, UNOBSERVED])
    assert len(result) == 0
    assert result.descriptors.shape == (0, 8)


def test_order_of_masks_does_not_matter() -> None:
    random = np.random.default_rng(0)
    views: list[HandView] = [
        [(range(3), random.normal(size=8).astype(np.float32)), (range(3, 6), random.normal(size=8).astype(np.float32))]
        for _ in range(7)
    ]
    ids = [0, 0, 0, 1, 1, 1]
    plain = describe(views, [0, 1] * 7, ids)
    swapped = describe([view[::-1] for view in views[::-1]], [1, 0] * 7, ids)
    np.testing.assert_allclose(swapped.descriptors, plain.descriptors, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(swapped.agreement, plain.agreement, rtol=1e-5)
