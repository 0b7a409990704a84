"""The node that maps, on stand-ins for rclpy and tf2 (``fake_ros``): it was never run on ROS here."""

import importlib

import numpy as np
import pytest

pytest.importorskip("rosbags")

import fake_ros
from frame_messages import messages_of, place_of, stamp_of, without_losses
from og_pointcloud_ros import ros_messages
from visits import BIN, CHEST, CRATE, SPACE, frames, moved

from og_pointcloud.errors import OgPointcloudError
from og_pointcloud.mapping.frame_queue import FrameQueue

BEFORE, AFTER = [CHEST, BIN, CRATE], [CHEST, BIN, moved(CRATE, (-0.9, 0.5, 0.0))]


@pytest.fixture
def module(monkeypatch):
    fake_ros.install(monkeypatch)
    fake_ros.Node.overrides.update(feature_space=SPACE, max_age=60.0)
    return importlib.import_module("og_pointcloud_ros.map_node")


def send(node, given, *, placed=True, without=(), messages=messages_of):
    for frame in given:
        if placed:
            node._transforms.tell("map", "camera", stamp_of(frame), *place_of(frame))
        for role, message in messages(ros_messages, frame).items():
            if role not in without:
                node.subscriptions[f"~/input/{role}"].callback(message)


def settled(node):
    """Wait until the queue has worked off what it has."""
    node._queue.close()
    node._queue = FrameQueue(node._queue.mapper, max_age=60.0, on_change=node._on_change, on_drop=node._warn)
    return node


def objects(node):
    """State by id, as the newest message says."""
    return {int(one.id): one.results[0].hypothesis.class_id for one in node.publishers["~/objects"].sent[-1].detections}


def warnings(node):
    return [text for level, text in node.logger.lines if level == "warning"]


def test_frames_become_objects_with_a_state(module):
    node = module.MapNode()
    send(node, frames(BEFORE))
    settled(node)
    assert len(node.publishers["~/objects"].sent) == 14
    assert set(objects(node).values()) == {"present"}
    (crate,) = (o for o in node._queue.mapper.objects() if np.abs(o.place[:2] - [0.65, 0.7]).max() < 0.2)
    box = next(one.bbox for one in node.publishers["~/objects"].sent[-1].detections if one.id == str(crate.id))
    assert abs(box.center.position.z - CRATE.size[2] / 2) < 0.02, "of the box, which is not where most points are"
    send(node, frames(AFTER, seed=1, first=100.0))
    assert objects(settled(node))[crate.id] == "moved"
    assert any(line == ("info", f"moved: {crate.id}") for line in node.logger.lines)
    node.destroy_node()
    assert node.destroyed


def test_compressed_images_make_the_map_that_raw_ones_make(module):
    raw = module.MapNode()
    send(raw, frames(BEFORE)[:3])
    fake_ros.Node.overrides["compressed"] = "depth, color,masks"
    node = module.MapNode()
    kinds = {name: subscription.kind.__name__ for name, subscription in node.subscriptions.items()}
    assert [kinds[f"~/input/{role}"] for role in ("depth", "masks", "color", "features")] == [
        "CompressedImage", "CompressedImage", "CompressedImage", "PointCloud2"
    ]  # fmt: skip
    send(node, frames(BEFORE)[:3], messages=without_losses)
    one, other = (settled(each)._queue.mapper.snapshot().cloud for each in (raw, node))
    assert len(one) > 0
    for name in ("xyz", "instance_ids", "rgb"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    assert not warnings(node)


def test_what_cannot_be_compressed_is_named(module):
    fake_ros.Node.overrides["compressed"] = "depth,features"
    with pytest.raises(OgPointcloudError, match="lists 'features'; expected one or more of depth, masks, color"):
        module.MapNode()


def test_the_map_is_saved_reset_and_loaded(module, tmp_path):
    node = module.MapNode()
    send(node, frames(BEFORE))
    known = objects(settled(node))
    answer = node.services["~/save"]()
    assert not answer.success
    assert "'map' is empty" in answer.message
    node.parameters["map"] = str(tmp_path / "room.ogpc")
    assert node.services["~/save"]().success
    assert node.services["~/reset"]().success
    assert objects(node) == {}
    node.parameters["feature_space"] = "another/encoder"
    answer = node.services["~/load"]()
    assert not answer.success
    assert "'another/encoder'" in answer.message
    node.parameters["feature_space"] = SPACE
    assert node.services["~/load"]().success
    assert objects(node) == dict.fromkeys(known, "unseen")
    send(node, frames(BEFORE, seed=2, first=200.0))
    assert objects(settled(node)) == dict.fromkeys(known, "present")


def test_a_frame_waits_for_its_transform_and_its_masks(module):
    node = module.MapNode()
    (frame,) = frames(BEFORE)[:1]
    send(node, [frame], placed=False)
    node.timers[0]()
    assert settled(node)._queue.mapper.points == 0
    node._transforms.tell("map", "camera", stamp_of(frame), *place_of(frame))
    node.timers[0]()
    assert settled(node)._queue.mapper.points > 0


def test_what_waits_too_long_is_used_as_it_is_or_dropped(module, monkeypatch):
    now = [100.0]
    monkeypatch.setattr(module.time, "monotonic", lambda: now[0])
    node = module.MapNode()
    first, second, third = frames(BEFORE)[:3]
    send(node, [first], without=("masks", "features"))
    send(node, [second], placed=False)
    send(node, [third], without=("depth", "masks"))
    assert settled(node)._queue.mapper.points == 0
    now[0] += 61.0
    node.timers[0]()
    assert settled(node)._queue.mapper.points > 0  # depth alone is a frame
    assert any("transform did not arrive" in text for text in warnings(node))
    assert any("features came without masks of the same stamp" in text for text in warnings(node))
    assert not node._assembler.waiting


def test_what_cannot_be_used_is_said_and_the_next_is_used(module):
    node = module.MapNode()
    first, second = frames(BEFORE)[:2]
    messages = messages_of(ros_messages, first)
    messages["depth"].encoding = "yuv422"
    node.subscriptions["~/input/depth"].callback(messages["depth"])
    node.subscriptions["~/input/features"].callback(messages["masks"])
    assert "yuv422" in warnings(node)[0]
    assert len(warnings(node)) == 2
    send(node, [second])
    assert settled(node)._queue.mapper.points > 0
