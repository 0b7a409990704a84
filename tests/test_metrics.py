"""Scores against numbers worked out by hand."""

import math

import numpy as np
import pytest

from og_pointcloud.errors import OgPointcloudError
from og_pointcloud.evaluate.metrics import adjusted_rand_index, matched_shares, score_labels


def test_score_by_hand():
    #           two of three hit | one of two hit | background: one false alarm | ambiguous
    truth = np.array([0, 0, 0, 1, 1, -1, -1, -1])
    labels = np.array([0, 0, -1, 1, 0, 1, -1, 0])
    background = np.array([False] * 5 + [True, True, False])
    score = score_labels(labels, truth, background=background, min_points=1)
    assert score.classes == (0, 1)
    # class 0: called at 0, 1, 4 (7 is not scored), true at 0, 1, 2; class 1: called at 3, 5, true at 3, 4
    assert score.class_iou == pytest.approx((2 / 4, 1 / 3))
    assert score.class_accuracy == pytest.approx((2 / 3, 1 / 2))
    assert score.miou == pytest.approx((2 / 4 + 1 / 3) / 2)
    assert score.macc == pytest.approx((2 / 3 + 1 / 2) / 2)
    assert score.unknown_share == pytest.approx(1 / 5)
    assert score.background_called == pytest.approx(1 / 2)
    assert score.points == 5


def test_rare_classes_and_unscored_points_say_nothing():
    truth = np.repeat([0, 1, 2], [40, 29, 60])
    scored = np.ones(len(truth), bool)
    scored[-35:] = False
    labels = np.where(truth == 1, 0, truth)
    score = score_labels(labels, truth, scored=scored)
    assert score.classes == (0,)
    assert score.miou == 1.0, "points of a class that is left out are not false positives of another"
    assert score.points == 40
    assert score.background_called is None


def test_nothing_to_score_is_nan():
    score = score_labels(np.full(5, -1), np.full(5, -1))
    assert math.isnan(score.miou)
    assert math.isnan(score.unknown_share)
    assert score.points == 0


def test_arrays_of_other_lengths_are_refused():
    with pytest.raises(OgPointcloudError, match=r"truth is \(3,\)"):
        score_labels(np.zeros(4, int), np.zeros(3, int))
    with pytest.raises(OgPointcloudError, match=r"\(4,\) and \(3,\)"):
        adjusted_rand_index(np.zeros(4, int), np.zeros(3, int))


def test_adjusted_rand_index_counts_pairs():
    rng = np.random.default_rng(3)
    first, second = rng.integers(0, 4, 60), rng.integers(-1, 3, 60)
    same_first, same_second = first[:, None] == first, second[:, None] == second
    upper = np.triu_indices(60, 1)
    a, b, both = same_first[upper].sum(), same_second[upper].sum(), (same_first & same_second)[upper].sum()
    expected = a * b / len(upper[0])
    assert adjusted_rand_index(first, second) == pytest.approx((both - expected) / ((a + b) / 2 - expected))


def test_adjusted_rand_index_of_equal_partitions_is_one():
    ids = np.array([0, 0, 1, 2, 2, 2])
    assert adjusted_rand_index(ids, 7 - 3 * ids) == pytest.approx(1.0)
    assert adjusted_rand_index(np.zeros(4, int), np.zeros(4, int)) == 1.0
    assert math.isnan(adjusted_rand_index(ids[:0], ids[:0]))


@pytest.mark.parametrize(
    ("ids", "things", "expected"),
    [
        ([0] * 4 + [1] * 4, [5] * 4 + [3] * 4, (1, 1)),  # whatever the numbers
        ([0] * 8, [0] * 4 + [1] * 4, (0, 0)),  # half of each is no match
        ([0] * 8, [0] * 5 + [1] * 3, (0.5, 1)),
        ([0] * 3 + [1] * 5, [0] * 8, (1, 0.5)),  # a piece beside it
        ([0] * 3 + [-1] * 5, [0] * 4 + [-1] * 4, (1, 1)),
        ([0] * 8, [0] * 4 + [-1] * 4, (0, 0)),  # background counts in the union
        ([0] * 4 + [1], [0] * 4 + [1], (1, 1)),  # the small ones are not asked for
        ([-1, -2], [-1, -1], (np.nan, np.nan)),
    ],
)
def test_instances_match_things_with_more_than_half_of_their_union(
    ids: list[int], things: list[int], expected: tuple[float, float]
):
    assert matched_shares(np.array(ids), np.array(things), min_points=2) == pytest.approx(expected, nan_ok=True)


def test_matched_shares_are_those_of_the_literal_reference():
    random = np.random.default_rng(0)
    things = random.integers(-1, 6, 400)
    ids = np.where(random.uniform(size=400) < 0.6, 5 - np.maximum(things, -1), random.integers(-2, 9, 400))
    sets = [{int(key): set(np.flatnonzero(part == key)) for key in set(part) - {-1, -2}} for part in (ids, things)]
    large = [[points for points in of.values() if len(points) >= 20] for of in sets]
    shares = []
    for asked, others in ((large[1], sets[0]), (large[0], sets[1])):
        best = [max(len(one & other) / len(one | other) for other in others.values()) for one in asked]
        shares.append(np.mean([iou > 0.5 for iou in best]))
    assert matched_shares(ids, things, min_points=20) == pytest.approx(shares)
    assert 0 < shares[1] < shares[0] < 1
