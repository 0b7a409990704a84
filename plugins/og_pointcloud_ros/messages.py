"""ROS messages without ROS: what a message is made of, and three ways to make one.

Whatever makes messages here takes a ``MessageFactory``, so that the same lines fill plain dataclasses, rosbags' types
and rclpy's. Reading needs none of this: messages are told by their attributes.
"""

from __future__ import annotations

import array
import importlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.errors import SceneError

__all__ = [
    "BoundingBox3D",
    "Detection3D",
    "Detection3DArray",
    "Header",
    "LabelInfo",
    "MessageFactory",
    "ObjectHypothesis",
    "ObjectHypothesisWithPose",
    "Point",
    "PointCloud2",
    "PointField",
    "Pose",
    "PoseWithCovariance",
    "Quaternion",
    "Time",
    "Vector3",
    "VisionClass",
    "header",
    "nanoseconds",
    "plain_messages",
    "ros_messages",
]

NANOSECONDS = 1_000_000_000


class MessageFactory(Protocol):
    """Makes a message of a type such as "std_msgs/msg/Header" from all of its fields.

    Fields hold messages of the same factory, sequences of such, numbers, strings, and numpy arrays where the message
    has a sequence or array of numbers.
    """

    def __call__(self, type_name: str, /, **fields: Any) -> Any:
        """The message."""
        ...


@dataclass
class Time:
    """builtin_interfaces/Time."""

    sec: int = 0
    nanosec: int = 0


@dataclass
class Header:
    """std_msgs/Header."""

    stamp: Any = field(default_factory=Time)
    frame_id: str = ""


@dataclass
class PointField:
    """sensor_msgs/PointField. datatype: 1 to 8 for int8, uint8, int16, uint16, int32, uint32, float32, float64."""

    name: str = ""
    offset: int = 0
    datatype: int = 7
    count: int = 1


@dataclass
class PointCloud2:
    """sensor_msgs/PointCloud2. data: anything with bytes in it, (height * row_step,) uint8."""

    header: Any = field(default_factory=Header)
    height: int = 1
    width: int = 0
    fields: Sequence[Any] = ()
    is_bigendian: bool = False
    point_step: int = 0
    row_step: int = 0
    data: Any = b""
    is_dense: bool = False


@dataclass
class Point:
    """geometry_msgs/Point."""

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0


@dataclass
class Vector3(Point):
    """geometry_msgs/Vector3."""


@dataclass
class Quaternion:
    """geometry_msgs/Quaternion."""

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    w: float = 1.0


@dataclass
class Pose:
    """geometry_msgs/Pose."""

    position: Any = field(default_factory=Point)
    orientation: Any = field(default_factory=Quaternion)


@dataclass
class PoseWithCovariance:
    """geometry_msgs/PoseWithCovariance. covariance: (36,) float64."""

    pose: Any = field(default_factory=Pose)
    covariance: NDArray[np.float64] = field(default_factory=lambda: np.zeros(36))


@dataclass
class BoundingBox3D:
    """vision_msgs/BoundingBox3D. size: full lengths along the axes of center."""

    center: Any = field(default_factory=Pose)
    size: Any = field(default_factory=Vector3)


@dataclass
class ObjectHypothesis:
    """vision_msgs/ObjectHypothesis."""

    class_id: str = ""
    score: float = 0.0


@dataclass
class ObjectHypothesisWithPose:
    """vision_msgs/ObjectHypothesisWithPose."""

    hypothesis: Any = field(default_factory=ObjectHypothesis)
    pose: Any = field(default_factory=PoseWithCovariance)


@dataclass
class Detection3D:
    """vision_msgs/Detection3D."""

    header: Any = field(default_factory=Header)
    results: Sequence[Any] = ()
    bbox: Any = field(default_factory=BoundingBox3D)
    id: str = ""


@dataclass
class Detection3DArray:
    """vision_msgs/Detection3DArray."""

    header: Any = field(default_factory=Header)
    detections: Sequence[Any] = ()


@dataclass
class VisionClass:
    """vision_msgs/VisionClass."""

    class_id: int = 0
    class_name: str = ""


@dataclass
class LabelInfo:
    """vision_msgs/LabelInfo."""

    header: Any = field(default_factory=Header)
    class_map: Sequence[Any] = ()
    threshold: float = 0.0


_PLAIN = {
    kind.__name__: kind
    for kind in (
        Time, Header, PointField, PointCloud2, Point, Vector3, Quaternion, Pose, PoseWithCovariance, BoundingBox3D,
        ObjectHypothesis, ObjectHypothesisWithPose, Detection3D, Detection3DArray, VisionClass, LabelInfo,
    )
}  # fmt: skip


def plain_messages(type_name: str, /, **fields: Any) -> Any:
    """The dataclasses of this module."""
    return _PLAIN[type_name.rpartition("/")[2]](**fields)


def ros_messages(type_name: str, /, **fields: Any) -> Any:
    """The message types of a ROS 2 installation, which are imported here and only here."""
    package, _, name = type_name.partition("/msg/")
    kind = getattr(importlib.import_module(f"{package}.msg"), name)
    # An array of bytes is taken over as it is; anything else is checked byte by byte.
    return kind(**{key: _byte_array(value) if _is_bytes(value) else value for key, value in fields.items()})


def header(messages: MessageFactory, frame_id: str, stamp: Any) -> Any:
    """A std_msgs/Header. stamp: a Time message, nanoseconds since the epoch, or None for 0."""
    now = nanoseconds(stamp)
    time = messages("builtin_interfaces/msg/Time", sec=now // NANOSECONDS, nanosec=now % NANOSECONDS)
    return messages("std_msgs/msg/Header", stamp=time, frame_id=frame_id)


def nanoseconds(stamp: Any) -> int:
    """Nanoseconds since the epoch of a Time message, of a number of them, or of None, which is 0."""
    if stamp is None:
        return 0
    if hasattr(stamp, "sec") and hasattr(stamp, "nanosec"):
        return int(stamp.sec) * NANOSECONDS + int(stamp.nanosec)
    if isinstance(stamp, (int, np.integer)):
        return int(stamp)
    raise SceneError(
        f"stamp is a {type(stamp).__name__}; expected a Time message (sec, nanosec) or nanoseconds since the epoch"
    )


def _is_bytes(value: Any) -> bool:
    return isinstance(value, np.ndarray) and value.dtype == np.uint8


def _byte_array(value: NDArray[np.uint8]) -> array.array[int]:
    data = array.array("B")
    data.frombytes(np.ascontiguousarray(value).data)
    return data
