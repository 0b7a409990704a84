"""The codebook: k-means against Lloyd's rule written out in float64, and what it does with hard input."""

from __future__ import annotations

import numba
import numpy as np
import pytest
from numpy.typing import NDArray

from og_pointcloud.codebook import kmeans, seed_centres
from og_pointcloud.errors import OgPointcloudError


def blobs(count: int = 4000, places: int = 12, width: int = 9, seed: int = 0, spread: float = 0.05):
    """Points around places, the place of each, and weights of which some are 0."""
    random = np.random.default_rng(seed)
    centres = random.normal(size=(places, width))
    place = random.integers(0, places, count)
    values = (centres[place] + spread * random.normal(size=(count, width))).astype(np.float32)
    return values, place, random.random(count) * (random.random(count) > 0.1)


def lloyd(values, weight, centres, rounds: int):
    """Weighted Lloyd as in a text book: every distance, in float64."""
    values, centres = values.astype(np.float64), centres.astype(np.float64)

    def nearest() -> NDArray[np.intp]:
        return ((values[:, None] - centres[None]) ** 2).sum(axis=2).argmin(axis=1)

    for _ in range(rounds):
        own = nearest()
        for cluster in range(len(centres)):
            mine = weight * (own == cluster)
            if mine.sum() > 0:
                centres[cluster] = mine @ values / mine.sum()
    return nearest(), centres


def spread(values, weight, own, centres) -> float:
    return float(weight @ ((values.astype(np.float64) - centres[own]) ** 2).sum(axis=1))


@pytest.mark.parametrize("rounds", [0, 1, 3, 25])
def test_kmeans_is_lloyds(rounds: int) -> None:
    values, _, weight = blobs(spread=0.6)
    start = values[:15]
    own, centres = kmeans(values, weight, start, rounds, reseed=False)
    expected_own, expected = lloyd(values, weight, start, rounds)
    np.testing.assert_allclose(centres, expected, atol=2e-6)
    assert (own != expected_own).mean() <= 1e-3  # a point halfway may fall to either side in float32
    assert own.dtype == np.int32
    assert centres.dtype == np.float32


def test_returned_centres_are_the_ones_assigned_to() -> None:
    values, _, weight = blobs(spread=0.8)
    own, centres = kmeans(values, weight, values[:15], 4, reseed=True)
    distance = ((values[:, None].astype(np.float64) - centres[None]) ** 2).sum(axis=2)
    assert (distance[np.arange(len(own)), own] <= distance.min(axis=1) + 1e-5).all()


def test_kmeans_stops_where_nothing_changes() -> None:
    values, _, weight = blobs()
    long, centres = kmeans(values, weight, values[:12], 500, reseed=True)
    once_more, same = kmeans(values, weight, centres, 1, reseed=True)
    np.testing.assert_array_equal(long, once_more)
    np.testing.assert_allclose(centres, same, atol=1e-6)


@pytest.mark.parametrize(("offset", "unit"), [(0.0, 2.0**-60), (0.0, 2.0**50), (4096.0, 1.0)])
def test_offset_and_unit_do_not_matter(offset: float, unit: float) -> None:
    values, _, weight = blobs()
    moved = (values * unit + offset).astype(np.float32)
    values = (moved.astype(np.float64) - offset).astype(np.float32)  # what is left of them at that offset
    own, centres = kmeans(values, weight, values[:12], 20, reseed=True)
    other, moved_centres = kmeans(moved, weight, moved[:12], 20, reseed=True)
    np.testing.assert_array_equal(own, other)
    np.testing.assert_allclose(moved_centres, centres + offset, rtol=1e-6)


def test_threads_do_not_matter() -> None:
    values, _, weight = blobs(20_000, spread=0.7)
    before = numba.get_num_threads()
    results = []
    for threads in (1, before):
        numba.set_num_threads(threads)
        results.append(kmeans(values, weight, values[:20], 30, reseed=True))
    numba.set_num_threads(before)
    np.testing.assert_array_equal(results[0][0], results[1][0])
    np.testing.assert_array_equal(results[0][1], results[1][1])


def test_weights_pull_and_zero_weights_do_not() -> None:
    values = np.array([[0.0], [1.0], [100.0]], np.float32)
    own, centres = kmeans(values, np.array([3.0, 1.0, 0.0]), np.array([[5.0]]), 9, reseed=True)
    np.testing.assert_allclose(centres, [[0.25]])
    np.testing.assert_array_equal(own, 0)


def test_empty_clusters_start_again_where_points_are_worst_represented() -> None:
    values, _, weight = blobs(places=6)
    far = np.full((6, 9), 50.0, np.float32)
    far[0] = values.mean(axis=0)
    own, centres = kmeans(values, weight, far, 50, reseed=True)
    assert len(np.unique(own[weight > 0])) == 6
    stuck, still = kmeans(values, weight, far, 50, reseed=False)
    assert len(np.unique(stuck)) == 1
    np.testing.assert_array_equal(still[1:], far[1:])
    assert spread(values, weight, own, centres) < 0.1 * spread(values, weight, stuck, still)


def test_more_centres_than_places() -> None:
    values = np.repeat(np.array([[1.0, 2.0], [3.0, 4.0]], np.float32), 5, axis=0)
    own, centres = kmeans(values, np.ones(10), np.zeros((7, 2)), 20, reseed=True)
    np.testing.assert_array_equal(centres[own], values)
    assert np.isfinite(centres).all()


@pytest.mark.parametrize("count", [0, 1])
def test_hardly_any_points(count: int) -> None:
    values = np.full((count, 3), 7, np.float32)
    own, centres = kmeans(values, np.ones(count), np.zeros((2, 3)), 5, reseed=True)
    assert own.shape == (count,)
    assert centres.shape == (2, 3)
    np.testing.assert_array_equal(centres[own], values)


def test_bad_input_is_refused() -> None:
    values, weight = np.zeros((4, 3), np.float32), np.ones(4)
    with pytest.raises(OgPointcloudError, match="0 centres"):
        kmeans(values, weight, np.zeros((0, 3)), 5, reseed=True)
    with pytest.raises(OgPointcloudError, match="do not fit"):
        kmeans(values, weight, np.zeros((2, 4)), 5, reseed=True)
    with pytest.raises(OgPointcloudError, match="finite"):
        kmeans(np.full((4, 3), np.nan, np.float32), weight, np.zeros((2, 3)), 5, reseed=True)


def test_seeds_lie_in_different_places() -> None:
    values, place, weight = blobs(places=12)
    for seed in range(5):
        seeds = seed_centres(values, weight, 12, np.random.default_rng(seed))
        rows = [int(np.flatnonzero((values == row).all(axis=1))[0]) for row in seeds]
        assert len(np.unique(place[rows])) >= 10
        assert (weight[rows] > 0).all()


def test_seeds_of_few_places_are_few() -> None:
    values = np.repeat(np.array([[1.0, 2.0], [3.0, 4.0]], np.float32), 5, axis=0)
    random = np.random.default_rng(0)
    assert seed_centres(values, np.ones(10), 7, random).shape == (2, 2)
    assert seed_centres(values, np.zeros(10), 7, random).shape == (0, 2)
    assert seed_centres(values[:0], np.zeros(0), 7, random).shape == (0, 2)
