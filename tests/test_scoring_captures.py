"""Scores of a capture against its own truth: by hand, by the slow way, and by what must not change them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from labelled_clouds import make_cloud, unit_rows

from og_pointcloud.ask.labelled_scene import LabelledScene
from og_pointcloud.errors import OgPointcloudError, SceneError
from og_pointcloud.evaluate import intervals
from og_pointcloud.evaluate.captures import Answer, ask, score_capture
from og_pointcloud.evaluate.intervals import bootstrap, miou_interval
from og_pointcloud.evaluate.metrics import score_labels
from og_pointcloud.evaluate.truth import Truth, read_truth

NAMES = ("cup", "pot")


def truth_of(cls, background=None, instance=None, scored=None):
    cls = np.asarray(cls)
    return Truth(cls, NAMES, np.ones(len(cls), bool) if scored is None else scored, background, instance)


def far_apart(count):
    """Places of which no two share a cube of any size that is tried but the last."""
    return np.arange(count)[:, None] * np.array([1e4, 0, 0])


# Truth ----------------------------------------------------------------------------------------------------------


def test_a_word_that_the_truth_lacks_is_a_wrong_answer():
    truth = truth_of([0] * 30 + [1] * 30)
    labels = np.repeat([0, 1, -1], [30, 15, 15])  # of the words pot and lamp: all cups are called pots
    score = truth.score(truth.class_of(labels, ("pot", "lamp")))
    assert score.class_iou == (0.0, 0.0)
    assert score.unknown_share == 15 / 60
    with pytest.raises(SceneError, match=r"59 labels for 60 points of gt\.npz"):
        truth.score(labels[:-1])


@pytest.mark.parametrize("kind", [np.uint8, np.uint32, np.uint64])
def test_classes_may_be_unsigned(tmp_path, kind):
    cls = np.arange(60) // 30
    np.savez(tmp_path / "gt.npz", cls=cls.astype(kind), names=np.array(["cup", "pot"]), instance=cls.astype(kind))
    truth = read_truth(tmp_path)
    assert (truth.cls - 2).min() == (truth.instance - 2).min() == -2, "below 0 is none: unsigned numbers have no such"
    assert truth.score(truth.class_of(cls, ("cup", "pot"))).miou == 1
    np.savez(tmp_path / "gt.npz", cls=(cls + 1).astype(kind), names=np.array(["cup", "pot"]))
    with pytest.raises(SceneError, match=r"up to 2, names .* expected whole numbers"):
        read_truth(tmp_path)


def test_a_class_is_named_once(tmp_path):
    np.savez(tmp_path / "gt.npz", cls=np.array([0, 1, 2]), names=np.array(["cup", "cup", "pot"]))
    with pytest.raises(SceneError, match="a name occurs twice in names; expected each class once"):
        read_truth(tmp_path)


def test_instances_of_the_truth_are_read_and_checked(tmp_path):
    entries = {"cls": np.array([0, 1]), "names": np.array(NAMES)}
    np.savez(tmp_path / "gt.npz", **entries)
    assert read_truth(tmp_path).instance is None
    np.savez(tmp_path / "gt.npz", **entries, instance=np.array([7, -1]))
    assert read_truth(tmp_path).instance.tolist() == [7, -1]
    np.savez(tmp_path / "gt.npz", **entries, instance=np.array([0.5, 1]))
    with pytest.raises(SceneError, match="instance is float64"):
        read_truth(tmp_path)
    np.savez(tmp_path / "gt.npz", **entries, instance=np.array([1, 2, 3]))
    with pytest.raises(SceneError, match=r"instance has shape \(3,\)"):
        read_truth(tmp_path)


# Intervals ------------------------------------------------------------------------------------------------------


def test_an_interval_is_as_wide_as_the_standard_error_says():
    hard = np.random.default_rng(1).uniform(0, 1, 40)
    alone = bootstrap(hard)
    # The standard error of a mean is deviation / root n; 95 % lie within 1.96 of them.
    assert (alone.high - alone.low) / 2 == pytest.approx(1.96 * hard.std() / np.sqrt(40), rel=0.1)
    assert bootstrap(hard) == alone
    assert bootstrap(np.array([0.5, np.nan])) == bootstrap(np.array([0.5]))
    with pytest.raises(OgPointcloudError, match="no finite score"):
        bootstrap(np.array([np.nan]))


def test_the_mean_of_an_interval_is_the_score():
    rng = np.random.default_rng(0)
    cls, called = rng.integers(-1, 2, 4000), rng.integers(-1, 3, 4000)
    background = (cls < 0) & (rng.random(4000) < 0.5)
    truth = truth_of(cls, background, scored=rng.random(4000) < 0.9)
    score = score_labels(called, cls, scored=truth.scored, background=background)
    interval = miou_interval(called, truth, rng.random((4000, 3)), 0.02, score.classes)
    assert interval.mean == pytest.approx(score.miou, abs=1e-12)
    assert interval.low < interval.mean < interval.high


def test_alone_in_their_cubes_points_are_drawn_as_items():
    """One class, nothing called elsewhere: the IoU is the share of right points, whose bootstrap is known."""
    right = np.random.default_rng(1).random(60) < 0.7
    truth = truth_of(np.zeros(60, int))
    called = np.where(right, 0, -1)
    found = miou_interval(called, truth, far_apart(60), 1.0, (0,))
    known = bootstrap(right.astype(float))
    assert found.mean == known.mean
    assert (found.low, found.high) == pytest.approx((known.low, known.high), abs=0.02)


def test_more_points_of_the_same_things_say_nothing_new():
    """A hundred points in each place, all as right as the one before: an interval over points would be ten times
    narrower."""
    right = np.random.default_rng(1).random(60) < 0.7
    one = miou_interval(np.where(right, 0, -1), truth_of(np.zeros(60, int)), far_apart(60), 1.0, (0,))
    many = np.repeat(np.where(right, 0, -1), 100)
    again = miou_interval(many, truth_of(np.zeros(6000, int)), far_apart(60).repeat(100, axis=0), 1.0, (0,))
    assert again == one
    assert bootstrap((many == 0).astype(float)).high - again.mean < (again.high - again.mean) / 5


def test_cubes_grow_to_hold_what_errs_together():
    """Patches of 32 spacings are right or wrong as a whole: smaller cubes would call the score surer than it is."""
    rng = np.random.default_rng(2)
    side = np.arange(256) + 0.5
    xyz = np.stack([*np.meshgrid(side, side), np.zeros((256, 256))], axis=-1).reshape(-1, 3)
    patch = (xyz[:, 1] // 32 * 8 + xyz[:, 0] // 32).astype(int)
    called = np.where(rng.random(64) < 0.6, 0, -1)[patch]
    found = miou_interval(called, truth_of(np.zeros(len(xyz), int)), xyz, 1.0, (0,))
    expected = bootstrap((called.reshape(256, 256)[16::32, 16::32] == 0).astype(float).ravel())
    assert found.edge == 32
    assert found.blocks == 64
    assert (found.low, found.high) == pytest.approx((expected.low, expected.high), abs=0.02)


def test_scale_place_and_order_do_not_matter():
    rng = np.random.default_rng(3)
    xyz, cls = rng.random((5000, 3)).astype(np.float32), rng.integers(0, 2, 5000)
    called = np.where(rng.random(5000) < 0.8, cls, 1 - cls)
    order = rng.permutation(5000)
    found = miou_interval(called, truth_of(cls), xyz, 0.02, (0, 1))
    assert miou_interval(called[order], truth_of(cls[order]), xyz[order], 0.02, (0, 1)) == found
    large = miou_interval(called, truth_of(cls), xyz * 1024, 0.02 * 1024, (0, 1))
    assert (large.low, large.high, large.blocks) == (found.low, found.high, found.blocks)


def test_a_difference_is_paired():
    rng = np.random.default_rng(4)
    truth = truth_of(np.zeros(200, int))
    worse = rng.random(200) < 0.5
    better = worse | (rng.random(200) < 0.1)
    first, second = np.where(better, 0, -1), np.where(worse, 0, -1)
    found = miou_interval(first, truth, far_apart(200), 1.0, (0,), less=second)
    known = bootstrap(better.astype(float) - worse)
    assert found.mean == pytest.approx(known.mean)
    assert (found.low, found.high) == pytest.approx((known.low, known.high), abs=0.01)
    assert found.low > 0
    alone = miou_interval(first, truth, far_apart(200), 1.0, (0,))
    assert found.high - found.low < (alone.high - alone.low) / 1.5
    same = miou_interval(first, truth, far_apart(200), 1.0, (0,), less=first)
    assert (same.mean, same.low, same.high) == (0, 0, 0)


def test_draws_in_parts_are_draws(monkeypatch):
    right = np.random.default_rng(1).random(60) < 0.7
    arguments = (np.where(right, 0, -1), truth_of(np.zeros(60, int)), far_apart(60), 1.0, (0,))
    whole = miou_interval(*arguments)
    monkeypatch.setattr(intervals, "NUMBERS_PER_CHUNK", 600)
    assert miou_interval(*arguments) == whole


def test_points_in_one_place_are_one_block():
    """Copies of one point say nothing new: no draw differs from another."""
    rng = np.random.default_rng(5)
    called, truth = rng.integers(-1, 2, 400), truth_of(rng.integers(0, 2, 400))
    whole = score_labels(called, truth.cls)
    one_place = miou_interval(called, truth, np.zeros((400, 3)), 1.0, (0, 1))
    assert one_place.blocks == 1
    assert one_place.low == one_place.mean == one_place.high == pytest.approx(whole.miou)


def test_a_class_that_is_not_there_has_no_score_and_is_a_miss_where_it_is_said():
    """The truth has cups alone. 20 of 50 are called pots, as are 10 points of background and 5 whose truth is not
    relied on."""
    cls = np.repeat([0, -1, 0], [50, 30, 5])
    called = np.repeat([1, 0, -1, 1, -1, 1], [20, 20, 10, 10, 20, 5])
    scored = np.arange(85) < 80
    truth = truth_of(cls, cls < 0, scored=scored)
    score = score_labels(called, cls, scored=scored, background=truth.background)
    assert (score.classes, score.class_iou, score.class_accuracy) == ((0,), (20 / 50,), (20 / 50,))
    assert (score.unknown_share, score.background_called) == (10 / 50, 10 / 30)
    answer = Answer(called, np.zeros(85, int), far_apart(85).astype(np.float32), 1.0)
    whole = score_capture(answer, truth)
    assert whole.labels == score
    assert whole.interval.mean == pytest.approx(20 / 50)
    assert (whole.answered.class_iou, whole.answered_share) == ((20 / 40,), 40 / 50)


# A whole answer -------------------------------------------------------------------------------------------------


@pytest.fixture
def answer():
    """Two cups and a pot of 120 points each, and 40 of background. Instance 0 is the first cup, 100 of its points and
    20 of background; 1 is both the second cup and the pot, called a pot; 2 is the other 20 points of the first cup, and
    no word fits it; the rest is unknown."""
    instances = np.repeat([0, 2, 1, 1, 0, -2], [100, 20, 120, 120, 20, 20])
    called = np.array([0, 1, -1, -1])[np.maximum(instances, -1)]
    return Answer(called, instances, far_apart(400).astype(np.float32), 1.0)


@pytest.fixture
def truth():
    cls = np.repeat([0, 0, 1, -1], [120, 120, 120, 40])
    return truth_of(cls, cls < 0, np.repeat([50, 9, 30, 77], [120, 120, 120, 40]))


def test_a_whole_answer_by_hand(answer, truth):
    score = score_capture(answer, truth)
    # Cup: 100 of 240 true and 20 on background. Pot: 120 of 120 true and 120 cups.
    assert score.labels.class_iou == (100 / 260, 120 / 240)
    assert score.labels.background_called == 20 / 40
    # Answered are 340 of 360. Of these cups 100 of 220, pots 120 of 240; background is no part of it.
    assert score.answered.class_iou == (100 / 220, 120 / 240)
    assert score.answered_share == 340 / 360
    assert score.interval.mean == score.labels.miou


def test_instances_by_hand(answer, truth):
    # Pairs of points together in both: 100 and 20 of the first cup, 120, 120. By the formula of Hubert and Arabie.
    pairs = {count: count * (count - 1) / 2 for count in (20, 100, 120, 240, 360)}
    both = pairs[100] + pairs[20] + 2 * pairs[120]
    first, second = pairs[100] + pairs[20] + pairs[240], 3 * pairs[120]
    chance = first * second / pairs[360]
    assert score_capture(answer, truth).rand == pytest.approx((both - chance) / ((first + second) / 2 - chance))


def test_numbers_of_things_do_not_matter(answer, truth):
    large = replace(truth, instance=truth.instance.astype(np.int64) * 10**15)
    assert score_capture(answer, large).rand == score_capture(answer, truth).rand
    assert score_capture(answer, replace(truth, instance=None)).rand is None
    assert score_capture(answer, replace(truth, instance=np.full(400, -1))).rand is None


def test_nothing_to_score_is_told(answer, truth):
    with pytest.raises(SceneError, match="no class of the truth has 30 points"):
        score_capture(answer, replace(truth, scored=np.zeros(400, bool)))


def test_a_scene_is_asked_for_the_names(tmp_path):
    cloud = make_cloud(far_apart(4), [0, 1, -1, 1], instances=None)
    words = {
        "pot": cloud.instances.descriptors[1],
        "lamp": unit_rows(3, seed=9)[2],
        "cup": cloud.instances.descriptors[0],
    }
    np.savez(
        tmp_path / "w.npz", names=list(words), vectors=np.stack(list(words.values())), feature_space=cloud.feature_space
    )
    scene = LabelledScene.from_cloud(cloud)
    found = ask(scene, truth_of([0, 1, 1, 1]), tmp_path / "w.npz")
    assert found.called.tolist() == [0, 1, -1, 1]
    with pytest.raises(SceneError, match="has 4 points, the truth 3"):
        ask(scene, truth_of([0, 1, 1]), tmp_path / "w.npz")


def test_an_interval_over_no_class_is_refused_not_waited_for():
    truth = Truth(np.full(40, -1), ("a",), np.ones(40, bool), np.ones(40, bool))
    with pytest.raises(OgPointcloudError, match="no class has enough points"):
        miou_interval(np.full(40, -1), truth, np.random.default_rng(0).normal(size=(40, 3)), 0.1, ())
