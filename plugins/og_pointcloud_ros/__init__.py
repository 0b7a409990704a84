"""og_pointcloud for robots: PointCloud2 messages in and out, detections, bags, and a ROS 2 node.

Only ``node`` needs ROS, and only bags need rosbags (the extra 'ros'); messages are converted with numpy alone.
"""

from __future__ import annotations

from og_pointcloud_ros.messages import plain_messages, ros_messages
from og_pointcloud_ros.pointcloud2 import UNLABELLED, from_pointcloud2, is_pointcloud2, read_fields, to_pointcloud2

__all__ = [
    "UNLABELLED",
    "from_pointcloud2",
    "is_pointcloud2",
    "plain_messages",
    "read_fields",
    "ros_messages",
    "to_pointcloud2",
]
