"""og_pointcloud for robots: PointCloud2 messages in and out, detections, bags, and a ROS 2 node.

Only ``node`` needs ROS, and only bags need rosbags (the extra 'ros'); messages are converted with numpy alone.
"""

from __future__ import annotations

from og_pointcloud_ros.detections import to_detections, to_label_info
from og_pointcloud_ros.messages import MessageFactory, plain_messages, ros_messages
from og_pointcloud_ros.pointcloud2 import UNLABELLED, from_pointcloud2, read_fields, to_pointcloud2, write_fields
from og_pointcloud_ros.transforms import TransformError, TransformTree

__all__ = [
    "UNLABELLED",
    "MessageFactory",
    "TransformError",
    "TransformTree",
    "from_pointcloud2",
    "plain_messages",
    "read_fields",
    "ros_messages",
    "to_detections",
    "to_label_info",
    "to_pointcloud2",
    "write_fields",
]
