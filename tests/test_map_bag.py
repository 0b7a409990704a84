"""A map of a ROS 2 bag: depth, masks with features and tf in, a .ogpc out."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("rosbags")

from commands import run
from frame_messages import (
    COMPRESSED,
    compressed,
    image_message,
    messages_of,
    place_of,
    png,
    stamp_of,
    transform,
    without_losses,
)  # fmt: skip
from og_pointcloud_ros.bags import ros2_types, rosbags_messages
from og_pointcloud_ros.frames import ENCODINGS, FrameAssembler, compressed_image_array
from og_pointcloud_ros.map_bags import BagFrames
from og_pointcloud_ros.messages import plain_messages
from rosbags.rosbag2 import Writer
from visits import BIN, CHEST, CRATE, SPACE, frames, instance_of, moved

import og_pointcloud as og
from og_pointcloud.cli import main, map_
from og_pointcloud.errors import SceneError

cv2 = pytest.importorskip("cv2")
TOPICS = {"info": "/camera_info", "depth": "/depth/image_rect", "color": "/color/image_rect", "masks": "/masks",
          "features": "/mask_features"}  # fmt: skip
KINDS = {"features": "sensor_msgs/msg/PointCloud2", "info": "sensor_msgs/msg/CameraInfo"}
TWO_CAMERAS = {"back info": "/back/camera_info", "back color": "/back/image_rect", "info": "/front/camera_info",
               "depth": "/front/depth/image_rect", "masks": "/front/depth/masks", "features": "/front/features",
               "color": "/front/image_rect"}  # fmt: skip


def write_bag(folder, given, without=(), messages=messages_of, topics=TOPICS, unplaced=()):
    store = ros2_types()
    make = rosbags_messages(store)
    with Writer(folder, version=8) as bag:
        kinds = {topic: KINDS.get(role.split()[-1], "sensor_msgs/msg/Image") for role, topic in topics.items()}
        kinds |= {topic: COMPRESSED for topic in topics.values() if topic.endswith(("/compressed", "/compressedDepth"))}
        kinds["/tf"] = "tf2_msgs/msg/TFMessage"
        out = {t: bag.add_connection(t, kind, typestore=store) for t, kind in kinds.items() if t not in without}
        for recorded, frame in enumerate(given):
            sent = {"/tf": transform(make, "map", "camera", *place_of(frame), stamp_of(frame))}
            if recorded in unplaced:
                sent = {}
            sent |= {topics[role]: message for role, message in messages(make, frame).items()}
            for topic in sent.keys() & out:
                bag.write(out[topic], recorded, store.serialize_cdr(sent[topic], kinds[topic]))
    return folder


THINGS = [CHEST, BIN, CRATE]


def test_a_bag_becomes_a_map(tmp_path, capsys):
    bag = write_bag(tmp_path / "drive", frames(THINGS))
    out = tmp_path / "room.ogpc"
    assert main(["map", str(bag), "-o", str(out), "--feature-space", SPACE]) == 0
    cloud = og.load(out).cloud
    assert len({instance_of(cloud, thing) for thing in THINGS} - {-1}) == 3
    assert cloud.feature_space == SPACE
    assert "14 frames" in capsys.readouterr().out
    assert not out.with_name("room.ogpc.map").exists()


def test_an_interrupted_map_is_resumed(tmp_path, capsys, monkeypatch):
    integrate, mappers = og.Mapper.integrate, []

    def interrupted(mapper, frame):
        mappers.append(mapper)
        if len(mappers) == 7:  # what numba makes of Ctrl-C in compiled code
            raise SystemError("a kernel returned a result with an exception set") from KeyboardInterrupt()
        return integrate(mapper, frame)

    given = frames(THINGS)
    given.insert(5, given.pop())  # late frames follow it, as in a bag that was put together of two
    bag = write_bag(tmp_path / "drive", given)
    arguments = ["map", str(bag), "-o", str(tmp_path / "room.ogpc"), "--feature-space", SPACE]
    with monkeypatch.context() as patch:
        patch.setattr(og.Mapper, "integrate", interrupted)
        assert main(arguments) == 130
    assert "room.ogpc.map': the map so far; --resume continues it" in capsys.readouterr().err
    assert not (tmp_path / "room.ogpc.map" / ".lock").exists(), "other processes are still kept out"
    assert main(arguments) == 2
    assert "add --resume" in capsys.readouterr().err
    assert main([*arguments, "--resume"]) == 0
    assert "8 frames" in capsys.readouterr().out


def test_a_map_that_goes_on_says_what_changed_and_how_large_it_is(tmp_path, capsys):
    first, later = tmp_path / "first.ogpc", tmp_path / "later.ogpc"
    bag = write_bag(tmp_path / "drive", frames(THINGS))
    assert run(capsys, "map", bag, "-o", first, "--feature-space", SPACE)[0] == 0
    bag = write_bag(tmp_path / "again", frames([CHEST, moved(CRATE, (-0.9, 0.5, 0.0))], seed=1, first=100.0))
    code, said, _ = run(capsys, "map", bag, "--start", first, "-o", later)
    cloud, before = og.load(later).cloud, og.load(first).cloud
    present = int((cloud.instances.points > 0).sum())
    assert code == 0
    assert f"gone: {instance_of(before, BIN)}\nmoved: {instance_of(before, CRATE)} from (" in said
    assert f"14 frames, {len(cloud):,} points, {present} objects" in said
    assert present == len(before.instances) - 1


@pytest.mark.parametrize("more", [[], ["--resume"]])
def test_a_folder_of_other_files_is_no_map_and_stays(tmp_path, capsys, more):
    bag, work = write_bag(tmp_path / "drive", frames(THINGS)[:2]), tmp_path / "precious"
    work.mkdir()
    (work / "thesis.txt").write_text("keep")
    assert main(["map", str(bag), "-o", str(tmp_path / "room.ogpc"), "--work", str(work), *more]) == 2
    assert "has other files than a map" in capsys.readouterr().err
    assert (work / "thesis.txt").read_text() == "keep"


def test_reasons_that_are_not_shown_are_counted(tmp_path, capsys, monkeypatch):
    given = [
        replace(frame, features=frame.features[:, :k] if k < 4 else frame.features[:1]) if k else frame
        for k, frame in enumerate(frames(THINGS)[:6])
    ]
    monkeypatch.setattr(map_, "SHOWN", 2)
    _, _, said = run(capsys, "map", write_bag(tmp_path / "drive", given), "-o", tmp_path / "room.ogpc")
    lines = [line for line in said.splitlines() if line.startswith("left out: ")]
    assert "mask features of frame 2 are" in lines[0]  # the only one of its width, so by its name
    assert lines[2:] == ["left out: 3 more, for 2 other reasons"]


def test_where_no_frame_is_taken_it_is_said_why_and_nothing_is_left(tmp_path, capsys):
    given = [replace(frame, depth=0 * frame.depth) for frame in frames(THINGS)[:2]]
    out = tmp_path / "room.ogpc"
    code, _, said = run(capsys, "map", write_bag(tmp_path / "drive", given), "-o", out)
    assert code == 2
    assert "left out: 2 x a frame has no depth, and the map has no points yet" in said
    assert sorted(path.name for path in tmp_path.iterdir()) == ["drive"]


def test_a_map_without_masks_leaves_nothing_either(tmp_path, capsys):
    bag = write_bag(tmp_path / "drive", frames(THINGS)[:2], messages=shifted)
    code, _, said = run(capsys, "map", bag, "-o", tmp_path / "room.ogpc")
    assert code == 2
    assert "left out: 2 x masks came without features" in said
    assert "no frame with masks has shown any point of the map yet" in said
    assert sorted(path.name for path in tmp_path.iterdir()) == ["drive"]


def as_gray(make, frame):
    messages = messages_of(make, frame)
    return messages | {"color": image_message(make, frame.rgb[..., 0], "mono8", stamp_of(frame))}


def as_halved(make, frame):
    messages = messages_of(make, frame)
    return messages | {"color": image_message(make, frame.rgb[::2, ::2], "rgb8", stamp_of(frame))}


def test_gray_images_color_points_gray_and_those_of_another_size_none(tmp_path):
    given = frames(THINGS)[:2]
    gray = write_bag(tmp_path / "gray", given, messages=as_gray)
    for frame, read in zip(given, BagFrames(gray), strict=True):
        np.testing.assert_array_equal(read.rgb, np.repeat(frame.rgb[..., :1], 3, axis=2))
    with pytest.warns(UserWarning, match=r"color images are uint8 .*: colors are left out") as said:
        read = list(BagFrames(write_bag(tmp_path / "halved", given, messages=as_halved)))
    assert ([frame.rgb for frame in read], len(said)) == ([None, None], 1)
    assert og.Mapper(feature_space=SPACE).integrate(read[0])


def test_frames_of_a_bag_are_those_that_were_recorded(tmp_path):
    given = frames(THINGS)
    given[3] = replace(given[3], masks=np.full_like(given[3].masks, -1), features=given[3].features[:0])
    for frame, read in zip(given, BagFrames(write_bag(tmp_path / "drive", given)), strict=True):
        np.testing.assert_allclose(read.camera.world_to_camera, frame.camera.world_to_camera, atol=1e-6)
        assert read.camera.intrinsics == frame.camera.intrinsics
        np.testing.assert_allclose(read.depth, frame.depth, atol=6e-4)
        np.testing.assert_array_equal(read.masks, frame.masks)
        np.testing.assert_array_equal(read.rgb, frame.rgb)
        np.testing.assert_array_equal(read.features, frame.features)


@pytest.mark.parametrize(("colors", "masks"), [("rgba8", "8UC1"), ("bgra8", "32SC1"), ("rgb8", "mono8")])
def test_images_of_other_encodings_are_read_alike(tmp_path, colors, masks):
    def encoded(make, frame):
        channels = frame.rgb[..., ::-1] if colors[0] == "b" else frame.rgb
        channels = np.dstack([channels, np.full(channels.shape[:2], 255, np.uint8)])[..., : len(colors) - 1]
        ids = (frame.masks + 1).astype(np.int32 if masks == "32SC1" else np.uint8)
        return messages_of(make, frame) | {
            "color": image_message(make, channels, colors, stamp_of(frame)),
            "masks": image_message(make, ids, masks, stamp_of(frame)),
        }

    (frame,) = frames(THINGS)[:1]
    (read,) = BagFrames(write_bag(tmp_path / "drive", [frame], messages=encoded))
    np.testing.assert_array_equal(read.rgb, frame.rgb)
    np.testing.assert_array_equal(read.masks, frame.masks)


def shifted(make, frame):
    messages = messages_of(make, frame)
    messages["masks"].header.stamp.nanosec += 1
    return messages


def test_masks_and_features_of_different_stamps_are_counted(tmp_path):
    bag = BagFrames(write_bag(tmp_path / "drive", frames(THINGS)[:3], messages=shifted))
    assert [frame.features for frame in bag] == [None] * 3
    assert bag.dropped == {
        f"{one} came without {other} of the same stamp: give both the stamp of their image": 3
        for one, other in (("masks", "features"), ("features", "masks"))
    }


def test_frames_outside_the_time_of_tf_are_counted_together(tmp_path):
    read = BagFrames(write_bag(tmp_path / "drive", frames(THINGS)[:5], unplaced=(0, 3, 4)))
    assert len(list(read)) == 2
    assert read.dropped == {"'camera' in 'map' is known from 2.000 to 3.000 s, not at the time of some frames": 3}


def beside_a_raw_image(make, frame):
    """The messages of a frame whose images image_proc rectified: P is their lens, K and D are that of the raw ones."""
    messages = messages_of(make, frame)
    info = messages["info"]
    info.p[:] = np.c_[info.k.reshape(3, 3), np.zeros(3)].ravel()
    info.k[:], info.d[:] = 1.1 * info.k, 0.1
    return messages


def test_rectified_images_have_the_lens_of_p(tmp_path, monkeypatch):
    (frame,) = frames(THINGS)[:1]
    (read,) = BagFrames(write_bag(tmp_path / "drive", [frame], messages=beside_a_raw_image))
    assert read.camera.intrinsics == frame.camera.intrinsics
    raw = FrameAssembler()
    for role, message in beside_a_raw_image(plain_messages, frame).items():
        raw.add(role, message)
    with pytest.raises(SceneError, match="has distortion; expected rectified images"):
        raw.frame(stamp_of(frame), lambda frame_id, stamp: np.eye(4))


def beside_a_second_camera(make, frame):
    messages = messages_of(make, frame)
    other = replace(frame, camera=replace(frame.camera, fx=2 * frame.camera.fx), rgb=255 - frame.rgb)
    for role in ("info", "color"):
        messages[f"back {role}"] = messages_of(make, other)[role]
        messages[f"back {role}"].header.frame_id = "back"
    return messages


def test_of_two_cameras_each_has_its_own_lens_and_colors(tmp_path):
    (frame,) = frames(THINGS)[:1]
    (read,) = BagFrames(write_bag(tmp_path / "drive", [frame], (), beside_a_second_camera, TWO_CAMERAS))
    assert read.camera.intrinsics == frame.camera.intrinsics
    np.testing.assert_array_equal(read.rgb, frame.rgb)  # recorded after the features
    np.testing.assert_array_equal(read.masks, frame.masks)  # of a topic below /front/depth


def test_a_depth_image_of_none_of_the_cameras_is_refused(tmp_path):
    def of_a_third(make, frame):
        messages = beside_a_second_camera(make, frame)
        messages["depth"].header.frame_id = "third"
        return messages

    bag = write_bag(tmp_path / "drive", frames(THINGS)[:1], (), of_a_third, TWO_CAMERAS)
    with pytest.raises(SceneError, match=r"frame_id 'third'; expected .*'camera' \(/front/camera_info\), 'back' \("):
        BagFrames(bag)


def test_a_frame_stands_where_its_depth_was_measured(tmp_path):
    def color_from_elsewhere(make, frame):
        messages = messages_of(make, frame)
        messages["color"].header.frame_id = "color_camera"  # which tf does not know
        return messages

    late = dict(sorted(TOPICS.items(), key=lambda item: item[0] == "color"))
    for number, topics in enumerate((TOPICS, late)):
        bag = BagFrames(write_bag(tmp_path / str(number), frames(THINGS)[:1], (), color_from_elsewhere, topics))
        assert (len(list(bag)), bag.dropped) == (1, {})


@pytest.mark.parametrize("role", ["depth", "masks", "features", "info"])
def test_what_a_bag_lacks_is_named(tmp_path, role):
    bag = write_bag(tmp_path / "drive", frames(THINGS)[:1], without=(TOPICS[role],))
    with pytest.raises(SceneError, match=f"has no {role}; expected "):
        BagFrames(bag)


OF_TRANSPORTS = TOPICS | {"depth": "/depth/image_rect/compressedDepth", "color": "/color/image_rect/compressed",
                          "masks": "/masks/compressed"}  # fmt: skip


def test_compressed_images_are_read_as_the_others(tmp_path):
    (frame,) = frames(THINGS)[:1]
    (plain,) = BagFrames(write_bag(tmp_path / "plain", [frame]))
    # Topics of raw images that nobody recorded are in many bags.
    bag = write_bag(
        tmp_path / "small", [frame], (), without_losses, OF_TRANSPORTS | {"silent color": "/color/image_rect"}
    )
    (read,) = BagFrames(bag)
    for role in ("depth", "masks", "rgb", "features"):
        np.testing.assert_array_equal(getattr(read, role), getattr(plain, role), role)


def test_of_an_image_in_both_forms_the_uncompressed_one_is_read(tmp_path):
    (frame,) = frames(THINGS)[:1]

    def both(make, frame):
        of_other = without_losses(make, replace(frame, rgb=255 - frame.rgb, depth=2 * frame.depth))
        return messages_of(make, frame) | {f"{role} again": of_other[role] for role in ("depth", "color")}

    topics = TOPICS | {f"{role} again": OF_TRANSPORTS[role] for role in ("depth", "color")}
    (read,) = BagFrames(write_bag(tmp_path / "drive", [frame], (), both, topics))
    np.testing.assert_array_equal(read.rgb, frame.rgb)
    np.testing.assert_allclose(read.depth, frame.depth, atol=6e-4)


def test_compressed_depth_in_meters_is_unpacked():
    depth = np.array([[0, 0.5, 1.25], [3.0, 7.5, 0]])
    a, b = 100.0 * 101.0, 1 - 100.0 * 101.0 / 10.0  # the codec's defaults: steps of 1 / 100 at 1 m, up to 10 m
    with np.errstate(divide="ignore"):
        stored = np.where(depth > 0, a / depth + b, 0).astype(np.uint16)
    data = np.r_[
        np.frombuffer(np.array([0], "<i4").tobytes() + np.array([a, b], "<f4").tobytes(), np.uint8), png(stored)
    ]
    message = SimpleNamespace(format="32FC1; compressedDepth png", data=data)
    read = compressed_image_array(message)
    assert read.dtype == np.float32
    np.testing.assert_array_equal(read == 0, depth == 0)
    np.testing.assert_allclose(read[depth > 0], depth[depth > 0], rtol=1e-3)
    with pytest.raises(SceneError, match=r"is coded by RVL; expected PNG: set the publisher's compressedDepth format"):
        compressed_image_array(SimpleNamespace(format="16UC1; compressedDepth rvl", data=data))
    with pytest.raises(SceneError, match="compressedDepth of 32FC1 holds uint8"):
        compressed_image_array(
            SimpleNamespace(format=message.format, data=np.r_[data[:12], png(stored.astype(np.uint8))])
        )


def test_masks_that_were_changed_by_jpeg_are_left_out(tmp_path):
    def as_jpeg(make, frame):
        messages = without_losses(make, frame)
        data = cv2.imencode(".jpg", (frame.masks + 1).astype(np.uint8))[1].ravel()
        return messages | {"masks": compressed(make, messages["masks"], "mono8; jpeg compressed ", data)}

    read = BagFrames(write_bag(tmp_path / "drive", frames(THINGS)[:2], (), as_jpeg, OF_TRANSPORTS))
    assert [frame.masks for frame in read] == [None, None]
    assert any("masks are JPEG images, which change numbers" in reason for reason in read.dropped)


@pytest.mark.parametrize(("role", "encoding", "says"), [
    ("depth", "mono8", "depth is uint8; expected 16UC1, millimeters, or 32FC1, meters"),
    ("masks", "32FC1", "masks are float32; expected 8UC1, 16UC1 or 32SC1"),
])  # fmt: skip
def test_pixels_of_the_wrong_kind_are_refused(role, encoding, says):
    """Depth drawn as a gray image has lost the lengths; a mask's number has no fractions."""
    code = ENCODINGS[encoding][0]
    message = image_message(plain_messages, np.ones((4, 5), code), encoding, 0)
    with pytest.raises(SceneError, match=says):
        FrameAssembler().add(role, message)


def test_a_damaged_compressed_image_is_named():
    with pytest.raises(SceneError, match=r"an image of format 'jpeg' \(40 bytes\) cannot be decoded"):
        compressed_image_array(SimpleNamespace(format="jpeg", data=np.zeros(40, np.uint8)))


def test_millimeters_as_floats_are_refused(tmp_path):
    def in_millimeters(make, frame):
        depth = image_message(make, (1000 * frame.depth).astype(np.float32), "32FC1", stamp_of(frame))
        return messages_of(make, frame) | {"depth": depth}

    read = BagFrames(write_bag(tmp_path / "drive", frames(THINGS)[:1], (), in_millimeters))
    assert not list(read)
    assert any("expected meters in 32FC1 (REP 118)" in reason for reason in read.dropped)
