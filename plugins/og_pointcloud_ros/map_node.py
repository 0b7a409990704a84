"""The ROS 2 node that maps: images with depth and masks in, objects with their state out. It needs ROS.

Subscribes ~/input/depth, ~/input/masks, ~/input/color (sensor_msgs/Image, or CompressedImage for those that the
parameter ``compressed`` lists), ~/input/features (PointCloud2) and ~/input/info (CameraInfo), all as `frames` reads
them; messages of one stamp are one frame, placed by tf at that stamp.
Publishes ~/objects (vision_msgs/Detection3DArray, latched) after each frame: ids, boxes, and as class id the state:
present, moved, unseen or gone. Serves ~/save, ~/load and ~/reset (std_srvs/Trigger): the map to and from the file that
the parameter ``map`` names, and an empty one.

Frames go through a queue into a separate thread, so that no sensor waits. Those that get too old there are dropped, and
so are those without a transform; those that wait too long for their masks are used without them. Every drop is logged.
No message ends the node.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from rclpy.qos import QoSReliabilityPolicy  # pyright: ignore[reportMissingImports]
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, PointCloud2  # pyright: ignore[reportMissingImports]
from std_srvs.srv import Trigger  # pyright: ignore[reportMissingImports]
from tf2_ros import TransformException  # pyright: ignore[reportMissingImports]
from vision_msgs.msg import Detection3DArray  # pyright: ignore[reportMissingImports]

from og_pointcloud.errors import OgPointcloudError
from og_pointcloud.mapping.frame_queue import FrameQueue
from og_pointcloud.mapping.mapper import FrameChange, Mapper
from og_pointcloud_ros.detections import to_objects
from og_pointcloud_ros.frames import FrameAssembler
from og_pointcloud_ros.messages import ros_messages, time_message
from og_pointcloud_ros.node import PlacedNode, error_text, latest_only, run

PARAMETERS = {"map": "", "target_frame": "map", "feature_space": "unknown", "rectified": False, "compressed": "",
              "max_age": 2.0}  # fmt: skip
"""Parameters with their defaults; config/map.yaml explains them."""
INPUTS = {"depth": Image, "masks": Image, "color": Image, "features": PointCloud2, "info": CameraInfo}
QUEUE_DEPTH = 10
"""Messages per topic that may wait while a service call runs."""


class MapNode(PlacedNode):
    """See the module."""

    def __init__(self, **options: Any) -> None:
        super().__init__("og_pointcloud_map", PARAMETERS, **options)
        compressed = _images_in(self._value("compressed"))
        self._assembler, self._arrived = FrameAssembler(rectified=self._value("rectified")), dict[int, float]()
        reliable, best_effort = QoSReliabilityPolicy.RELIABLE, QoSReliabilityPolicy.BEST_EFFORT
        self._objects = self.create_publisher(Detection3DArray, "~/objects", latest_only(reliable, latched=True))
        self._queue = FrameQueue(self._mapper(), max_age=self._max_age, on_change=self._on_change, on_drop=self._warn)
        for role, raw in INPUTS.items():
            kind = CompressedImage if role in compressed else raw
            take = partial(self._on_message, role)
            self.create_subscription(kind, f"~/input/{role}", take, latest_only(best_effort, depth=QUEUE_DEPTH))
        for name, serve in {"save": self._save, "load": self._load, "reset": self._reset}.items():
            self.create_service(Trigger, f"~/{name}", partial(self._serve, serve))

    def _mapper(self, start: str | None = None) -> Mapper:
        return Mapper(start, feature_space=self._value("feature_space"))

    def _on_message(self, role: str, message: Any) -> None:
        try:
            self._assembler.add(role, message)
        except Exception as error:  # whatever a message holds, the node keeps running
            self._warn(f"{role} was dropped: {error_text(error)}")
        self._work()

    def _work(self) -> None:
        """Pass on the frames that are complete, or have waited long enough for the rest."""
        now = time.monotonic()  # waiting counts from arrival: stamps may be of a bag or a simulation
        self._arrived = {stamp: self._arrived.get(stamp, now) for stamp in self._assembler.waiting}
        for stamp, arrived in self._arrived.items():
            is_old = now - arrived > self._max_age
            if not is_old and not self._assembler.is_complete(stamp):
                continue
            try:
                if (frame := self._assembler.frame(stamp, self._pose_at)) is not None:
                    self._queue.put(frame)
            except TransformException as error:
                if not is_old:  # tf is often a little later: retried
                    continue
                self._warn(f"a frame was dropped: its transform did not arrive within {self._max_age} s: {error}")
            except Exception as error:
                self._warn(f"a frame was dropped: {error_text(error)}")
            if unpaired := self._assembler.unpaired(stamp):
                self._warn(unpaired)
            self._assembler.forget(stamp)

    def _pose_at(self, frame_id: str, stamp: int) -> Any:
        return self._pose(frame_id, time_message(ros_messages, stamp))

    def _on_change(self, change: FrameChange) -> None:
        for text, ids in (("gone", change.gone), ("moved", [moved.id for moved in change.moved])):
            if ids:
                self.get_logger().info(f"{text}: {', '.join(map(str, ids))}")
        self._publish()

    def _publish(self) -> None:
        stamp = self.get_clock().now().to_msg()
        self._objects.publish(
            to_objects(self._queue.mapper.objects(), self._target_frame, stamp, messages=ros_messages)
        )

    def _serve(self, serve: Callable[[], str], _: Any, response: Any) -> Any:
        """Answer a Trigger while no frame is being integrated."""
        try:
            with self._queue.lock:
                response.success, response.message = True, serve()
        except Exception as error:  # a full disk or a foreign file must not end the map
            response.success, response.message = False, error_text(error)
        return response

    def _save(self) -> str:
        return f"wrote {self._queue.mapper.save(self._path())}"

    def _load(self) -> str:
        self._queue.mapper = self._mapper(self._path())
        self._publish()
        return f"{self._queue.mapper.points:,} points, {len(self._queue.mapper.objects())} objects"

    def _reset(self) -> str:
        self._queue.mapper = self._mapper()
        self._publish()
        return "the map is empty"

    def _path(self) -> str:
        if not self._value("map"):
            raise OgPointcloudError(
                "the parameter 'map' is empty; expected a .ogpc file: --ros-args -p map:=/maps/room.ogpc"
            )
        return self._value("map")

    def destroy_node(self) -> None:
        """Ends the queue first."""
        self._queue.close()
        super().destroy_node()


def _images_in(listed: str) -> set[str]:
    """The roles of images in a comma-separated list."""
    images = [role for role, kind in INPUTS.items() if kind is Image]
    roles = {role.strip() for role in listed.split(",")} - {""}
    if unknown := sorted(roles.difference(images)):
        raise OgPointcloudError(
            f"the parameter 'compressed' lists '{unknown[0]}'; expected one or more of {', '.join(images)}, as in "
            "--ros-args -p compressed:=depth,color"
        )
    return roles


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the node until it is stopped. Returns the exit code."""
    return run(MapNode, arguments)
