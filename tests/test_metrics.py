"""Scores against numbers worked out by hand and against the scoring script of the shared data."""

import math
import runpy
from pathlib import Path

import numpy as np
import pytest

from og_pointcloud.errors import OgPointcloudError
from og_pointcloud.evaluate.metrics import adjusted_rand_index, score_labels

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


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
    with pytest.raises(OgPointcloudError, match=r"truth has shape \(3,\)"):
        score_labels(np.zeros(4, int), np.zeros(3, int))
    with pytest.raises(OgPointcloudError, match=r"\(4,\) and \(3,\)"):
        adjusted_rand_index(np.zeros(4, int), np.zeros(3, int))


@pytest.mark.parametrize("folder", ["apc_shelf_B", "seven_redkitchen", "ycb_0050", "nuscenes_frame"])
def test_same_score_as_the_shared_script(folder):
    if not (DATA / "score.py").exists() or not (DATA / folder).exists():
        pytest.skip(f"{DATA / folder} is absent")
    reference = runpy.run_path(str(DATA / "score.py"))["score"]
    truth = np.load(DATA / folder / "gt.npz")
    cls = truth["cls"]
    rng = np.random.default_rng(5)
    labels = np.where(rng.uniform(size=len(cls)) < 0.7, cls, rng.integers(-1, len(truth["names"]), len(cls)))
    scored = np.ones(len(cls), bool)
    if "views" in truth:
        scored &= truth["views"] > 0
    if "ratio" in truth:
        scored &= (truth["ratio"] >= 0.5) & (truth["votes"] >= 2)
    background = truth.get("background")
    ours, theirs = score_labels(labels, cls, background=background, scored=scored), reference(labels, DATA / folder)
    assert ours.miou == pytest.approx(theirs["miou"], abs=6e-5)
    assert ours.macc == pytest.approx(theirs["macc"], abs=6e-5)
    assert ours.unknown_share == pytest.approx(theirs["unknown"], abs=6e-5)
    assert (len(ours.classes), ours.points) == (theirs["classes"], theirs["points"])
    if "background_called" in theirs:
        assert ours.background_called == pytest.approx(theirs["background_called"], abs=6e-5)


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
