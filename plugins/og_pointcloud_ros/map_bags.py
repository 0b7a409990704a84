"""Frames of a map from a ROS 2 bag, without ROS: depth and color images, masks with features, poses from tf.

Topics are recognized by type and name: an Image with "depth" in its topic's name is depth, one with "mask" is masks,
any other is color; a PointCloud2 with "feature" brings features (`frames`). Images are rectified where depth or masks
have "rect" in their topic's name. Messages of one stamp are one frame.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from functools import partial

from og_pointcloud.errors import OgPointcloudError, SceneError
from og_pointcloud.mapping.frame import Frame
from og_pointcloud_ros.bags import decoded, messages_of, open_bag, ros2_types, transforms_of
from og_pointcloud_ros.frames import REQUIRED_ROLES, FrameAssembler
from og_pointcloud_ros.transforms import TransformTree

IMAGE, INFO, CLOUD = "sensor_msgs/msg/Image", "sensor_msgs/msg/CameraInfo", "sensor_msgs/msg/PointCloud2"
MAX_PENDING_STAMPS = 100
"""Number of stamps that wait for their other messages; masks come seconds after their image."""


class BagFrames:
    """Iterates over the frames of a bag. frame: the map's frame in tf. dropped: reason -> number of unusable frames.

    SceneError if the bag has no depth, no masks, or no camera_info.
    """

    def __init__(self, source: str | os.PathLike[str], frame: str = "map") -> None:
        self.source, self.frame, self.dropped = source, frame, dict[str, int]()
        with open_bag(source) as reader:
            self._roles = _roles([(c.topic, c.msgtype) for c in reader.connections], str(source))

    def __iter__(self) -> Iterator[Frame]:
        required = [role for role in REQUIRED_ROLES if role in self._roles.values()]
        rectified = any("rect" in topic.lower() for topic, role in self._roles.items() if role in ("depth", "masks"))
        store, assembler = ros2_types(), FrameAssembler(required, rectified=rectified)
        with open_bag(self.source) as reader:
            tree = transforms_of(reader, store)
            for connection, _, data in messages_of(reader, [c for c in reader.connections if c.topic in self._roles]):
                role = self._roles[connection.topic]
                try:
                    assembler.add(role, decoded(store, data, connection.msgtype))
                except (OgPointcloudError, ValueError) as error:
                    self._drop(f"{role}: {error}")
                # Complete frames; else the oldest of too many waiting ones, with the messages that have arrived.
                ready = [*filter(assembler.is_complete, assembler.waiting)]
                for stamp in ready or sorted(assembler.waiting)[:-MAX_PENDING_STAMPS]:
                    yield from self._made(stamp, assembler, tree)
            for stamp in sorted(assembler.waiting):
                yield from self._made(stamp, assembler, tree)

    def _made(self, stamp: int, assembler: FrameAssembler, tree: TransformTree) -> Iterator[Frame]:
        """The frame of a stamp, or none if it shows nothing or is dropped; the stamp is forgotten in any case."""
        try:
            if (frame := assembler.frame(stamp, partial(tree.lookup, self.frame))) is not None:
                yield frame
        except OgPointcloudError as error:
            self._drop(str(error))
        assembler.forget(stamp)

    def _drop(self, why: str) -> None:
        self.dropped[why] = self.dropped.get(why, 0) + 1


def _roles(topics: list[tuple[str, str]], source: str) -> dict[str, str]:
    """Topic -> role; the first topic of each role in alphabetical order."""
    roles: dict[str, str] = {}
    for topic, kind in sorted(set(topics)):
        name, role = topic.lower(), None
        if kind == IMAGE:
            role = "depth" if "depth" in name else "masks" if "mask" in name else "color"
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
