"""The ROS 2 node: clouds in, labelled clouds and detections out. Only this and `map_node` need ROS.

Subscribes ~/input/points (sensor_msgs/PointCloud2, best effort, only the newest).
Publishes ~/output/points, ~/output/detections and, latched, ~/label_info. A cloud is placed in the scene by tf.

Clouds are dropped rather than queued: when nobody subscribes, when a newer one has arrived, or when the transform does
not arrive in time. No message ends the node: what it cannot use is logged.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import rclpy  # pyright: ignore[reportMissingImports]
import rclpy.executors  # pyright: ignore[reportMissingImports]
import rclpy.logging  # pyright: ignore[reportMissingImports]
from numpy.typing import NDArray
from rcl_interfaces.msg import SetParametersResult  # pyright: ignore[reportMissingImports]
from rclpy.node import Node  # pyright: ignore[reportMissingImports]
from rclpy.qos import QoSDurabilityPolicy, QoSHistoryPolicy, QoSProfile, QoSReliabilityPolicy  # pyright: ignore[reportMissingImports]
from rclpy.time import Time  # pyright: ignore[reportMissingImports]
from sensor_msgs.msg import PointCloud2  # pyright: ignore[reportMissingImports]
from tf2_ros import Buffer, TransformException, TransformListener  # pyright: ignore[reportMissingImports]
from vision_msgs.msg import Detection3DArray, LabelInfo  # pyright: ignore[reportMissingImports]

from og_pointcloud.ask.labelled_scene import Segmenter, load
from og_pointcloud.errors import OgPointcloudError
from og_pointcloud_ros.detections import to_label_info
from og_pointcloud_ros.labelling import MINIMUM_POINTS, CloudLabeller
from og_pointcloud_ros.messages import ros_messages
from og_pointcloud_ros.transforms import pose_of

PARAMETERS = {
    "scene": "",
    "labels": [""],
    "text_features": "",
    "target_frame": "map",
    "max_distance": 0.0,
    "max_age": 0.5,
    "minimum_points": MINIMUM_POINTS,
}
"""Parameters with their defaults; config/parameters.yaml explains them. An empty list has no type in ROS, hence
[""]."""
RETRY_S = 0.02
"""Seconds between two attempts to find a waiting cloud's transform: tf is often a little later than the cloud."""
WARNING_INTERVAL_S = 5.0
"""Minimum seconds between two warnings."""


class PlacedNode(Node):
    """Base of both nodes: parameters, poses of messages from tf, and a timer for messages that wait for their pose.

    parameters: with their defaults, including ``target_frame`` and ``max_age``.
    """

    def __init__(self, name: str, parameters: Mapping[str, Any], **options: Any) -> None:
        super().__init__(name, **options)
        for parameter, default in parameters.items():
            self.declare_parameter(parameter, default)
        self._target_frame, self._max_age = self._value("target_frame"), self._value("max_age")
        self._transforms = Buffer()
        self._listener = TransformListener(self._transforms, self)
        self.create_timer(RETRY_S, self._work)

    def _value(self, name: str) -> Any:
        return self.get_parameter(name).value

    def _work(self) -> None:
        """Retry what is waiting; called every RETRY_S seconds."""
        raise NotImplementedError

    def _pose(self, frame_id: str, stamp: Any) -> NDArray[np.float64]:
        """(4, 4) from a frame to the target frame. stamp: a Time message. tf2's TransformException if unknown."""
        found = self._transforms.lookup_transform(self._target_frame, frame_id, Time.from_msg(stamp))
        translation, rotation = found.transform.translation, found.transform.rotation
        return pose_of((translation.x, translation.y, translation.z), (rotation.x, rotation.y, rotation.z, rotation.w))

    def _warn(self, text: str) -> None:
        self.get_logger().warning(text, throttle_duration_sec=WARNING_INTERVAL_S)


class SegmentNode(PlacedNode):
    """See the module. The parameter ``labels`` may be set at run time; the others are read at the start.

    SceneError, BundleError or FeatureSpaceError if the scene or the words cannot be used.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__("og_pointcloud", PARAMETERS, **options)
        if not (path := self._value("scene")):
            raise OgPointcloudError("the parameter 'scene' is empty; expected a .ogpc file: -p scene:=/maps/room.ogpc")
        self._scene = load(path)
        reliable, best_effort = QoSReliabilityPolicy.RELIABLE, QoSReliabilityPolicy.BEST_EFFORT
        self._points = self.create_publisher(PointCloud2, "~/output/points", latest_only(reliable))
        self._detections = self.create_publisher(Detection3DArray, "~/output/detections", latest_only(reliable))
        self._info = self.create_publisher(LabelInfo, "~/label_info", latest_only(reliable, latched=True))
        self._labeller = CloudLabeller(
            self._segmenter(self._value("labels")), ros_messages, self._target_frame, self._value("minimum_points")
        )
        self._announce()
        self.add_on_set_parameters_callback(self._on_parameters)
        self._waiting: tuple[Any, float] | None = None
        self.create_subscription(PointCloud2, "~/input/points", self._on_cloud, latest_only(best_effort))

    def _segmenter(self, labels: Sequence[str]) -> Segmenter:
        return Segmenter(
            self._scene,
            [label for label in labels if label] or None,
            text_features=self._value("text_features") or None,
            max_distance=self._value("max_distance") or None,
        )

    def _announce(self) -> None:
        names = self._labeller.segmenter.names
        stamp = self.get_clock().now().to_msg()
        self._info.publish(to_label_info(names, self._target_frame, stamp, messages=ros_messages))
        self.get_logger().info(f"{len(names)} labels: {', '.join(names)}")

    def _on_parameters(self, parameters: Sequence[Any]) -> Any:
        """Adopt new labels; refuse unusable values, with the reason, before they are set."""
        for parameter in parameters:
            if parameter.name in PARAMETERS and parameter.name != "labels":
                return SetParametersResult(successful=False, reason=f"{parameter.name} is only read at startup")
        for labels in (parameter.value for parameter in parameters if parameter.name == "labels"):
            try:
                self._labeller.segmenter = self._segmenter(labels or [])
            except Exception as error:  # words are user input, and a robot keeps those that it had
                return SetParametersResult(successful=False, reason=error_text(error))
            self._announce()
        return SetParametersResult(successful=True)

    def _on_cloud(self, message: Any) -> None:
        if not (self._points.get_subscription_count() or self._detections.get_subscription_count()):
            self._waiting = None
            return
        self._waiting = (message, time.monotonic())  # replaces an older one that still waits
        self._work()

    def _work(self) -> None:
        """Label the waiting cloud, if there is one and its transform has arrived."""
        if self._waiting is None:
            return
        # Removed first, and put back only while its transform may still arrive: a cloud that fails is not retried.
        message, arrived = self._waiting
        self._waiting = None
        try:
            labelled = self._labeller(message, self._pose(message.header.frame_id, message.header.stamp))
        except TransformException as error:
            if time.monotonic() - arrived <= self._max_age:
                self._waiting = message, arrived
            else:
                self._warn(f"a cloud was dropped: its transform did not arrive within {self._max_age} s: {error}")
        except Exception as error:  # whatever a message holds, the node keeps running
            self._warn(f"a cloud was dropped: {error_text(error)}")
        else:
            self._points.publish(labelled.points)
            self._detections.publish(labelled.detections)


def error_text(error: Exception) -> str:
    """The error's message, with its type for errors of other libraries, which say little by themselves."""
    return str(error) if isinstance(error, (OgPointcloudError, OSError)) else f"{type(error).__name__}: {error}"


def latest_only(reliability: Any, latched: bool = False, depth: int = 1) -> Any:
    """QoS that keeps only the newest message, or the newest ``depth``. A reliable publisher serves reliable and best
    effort subscribers; a best effort subscriber receives from both."""
    durability = QoSDurabilityPolicy.TRANSIENT_LOCAL if latched else QoSDurabilityPolicy.VOLATILE
    return QoSProfile(history=QoSHistoryPolicy.KEEP_LAST, depth=depth, reliability=reliability, durability=durability)


def run(make: Callable[[], Node], arguments: Sequence[str] | None) -> int:
    """Make a node and run it until it is stopped. Returns the exit code, 2 for unusable input."""
    rclpy.init(args=arguments)
    try:
        node = make()
    except (OgPointcloudError, OSError) as error:
        rclpy.logging.get_logger("og_pointcloud").fatal(str(error))
        rclpy.try_shutdown()
        return 2
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, rclpy.executors.ExternalShutdownException):
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the node until it is stopped. Returns the exit code, 2 for a scene or words that cannot be used."""
    return run(SegmentNode, arguments)
