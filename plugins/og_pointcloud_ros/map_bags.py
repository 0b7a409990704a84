"""Frames of a map from a ROS 2 bag, without ROS: depth and color images, masks with features, poses from tf.

Topics are recognized by type and name: an Image with "depth" in its topic's name is depth, one with "mask" is masks,
any other is color; a PointCloud2 with "feature" brings features (`frames`). The last part of a name decides:
/depth/masks is masks. CompressedImages count by the name of the image that was compressed; where a bag holds both, the
uncompressed ones are read. Topics without messages do not count. Of several cameras, the frames are those of the first
depth topic in alphabetical order: its camera_info is the one with its frame_id, and the other topics are those whose
names begin most like its own. Images are rectified where depth or masks have "rect" in their topic's name. Messages of
one stamp are one frame.
"""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from functools import partial
from posixpath import commonpath

from og_pointcloud.errors import OgPointcloudError, SceneError
from og_pointcloud.mapping.frame import Frame
from og_pointcloud_ros.bags import CLOUD, Reader, decoded, messages_of, open_bag, ros2_types, transforms_of
from og_pointcloud_ros.frames import REQUIRED_ROLES, FrameAssembler
from og_pointcloud_ros.transforms import TransformTree

IMAGE, INFO = "sensor_msgs/msg/Image", "sensor_msgs/msg/CameraInfo"
COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
TRANSPORTS = ("/compressed", "/compresseddepth")
"""What image_transport appends to the topic of an image for that of the compressed one, in lower case."""
OUTSIDE_TF = re.compile(r"not at \S+ s$")
"""How `TransformTree.lookup` ends for a stamp outside the known interval."""
MAX_PENDING_STAMPS = 100
"""Number of stamps that wait for their other messages; masks come seconds after their image."""


class BagFrames:
    """Iterates over the frames of a bag. frame: the map's frame in tf. dropped: reason -> number of frames
    and messages that cannot be used.

    SceneError if the bag has no depth, no masks, no features, no camera_info, or several of which none has the depth's
    frame_id.
    """

    def __init__(self, source: str | os.PathLike[str], frame: str = "map") -> None:
        self.source, self.frame, self.dropped = source, frame, Counter[str]()
        with open_bag(source) as reader:
            topics = _topics_by_role([(c.topic, c.msgtype) for c in reader.connections if c.msgcount], str(source))
            if len(infos := topics["info"]) > 1:
                topics["info"] = _infos_of_depth(reader, topics["depth"][0], infos)
        self._roles = {names[0]: role for role, names in topics.items()}

    def __iter__(self) -> Iterator[Frame]:
        required = (*REQUIRED_ROLES, "color") if "color" in self._roles.values() else REQUIRED_ROLES
        rectified = any("rect" in topic.lower() for topic, role in self._roles.items() if role in ("depth", "masks"))
        store, assembler = ros2_types(), FrameAssembler(required, rectified=rectified)
        with open_bag(self.source) as reader:
            tree = transforms_of(reader, store)
            for connection, _, data in messages_of(reader, [c for c in reader.connections if c.topic in self._roles]):
                role = self._roles[connection.topic]
                try:
                    assembler.add(role, decoded(store, data, connection.msgtype))
                except (OgPointcloudError, ValueError) as error:
                    self.dropped[f"{role}: {error}"] += 1
                # Complete frames; else the oldest of too many waiting ones, with the messages that have arrived.
                ready = [*filter(assembler.is_complete, assembler.waiting)]
                for stamp in ready or sorted(assembler.waiting)[:-MAX_PENDING_STAMPS]:
                    yield from self._made(stamp, assembler, tree)
            for stamp in sorted(assembler.waiting):
                yield from self._made(stamp, assembler, tree)

    def _made(self, stamp: int, assembler: FrameAssembler, tree: TransformTree) -> Iterator[Frame]:
        """The frame of a stamp, or none if it shows nothing or is dropped; the stamp is forgotten in any case."""
        if unpaired := assembler.unpaired(stamp):
            self.dropped[unpaired] += 1
        try:
            if (frame := assembler.frame(stamp, partial(tree.lookup, self.frame))) is not None:
                yield frame
        except OgPointcloudError as error:
            # Frames outside the time of tf are counted together, whatever the time of each.
            self.dropped[OUTSIDE_TF.sub("not at the time of some frames", str(error))] += 1
        assembler.forget(stamp)


def _topics_by_role(topics: list[tuple[str, str]], source: str) -> dict[str, list[str]]:
    """Role -> its topics: first those that share most of the leading parts of their names with the first depth topic,
    then in alphabetical order."""
    found: dict[str, list[str]] = {}
    for topic, kind in sorted(set(topics), key=lambda one: (one[1] == COMPRESSED_IMAGE, one)):
        if role := _role(topic.lower(), kind):
            found.setdefault(role, []).append(topic)
    for role, expected in (("depth", "an Image whose topic has 'depth' in its name"), ("info", "a CameraInfo"),
                           ("masks", "an Image whose topic has 'mask' in its name"),
                           ("features", "a PointCloud2 whose topic has 'feature' in its name")):  # fmt: skip
        if role not in found:
            raise SceneError(f"{source} has no {role}; expected {expected}; it has {', '.join(t for t, _ in topics)}")
    depth = found["depth"][0]
    for names in found.values():
        names.sort(key=lambda name: -len(commonpath((f"/{name}", f"/{depth}"))))
    return found


def _role(topic: str, kind: str) -> str | None:
    if kind in (IMAGE, COMPRESSED_IMAGE):
        for transport in TRANSPORTS if kind == COMPRESSED_IMAGE else ():
            topic = topic.removesuffix(transport)
        for part in reversed(topic.split("/")):
            if "mask" in part or "depth" in part:
                return "masks" if "mask" in part else "depth"
        return "color"
    return "info" if kind == INFO else "features" if kind == CLOUD and "feature" in topic else None


def _infos_of_depth(reader: Reader, depth: str, infos: list[str]) -> list[str]:
    """The camera_info topics whose first message has the frame_id of the first depth image."""
    store, frame_ids = ros2_types(), dict[str, str]()
    for topic in (depth, *infos):
        for connection, _, data in messages_of(reader, [c for c in reader.connections if c.topic == topic]):
            with suppress(SceneError):  # a damaged message
                frame_ids[topic] = decoded(store, data, connection.msgtype).header.frame_id.lstrip("/")
                break
    chosen = [topic for topic in infos if frame_ids.get(topic) == frame_ids.get(depth)]
    if depth in frame_ids and not chosen:
        known = ", ".join(f"'{frame_ids[topic]}' ({topic})" for topic in infos if topic in frame_ids)
        raise SceneError(
            f"{depth} has the frame_id '{frame_ids[depth]}'; expected that of one of several camera_info: {known}; "
            "record the camera_info of the depth images, or no other"
        )
    return chosen or infos
