"""Frames of a map from a ROS 2 bag, without ROS: depth and colour images, masks with features, poses from tf.

Topics are told by type and name. Images whose name has "depth" are depth (16UC1 in millimetres, 32FC1 in metres), those
with "mask" are masks (16UC1 or 32SC1: 0 none, else a number from 1 that means something in this image alone), other
colour ones are colour. A PointCloud2 with a field ``feature`` has a row a mask: what the encoder saw of masks 1, 2, ...
Messages of one stamp are one frame.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.errors import OgPointcloudError, SceneError
from og_pointcloud.mapping.frame import Frame
from og_pointcloud.scene import Camera
from og_pointcloud_ros.bags import _decoded, _messages, _transforms, open_bag, ros2_types
from og_pointcloud_ros.messages import nanoseconds
from og_pointcloud_ros.pointcloud2 import read_fields
from og_pointcloud_ros.transforms import TransformTree

__all__ = ["BagFrames", "image_array"]

IMAGE, INFO, CLOUD = "sensor_msgs/msg/Image", "sensor_msgs/msg/CameraInfo", "sensor_msgs/msg/PointCloud2"
PENDING = 100
"""Stamps that wait for their other messages; masks come seconds after their image."""
ENCODINGS = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4", "32SC1": "i4", "rgb8": "u1", "bgr8": "u1", "mono8": "u1"}


def image_array(message: Any) -> NDArray[Any]:
    """(H, W) or (H, W, 3) pixels of a sensor_msgs/Image, colours as RGB. SceneError for an encoding that is unknown."""
    encoding = str(message.encoding)
    if encoding not in ENCODINGS:
        raise SceneError(f"image encoding is '{encoding}'; expected one of {', '.join(ENCODINGS)}")
    kind = np.dtype(ENCODINGS[encoding]).newbyteorder(">" if message.is_bigendian else "<")
    data = np.frombuffer(np.asarray(message.data, np.uint8).tobytes(), np.uint8)
    channels = 3 if encoding in ("rgb8", "bgr8") else 1
    line = message.width * channels * kind.itemsize
    if message.step < line or len(data) < message.step * message.height:
        raise SceneError(f"image has {len(data)} bytes, {message.step} a line; expected {message.height} of {line}")
    lines = data[: message.step * message.height].reshape(message.height, message.step)[:, :line]
    pixels = np.ascontiguousarray(lines).view(kind).reshape(message.height, message.width, channels)
    pixels = pixels.astype(kind.newbyteorder("="))
    return pixels[..., ::-1] if encoding == "bgr8" else pixels if channels == 3 else pixels[..., 0]


@dataclass
class _Parts:
    """What has come of one stamp. frame_id: of the camera."""

    frame_id: str = ""
    depth: NDArray[Any] | None = None
    masks: NDArray[Any] | None = None
    rgb: NDArray[Any] | None = None
    features: NDArray[Any] | None = None


class BagFrames:
    """Iterates over the frames of a bag. frame: what tf calls the map. dropped: frames that could not be used, by why.

    SceneError where the bag has no depth, no masks, or no camera_info.
    """

    def __init__(self, source: str | os.PathLike[str], frame: str = "map") -> None:
        self.source, self.frame, self.dropped = source, frame, {}
        with open_bag(source) as reader:
            self._roles = _roles([(c.topic, c.msgtype) for c in reader.connections], str(source))

    def __iter__(self) -> Iterator[Frame]:
        store, waiting = ros2_types(), {}
        lens: Any = None
        with open_bag(self.source) as reader:
            tree = _transforms(reader, store)
            wanted = [c for c in reader.connections if c.topic in self._roles]
            whole = {"depth", "masks", "features"} & set(self._roles.values())
            for connection, _, data in _messages(reader, wanted):
                role, message = self._roles[connection.topic], _decoded(store, data, connection.msgtype)
                if role == "info":
                    lens = message
                    continue
                stamp = nanoseconds(message.header.stamp)
                parts = waiting.setdefault(stamp, _Parts())
                self._take(parts, role, message)
                complete = all(getattr(parts, name) is not None for name in whole)
                if complete or len(waiting) > PENDING:
                    first = stamp if complete else next(iter(waiting))
                    yield from self._made(waiting.pop(first), first, lens, tree)
            for stamp, parts in sorted(waiting.items()):
                yield from self._made(parts, stamp, lens, tree)

    def _take(self, parts: _Parts, role: str, message: Any) -> None:
        parts.frame_id = message.header.frame_id if role != "features" or not parts.frame_id else parts.frame_id
        try:
            if role == "features":
                rows = read_fields(message)
                parts.features = np.asarray(rows["feature"], np.float32).reshape(message.width * message.height, -1)
            else:
                setattr(parts, role, image_array(message))
        except (OgPointcloudError, KeyError, ValueError) as error:
            self._drop(f"{role}: {error}")

    def _made(self, parts: _Parts, stamp: int, lens: Any, tree: TransformTree) -> Iterator[Frame]:
        if parts.depth is None and parts.masks is None:
            return
        try:
            if lens is None:
                raise SceneError("no camera_info came before it")
            camera = _camera(lens, np.linalg.inv(tree.lookup(self.frame, parts.frame_id, stamp)).astype(np.float64))
            depth = parts.depth
            if depth is not None and depth.dtype.kind == "u":
                depth = depth.astype(np.float32) * np.float32(1e-3)
            masks = None if parts.masks is None or parts.features is None else parts.masks.astype(np.int64) - 1
            features = None if masks is None else parts.features
            yield Frame(camera, masks, features, depth, rgb=parts.rgb, stamp=stamp / 1e9)
        except OgPointcloudError as error:
            self._drop(str(error))

    def _drop(self, why: str) -> None:
        self.dropped[why] = self.dropped.get(why, 0) + 1


def _roles(topics: list[tuple[str, str]], source: str) -> dict[str, str]:
    """Topic -> what it brings; the first of each kind in alphabetical order."""
    roles: dict[str, str] = {}
    for topic, kind in sorted(set(topics)):
        name, role = topic.lower(), None
        if kind == IMAGE:
            role = "depth" if "depth" in name else "masks" if "mask" in name else "rgb"
        elif kind == INFO:
            role = "info"
        elif kind == CLOUD and "feature" in name:
            role = "features"
        if role and role not in roles.values():
            roles[topic] = role
    for role, expected in (("depth", "an Image whose topic has 'depth' in its name"), ("info", "a CameraInfo"),
                           ("masks", "an Image whose topic has 'mask' in its name")):  # fmt: skip
        if role not in roles.values():
            raise SceneError(f"{source} has no {role}; expected {expected}; it has {', '.join(t for t, _ in topics)}")
    return roles


def _camera(info: Any, world_to_camera: NDArray[np.float64]) -> Camera:
    if np.any(np.abs(np.asarray(info.d, np.float64)) > 1e-9):
        raise SceneError("camera_info has distortion; expected rectified images: record image_rect topics")
    k = np.asarray(info.k, np.float64)
    return Camera(int(info.width), int(info.height), k[0], k[4], k[2], k[5], world_to_camera)
