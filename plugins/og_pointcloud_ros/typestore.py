"""rosbags' message types, and those of vision_msgs, which it does not bring."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from og_pointcloud.errors import MissingExtraError
from og_pointcloud_ros.messages import MessageFactory

try:
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    from rosbags.typesys.store import Typestore
except ImportError as error:
    raise MissingExtraError("rosbags", "ros") from error

__all__ = ["VISION_MSGS", "ros2_types", "rosbags_messages"]

VISION_MSGS: Mapping[str, str] = {
    "vision_msgs/msg/VisionClass": "uint16 class_id\nstring class_name",
    "vision_msgs/msg/LabelInfo": "std_msgs/Header header\nvision_msgs/VisionClass[] class_map\nfloat32 threshold",
    "vision_msgs/msg/ObjectHypothesis": "string class_id\nfloat64 score",
    "vision_msgs/msg/ObjectHypothesisWithPose": (
        "vision_msgs/ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose"
    ),
    "vision_msgs/msg/BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size",
    "vision_msgs/msg/Detection3D": (
        "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\n"
        "vision_msgs/BoundingBox3D bbox\nstring id"
    ),
    "vision_msgs/msg/Detection3DArray": "std_msgs/Header header\nvision_msgs/Detection3D[] detections",
}
"""The fields of vision_msgs 4, that of ROS 2 Humble and later."""


def ros2_types() -> Typestore:
    """Types of ROS 2 Humble, whose clouds and transforms are those of every later release, and vision_msgs."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    for name, fields in VISION_MSGS.items():
        store.register(get_types_from_msg(fields, name))
    return store


def rosbags_messages(store: Typestore) -> MessageFactory:
    """Makes messages of rosbags' types, of ROS 2 or ROS 1, ready for ``store.serialize_cdr`` or ``serialize_ros1``."""

    def make(type_name: str, /, **fields: Any) -> Any:
        kind: Any = store.types[type_name]
        if "seq" in getattr(kind, "__dataclass_fields__", ()):  # a header of ROS 1
            fields["seq"] = 0
        return kind(**fields)

    return make
