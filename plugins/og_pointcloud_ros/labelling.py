"""Labels each cloud of a bag or a running node: message in, labelled cloud and detections out."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.ask.labelled_scene import Segmenter, instance_table
from og_pointcloud.ask.segmentation import Segmentation
from og_pointcloud_ros.detections import to_detections
from og_pointcloud_ros.messages import MessageFactory
from og_pointcloud_ros.pointcloud2 import from_pointcloud2, read_fields, to_pointcloud2

UP = (0.0, 0.0, 1.0)
"""Vertical axis of boxes: z is up in ROS frames (REP 103)."""
MINIMUM_POINTS = 10
"""An instance with fewer points in a cloud is no detection."""


class LabelledMessages(NamedTuple):
    """result: in the scene's world. points: sensor_msgs/PointCloud2. detections: vision_msgs/Detection3DArray."""

    result: Segmentation
    points: Any
    detections: Any


class CloudLabeller:
    """Labels PointCloud2 messages one by one; words are scored, and boxes computed, once.

    segmenter: of the scene; may be replaced by one with other labels.
    frame: the scene's frame, that of detections. minimum_points: points that an instance needs to be a detection.
    """

    def __init__(
        self, segmenter: Segmenter, messages: MessageFactory, frame: str = "map", minimum_points: int = MINIMUM_POINTS
    ) -> None:
        self.segmenter = segmenter
        self._messages, self._frame, self._minimum_points = messages, frame, minimum_points
        self._instances = instance_table(segmenter.scene, up=UP)  # keeps the boxes

    def __call__(self, message: Any, pose: NDArray[np.float64]) -> LabelledMessages:
        """message: a cloud in the sensor's frame. pose: (4, 4), from there to the scene's frame.

        The labelled cloud keeps the frame, stamp, height, width and coordinates of the message, so that tools that
        match the two by time, or display them with tf, see them in the same place.
        """
        xyz = from_pointcloud2(message)
        result = self.segmenter(xyz, pose)
        head = message.header
        # Coordinates stay float64 if they were: those of a map may lie far from 0.
        rows = read_fields(message)
        double = any(rows.dtype[axis].itemsize > 4 for axis in "xyz" if axis in (rows.dtype.names or ()))
        points = to_pointcloud2(
            result, head.frame_id, head.stamp, xyz=xyz.reshape(*rows.shape, 3), double=double, messages=self._messages
        )
        detections = to_detections(
            self._instances, result, self._frame, head.stamp, minimum_points=self._minimum_points,
            messages=self._messages,
        )  # fmt: skip
        return LabelledMessages(result, points, detections)
