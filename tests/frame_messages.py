"""Frames of a map as ROS messages: what a bag holds and what a node hears."""

from __future__ import annotations

import cv2
import numpy as np
from og_pointcloud_ros import write_fields
from og_pointcloud_ros.frames import DEPTH_HEADER
from og_pointcloud_ros.messages import header
from scipy.spatial.transform import Rotation

SECOND = 1_000_000_000
COMPRESSED = "sensor_msgs/msg/CompressedImage"


def stamp_of(frame):
    """Nanoseconds."""
    return int((1 + frame.stamp) * SECOND)


def place_of(frame):
    """The camera in the map: translation (3,) and quaternion x y z w."""
    pose = np.linalg.inv(frame.camera.world_to_camera)
    return pose[:3, 3], Rotation.from_matrix(pose[:3, :3]).as_quat()


def transform(make, parent, child, translation, rotation, stamp):
    """tf2_msgs/TFMessage of one: the child in its parent, by a translation (3,) and a quaternion x y z w."""
    place = make("geometry_msgs/msg/Vector3", **dict(zip("xyz", map(float, translation), strict=True)))
    turn = make("geometry_msgs/msg/Quaternion", **dict(zip("xyzw", map(float, rotation), strict=True)))
    moved = make("geometry_msgs/msg/Transform", translation=place, rotation=turn)
    head = header(make, parent, stamp)
    stamped = make("geometry_msgs/msg/TransformStamped", header=head, child_frame_id=child, transform=moved)
    return make("tf2_msgs/msg/TFMessage", transforms=[stamped])


def image_message(make, array, encoding, stamp):
    """sensor_msgs/Image of an array (H, W) or (H, W, 3)."""
    height, width = array.shape[:2]
    data = np.frombuffer(np.ascontiguousarray(array).tobytes(), np.uint8)
    return make("sensor_msgs/msg/Image", header=header(make, "camera", stamp), height=height, width=width,
                encoding=encoding, is_bigendian=0, step=len(data) // height, data=data)  # fmt: skip


def messages_of(make, frame):
    """By role, what a camera and a mask proposer send of a frame."""
    camera, stamp = frame.camera, stamp_of(frame)
    # ROS counts pixel centers at whole numbers.
    k = np.array([camera.fx, 0, camera.cx - 0.5, 0, camera.fy, camera.cy - 0.5, 0, 0, 1], np.float64)
    window = make("sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    rows = np.zeros(len(frame.features), [("feature", "<f4", (frame.features.shape[1],))])
    rows["feature"] = frame.features
    return {
        "info": make(
            "sensor_msgs/msg/CameraInfo", header=header(make, "camera", stamp), height=camera.height,
            width=camera.width, distortion_model="plumb_bob", d=np.zeros(5), k=k, r=np.eye(3).ravel(), p=np.zeros(12),
            binning_x=0, binning_y=0, roi=window),
        "depth": image_message(make, (1000 * frame.depth).round().astype(np.uint16), "16UC1", stamp),
        "color": image_message(make, frame.rgb[..., ::-1], "bgr8", stamp),
        "masks": image_message(make, (frame.masks + 1).astype(np.uint16), "16UC1", stamp),
        "features": write_fields(rows, "camera", stamp, messages=make),
    }  # fmt: skip


def png(array):
    return cv2.imencode(".png", array)[1].ravel()


def compressed(make, message, form, data):
    return make(COMPRESSED, header=message.header, format=form, data=data)


def without_losses(make, frame):
    """The messages of a frame as image_transport compresses them; colors as PNG, too."""
    messages = messages_of(make, frame)
    depth, masks = (1000 * frame.depth).round().astype(np.uint16), (frame.masks + 1).astype(np.uint16)
    start = np.zeros(DEPTH_HEADER, np.uint8)
    forms = {"depth": ("16UC1; compressedDepth png", np.r_[start, png(depth)]),
             "masks": ("16UC1; png compressed ", png(masks)),
             "color": ("rgb8; png compressed bgr8", png(frame.rgb[..., ::-1]))}  # fmt: skip
    return messages | {role: compressed(make, messages[role], *form) for role, form in forms.items()}
