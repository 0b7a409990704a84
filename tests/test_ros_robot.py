"""The robot's drive: repeatable, physically plausible, and the example that shows it."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("open3d")
pytest.importorskip("rosbags")
pytest.importorskip("matplotlib")

from labelled_clouds import instance_table, make_cloud
from og_pointcloud_export import write_bundle
from og_pointcloud_room.furniture import CLASS_NAMES
from og_pointcloud_room.robot import BACKGROUND, MOVED, NEW, NO_RETURN, Drive, Lidar
from og_pointcloud_room.room import furnish

from og_pointcloud.cloud import Vocabulary

EXAMPLE = Path(__file__).resolve().parents[1] / "examples" / "07_robot.py"
SPACING = 0.06
EXACT = Lidar(noise_m=0.0, dropouts=0.0, pose_noise_m=0.0, pose_noise_rad=0.0, beams=16, columns=180)


@pytest.fixture(scope="module")
def exact_frames():
    drive = Drive(0, EXACT, frames=6)
    return drive, list(drive)


def in_map(frame):
    return frame.xyz @ frame.sensor_to_map[:3, :3].T + frame.sensor_to_map[:3, 3]


@pytest.mark.slow
def test_a_seed_gives_one_drive():
    first, again, other = (next(iter(Drive(seed, Lidar(beams=4, columns=60), frames=2))) for seed in (0, 0, 1))
    np.testing.assert_array_equal(first.xyz, again.xyz)
    assert not np.array_equal(first.xyz, other.xyz)


def test_rays_end_in_the_room_on_what_they_are_said_to_hit(exact_frames):
    drive, frames = exact_frames
    half = np.array(drive.room.size) / 2
    boxes = {}
    for item, truth in zip(drive.now.items, drive.now.truth, strict=True):
        corners = item.vertices
        boxes.setdefault(int(truth), []).append((corners.min(axis=0) - 1e-3, corners.max(axis=0) + 1e-3))
    for frame in frames:
        xyz = in_map(frame)
        assert (frame.truth != NO_RETURN).all()
        assert (np.abs(xyz[:, :2]) <= half[:2] + 1e-3).all()
        for kind in np.unique(frame.truth):
            inside = [(xyz >= low).all(axis=1) & (xyz <= high).all(axis=1) for low, high in boxes[int(kind)]]
            assert np.any(inside, axis=0)[frame.truth == kind].all()
    seen = set(np.concatenate([frame.truth for frame in frames]).tolist())
    assert {BACKGROUND, NEW, MOVED, CLASS_NAMES.index("table")} <= seen


def test_the_robot_keeps_clear_of_everything(exact_frames):
    _, frames = exact_frames
    assert min(np.linalg.norm(frame.xyz, axis=1).min() for frame in frames) > 0.2
    places = np.array([frame.position for frame in frames])
    assert np.linalg.norm(places - np.roll(places, 1, axis=0), axis=1).min() > 0.3  # it moves


@pytest.mark.slow
def test_noise_is_of_the_size_that_it_is_said_to_be():
    lidar = replace(EXACT, noise_m=0.02, dropouts=0.1)
    exact, noisy = (next(iter(Drive(0, kind, frames=2))) for kind in (EXACT, lidar))
    lost = np.isnan(noisy.xyz).any(axis=1)
    assert (noisy.truth[lost] == NO_RETURN).all()
    assert lost.mean() == pytest.approx(0.1, abs=0.02)
    error = np.linalg.norm(noisy.xyz, axis=1)[~lost] - np.linalg.norm(exact.xyz, axis=1)[~lost]
    assert error.std() == pytest.approx(0.02, rel=0.1)


def sampled(parts, spacing, rng):
    """About a point per spacing squared on the parts' triangles."""
    corners = np.concatenate([part.vertices[part.triangles] for part in parts])
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    chosen = rng.choice(len(area), max(int(area.sum() / spacing**2), 1), p=area / area.sum())
    return (corners[chosen] * rng.dirichlet(np.ones(3), len(chosen))[:, :, None]).sum(axis=1)


@pytest.fixture(scope="module")
def true_scene(tmp_path_factory):
    """The room of seed 0 as a perfect fit would have it: points on its true surfaces, a vector a class."""
    room, rng = furnish(0), np.random.default_rng(0)
    points = [sampled(item.parts, SPACING, rng) for item in (*room.objects, *room.shell)]
    count = len(room.objects)
    owners = [*range(count), *[-1] * len(room.shell)]
    ids = np.repeat(np.array(owners, np.int32), [len(part) for part in points])
    vectors = np.linalg.qr(rng.normal(size=(32, 32)))[0][: len(CLASS_NAMES)].astype(np.float32)
    classes = [CLASS_NAMES.index(item.name) for item in room.objects]
    table = replace(instance_table(count), descriptors=vectors[classes])
    cloud = make_cloud(np.concatenate(points), ids, SPACING, 2 * SPACING, instances=table)
    cloud = replace(cloud, vocabulary=Vocabulary(CLASS_NAMES, vectors))
    return write_bundle(cloud, tmp_path_factory.mktemp("room") / "room.ogpc")


@pytest.mark.slow
def test_the_example_leaves_a_picture_and_two_bags(true_scene, tmp_path):
    assert len(EXAMPLE.read_text().splitlines()) <= 60
    (tmp_path / "drive").mkdir()
    (tmp_path / "drive" / "mine.txt").write_text("kept")
    command = [sys.executable, str(EXAMPLE), "-o", str(tmp_path), "--scene", str(true_scene), "--frames", "8"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    lines = {line.split(":")[0]: line for line in done.stdout.splitlines()}
    right = float(lines["right label on what stands as mapped"].split(":")[1].split("%")[0])
    unknown = float(lines["unknown"].split("%")[1].split()[-1])
    same = float(lines["read back"].split()[2].rstrip("%"))
    assert right > 85
    assert unknown > 95
    assert same > 99.9
    assert (tmp_path / "07_robot.png").read_bytes().startswith(b"\x89PNG")
    assert {path.name for path in tmp_path.iterdir()} == {
        "07_robot.png",
        "07_robot_drive",
        "07_robot_labelled",
        "drive",
    }
    assert (tmp_path / "drive" / "mine.txt").read_text() == "kept"
