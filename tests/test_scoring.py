"""Scores by hand: each expected number is worked out in a comment."""

import json

import numpy as np
import pytest

from og_pointcloud.cli import main
from og_pointcloud.errors import OgPointcloudError, SceneError
from og_pointcloud.evaluate.instance_scores import average_precision
from og_pointcloud.evaluate.intervals import bootstrap, paired_bootstrap, risk_coverage
from og_pointcloud.evaluate.lerf import pair_ious, read_frame, score_scenes
from og_pointcloud.evaluate.scannet import NAMES, TASKS, average, read_truth, score_scene
from og_pointcloud.formats.ply import write_ply

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
    assert score.protocol.class_iou == (4 / 7, 3 / 5)
    assert score.protocol.class_accuracy == (4 / 6, 3 / 4)
    assert score.protocol.miou == pytest.approx((4 / 7 + 3 / 5) / 2)
    # As abstention: the unknown wall point is not there. Wall: 4 of 5 true + 1; chair: 3 of 4 + 1.
    assert score.answered.class_iou == (4 / 6, 3 / 5)
    assert score.answered_share == 9 / 10


def test_transparent_points_count_nowhere():
    truth, predicted = ids((WALL, 4), (CHAIR, 2)), ids((WALL, 2), (CHAIR, 4))
    opacity = np.array([1, 1, 0.09, 0.1, 1, 1])
    score = score_scene(predicted, truth, 10, opacity)
    # Ignored: point 2. Wall: hits 2 of 3; chair: hits 2, union 2 + 1 (0.1 is not below 0.1).
    assert score.protocol.class_iou == (2 / 3, 2 / 3)


def test_absent_classes_do_not_dilute_and_classes_outside_the_task_are_ignored():
    truth = ids((WALL, 2), (PICTURE, 2))
    # Floor is called on a wall point: wrong for the wall, but floor is absent and has no IoU of 0.
    predicted = np.array([WALL, FLOOR, PICTURE, WALL])
    assert score_scene(predicted, truth, 19).protocol.class_iou == (1 / 3, 1 / 2)
    # Picture is not among the 10: its points, and the wall called there, count nowhere.
    ten = score_scene(predicted, truth, 10).protocol
    assert (ten.classes, ten.class_iou) == ((WALL,), (1 / 2,))


def test_macro_and_flat_means():
    first = score_scene(ids((WALL, 10)), ids((WALL, 10)), 10)  # wall 10 / 10
    second = score_scene(ids((WALL, 1), (0, 1), (CHAIR, 2)), ids((WALL, 2), (CHAIR, 2)), 10)  # wall 1 / 2, chair 2 / 2
    empty = score_scene(ids((WALL, 3)), ids((OTHER, 3)), 10)
    mean = average([first, second, empty])
    assert mean.miou == pytest.approx((1 + 3 / 4) / 2)
    assert mean.flat_miou == pytest.approx((11 / 12 + 1) / 2)
    assert mean.scenes == 2
    assert np.isnan(average([empty]).miou)


def test_flat_mean_against_one_scene_of_all_points():
    rng = np.random.default_rng(0)
    parts = [(rng.choice([0, 1, 2, 5, 11, 40], 50), rng.choice([0, 1, 2, 5, 11, 40], 50)) for _ in range(4)]
    pooled = score_scene(*(np.concatenate(side) for side in zip(*parts, strict=True)), 19)
    assert average([score_scene(*part, 19) for part in parts]).flat_miou == pytest.approx(pooled.protocol.miou)


def test_wrong_input_is_told():
    with pytest.raises(SceneError, match="the task is 20 classes"):
        score_scene(ids((1, 1)), ids((1, 1)), 20)
    with pytest.raises(SceneError, match=r"opacities have shape \(2,\)"):
        score_scene(ids((1, 1)), ids((1, 1)), 19, np.ones(2))


# The command ----------------------------------------------------------------------------------------------------


def write_labels(folder, scene, truth):
    """As ScanNet's *_vh_clean_2.labels.ply: x y z red green blue alpha label."""
    (folder / scene).mkdir(parents=True)
    fields = [("x", "f4"), ("y", "f4"), ("z", "f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1"), ("alpha", "u1")]
    rows = np.zeros(len(truth), [*fields, ("label", "u2")])
    rows["x"], rows["label"] = np.arange(len(truth)), truth
    write_ply(folder / scene / f"{scene}_vh_clean_2.labels.ply", {"vertex": rows})


@pytest.fixture
def scannet(tmp_path):
    """Two scenes with stored labels: wall 1 of 2 and chair 1 of 1 + 1; floor 2 of 2."""
    (tmp_path / "p").mkdir()
    write_labels(tmp_path / "scans", "scene0000_00", [WALL, WALL, CHAIR, OTHER])
    write_labels(tmp_path / "scans", "scene0062_00", [FLOOR, FLOOR])
    names = np.array(["chair", "wall", "floor", "lamp"])
    np.savez(tmp_path / "p/scene0000_00.npz", labels=np.array([1, 0, 0, 1]), names=names)
    np.savez(tmp_path / "p/scene0062_00.npz", labels=np.array([2, 2]), names=names)
    return tmp_path


def test_the_command_scores_a_miniature_data_set(scannet, capsys):
    command = ["eval", "scannet", str(scannet / "scans"), "--predictions", str(scannet / "p")]
    assert main([*command, "--json", str(scannet / "s.json")]) == 0
    assert "2 scenes, 2 of the 10" in capsys.readouterr().out
    scores = json.loads((scannet / "s.json").read_text())["19"]
    assert scores["scenes"]["scene0000_00"]["class_iou"] == {"1": 0.5, "5": 0.5}
    assert scores["miou"] == pytest.approx((0.5 + 1) / 2)
    (scannet / "p/scene0062_00.npz").unlink()
    assert main(command) == 2
    assert "neither scene0062_00.ogpc nor scene0062_00.npz" in capsys.readouterr().err
    assert main([*command, "--scenes", "scene0000_00"]) == 0
    assert main([*command, "--scenes", "scene9999_00"]) == 2


def test_a_name_outside_the_table_is_a_wrong_answer_and_counts_must_fit(scannet, capsys):
    names = np.array(["lamp"])
    np.savez(scannet / "p/scene0062_00.npz", labels=np.array([0, -1]), names=names)
    command = ["eval", "scannet", str(scannet / "scans"), "--predictions", str(scannet / "p")]
    assert main([*command, "--json", str(scannet / "s.json")]) == 0
    scene = json.loads((scannet / "s.json").read_text())["10"]["scenes"]["scene0062_00"]
    assert (scene["miou"], scene["answered_share"], scene["answered_miou"]) == (0, 0.5, 0)
    np.savez(scannet / "p/scene0062_00.npz", labels=np.array([0]), names=names)
    assert main(command) == 2
    assert "labels are int64 (1,)" in capsys.readouterr().err


def test_labels_that_are_not_nyu40_are_refused(tmp_path):
    write_labels(tmp_path, "a", [1, 1191])
    with pytest.raises(SceneError, match=r"labels span 1\.\.1191; expected NYU40"):
        read_truth(tmp_path / "a/a_vh_clean_2.labels.ply")


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
    # Shown: 16 of the cups and 5 elsewhere; 0.7 is not above 0.7. IoU 16 / 25. Nothing is said of the fork: 0.
    assert pair_ious(frame, {"cup": alpha}) == {"cup": 16 / 25, "fork": 0.0}
    with pytest.raises(SceneError, match=r"render is \(2, 2\), the label \(10, 20\)"):
        pair_ious(frame, {"cup": np.zeros((2, 2))})


def test_scenes_are_averaged_as_in_the_table():
    score = score_scenes({"a": np.array([0.64, 0.0, 0.25]), "b": np.array([1.0]), "c": np.array([])})
    # a: mean 0.89 / 3, one of three above 0.25 (0.25 is not). b: 1, 1.
    assert score.miou == pytest.approx((0.89 / 3 + 1) / 2)
    assert score.accuracy == pytest.approx((1 / 3 + 1) / 2)
    assert (score.flat_miou, score.flat_accuracy, score.pairs) == (pytest.approx(1.89 / 4), 2 / 4, 4)


@pytest.mark.parametrize("content", ["{", "[]", '{"info": {"name": "a", "width": 1e9, "height": 1e9}, "objects": []}'])
def test_damaged_label_files_are_refused(tmp_path, content):
    (tmp_path / "f.json").write_text(content)
    with pytest.raises(SceneError, match=r"f\.json"):
        read_frame(tmp_path / "f.json")
    write_lerf(tmp_path / "f.json", [("cup", [[0, 0], [1, 1]])])
    with pytest.raises(SceneError, match="object 'cup': the outline is"):
        read_frame(tmp_path / "f.json")


# Spread ---------------------------------------------------------------------------------------------------------


def test_risk_coverage_by_hand():
    # Surest first: right | wrong and right together | wrong. Risk 0, 1/3, 2/4 at coverage 1/4, 3/4, 1.
    found = risk_coverage(np.array([False, True, False, True]), np.array([0.5, 0.9, 0.1, 0.5]))
    np.testing.assert_allclose(found.coverage, [1 / 4, 3 / 4, 1])
    np.testing.assert_allclose(found.risk, [0, 1 / 3, 1 / 2])
    assert found.area == pytest.approx(1 / 3 / 2 + 1 / 2 / 4)


def test_a_paired_interval_sees_what_two_intervals_hide():
    rng = np.random.default_rng(1)
    hard = rng.uniform(0, 1, 40)
    better = paired_bootstrap(hard + 0.05 + rng.normal(0, 0.01, 40), hard)
    assert 0.04 < better.low < better.mean < better.high < 0.06
    alone = bootstrap(hard)
    assert alone.high - alone.low > 0.1
    # The standard error of a mean is deviation / root n; 95 % lie within 1.96 of them.
    assert (alone.high - alone.low) / 2 == pytest.approx(1.96 * hard.std() / np.sqrt(40), rel=0.1)
    assert bootstrap(hard) == alone
    assert bootstrap(np.array([0.5, np.nan])) == bootstrap(np.array([0.5]))
    with pytest.raises(OgPointcloudError, match="no finite score"):
        bootstrap(np.array([np.nan]))


# Instances ------------------------------------------------------------------------------------------------------


def test_average_precision_by_hand():
    # True: 0 (10 points), 1 (10 points). Predicted: 0 has 9 of true 0 (IoU 0.9); 1 has 6 of true 1 (IoU 0.6), unsure;
    # 2 has the rest of true 1, 4 points (IoU 0.4), surer than 1.
    truth = ids((0, 10), (1, 10))
    predicted = ids((0, 9), (-1, 1), (1, 6), (2, 4))
    found = average_precision(predicted, truth, np.array([0.9, 0.2, 0.5]), min_points=1)
    # At 0.5: surest first right (recall 1/2), wrong, right (recall 1). Levels ascending 0.2, 0.5, 0.9, then the end:
    # precision 2/3, 1/2, 1, 1; recall 1, 1/2, 1/2, 0; steps (1-1/2)/2, (1-1/2)/2, (1/2-0)/2, (1/2-0)/2 = 1/4 each.
    assert found.ap50 == pytest.approx((2 / 3 + 1 / 2 + 1 + 1) / 4)
    # At 0.25 both find true 1: the surer one is the hit, the other is false. Precision 2/3, 1, 1, 1; recall 1, 1,
    # 1/2, 0; steps (1-1)/2, (1-1/2)/2, (1-0)/2, (1/2-0)/2.
    assert found.ap25 == pytest.approx(0 + 1 / 4 + 1 / 2 + 1 / 4)


def test_perfect_and_missing_instances():
    truth = ids((0, 5), (1, 5))
    assert average_precision(truth, truth, np.ones(2), min_points=1).ap == 1
    assert average_precision(np.full(10, -1), truth, np.ones(0), min_points=1).ap == 0
    assert np.isnan(average_precision(truth, np.full(10, -1), np.ones(2), min_points=1).ap)
    # One of two, perfectly: precision 1 up to recall 1/2.
    assert average_precision(ids((0, 5), (-1, 5)), truth, np.ones(1), min_points=1).ap50 == pytest.approx(0.5)


def test_small_and_unlabelled_instances_are_void():
    truth = ids((0, 10), (1, 3), (-1, 10))
    # Prediction 1 lies on the small instance, 2 on nothing known: neither is false.
    predicted = ids((0, 10), (1, 3), (2, 10))
    assert average_precision(predicted, truth, np.array([0.1, 0.9, 0.9]), min_points=3).ap50 == pytest.approx(1)
    # With min_points 4 the small one is void, and prediction 1 is too small to be looked at.
    assert average_precision(predicted, truth, np.array([0.1, 0.9, 0.9]), min_points=4).ap50 == pytest.approx(1)
    # A prediction over one of class 7 is false for class 8 only if it says 8; here it is of class 8 and finds nothing.
    found = average_precision(
        ids((0, 5), (1, 5)), ids((0, 5), (1, 5)), np.array([0.5, 0.9]), np.array([7, 7]), np.array([7, 8]), min_points=1
    )
    # Class 7: surest wrong, then right. Precision 1/2, 0, 1; recall 1, 0, 0; steps 1/2, 1/2, 0: 1/4. Class 8: none, 0.
    assert found.ap50 == pytest.approx(1 / 8)


def literal_average_precision(threshold, iou, void_share, confidence):
    """Point by point down the list of confidences, as the benchmark's rules say."""
    entries, used = [], set()
    for column in range(iou.shape[1]):
        finders = [row for row in range(len(iou)) if iou[row, column] > threshold and row not in used]
        finders.sort(key=lambda row: -confidence[row])
        if finders:
            used.add(finders[0])
            entries.append((confidence[finders[0]], True))
    for row in range(len(iou)):
        finds = any(iou[row, column] > threshold for column in range(iou.shape[1]))
        if row not in used and (finds or void_share[row] <= threshold):
            entries.append((confidence[row], False))
    curve = [(1.0, 0.0)]
    for level in sorted({score for score, _ in entries}, reverse=True):
        taken = [right for score, right in entries if score >= level]
        curve.append((sum(taken) / len(taken), sum(taken) / iou.shape[1]))
    total = 0.0
    for index, (precision, recall) in enumerate(curve):
        before = curve[index - 1][1] if index else 0.0
        after = curve[index + 1][1] if index + 1 < len(curve) else recall
        total += precision * (after - before) / 2
    return total if any(right for _, right in entries) else 0.0


@pytest.mark.parametrize("seed", range(8))
def test_average_precision_against_a_literal_one(seed):
    rng = np.random.default_rng(seed)
    truth = np.repeat(rng.integers(-1, 6, 40), 10)
    predicted = np.where(rng.uniform(size=400) < 0.8, truth + rng.integers(0, 2, 400) * 6, -1)
    confidence = rng.integers(0, 5, 13) / 5.0
    shared = np.array([[np.sum((predicted == p) & (truth == t)) for t in range(6)] for p in range(13)])
    sizes = np.array([np.sum(predicted == p) for p in range(13)])
    true = np.array([np.sum(truth == t) for t in range(6)])
    rows, columns = np.flatnonzero(sizes), np.flatnonzero(true)
    iou = np.array([[shared[p, t] / (sizes[p] + true[t] - shared[p, t]) for t in columns] for p in rows])
    void = np.array([np.sum((predicted == p) & (truth < 0)) / sizes[p] for p in rows])
    found = average_precision(predicted, truth, confidence, min_points=1)
    assert found.ap50 == pytest.approx(literal_average_precision(0.5, iou, void, confidence[rows]))
    assert found.ap25 == pytest.approx(literal_average_precision(0.25, iou, void, confidence[rows]))
