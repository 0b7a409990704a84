"""The codebook: k-means against Lloyd's rule in float64, and two levels on things whose clusters are known."""

from __future__ import annotations

import numba
import numpy as np
import pytest
from numpy.typing import NDArray
from test_grouping import ONE, hand_table

from og_pointcloud.fitting.learned.codebook import (
    Codebook,
    kmeans,
    seed_centers,
    thing_count,
    things_together,
    two_level_codebook,
)
from og_pointcloud.fitting.mask_table import weights_by_instance
from og_pointcloud.settings import CodebookSettings

DEFAULTS = CodebookSettings()


def blobs(count: int = 4000, places: int = 12, width: int = 9, seed: int = 0, spread: float = 0.05):
    """Points around places, the place of each, and weights of which some are 0."""
    random = np.random.default_rng(seed)
    centers = random.normal(size=(places, width))
    place = random.integers(0, places, count)
    values = (centers[place] + spread * random.normal(size=(count, width))).astype(np.float32)
    return values, place, random.random(count) * (random.random(count) > 0.1)


def lloyd(values, weight, centers, rounds: int):
    """Weighted Lloyd as in a text book: every distance, in float64."""
    values, centers = values.astype(np.float64), centers.astype(np.float64)

    def nearest() -> NDArray[np.intp]:
        return ((values[:, None] - centers[None]) ** 2).sum(axis=2).argmin(axis=1)

    for _ in range(rounds):
        own = nearest()
        for cluster in range(len(centers)):
            mine = weight * (own == cluster)
            if mine.sum() > 0:
                centers[cluster] = mine @ values / mine.sum()
    return nearest(), centers


@pytest.mark.parametrize("rounds", [0, 1, 3, 25])
def test_kmeans_is_lloyds(rounds: int) -> None:
    values, _, weight = blobs(spread=0.6)
    start = values[:15]
    own, centers = kmeans(values, weight, start, rounds)
    expected_own, expected = lloyd(values, weight, start, rounds)
    np.testing.assert_allclose(centers, expected, atol=2e-6)
    assert (own != expected_own).mean() <= 1e-3  # a point halfway may fall to either side in float32
    assert own.dtype == np.int32
    assert centers.dtype == np.float32


@pytest.mark.parametrize(("offset", "unit"), [(0.0, 2.0**-60), (0.0, 2.0**50), (4096.0, 1.0)])
def test_offset_and_unit_do_not_matter(offset: float, unit: float) -> None:
    values, _, weight = blobs()
    moved = (values * unit + offset).astype(np.float32)
    values = (moved.astype(np.float64) - offset).astype(np.float32)  # what is left of them at that offset
    own, centers = kmeans(values, weight, values[:12], 20)
    other, moved_centers = kmeans(moved, weight, moved[:12], 20)
    np.testing.assert_array_equal(own, other)
    np.testing.assert_allclose(moved_centers, centers + offset, rtol=1e-6)


def test_threads_do_not_matter() -> None:
    values, _, weight = blobs(20_000, spread=0.7)
    before = numba.get_num_threads()
    results = []
    for threads in (1, before):
        numba.set_num_threads(threads)
        results.append(kmeans(values, weight, values[:20], 30))
    numba.set_num_threads(before)
    np.testing.assert_array_equal(results[0][0], results[1][0])
    np.testing.assert_array_equal(results[0][1], results[1][1])


def test_more_centers_than_places() -> None:
    values = np.repeat(np.array([[1.0, 2.0], [3.0, 4.0]], np.float32), 5, axis=0)
    own, centers = kmeans(values, np.ones(10), np.zeros((7, 2)), 20)
    np.testing.assert_array_equal(centers[own], values)
    assert np.isfinite(centers).all()


@pytest.mark.parametrize("count", [0, 1])
def test_hardly_any_points(count: int) -> None:
    values = np.full((count, 3), 7, np.float32)
    own, centers = kmeans(values, np.ones(count), np.zeros((2, 3)), 5)
    assert own.shape == (count,)
    assert centers.shape == (2, 3)
    np.testing.assert_array_equal(centers[own], values)


def test_seeds_lie_in_different_places() -> None:
    values, place, weight = blobs(places=12)
    for seed in range(5):
        seeds = seed_centers(values, weight, 12, np.random.default_rng(seed))
        rows = [int(np.flatnonzero((values == row).all(axis=1))[0]) for row in seeds]
        assert len(np.unique(place[rows])) >= 10
        assert (weight[rows] > 0).all()


def test_seeds_of_few_places_are_few() -> None:
    values = np.repeat(np.array([[1.0, 2.0], [3.0, 4.0]], np.float32), 5, axis=0)
    random = np.random.default_rng(0)
    assert seed_centers(values, np.ones(10), 7, random).shape == (2, 2)
    assert seed_centers(values, np.zeros(10), 7, random).shape == (0, 2)
    assert seed_centers(values[:0], np.zeros(0), 7, random).shape == (0, 2)


def room(seed: int = 0, points_each: int = 120, views: int = 6):
    """Eight things in two corners, four in each, never seen together: things 0 and 4, 1 and 5, ... share a feature.

    Returns features (n, 6), positions (n, 3), the thing of each point, and a table of half the views in either corner.
    """
    random = np.random.default_rng(seed)
    thing = np.repeat(np.arange(8), points_each)
    features = np.eye(6)[thing % 4] + 0.05 * random.normal(size=(len(thing), 6))
    corner = thing // 4
    xyz = 10.0 * corner[:, None] + random.random((len(thing), 3))
    seen = [[(np.flatnonzero(thing == 4 * (view % 2) + k), ONE) for k in range(4)] for view in range(views)]
    unseen = [np.flatnonzero(corner != view % 2) for view in range(views)]
    table = hand_table(len(thing), seen, unseen)
    return features.astype(np.float32), xyz.astype(np.float32), thing, table


def same_partition(labels: NDArray[np.int32], truth: NDArray[np.int64]) -> bool:
    pairs = np.unique(np.stack([labels, truth]), axis=1)
    return len(np.unique(labels)) == len(np.unique(truth)) == pairs.shape[1]


def build(settings: CodebookSettings = DEFAULTS, seed: int = 0, **changes) -> Codebook:
    features, xyz, thing, table = room()
    given = {"features": features, "xyz": xyz, "weight": np.ones(len(thing)), "table": table} | changes
    return two_level_codebook(given["features"], given["xyz"], given["weight"], given["table"], settings, seed)


def test_as_many_things_as_the_masks_show() -> None:
    _, _, _, table = room()
    assert thing_count(table) == 8
    assert thing_count(room(views=14)[3]) == 8
    assert thing_count(hand_table(5, [[(range(5), ONE)]] * 9)) == 1
    assert thing_count(hand_table(5, [[], []])) == 1


def test_masks_of_one_view_are_counted_in_each_cluster() -> None:
    _, _, thing, table = room()
    np.testing.assert_array_equal(things_together(table, (thing // 4).astype(np.int32), 2, DEFAULTS), [4, 4])
    np.testing.assert_array_equal(things_together(table, thing.astype(np.int32), 9, DEFAULTS), [1] * 9)


def test_a_sliver_of_a_mask_is_no_thing_in_a_cluster() -> None:
    table = hand_table(100, [[(range(52), ONE), (range(52, 100), ONE)]] * 3)
    halves = np.repeat([0, 1], 50).astype(np.int32)
    np.testing.assert_array_equal(things_together(table, halves, 2, DEFAULTS), [1, 1])


def test_a_few_torn_views_are_outvoted() -> None:
    whole, torn = [(range(100), ONE)], [(range(50), ONE), (range(50, 100), ONE)]
    everything = np.zeros(100, np.int32)
    assert things_together(hand_table(100, [whole] * 9 + [torn]), everything, 1, DEFAULTS) == [1]
    assert things_together(hand_table(100, [whole] + [torn] * 9), everything, 1, DEFAULTS) == [2]


@pytest.mark.parametrize("seed", range(5))
def test_the_scene_says_how_many_clusters(seed: int) -> None:
    _, _, thing, _ = room()
    codebook = build(seed=seed)
    assert same_partition(codebook.leaf, thing)
    assert codebook.coarse_count == len(codebook.leaf_centers) == 8


def test_fine_clusters_part_what_coarse_ones_hold_together() -> None:
    _, _, thing, _ = room()
    codebook = build(CodebookSettings(k1=2, position_weight=5.0))
    assert same_partition(codebook.leaf_coarse[codebook.leaf], thing // 4)
    assert same_partition(codebook.leaf, thing)
    assert codebook.coarse_count == 2
    assert (np.diff(codebook.leaf_coarse) >= 0).all()
    alone = build(CodebookSettings(k1=2, position_weight=5.0, k2=1))
    assert len(alone.leaf_centers) == 2
    at_most_three = build(CodebookSettings(k1=2, position_weight=5.0, k2=3))
    np.testing.assert_array_equal(at_most_three.leaf_coarse, [0, 0, 0, 1, 1, 1])


def test_without_positions_things_never_seen_together_fall_into_one() -> None:
    """The paper's first challenge of one codebook (Sec. 3.2)."""
    _, _, thing, _ = room()
    codebook = build(CodebookSettings(position_weight=0.0, k1=4))
    assert same_partition(codebook.leaf, thing % 4)


def test_centers_are_weighted_means() -> None:
    features, _, thing, _ = room()
    weight = np.random.default_rng(3).random(len(thing))
    codebook = build(weight=weight)
    for leaf in range(len(codebook.leaf_centers)):
        mine = codebook.leaf == leaf
        expected = np.average(features[mine].astype(np.float64), axis=0, weights=weight[mine])
        np.testing.assert_allclose(codebook.leaf_centers[leaf], expected, rtol=1e-5, atol=1e-6)


def test_points_without_weight_have_no_cluster() -> None:
    _, _, thing, _ = room()
    weight = (thing != 3).astype(np.float64)
    codebook = build(weight=weight)
    np.testing.assert_array_equal(codebook.leaf[thing == 3], -1)
    assert (codebook.leaf[thing != 3] >= 0).all()


def test_unit_and_place_of_the_scene_do_not_matter() -> None:
    _, xyz, _, _ = room()
    one = build()
    np.testing.assert_array_equal(build(xyz=1000 * xyz + 50_000).leaf, one.leaf)


def test_outliers_do_not_set_the_extent() -> None:
    _, xyz, thing, _ = room()
    xyz[[5, 700]] = [[1e5, 0, 0], [0, -1e5, 0]]
    codebook = build(CodebookSettings(k2=1), xyz=xyz)
    plain = np.ones(len(thing), bool)
    plain[[5, 700]] = False
    assert same_partition(codebook.leaf[plain], thing[plain])


@pytest.mark.filterwarnings("ignore:overflow")
def test_positions_may_outweigh_features_by_any_factor() -> None:
    """Squares of 1e30 are infinite in float32: no start is then better than another, and one must be taken."""
    _, _, thing, _ = room()
    codebook = build(CodebookSettings(k1=2, k2=1, position_weight=1e30))
    assert same_partition(codebook.leaf, thing // 4)


@pytest.mark.parametrize("count", [0, 1, 3])
@pytest.mark.parametrize("settings", [DEFAULTS, CodebookSettings(k1=64, k2=5), CodebookSettings(position_weight=0.0)])
def test_hardly_any_points_for_two_levels(count: int, settings: CodebookSettings) -> None:
    """Coincident points in one mask; with 0 of them, nothing takes part."""
    table = hand_table(3, [[(range(3), ONE)]] * 2)
    weight = (np.arange(3) < count).astype(np.float64)
    codebook = two_level_codebook(np.ones((3, 6), np.float32), np.ones((3, 3), np.float32), weight, table, settings)
    np.testing.assert_array_equal(codebook.leaf, np.where(weight > 0, 0, -1))
    assert len(codebook.leaf_centers) == codebook.coarse_count == min(count, 1)


def test_weights_by_instance_are_a_product_with_indicators() -> None:
    _, _, _, table = room()
    cluster = np.random.default_rng(0).integers(-1, 5, table.weights.shape[1]).astype(np.int32)
    onehot = (cluster[:, None] == np.arange(5)).astype(float)
    np.testing.assert_allclose(weights_by_instance(table.weights, cluster, 5), table.weights.toarray() @ onehot)
