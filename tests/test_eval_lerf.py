"""``eval lerf`` on a miniature of LeRF-OVS whose scores are worked out by hand.

Every Gaussian sits in the middle of one pixel of a camera that looks along z from depth 10 at focal length 10, so that
a step of 1 in the world is 1 pixel. Its alpha is 0.99 there and below 0.25 on the next pixel: what is above 0.7 is a
selection's own pixels.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from commands import error_of, output_of, run
from labelled_clouds import SPACE, make_cloud

import og_pointcloud as og
from og_pointcloud.cloud import BACKGROUND, InstanceTable, WordBank
from og_pointcloud.errors import SceneError
from og_pointcloud.evaluate.lerf import gaussians_of, pair_ious, read_frame, read_scene, score_pairs
from og_pointcloud.formats.gaussian_ply import gaussian_rows
from og_pointcloud.formats.ply import write_ply
from og_pointcloud.scene import Points

WIDTH, HEIGHT, DEPTH = 20, 10, 10.0
SMALL = 0.01
"""Standard deviation of a Gaussian: what is drawn is the low-pass filter alone."""
WORDS = ("cup", "fork", "duck")


def block(column, row, side):
    """World places of the pixels of a square."""
    x, y = np.meshgrid(np.arange(side) + column + 0.5, np.arange(side) + row + 0.5)
    return np.stack([x.ravel() - WIDTH / 2, y.ravel() - HEIGHT / 2, np.full(side * side, DEPTH)], axis=1)


def outline(column, row, side):
    """A polygon whose filled pixels, border included, are side x side."""
    last = side - 1
    return [[column, row], [column + last, row], [column + last, row + last], [column, row + last]]


def write_labels(folder: Path, scene: str, frame: str, objects) -> Path:
    file = folder / "label" / scene / f"{frame}.json"
    file.parent.mkdir(parents=True, exist_ok=True)
    info = {"name": f"{frame}.jpg", "width": WIDTH, "height": HEIGHT}
    entries = [{"category": name, "segmentation": corners} for name, corners in objects]
    file.write_text(json.dumps({"info": info, "objects": entries}))
    return file


def write_poses(folder: Path, scene: str, shifts: dict[str, float], scale: int = 1) -> None:
    """COLMAP's text model: cameras moved along x. scale: of the image that the model knows, over the labelled one."""
    model = folder / scene / "sparse/0"
    model.mkdir(parents=True)
    width, height, focal = scale * WIDTH, scale * HEIGHT, scale * DEPTH
    (model / "cameras.txt").write_text(f"1 PINHOLE {width} {height} {focal} {focal} {width / 2} {height / 2}\n")
    lines = [f"{i + 1} 1 0 0 0 {-x} 0 0 1 {name}.jpg\n\n" for i, (name, x) in enumerate(shifts.items())]
    (model / "images.txt").write_text("".join(lines))


def scene_of(blocks, descriptors, origin=(0, 0, 0)):
    """A cloud of one instance a block; descriptors (instances, 3) over the axes of WORDS. The cloud knows no words."""
    xyz = np.concatenate(blocks)
    ids = np.repeat(np.arange(len(blocks)), [len(part) for part in blocks])
    count = np.bincount(ids).astype(np.int32)
    rows = np.array(descriptors, np.float32)
    rows /= np.linalg.norm(rows, axis=1, keepdims=True)
    ones = np.ones(len(blocks), np.int32)
    owner = np.arange(len(blocks), dtype=np.int32)
    table = InstanceTable(rows, owner, count, ones, ones, ones.astype(np.float32), count.astype(np.float32))
    return make_cloud(xyz - np.array(origin), ids, 1.0, 2.0, origin, table, words=())


def write_gaussians(path: Path, cloud, opacity=0.99) -> None:
    n = len(cloud)
    rotation = np.tile(np.array([1, 0, 0, 0], np.float32), (n, 1))
    points = Points(
        cloud.xyz, cloud.origin, rgb=np.full((n, 3), 9, np.uint8), scale=np.full((n, 3), SMALL, np.float32),
        rotation=rotation, opacity=np.full(n, opacity, np.float32),
    )  # fmt: skip
    path.parent.mkdir(parents=True, exist_ok=True)
    write_ply(path, {"vertex": gaussian_rows(points)})


@pytest.fixture
def data(tmp_path):
    """Two scenes. figurines: two instances, a cup and a fork (a little like a duck), seen from two places. teatime: one
    instance, a cup, in map coordinates; its poses are of images twice as large as the labelled ones."""
    write_poses(tmp_path / "d", "figurines", {"frame_00001": 0.0, "frame_00041": 1.0, "frame_00099": 3.0})
    squares = [("cup", outline(0, 0, 4)), ("fork", outline(11, 5, 3)), ("duck", outline(10, 5, 1))]
    write_labels(tmp_path / "d", "figurines", "frame_00001", squares)
    write_labels(tmp_path / "d", "figurines", "frame_00041", squares[:1])
    figurines = scene_of([block(0, 0, 4), block(10, 5, 3)], [[1, 0, 0], [0, 1, 0.5]])
    write_gaussians(tmp_path / "g/figurines/point_cloud/iteration_7/point_cloud.ply", figurines)

    write_poses(tmp_path / "d", "teatime", {"frame_00002": 0.0}, scale=2)
    write_labels(tmp_path / "d", "teatime", "frame_00002", [("cup", outline(4, 2, 2))])
    teatime = scene_of([block(4, 2, 4)], [[1, 0, 0]], origin=(0, 0, 3))
    write_gaussians(tmp_path / "g/teatime.ply", teatime)

    (tmp_path / "p").mkdir()
    og.write_bundle(figurines, tmp_path / "p/figurines.ogpc")
    og.write_bundle(teatime, tmp_path / "p/teatime.ogpc")
    np.savez(tmp_path / "w.npz", names=np.array(WORDS), vectors=np.eye(3, 16)[:, :3], feature_space=np.array(SPACE))
    return tmp_path


def command(data, *more):
    paths = ["--predictions", "p", "--gaussians", "g", "--text-features", "w.npz"]
    return ["eval", "lerf", str(data / "d"), *[str(data / x) if not x.startswith("-") else x for x in paths], *more]


def scored(capsys, data, *more):
    """What the command prints, and the scores that it writes."""
    out = output_of(capsys, *command(data, "--json", data / "s.json", *more))
    return out, json.loads((data / "s.json").read_text())


def test_selection_by_hand(tmp_path):
    cups = [("cup", outline(0, 0, 4)), ("cup", outline(10, 0, 2))]
    frame = read_frame(write_labels(tmp_path, "kitchen", "frame_00041", [*cups, ("fork", outline(5, 5, 3))]))
    assert frame.name == "frame_00041"
    # Two cups are one object of 16 + 4 pixels.
    assert {name: int(mask.sum()) for name, mask in frame.objects.items()} == {"cup": 20, "fork": 9}
    alpha = np.zeros((10, 20))
    alpha[0:4, 0:4], alpha[9, 0:5], alpha[0, 10] = 0.71, 0.9, 0.7
    # Shown: 16 of the cups and 5 elsewhere; 0.7 is not above 0.7. IoU 16 / 25. Nothing is selected of the fork: 0.
    assert pair_ious(frame, {"cup": alpha, "fork": np.zeros((10, 20))}) == {"cup": 16 / 25, "fork": 0.0}


@pytest.mark.parametrize("content", ["{", "[]", '{"info": {"name": "a", "width": 1e9, "height": 1e9}, "objects": []}'])
def test_damaged_label_files_are_refused(tmp_path, content):
    (tmp_path / "f.json").write_text(content)
    with pytest.raises(SceneError, match=r"f\.json"):
        read_frame(tmp_path / "f.json")


def test_an_outline_of_two_corners_is_refused(tmp_path):
    with pytest.raises(SceneError, match="object 'cup': the outline is"):
        read_frame(write_labels(tmp_path, "kitchen", "f", [("cup", [[0, 0], [1, 1]])]))


def test_a_miniature_data_set_by_hand(data, capsys):
    out, report = scored(capsys, data)
    pairs = {(p["frame"], p["object"]): p["iou"] for p in report["scenes"]["figurines"]}
    # The cup is outlined as it is: 16 of 16. From 1 to the right it is seen 1 to the left, its first column outside the
    # image: 12 pixels within the outline's 16.
    assert pairs["frame_00001", "cup"] == {"best": 1, "calibrated": 1}
    assert pairs["frame_00041", "cup"]["best"] == 12 / 16
    # The fork is outlined 1 too far to the right: 6 pixels of 9 + 3.
    assert pairs["frame_00001", "fork"]["best"] == 6 / 12
    # The duck was missed; the text finds the fork, 9 pixels of which 1 is the duck's.
    assert pairs["frame_00001", "duck"] == {"best": 1 / 9, "calibrated": 1 / 9}
    # Half as large an outline within the cup: 4 of 16, which is not above 0.25.
    (teatime,) = report["scenes"]["teatime"]
    assert teatime["iou"]["best"] == 4 / 16
    best = report["means"]["best"]
    assert best["miou"] == pytest.approx(((1 + 1 / 2 + 1 / 9 + 3 / 4) / 4 + 1 / 4) / 2)
    assert best["accuracy"] == pytest.approx((3 / 4 + 0) / 2)
    assert "5 pairs in 2 scenes; the published table: 208 in 4" in out


def test_a_word_bank_lets_a_text_select_nothing(data):
    """Bank words fill the space evenly; the duck's text fits the fork less than many of them do."""
    scene = og.load(data / "p/figurines.ogpc")
    bank = np.random.default_rng(0).normal(size=(200, 3)).astype(np.float32)
    calibrated = og.LabelledScene.from_cloud(replace(scene.cloud, word_bank=WordBank(bank)))
    labels = read_scene(data / "d", "figurines")
    gaussians = gaussians_of(scene.cloud, data / "g/figurines/point_cloud/iteration_7/point_cloud.ply")
    pairs = score_pairs(calibrated, labels, gaussians, data / "w.npz")
    duck = next(pair for pair in pairs if pair.object == "duck")
    assert (duck.iou["best"], duck.iou["calibrated"]) == (1 / 9, 0)


def test_transparent_gaussians_show_nothing(data):
    """An alpha of 0.7 is asked for: at opacity 0.4, 0.59 with its neighbors, even the right instance has no pixel."""
    scene = og.load(data / "p/figurines.ogpc")
    write_gaussians(data / "soft.ply", scene.cloud, 0.4)
    labels = read_scene(data / "d", "figurines")
    pairs = score_pairs(scene, labels, gaussians_of(scene.cloud, data / "soft.ply"), data / "w.npz")
    assert {pair.iou["best"] for pair in pairs} == {0.0}


def test_frames_without_objects_and_objects_outside_the_image(data, capsys):
    """A frame with nothing outlined has no pair; a scene of such frames is no part of the mean. What is outlined beside
    the image has no pixel: nothing can be found of it, and it scores 0."""
    write_labels(data / "d", "figurines", "frame_00099", [("duck", outline(-30, -30, 4))])
    write_labels(data / "d", "teatime", "frame_00002", [])
    out, report = scored(capsys, data)
    assert report["scenes"]["teatime"] == []
    (outside,) = [pair for pair in report["scenes"]["figurines"] if pair["frame"] == "frame_00099"]
    assert set(outside["iou"].values()) == {0}
    best = report["means"]["best"]
    assert best["miou"] == pytest.approx((1 + 1 / 2 + 1 / 9 + 3 / 4 + 0) / 5)
    row = next(line for line in out.splitlines() if line.startswith("teatime"))
    assert row.split() == ["teatime", "0", *"-" * 4]
    assert "no labeled object in any frame" in error_of(capsys, *command(data, "--scenes", "teatime"))


def test_a_scene_without_instances_selects_nothing(data, capsys):
    """Nothing is an answer, and scores 0."""
    cloud = og.load(data / "p/teatime.ogpc").cloud
    og.write_bundle(replace(cloud, instance_ids=np.full(len(cloud), BACKGROUND, np.int32)), data / "p/teatime.ogpc")
    (pair,) = scored(capsys, data, "--scenes", "teatime")[1]["scenes"]["teatime"]
    assert pair["iou"] == {"best": 0, "calibrated": 0}


def test_gaussians_that_lie_in_one_place_are_one_to_the_eye(data):
    """Every Gaussian twice: what is covered at 0.99 is covered, and the scores are the same."""
    figurines = og.load(data / "p/figurines.ogpc").cloud
    doubled = {"xyz": np.tile(figurines.xyz, (2, 1)), "instance_ids": np.tile(figurines.instance_ids, 2)}
    twice = replace(figurines, **doubled, rgb=None)
    write_gaussians(data / "twice.ply", twice)
    labels, words = read_scene(data / "d", "figurines"), data / "w.npz"
    once = data / "g/figurines/point_cloud/iteration_7/point_cloud.ply"
    found = score_pairs(og.LabelledScene.from_cloud(twice), labels, gaussians_of(twice, data / "twice.ply"), words)
    known = score_pairs(og.LabelledScene.from_cloud(figurines), labels, gaussians_of(figurines, once), words)
    assert [pair.iou for pair in found] == [pair.iou for pair in known]


@pytest.mark.parametrize(
    ("remove", "text"),
    [
        ("d/label", "has no label/<scene>/frame_*.json"),
        ("d/teatime/sparse/0/cameras.txt", "teatime has no poses; expected COLMAP's sparse/0"),
        ("p/teatime.ogpc", "has no teatime.ogpc"),
        ("g/teatime.ply", "has neither teatime.ply nor teatime/point_cloud"),
    ],
)
def test_a_missing_file_is_one_error(remove, text, data, capsys):
    (data / remove).rename(data / "gone")
    code, out, error = run(capsys, *command(data))
    assert (code, out, text in error) == (2, "", True)
    if remove.endswith(".ogpc"):  # neither is a file of no bytes a prediction
        (data / remove).write_bytes(b"")
        assert remove in error_of(capsys, *command(data))


def test_labels_that_fit_no_pose_are_refused(data, capsys):
    write_labels(data / "d", "teatime", "frame_00003", [("cup", outline(0, 0, 4))])
    assert "frame 'frame_00003' has none of the" in error_of(capsys, *command(data))
    ramen = command(data, "--scenes", "ramen")
    assert "has no labels for 'ramen'; it has figurines, teatime" in error_of(capsys, *ramen)
    camera = data / "d/figurines/sparse/0/cameras.txt"
    camera.write_text(camera.read_text().replace("20 10", "20 20"))
    assert "expected the same aspect ratio" in error_of(capsys, *command(data, "--scenes", "figurines"))


def test_gaussians_of_another_cloud_are_refused(data):
    cloud = og.load(data / "p/figurines.ogpc").cloud
    with pytest.raises(SceneError, match="has 16 Gaussians, the scene 25 points"):
        gaussians_of(cloud, data / "g/teatime.ply")
    write_gaussians(data / "moved.ply", replace(cloud, origin=np.array([0, 0.5, 0])))
    with pytest.raises(SceneError, match=r"lie up to 0\.5 from the scene's points"):
        gaussians_of(cloud, data / "moved.ply")
