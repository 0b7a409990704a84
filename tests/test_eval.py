"""``og-pointcloud eval capture`` and ``eval scannet`` from files to table and JSON."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from commands import error_of, output_of
from labelled_clouds import SPACE, WIDTH, instance_table, make_cloud
from scenes import NAMES, write_tiny_capture

import og_pointcloud as og
from og_pointcloud.cloud import BACKGROUND, WordBank
from og_pointcloud.evaluate.scannet import NAMES as NYU40
from og_pointcloud.evaluate.scannet import TASKS, read_truth, score_scene
from og_pointcloud.formats.ply import write_ply

WALL, FLOOR, CHAIR, PICTURE, OTHER = 1, 2, 5, 11, 40


# Captures -------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def fitted(tmp_path_factory) -> Path:
    """A folder with the tiny capture, its truth, S.ogpc, and worse.ogpc, in which the second ball is background."""
    folder = tmp_path_factory.mktemp("eval")
    capture = write_tiny_capture(folder / "tiny")
    ids = capture.object_ids
    np.savez(capture.folder / "gt.npz", names=np.array(NAMES), cls=ids, background=ids < 0, instance=ids)
    cloud = og.fit(og.read_capture(capture.folder), progress=False)
    og.write_bundle(cloud, folder / "S.ogpc")
    missed = np.where(ids == 1, BACKGROUND, cloud.instance_ids).astype(np.int32)
    og.write_bundle(replace(cloud, instance_ids=missed), folder / "worse.ogpc")
    return folder


def test_a_capture_is_scored_against_its_own_truth(fitted, tmp_path, capsys):
    command = ("eval", "capture", fitted / "tiny", fitted / "S.ogpc", "--against", fitted / "worse.ogpc")
    out = output_of(capsys, *command, "--json", tmp_path / "s.json")
    entry = json.loads((tmp_path / "s.json").read_text())["tiny"]
    words = fitted / "tiny/text_features.npz"
    result = og.segment(og.load(fitted / "S.ogpc"), None, text_features=words)
    cls = np.load(fitted / "tiny/gt.npz")["cls"]
    said = np.array([*result.names, ""])[result.labels]
    hits = [((said == name) & (cls == k)).sum() / ((said == name) | (cls == k)).sum() for k, name in enumerate(NAMES)]
    assert entry["labels"]["class_iou"] == pytest.approx(hits)
    assert entry["labels"]["miou"] == entry["interval"]["mean"] > 0.8
    assert f"{100 * np.mean(hits):.1f}" in out
    assert entry["interval"]["low"] <= entry["interval"]["mean"] <= entry["interval"]["high"]
    assert entry["rand"] > 0.9
    # The other lacks one ball of two: about half of the score, in every draw.
    less = entry["less_the_other"]
    assert less["mean"] == pytest.approx(hits[1] / 2)
    assert 0.3 < less["low"] <= less["mean"] <= less["high"]
    assert "cubes of" in out


def test_what_cannot_be_scored_is_one_error(fitted, tmp_path, capsys):
    (tmp_path / "bare").mkdir()
    bare = ("eval", "capture", tmp_path / "bare", fitted / "S.ogpc")
    assert "gt.npz is not a file" in error_of(capsys, *bare)
    assert "none.ogpc is not a file" in error_of(capsys, "eval", "capture", fitted / "tiny", fitted / "none.ogpc")
    np.savez(tmp_path / "bare/gt.npz", names=np.array(NAMES), cls=np.zeros(3, int))
    assert "points, the truth 3; expected the truth's points" in error_of(capsys, *bare)
    cloud = og.load(fitted / "S.ogpc").cloud
    og.write_bundle(replace(cloud, vocabulary=None), tmp_path / "wordless.ogpc")
    np.savez(tmp_path / "bare/gt.npz", names=np.array(NAMES), cls=np.zeros(len(cloud), int))
    said = error_of(capsys, "eval", "capture", tmp_path / "bare", tmp_path / "wordless.ogpc")
    assert "wordless.ogpc has no words; expected the capture's text_features.npz" in said
    assert "--labels" not in said, "this command has no such option"
    kept = ("eval", "capture", fitted / "tiny", fitted / "S.ogpc", "--json", fitted / "tiny/transforms.json")
    assert "which is an input; expected another name" in error_of(capsys, *kept)


def test_a_score_of_nothing_is_null_in_json(fitted, tmp_path, capsys):
    """No point is answered: precision has no value, which JSON has no word for."""
    cloud = og.load(fitted / "S.ogpc").cloud
    silent = replace(cloud, instance_ids=np.full(len(cloud), BACKGROUND, np.int32))
    og.write_bundle(silent, tmp_path / "silent.ogpc")
    command = ("eval", "capture", fitted / "tiny", tmp_path / "silent.ogpc")
    output_of(capsys, *command, "--json", tmp_path / "s.json")
    entry = json.loads((tmp_path / "s.json").read_text(), parse_constant=lambda name: pytest.fail(name))["tiny"]
    assert entry["labels"]["miou"] == 0
    assert entry["answered"]["miou"] is None


# ScanNet --------------------------------------------------------------------------------------------------------


def write_labels(folder: Path, scene: str, xyz, truth) -> None:
    """As ScanNet's *_vh_clean_2.labels.ply: x y z red green blue alpha label."""
    (folder / scene).mkdir(parents=True)
    fields = [(name, "f4") for name in "xyz"] + [(name, "u1") for name in ("red", "green", "blue", "alpha")]
    rows = np.zeros(len(truth), [*fields, ("label", "u2")])
    for axis, name in enumerate("xyz"):
        rows[name] = xyz[:, axis]
    rows["label"] = truth
    write_ply(folder / scene / f"{scene}_vh_clean_2.labels.ply", {"vertex": rows})


@pytest.fixture
def scannet(tmp_path) -> Path:
    """Two scenes of four points, 1 apart. Instances 0, 1 and 2 look like wall, floor and chair: they are what the .ogpc
    answers. Scene 0: wall, wall, chair, chair, of which the last is said to be floor. Scene 62: wall, unknown, floor,
    floor, of walls and floors."""
    vectors = np.eye(3, WIDTH, dtype=np.float32)
    table = replace(instance_table(3), descriptors=vectors)
    names = list(NYU40.values())
    texts = np.random.default_rng(1).normal(size=(len(names), WIDTH)).astype(np.float32) * 0.01
    for row, class_id in enumerate((WALL, FLOOR, CHAIR)):
        texts[names.index(NYU40[class_id])] = vectors[row]
    np.savez(tmp_path / "w.npz", names=names, vectors=texts, feature_space=np.array(SPACE))
    xyz = np.arange(4)[:, None] * np.array([1.0, 0, 0])
    (tmp_path / "p").mkdir()
    for scene, ids, truth in (
        ("scene0000_00", [0, 0, 2, 1], [WALL, WALL, CHAIR, CHAIR]),
        ("scene0062_00", [0, -1, 1, 1], [WALL, WALL, FLOOR, FLOOR]),
    ):
        write_labels(tmp_path / "scans", scene, xyz, truth)
        og.write_bundle(make_cloud(xyz, ids, 1.0, 0.5, instances=table, words=()), tmp_path / f"p/{scene}.ogpc")
    return tmp_path


def command(scannet, *more, truth="scans"):
    folders = ["--predictions", scannet / "p", "--text-features", scannet / "w.npz"]
    return ["eval", "scannet", scannet / truth, *folders, *more]


def scored(capsys, scannet, *more, **truth):
    """What the command prints, and the scores that it writes."""
    out = output_of(capsys, *command(scannet, "--json", scannet / "s.json", *more, **truth))
    return out, json.loads((scannet / "s.json").read_text(), parse_constant=lambda name: pytest.fail(name))


def test_the_tasks_are_those_of_the_table():
    assert [len(TASKS[task]) for task in (19, 15, 10)] == [19, 15, 10]
    assert set(TASKS[10]) < set(TASKS[15]) < set(TASKS[19]) == set(NYU40)


def test_one_scene_by_hand():
    truth = np.repeat([WALL, CHAIR, OTHER, 0], [6, 4, 3, 2])
    # Wall: 4 right, 1 called chair, 1 unknown. Chair: 3 right, 1 called wall. The rest is ignored, whatever is said.
    predicted = np.array([1, 1, 1, 1, 5, 0, 5, 5, 5, 1, 1, 5, 5, 1, 1])
    score = score_scene(predicted, truth, 19)
    # Wall: hits 4, union 6 true + 1 chair called wall = 7. Chair: hits 3, union 4 + 1 wall called chair = 5.
    assert score.class_iou == (4 / 7, 3 / 5)
    assert score.class_accuracy == (4 / 6, 3 / 4)
    assert (score.points, score.unknown_share) == (10, 1 / 10)


def test_transparent_points_count_nowhere():
    truth, predicted = np.repeat([WALL, CHAIR], [4, 2]), np.repeat([WALL, CHAIR], [2, 4])
    opacity = np.array([1, 1, 0.09, 0.1, 1, 1])
    score = score_scene(predicted, truth, 10, opacity)
    # Ignored: point 2. Wall: hits 2 of 3; chair: hits 2, union 2 + 1 (0.1 is not below 0.1).
    assert score.class_iou == (2 / 3, 2 / 3)


def test_absent_classes_do_not_dilute_and_classes_outside_the_task_are_ignored():
    truth = np.repeat([WALL, PICTURE], 2)
    # Floor is called on a wall point: wrong for the wall, but floor is absent and has no IoU of 0.
    predicted = np.array([WALL, FLOOR, PICTURE, WALL])
    assert score_scene(predicted, truth, 19).class_iou == (1 / 3, 1 / 2)
    # Picture is not among the 10: its points, and the wall called there, count nowhere.
    ten = score_scene(predicted, truth, 10)
    assert (ten.classes, ten.class_iou) == ((WALL,), (1 / 2,))


def test_scenes_are_asked_for_the_names_of_the_table(scannet, capsys):
    out, report = scored(capsys, scannet)
    report = report["19"]
    # Scene 0: wall 2 of 2, chair 1 of 2. Scene 62: wall 1 of 2, floor 2 of 2; of its 4 one is unknown.
    assert report["scenes"]["scene0000_00"]["class_iou"] == {"1": 1.0, "5": 0.5}
    assert report["scenes"]["scene0062_00"]["class_iou"] == {"1": 0.5, "2": 1.0}
    assert report["scenes"]["scene0062_00"]["unknown"] == 1 / 4
    assert report["unknown"] == 1 / 8
    assert report["miou"] == pytest.approx(0.75)
    # Without a bank no instance may abstain: as asked and as forced are one.
    assert report["forced_miou"] == report["miou"]
    assert "2 scenes, 2 of the 10 in the published table" in out


def test_a_scene_that_abstains_is_also_scored_as_if_it_might_not(scannet, capsys):
    """In the bank are 60 words as like the floor's descriptor as "floor" is: instance 1 says that none fits. Made to
    choose, it says floor, as it does without the bank."""
    bank = np.random.default_rng(2).normal(size=(60, WIDTH)).astype(np.float32)
    bank[:20] = np.eye(3, WIDTH, dtype=np.float32)[1] + 0.3 * bank[:20] / np.linalg.norm(bank[:20], axis=1)[:, None]
    for file in (scannet / "p").glob("*.ogpc"):
        og.write_bundle(replace(og.load(file).cloud, word_bank=WordBank(bank)), file)
    out, report = scored(capsys, scannet)
    assert report["19"]["scenes"]["scene0062_00"]["class_iou"]["2"] == 0
    assert report["19"]["forced_miou"] == pytest.approx(0.75)  # as without a bank, above
    assert report["19"]["miou"] < 0.75
    assert "forced" in out


def test_scenes_without_a_point_of_the_task_are_left_out(scannet, capsys):
    """Bathtubs are among the 19 classes, not among the 10; nothing is where all scenes are of other things."""
    xyz = np.arange(4)[:, None] * np.array([1.0, 0, 0])
    write_labels(scannet / "other", "scene0000_00", xyz, [36, 36, 40, 0])
    write_labels(scannet / "other", "scene0062_00", xyz, [WALL, WALL, 40, 0])
    _, report = scored(capsys, scannet, truth="other")
    assert (report["19"]["miou"], report["10"]["miou"]) == (0.25, 0.5)  # bathtub 0 of 2; wall 1 of 2
    assert report["10"]["scenes"]["scene0000_00"] == {
        "miou": None, "macc": None, "forced_miou": None, "unknown": None, "points": 0, "class_iou": {},
    }  # fmt: skip
    assert report["10"]["interval"] == [0.5, 0.5]
    out, report = scored(capsys, scannet, "--scenes", "scene0000_00", truth="other")
    assert [report["10"][name] for name in ("miou", "forced_miou", "unknown", "interval")] == [None] * 4
    row = next(line for line in out.splitlines() if line.startswith("10 classes"))
    assert set(row.split()[2:]) == {"-"}


def test_a_missing_or_empty_scene_is_one_error(scannet, capsys):
    assert "has no labels for 'scene9999_00'" in error_of(capsys, *command(scannet, "--scenes", "scene9999_00"))
    prediction = scannet / "p/scene0062_00.ogpc"
    prediction.write_bytes(b"")
    assert str(prediction) in error_of(capsys, *command(scannet))
    prediction.unlink()
    assert "has no scene0062_00.ogpc" in error_of(capsys, *command(scannet))
    output_of(capsys, *command(scannet, "--scenes", "scene0000_00"))


def test_labels_that_are_not_nyu40_are_one_error(scannet, capsys):
    write_labels(scannet / "raw", "scene0000_00", np.zeros((2, 3)), [WALL, 1191])
    assert "labels span 1..1191; expected NYU40" in error_of(capsys, *command(scannet, truth="raw"))


def test_ids_that_scannet_left_by_mistake_are_of_no_class(tmp_path):
    write_labels(tmp_path, "scene0270_00", np.zeros((3, 3)), [WALL, 50, 149])
    (file,) = tmp_path.rglob("*.labels.ply")
    assert read_truth(file)[1].tolist() == [WALL, 0, 0]


def test_points_that_lie_in_one_place_count_each(scannet, capsys):
    """ScanNet's meshes repeat vertices: three floors in one place, of which one is labelled wall, are three points."""
    truth = [WALL, WALL, FLOOR, FLOOR, FLOOR, WALL]
    xyz = np.array([0, 1, 2, 3, 3, 3])[:, None] * np.array([1.0, 0, 0])
    write_labels(scannet / "twice", "scene0062_00", xyz, truth)
    scene = scored(capsys, scannet, truth="twice")[1]["19"]["scenes"]["scene0062_00"]
    # Said are wall, nothing, floor, floor, floor, floor. Wall: 1 of 3. Floor: 3 of 3 + 1.
    assert scene["class_iou"] == {"1": pytest.approx(1 / 3), "2": 3 / 4}
    assert scene["points"] == 6
