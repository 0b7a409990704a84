"""The node, on stand-ins for rclpy and tf2 (``fake_ros``): it was never run on ROS here."""

import importlib
import json
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rosbags")

import fake_ros
from og_pointcloud_ros import from_pointcloud2, read_fields, ros_messages, write_fields

import og_pointcloud as og

PACKAGE = Path(__file__).resolve().parents[1] / "plugins" / "og_pointcloud_ros"
STAMP = 5_000_000_000
TURN_LEFT = (0, 0, np.sqrt(0.5), np.sqrt(0.5))
WORDS = ["apple", "pear", "plum"]


@pytest.fixture
def rclpy(monkeypatch, scene):
    stand_in = fake_ros.install(monkeypatch)
    fake_ros.Node.overrides.update(scene=str(scene.path), labels=WORDS, minimum_points=1)
    return stand_in


@pytest.fixture
def module(rclpy):
    return importlib.import_module("og_pointcloud_ros.node")


@pytest.fixture
def node(module):
    made = module.SegmentNode()
    made._transforms.tell("map", "lidar", STAMP, (1, 2, 3), TURN_LEFT)
    return made


def cloud(scene, stamp=STAMP, frame="lidar"):
    """The scene's points as a sensor at (1, 2, 3) that looks along y sees them."""
    rows = np.zeros(len(scene.xyz), [(axis, "<f4") for axis in "xyz"])
    x, y, z = (scene.xyz - [1, 2, 3]).T
    rows["x"], rows["y"], rows["z"] = y, -x, z
    return write_fields(rows, frame, stamp, messages=ros_messages)


def send(node, topic, message):
    node.subscriptions[topic].callback(message)


def sent(node, topic="~/output/points"):
    return node.publishers[topic].sent


def test_a_cloud_is_labelled_where_tf_puts_it(node, scene):
    message = cloud(scene)
    send(node, "~/input/points", message)
    (points,), (detections,) = sent(node), sent(node, "~/output/detections")
    expected = og.segment(scene.xyz, WORDS, scene)
    rows = read_fields(points)[0]
    assert (rows["instance"] == expected.instances).mean() > 0.99
    assert set(rows["label"].tolist()) == {0, 1, 2, 65535}
    np.testing.assert_array_equal(from_pointcloud2(points), from_pointcloud2(message))
    assert points.header.frame_id == "lidar"
    assert points.header.stamp.sec == 5
    assert detections.header.frame_id == "map"
    assert {entry.results[0].hypothesis.class_id for entry in detections.detections} == set(WORDS)


def test_topics_and_their_quality(node):
    latest = fake_ros.QoSProfile("keep last", 1, "best effort", "volatile")
    assert node.name == "og_pointcloud"
    assert node.subscriptions["~/input/points"].qos == latest
    assert set(node.subscriptions) == {"~/input/points"}
    assert {topic: publisher.qos.durability for topic, publisher in node.publishers.items()} == {
        "~/output/points": "volatile", "~/output/detections": "volatile", "~/label_info": "transient local",
    }  # fmt: skip
    assert all(publisher.qos.reliability == "reliable" for publisher in node.publishers.values())


def names(node):
    return [[entry.class_name for entry in info.class_map] for info in sent(node, "~/label_info")]


def set_labels(node, *labels):
    (answer,) = node.set_parameters([fake_ros.Parameter("labels", list(labels))])
    return answer


def test_labels_change_while_it_runs(node, scene):
    assert set_labels(node, "pear", "plum").successful
    assert names(node) == [WORDS, ["pear", "plum"]]
    assert sent(node, "~/label_info")[0].header.stamp.sec == 12
    assert node.get_parameter("labels").value == ["pear", "plum"]
    send(node, "~/input/points", cloud(scene))
    assert set(read_fields(sent(node)[0])["label"].ravel().tolist()) == {0, 1, 65535}


def test_setting_the_parameter_answers(node):
    good, unknown = set_labels(node, "plum"), set_labels(node, "pear", "unicorn")
    (fixed,) = node.set_parameters([fake_ros.Parameter("scene", "other.ogpc")])
    (foreign,) = node.set_parameters([fake_ros.Parameter("use_sim_time", True)])
    assert (good.successful, unknown.successful, fixed.successful, foreign.successful) == (True, False, False, True)
    assert "unicorn" in unknown.reason
    assert "only read at startup" in fixed.reason
    assert node.get_parameter("labels").value == ["plum"]
    assert names(node) == [WORDS, ["plum"]]


def test_nothing_is_done_for_nobody_and_one_listener_is_enough(node, scene):
    for publisher in node.publishers.values():
        publisher.listeners = 0
    calls, labeller = [], node._labeller
    node._labeller = lambda *now: calls.append(now)
    send(node, "~/input/points", cloud(scene))
    assert (calls, sent(node)) == ([], [])
    node._labeller = labeller
    node.publishers["~/output/detections"].listeners = 1
    send(node, "~/input/points", cloud(scene))
    assert len(sent(node, "~/output/detections")) == 1


def test_a_cloud_waits_for_its_transform(node, scene):
    late = STAMP + 7
    send(node, "~/input/points", cloud(scene, late))
    assert sent(node) == []
    node._transforms.tell("map", "lidar", late, (1, 2, 3), TURN_LEFT)
    (tick,) = node.timers
    tick()
    assert len(sent(node)) == 1
    tick()
    assert len(sent(node)) == 1


def test_a_newer_cloud_takes_the_place_of_one_that_waits(node, scene):
    send(node, "~/input/points", cloud(scene, STAMP + 7))
    send(node, "~/input/points", cloud(scene, STAMP))
    node._transforms.tell("map", "lidar", STAMP + 7, (1, 2, 3), TURN_LEFT)
    node.timers[0]()
    assert [points.header.stamp.nanosec for points in sent(node)] == [0]


def test_a_cloud_that_waits_too_long_is_dropped(node, scene, module, monkeypatch):
    now = [100.0]
    monkeypatch.setattr(module.time, "monotonic", lambda: now[0])
    send(node, "~/input/points", cloud(scene, STAMP + 7))
    now[0] += 0.4
    node.timers[0]()
    assert not [line for line in node.logger.lines if line[0] == "warning"]
    now[0] += 0.2
    node.timers[0]()
    assert "did not arrive within 0.5 s" in node.logger.lines[-1][1]
    node._transforms.tell("map", "lidar", STAMP + 7, (1, 2, 3), TURN_LEFT)
    node.timers[0]()
    assert sent(node) == []


DAMAGES = {
    "cut off": (lambda cloud: setattr(cloud, "width", cloud.width + 1), "it was cut off"),
    "no fields": (lambda cloud: setattr(cloud, "fields", None), "fields of a PointCloud2 are damaged"),
    "before 1970": (lambda cloud: setattr(cloud.header.stamp, "sec", -3), "Seconds value must not be negative"),
    "no header": (lambda cloud: setattr(cloud, "header", None), "AttributeError"),
}


@pytest.mark.parametrize(("damage", "text"), DAMAGES.values(), ids=DAMAGES)
def test_a_damaged_cloud_is_dropped_and_the_next_is_not(node, scene, damage, text):
    damaged = cloud(scene)
    damage(damaged)
    send(node, "~/input/points", damaged)
    assert text in node.logger.lines[-1][1]
    send(node, "~/input/points", cloud(scene))
    assert len(sent(node)) == 1


def test_words_that_cannot_be_scored_change_nothing(node, module, monkeypatch):
    def broken(*_, **__):
        raise RuntimeError("the graph ended")

    monkeypatch.setattr(module, "Segmenter", broken)
    answer = set_labels(node, "chair")
    assert (answer.successful, answer.reason) == (False, "RuntimeError: the graph ended")


def test_max_distance_shortens_the_reach(module, scene):
    def unknown():
        made = module.SegmentNode()
        made._transforms.tell("map", "lidar", STAMP, (1, 2, 3.02), TURN_LEFT)  # 2 cm off
        send(made, "~/input/points", cloud(scene))
        return (read_fields(sent(made)[0])["instance"] == -3).mean()

    assert unknown() == 0
    fake_ros.Node.overrides["max_distance"] = 0.01
    assert unknown() > 0.5


def test_no_label_given_means_all_words(module):
    del fake_ros.Node.overrides["labels"]
    assert names(module.SegmentNode()) == [["apple", "pear", "plum", "café", "red ball"]]


def test_main_runs_until_it_is_stopped(module, rclpy):
    assert module.main([]) == 0
    (node,) = rclpy.state["spun"]
    assert node.destroyed
    assert not rclpy.state["running"]


@pytest.mark.parametrize(("path", "text"), [("", "'scene' is empty"), ("/no/such.ogpc", "no/such.ogpc")])
def test_main_without_a_scene_says_so(module, rclpy, path, text):
    fake_ros.Node.overrides["scene"] = path
    assert module.main([]) == 2
    ((level, line),) = rclpy.state["log"].lines
    assert level == "fatal"
    assert text in line
    assert not rclpy.state["running"]


# The package ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("file", "node"), [("parameters", "node"), ("map", "map_node")])
def test_a_parameter_file_names_every_parameter_with_its_default(rclpy, file, node):
    yaml = pytest.importorskip("ruamel.yaml").YAML(typ="safe")
    told = yaml.load((PACKAGE / "config" / f"{file}.yaml").read_text())["/**"]["ros__parameters"]
    parameters = importlib.import_module(f"og_pointcloud_ros.{node}").PARAMETERS
    assert json.dumps(told, sort_keys=True) == json.dumps(parameters, sort_keys=True)


@pytest.mark.parametrize("name", ["segment", "map"])
def test_a_launch_file_names_what_its_node_takes(rclpy, name):
    module = importlib.import_module(f"og_pointcloud_ros.{'node' if name == 'segment' else 'map_node'}")
    inputs = ["points"] if name == "segment" else module.INPUTS
    launch = ElementTree.parse(PACKAGE / "launch" / f"{name}.launch.xml").getroot()
    arguments, node = {entry.get("name") for entry in launch.findall("arg")}, launch.find("node")
    assert {entry.get("from"): entry.get("to") for entry in node.findall("remap")} == {
        f"~/input/{role}": f"$(var {role})" for role in inputs
    }
    stated = {entry.get("name"): entry.get("value") for entry in node.findall("param") if entry.get("name")}
    assert stated == {parameter: f"$(var {parameter})" for parameter in stated}
    assert stated.keys() <= module.PARAMETERS.keys()
    assert arguments == {*inputs, *stated, "parameters"}
    assert f'"{node.get("exec")} = ' in (PACKAGE / "setup.py").read_text().replace('f"', '"')


def test_what_colcon_needs_is_there():
    package = ElementTree.parse(PACKAGE / "package.xml").getroot()
    assert package.findtext("name") == PACKAGE.name
    assert package.findtext("license") == "Apache-2.0"
    assert package.find("export").findtext("build_type") == "ament_python"
    assert (PACKAGE / "resource" / PACKAGE.name).is_file()
    setup = (PACKAGE / "setup.py").read_text()
    for path in PACKAGE.rglob("*"):
        if path.is_file() and path.parent.name in ("launch", "config"):
            assert f"{path.parent.name}/{path.name}" in setup
    lines = [line for name in ("node.py", "map_node.py") for line in (PACKAGE / name).read_text().splitlines()]
    imported = {
        line.split()[1].split(".")[0] for line in lines if line.startswith(("import", "from")) and "reportM" in line
    }
    depends = {entry.text for entry in package.findall("exec_depend")}
    assert {"rclpy", "tf2_ros", "vision_msgs", "std_srvs"} <= imported <= depends
    assert "tf2_ros_py" in depends, "the Python module tf2_ros is a package of its own"
