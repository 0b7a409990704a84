"""Bags in and bags out: labels as ``segment`` gives them, everything else as it was, and nothing half-written."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from commands import error_of, run
from frame_messages import transform

pytest.importorskip("rosbags")

from og_pointcloud_ros import from_pointcloud2, read_fields, write_fields
from og_pointcloud_ros.bags import label_bag, open_bag, ros2_types, rosbags_messages
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

import og_pointcloud as og

STORE = ros2_types()
MAKE = rosbags_messages(STORE)
WORDS = ["apple", "pear", "plum"]
SECOND = 1_000_000_000
CLOUDS = 4


def turned(parent, child, translation, stamp, yaw):
    return transform(MAKE, parent, child, translation, (0, 0, np.sin(yaw / 2), np.cos(yaw / 2)), stamp)


def pose_at(k):
    """base in map at second k + 1: it drives along x and turns; the lidar sits 0.5 above, looking left."""
    base, lidar = np.eye(4), np.eye(4)
    c, s = np.cos(0.1 * k), np.sin(0.1 * k)
    base[:2, :2], base[0, 3] = [[c, -s], [s, c]], 0.2 * k
    lidar[:2, :2], lidar[2, 3] = [[0, -1], [1, 0]], 0.5
    return base @ lidar


def in_lidar(scene, k):
    points = scene.xyz[k::7]
    return (points - pose_at(k)[:3, 3]) @ pose_at(k)[:3, :3]


def write_drive(folder, scene, storage=StoragePlugin.SQLITE3, compressed=None, frame="lidar", damage=None):
    """A bag of clouds seen on a drive, with tf at twice their rate, and text that has nothing to do with it."""
    bag = Writer(folder, version=8, storage_plugin=storage)
    if compressed:
        bag.set_compression(compressed, CompressionFormat.ZSTD)
    with bag:
        kinds = {
            "/lidar/points": "sensor_msgs/msg/PointCloud2", "/tf": "tf2_msgs/msg/TFMessage",
            "/tf_static": "tf2_msgs/msg/TFMessage", "/chatter": "std_msgs/msg/String",
        }  # fmt: skip
        topics = {topic: bag.add_connection(topic, kind, typestore=STORE) for topic, kind in kinds.items()}

        def write(topic, stamp, message):
            bag.write(topics[topic], stamp, STORE.serialize_cdr(message, kinds[topic]))

        write("/tf_static", 1, turned("base", "lidar", (0, 0, 0.5), 1, np.pi / 2))
        for k in range(CLOUDS):
            # Midway between two transforms: every other one is left out, so that the cloud's own has to be found.
            for half in (-0.5, 0.5):
                moment = round((k + 1 + half) * SECOND)
                write("/tf", moment, turned("map", "base", (0.2 * (k + half), 0, 0), moment, 0.1 * (k + half)))
            stamp = (k + 1) * SECOND
            rows = np.zeros(len(scene.xyz[k::7]), [("intensity", "<f4"), *((axis, "<f4") for axis in "zyx")])
            for axis, values in zip("xyz", in_lidar(scene, k).T, strict=True):
                rows[axis] = values
            cloud = write_fields(rows, frame, stamp, messages=MAKE)
            if k == damage:
                cloud.width += 1
            write("/lidar/points", stamp + 5, cloud)
            write("/chatter", stamp + 6, MAKE("std_msgs/msg/String", data=f"hello {k}"))
    return folder


def read(folder):
    """topic -> [(stamp, bytes)], and topic -> message of the first."""
    messages = {}
    with open_bag(folder) as reader:
        for connection, stamp, data in reader.messages():
            messages.setdefault((connection.topic, connection.msgtype), []).append((stamp, bytes(data)))
    return messages


def decoded(messages, topic):
    kind = next(kind for name, kind in messages if name == topic)
    return [STORE.deserialize_cdr(data, kind) for _, data in messages[topic, kind]]


def test_a_bag_that_is_packed_as_whole_files_is_refused_before_it_is_unpacked(scene, tmp_path):
    source = write_drive(tmp_path / "drive", scene, compressed=CompressionMode.FILE)
    for path in (source, next(source.glob("*.zst*"))):
        with pytest.raises(og.SceneError, match=r"compressed as whole files .*: use 'ros2 bag convert'"):
            label_bag(path, tmp_path / "out", og.Segmenter(scene, WORDS))


@pytest.mark.parametrize(
    ("storage", "compressed"),
    [(StoragePlugin.SQLITE3, None), (StoragePlugin.MCAP, None), (StoragePlugin.SQLITE3, CompressionMode.MESSAGE)],
)
def test_a_bag_is_labelled_as_its_clouds_are(scene, tmp_path, storage, compressed):
    source = write_drive(tmp_path / "drive", scene, storage, compressed)
    report = label_bag(source, tmp_path / "out", og.Segmenter(scene, WORDS), minimum_points=1, progress=True)
    before, after = read(source), read(tmp_path / "out")
    assert before == {key: after[key] for key in before}, "what was there is there"
    labelled = decoded(after, "/lidar/points/labelled")
    boxes = decoded(after, "/lidar/points/detections")
    assert len(labelled) == len(boxes) == report.clouds == CLOUDS
    share = []
    for k, (cloud, original) in enumerate(zip(labelled, decoded(before, "/lidar/points"), strict=True)):
        np.testing.assert_array_equal(from_pointcloud2(cloud), from_pointcloud2(original))
        assert (cloud.header, len(cloud.fields)) == (original.header, 7)
        expected = og.segment(in_lidar(scene, k).astype(np.float32), WORDS, scene, pose=pose_at(k))
        instances = read_fields(cloud)["instance"][0]
        share.append((instances == expected.instances).mean())
        seen = {entry.id for entry in boxes[k].detections}
        assert seen == {str(i) for i in instances[read_fields(cloud)["label"][0] != 65535].tolist()}
        assert boxes[k].header.frame_id == "map"
        assert boxes[k].header.stamp == original.header.stamp
    assert min(share) > 0.995  # a pose that was interpolated moves points on a border by a rounding
    (info,) = decoded(after, "/og_pointcloud/label_info")
    assert [entry.class_name for entry in info.class_map] == WORDS
    files = sorted(path.suffix for path in (tmp_path / "out").iterdir())
    assert files == [".mcap" if storage == StoragePlugin.MCAP else ".db3", ".yaml"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["drive", "out"]


def test_a_cloud_of_a_single_file_that_is_in_the_map_already_needs_no_transform(scene, tmp_path):
    source = next(write_drive(tmp_path / "drive", scene).glob("*.db3"))
    assert label_bag(source, tmp_path / "out", og.Segmenter(scene, WORDS), frame="lidar").clouds == CLOUDS
    with open_bag(tmp_path / "out") as reader:
        (info,) = (entry for entry in reader.connections if entry.topic == "/og_pointcloud/label_info")
        first = next(reader.messages())[0].topic
    assert info.ext.offered_qos_profiles[0].durability.name == "TRANSIENT_LOCAL"
    assert first == info.topic


def test_what_cannot_be_labelled_is_skipped_and_counted(scene, tmp_path):
    source = write_drive(tmp_path / "drive", scene, damage=2)
    report = label_bag(source, tmp_path / "out", og.Segmenter(scene, WORDS))
    assert report.clouds == CLOUDS - 1
    assert report.points == sum(report.counts.values()) + sum(report.unknown_because.values())
    (reason,) = report.skipped
    assert "it was cut off" in reason
    assert len(decoded(read(tmp_path / "out"), "/lidar/points")) == CLOUDS


def fails(tmp_path, text, source, scene, **options):
    with pytest.raises(og.SceneError, match=text):
        label_bag(source, tmp_path / "out", og.Segmenter(scene, WORDS), **options)
    assert not (tmp_path / "out").exists()
    assert [path.name for path in tmp_path.iterdir() if path.name.startswith(".")] == []


def test_missing_frames_are_named(scene, tmp_path):
    source, text = write_drive(tmp_path / "drive", scene), "'world' unknown; the frames are base, lidar, map"
    fails(tmp_path, f"from 'lidar' to 'world': {text}", source, scene, frame="world")


def test_topics_are_checked(scene, tmp_path):
    source = write_drive(tmp_path / "drive", scene)
    fails(tmp_path, "'/nose' is not in the bag; .* are /lidar/points", source, scene, topics=["/nose"])
    fails(tmp_path, "'/chatter' carries std_msgs/msg/String", source, scene, topics=["/chatter"])
    label_bag(source, tmp_path / "twice", og.Segmenter(scene, WORDS))
    fails(tmp_path, "already has a topic '/lidar/points/labelled'", tmp_path / "twice", scene)


def test_what_is_no_bag(scene, tmp_path):
    fails(tmp_path, "is not a bag; expected a folder", tmp_path / "none", scene)
    (tmp_path / "old.bag").write_bytes(b"#ROSBAG V2.0\n")
    fails(tmp_path, "is a ROS 1 bag; .* rosbags-convert --src", tmp_path / "old.bag", scene)
    (tmp_path / "text.db3").write_text("no database")
    fails(tmp_path, "cannot be read as a bag", tmp_path / "text.db3", scene)


def test_a_bag_that_breaks_off(scene, tmp_path):
    source = write_drive(tmp_path / "drive", scene)
    (file,) = source.glob("*.db3")
    os.truncate(file, file.stat().st_size // 2)
    fails(tmp_path, "cannot be read (fully|as a bag)", source, scene)


def second_cloud_raises(monkeypatch, error):
    """The labeller does, on the second cloud that it is given."""
    usual, calls = og.Segmenter.__call__, []

    def label(segmenter, *arguments):
        calls.append(arguments)
        if len(calls) == 2:
            raise error
        return usual(segmenter, *arguments)

    monkeypatch.setattr(og.Segmenter, "__call__", label)


def test_an_interruption_leaves_nothing(scene, tmp_path, monkeypatch):
    second_cloud_raises(monkeypatch, KeyboardInterrupt)
    with pytest.raises(KeyboardInterrupt):
        label_bag(write_drive(tmp_path / "drive", scene), tmp_path / "out", og.Segmenter(scene, WORDS))
    assert [path.name for path in tmp_path.iterdir()] == ["drive"]


def test_a_cloud_that_breaks_the_labeller_is_skipped_and_counted(scene, tmp_path, monkeypatch):
    second_cloud_raises(monkeypatch, ZeroDivisionError("float division by zero"))
    report = label_bag(write_drive(tmp_path / "drive", scene), tmp_path / "out", og.Segmenter(scene, WORDS))
    assert report.clouds == CLOUDS - 1
    assert dict(report.skipped) == {"ZeroDivisionError: float division by zero": 1}


def test_transforms_without_sense_are_left_out(scene, tmp_path):
    source = write_drive(tmp_path / "drive", scene)
    with Writer(tmp_path / "odd", version=8) as bag, open_bag(source) as reader:
        copies = {old.id: bag.add_connection(old.topic, old.msgtype, typestore=STORE) for old in reader.connections}
        for old, stamp, data in reader.messages():
            bag.write(copies[old.id], stamp, data)
        (static,) = (old for old in reader.connections if old.topic == "/tf_static")
        bag.write(
            copies[static.id], 3, STORE.serialize_cdr(turned("base", "arm", (np.nan, 0, 0), 1, 0.0), static.msgtype)
        )
        bag.write(copies[static.id], 4, b"\0\1\0\0\7")
    with pytest.warns(UserWarning, match="2 transform messages left out"):
        assert label_bag(tmp_path / "odd", tmp_path / "out", og.Segmenter(scene, WORDS)).clouds == CLOUDS


# The command ----------------------------------------------------------------------------------------------------


def test_the_command(scene, tmp_path, capsys):
    source = write_drive(tmp_path / "drive", scene, damage=0)
    command = ["ros-bag", source, "-o", tmp_path / "out", "--scene", scene.path, "--labels", "apple,pear"]
    code, out, _ = run(capsys, *command)
    assert code == 0
    for text in ("apple", "unknown", "3 clouds", "points per second", "skipped 1 cloud without", "next: ros2 bag play"):
        assert text in out
    before = read(tmp_path / "out")
    assert "exists; expected a new name" in error_of(capsys, *command)
    assert read(tmp_path / "out") == before


@pytest.mark.slow
def test_a_missing_rosbags_names_its_extra(scene, tmp_path):
    command = ["ros-bag", "in", "-o", str(tmp_path / "out"), "--scene", str(scene.path), "--labels", "apple"]
    code = f"import sys; sys.modules['rosbags'] = None\nfrom og_pointcloud.cli import main; sys.exit(main({command}))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (
        2, "error: this needs rosbags, which is not installed: pip install 'og-pointcloud[ros]'\n",
    )  # fmt: skip


def test_converting_messages_needs_neither_rosbags_nor_ros():
    code = "import sys; import og_pointcloud_ros; print(*sys.modules)"
    loaded = {name.split(".")[0] for name in subprocess.check_output([sys.executable, "-c", code], text=True).split()}
    assert not loaded & {"rosbags", "rclpy", "onnxruntime"}
    assert Path(__file__).resolve().parents[1].joinpath("plugins/og_pointcloud_ros/package.xml").is_file()
