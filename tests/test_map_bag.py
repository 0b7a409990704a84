"""A map of a ROS 2 bag: depth, masks with features and tf in, a .ogpc out."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("rosbags")

from og_pointcloud_ros import write_fields
from og_pointcloud_ros.bags import ros2_types, rosbags_messages
from og_pointcloud_ros.map_bags import BagFrames, image_array
from og_pointcloud_ros.messages import header
from rosbags.rosbag2 import Writer
from visits import BIN, CHEST, CRATE, SPACE, frames, instance_of

import og_pointcloud as og
from og_pointcloud.cli import main
from og_pointcloud.errors import SceneError

SECOND = 1_000_000_000


def quaternion(rotation):
    w = np.sqrt(max(1 + np.trace(rotation), 1e-12)) / 2
    x, y, z = (rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1])
    return np.array([x, y, z]) / (4 * w), w


def write_bag(folder, given, without=()):
    store = ros2_types()
    make = rosbags_messages(store)
    with Writer(folder, version=8) as bag:
        topics = {
            "/depth/image_rect": "sensor_msgs/msg/Image", "/masks": "sensor_msgs/msg/Image",
            "/mask_features": "sensor_msgs/msg/PointCloud2", "/camera_info": "sensor_msgs/msg/CameraInfo",
            "/color/image_rect": "sensor_msgs/msg/Image", "/tf": "tf2_msgs/msg/TFMessage",
        }  # fmt: skip
        out = {t: bag.add_connection(t, kind, typestore=store) for t, kind in topics.items() if t not in without}

        def send(topic, stamp, message):
            if topic in out:
                bag.write(out[topic], stamp, store.serialize_cdr(message, topics[topic]))

        def image(array, encoding, stamp):
            height, width = array.shape[:2]
            data = np.frombuffer(np.ascontiguousarray(array).tobytes(), np.uint8)
            return make("sensor_msgs/msg/Image", header=header(make, "camera", stamp), height=height, width=width,
                        encoding=encoding, is_bigendian=0, step=len(data) // height, data=data)  # fmt: skip

        for frame in given:
            camera, stamp = frame.camera, int((1 + frame.stamp) * SECOND)
            pose = np.linalg.inv(camera.world_to_camera)
            (x, y, z), w = quaternion(pose[:3, :3])
            place = make("geometry_msgs/msg/Vector3", **dict(zip("xyz", map(float, pose[:3, 3]), strict=True)))
            turn = make("geometry_msgs/msg/Quaternion", x=float(x), y=float(y), z=float(z), w=float(w))
            where = make("geometry_msgs/msg/TransformStamped", header=header(make, "map", stamp),
                         child_frame_id="camera", transform=make("geometry_msgs/msg/Transform", translation=place,
                                                                 rotation=turn))  # fmt: skip
            send("/tf", stamp, make("tf2_msgs/msg/TFMessage", transforms=[where]))
            k = np.array([camera.fx, 0, camera.cx, 0, camera.fy, camera.cy, 0, 0, 1], np.float64)
            window = make("sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0,
                          do_rectify=False)  # fmt: skip
            send("/camera_info", stamp, make(
                "sensor_msgs/msg/CameraInfo", header=header(make, "camera", stamp), height=camera.height,
                width=camera.width, distortion_model="plumb_bob", d=np.zeros(5), k=k, r=np.eye(3).ravel(),
                p=np.zeros(12), binning_x=0, binning_y=0, roi=window))  # fmt: skip
            send("/depth/image_rect", stamp, image((1000 * frame.depth).round().astype(np.uint16), "16UC1", stamp))
            send("/color/image_rect", stamp, image(frame.rgb[..., ::-1], "bgr8", stamp))
            send("/masks", stamp, image((frame.masks + 1).astype(np.uint16), "16UC1", stamp))
            rows = np.zeros(len(frame.features), [("feature", "<f4", (frame.features.shape[1],))])
            rows["feature"] = frame.features
            send("/mask_features", stamp, write_fields(rows, "camera", stamp, messages=make))
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


def test_an_interrupted_map_is_resumed(tmp_path, capsys):
    given = frames(THINGS)
    bag, out, work = write_bag(tmp_path / "drive", given), tmp_path / "room.ogpc", tmp_path / "room.ogpc.map"
    begun = og.Mapper(feature_space=SPACE, journal=work)
    for frame in list(BagFrames(bag))[:6]:
        begun.integrate(frame)
    del begun
    arguments = ["map", str(bag), "-o", str(out), "--feature-space", SPACE]
    assert main(arguments) == 2
    assert "add --resume" in capsys.readouterr().err
    assert main([*arguments, "--resume"]) == 0
    assert "8 frames" in capsys.readouterr().out


def test_frames_of_a_bag_are_those_that_were_recorded(tmp_path):
    given = frames(THINGS)
    for frame, read in zip(given, BagFrames(write_bag(tmp_path / "drive", given)), strict=True):
        np.testing.assert_allclose(read.camera.world_to_camera, frame.camera.world_to_camera, atol=1e-6)
        np.testing.assert_allclose(read.depth, frame.depth, atol=6e-4)
        np.testing.assert_array_equal(read.masks, frame.masks)
        np.testing.assert_array_equal(read.rgb, frame.rgb)
        np.testing.assert_array_equal(read.features, frame.features)


@pytest.mark.parametrize("topic", ["/depth/image_rect", "/masks", "/camera_info"])
def test_what_a_bag_lacks_is_named(tmp_path, topic):
    bag = write_bag(tmp_path / "drive", frames(THINGS)[:1], without=(topic,))
    with pytest.raises(SceneError, match=r"has no (depth|masks|info)"):
        BagFrames(bag)


def test_an_unknown_encoding_is_refused():
    message = type("Image", (), {"encoding": "yuv422", "width": 1, "height": 1})
    with pytest.raises(SceneError, match="yuv422"):
        image_array(message)
