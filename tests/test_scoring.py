"""Scores by hand: each expected number is worked out in a comment."""

import json

import numpy as np
import pytest

from og_pointcloud.errors import OgPointcloudError, SceneError
from og_pointcloud.evaluate.intervals import bootstrap
from og_pointcloud.evaluate.lerf import pair_ious, read_frame, score_scenes
from og_pointcloud.evaluate.scannet import NAMES, TASKS, score_scene

WALL, FLOOR, CHAIR, PICTURE, OTHER = 1, 2, 5, 11, 40


def ids(*groups):
    """ids((1, 3), (5, 2)) -> 1 1 1 5 5."""
    return np.concatenate([np.full(count, value) for value, count in groups]).astype(int)


# ScanNet --------------------------------------------------------------------------------------------------------


def test_the_tasks_are_those_of_the_table():
    assert [len(TASKS[task]) for task in (19, 15, 10)] == [19, 15, 10]
    assert set(TASKS[10]) < set(TASKS[15]) < set(TASKS[19]) == set(NAMES)


def test_one_scene_by_hand():
    truth = ids((WALL, 6), (CHAIR, 4), (OTHER, 3), (0, 2))
    # Wall: 4 right, 1 called chair, 1 unknown. Chair: 3 right, 1 called wall. The rest is ignored, whatever is said.
    predicted = np.array([1, 1, 1, 1, 5, 0, 5, 5, 5, 1, 1, 5, 5, 1, 1])
    score = score_scene(predicted, truth, 19)
    # Wall: hits 4, union 6 true + 1 chair called wall = 7. Chair: hits 3, union 4 + 1 wall called chair = 5.
    assert score.class_iou == (4 / 7, 3 / 5)
    assert score.class_accuracy == (4 / 6, 3 / 4)
    assert score.miou == pytest.approx((4 / 7 + 3 / 5) / 2)
    assert (score.points, score.unknown_share) == (10, 1 / 10)


def test_transparent_points_count_nowhere():
    truth, predicted = ids((WALL, 4), (CHAIR, 2)), ids((WALL, 2), (CHAIR, 4))
    opacity = np.array([1, 1, 0.09, 0.1, 1, 1])
    score = score_scene(predicted, truth, 10, opacity)
    # Ignored: point 2. Wall: hits 2 of 3; chair: hits 2, union 2 + 1 (0.1 is not below 0.1).
    assert score.class_iou == (2 / 3, 2 / 3)


def test_absent_classes_do_not_dilute_and_classes_outside_the_task_are_ignored():
    truth = ids((WALL, 2), (PICTURE, 2))
    # Floor is called on a wall point: wrong for the wall, but floor is absent and has no IoU of 0.
    predicted = np.array([WALL, FLOOR, PICTURE, WALL])
    assert score_scene(predicted, truth, 19).class_iou == (1 / 3, 1 / 2)
    # Picture is not among the 10: its points, and the wall called there, count nowhere.
    ten = score_scene(predicted, truth, 10)
    assert (ten.classes, ten.class_iou) == ((WALL,), (1 / 2,))


# LeRF-OVS -------------------------------------------------------------------------------------------------------


def write_lerf(file, objects):
    info = {"name": "frame_00041.jpg", "width": 20, "height": 10}
    file.write_text(json.dumps({"info": info, "objects": [{"category": c, "segmentation": o} for c, o in objects]}))


def square(x, y, side):
    """A polygon whose filled pixels, border included, are side x side."""
    return [[x, y], [x + side - 1, y], [x + side - 1, y + side - 1], [x, y + side - 1]]


def test_selection_by_hand(tmp_path):
    write_lerf(tmp_path / "f.json", [("cup", square(0, 0, 4)), ("cup", square(10, 0, 2)), ("fork", square(5, 5, 3))])
    frame = read_frame(tmp_path / "f.json")
    assert frame.name == "frame_00041"
    # Two cups are one object of 16 + 4 pixels.
    assert {name: int(mask.sum()) for name, mask in frame.objects.items()} == {"cup": 20, "fork": 9}
    alpha = np.zeros((10, 20))
    alpha[0:4, 0:4], alpha[9, 0:5], alpha[0, 10] = 0.71, 0.9, 0.7
    # Shown: 16 of the cups and 5 elsewhere; 0.7 is not above 0.7. IoU 16 / 25. Nothing is selected of the fork: 0.
    assert pair_ious(frame, {"cup": alpha, "fork": np.zeros((10, 20))}) == {"cup": 16 / 25, "fork": 0.0}


def test_scenes_are_averaged_as_in_the_table():
    miou, accuracy = score_scenes({"a": np.array([0.64, 0.0, 0.25]), "b": np.array([1.0]), "c": np.array([])})
    # a: mean 0.89 / 3, one of three above 0.25 (0.25 is not). b: 1, 1.
    assert miou == pytest.approx((0.89 / 3 + 1) / 2)
    assert accuracy == pytest.approx((1 / 3 + 1) / 2)


@pytest.mark.parametrize("content", ["{", "[]", '{"info": {"name": "a", "width": 1e9, "height": 1e9}, "objects": []}'])
def test_damaged_label_files_are_refused(tmp_path, content):
    (tmp_path / "f.json").write_text(content)
    with pytest.raises(SceneError, match=r"f\.json"):
        read_frame(tmp_path / "f.json")
    write_lerf(tmp_path / "f.json", [("cup", [[0, 0], [1, 1]])])
    with pytest.raises(SceneError, match="object 'cup': the outline is"):
        read_frame(tmp_path / "f.json")


# Spread ---------------------------------------------------------------------------------------------------------


def test_an_interval_is_as_wide_as_the_standard_error_says():
    hard = np.random.default_rng(1).uniform(0, 1, 40)
    alone = bootstrap(hard)
    # The standard error of a mean is deviation / root n; 95 % lie within 1.96 of them.
    assert (alone.high - alone.low) / 2 == pytest.approx(1.96 * hard.std() / np.sqrt(40), rel=0.1)
    assert bootstrap(hard) == alone
    assert bootstrap(np.array([0.5, np.nan])) == bootstrap(np.array([0.5]))
    with pytest.raises(OgPointcloudError, match="no finite score"):
        bootstrap(np.array([np.nan]))
