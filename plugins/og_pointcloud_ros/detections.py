"""Instances as vision_msgs: a Detection3DArray of oriented boxes, and the LabelInfo that names label numbers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.ask.boxes import Box
from og_pointcloud.ask.instances import Instances
from og_pointcloud.ask.labelled_scene import LabelledScene
from og_pointcloud.ask.segmentation import Segmentation
from og_pointcloud.errors import OgPointcloudError
from og_pointcloud_ros.messages import MessageFactory, header, plain_messages
from og_pointcloud_ros.pointcloud2 import UNLABELLED

if TYPE_CHECKING:
    from og_pointcloud.mapping.map_objects import MapObject


def to_detections(
    instances: LabelledScene | Instances,
    result: Segmentation,
    frame_id: str = "map",
    stamp: Any = None,
    *,
    minimum_points: int = 1,
    messages: MessageFactory = plain_messages,
) -> Any:
    """The labelled instances with points in ``result``, as vision_msgs/Detection3DArray.

    Each has its label's name as class id, its score, its instance id as id, and the oriented box of the whole instance
    in the scene; the result may show only a part of that.
    instances: a scene, or ``og.instance_table(scene, up=(0, 0, 1))`` of it for upright boxes; keep the table, as it
    computes each box once. result: of ``segment`` or a ``Segmenter`` for a cloud of the same scene.
    frame_id: the scene's frame. stamp: a Time message, or nanoseconds since the epoch.
    minimum_points: an instance with fewer points in the result is left out.
    """
    table = instances.instances if isinstance(instances, LabelledScene) else instances
    labelled = np.flatnonzero(result.labels >= 0)
    owners = result.instances[labelled]
    if len(owners) and owners.max() >= len(table):
        raise OgPointcloudError(
            f"the result has instance {owners.max()}, the table only {len(table)}: they are from different scenes"
        )
    # One row of the result for each instance, no matter which: all its points have the same label and score.
    example = np.zeros(len(table), np.int64)
    example[owners] = labelled
    seen = np.flatnonzero(np.bincount(owners, minlength=len(table)) >= max(minimum_points, 1))
    head = header(messages, frame_id, stamp)
    detections = [
        _detection(k, box, result.names[result.labels[row]], float(result.scores[row]), head, messages)
        for k, row in zip(seen.tolist(), example[seen], strict=True)
        if (box := table[k].oriented_box) is not None
    ]
    return messages("vision_msgs/msg/Detection3DArray", header=head, detections=detections)


def to_label_info(
    names: Sequence[str], frame_id: str = "", stamp: Any = None, *, messages: MessageFactory = plain_messages
) -> Any:
    """The meaning of the numbers in the field ``label``, as vision_msgs/LabelInfo, to be published once, latched.

    names: those of the result, at most 65,535.
    """
    if len(names) > UNLABELLED:
        raise OgPointcloudError(f"{len(names)} names; expected at most {UNLABELLED}, as {UNLABELLED} means unlabelled")
    class_map = [
        messages("vision_msgs/msg/VisionClass", class_id=number, class_name=name) for number, name in enumerate(names)
    ]
    head = header(messages, frame_id, stamp)
    return messages("vision_msgs/msg/LabelInfo", header=head, class_map=class_map, threshold=0.0)


def to_objects(
    objects: Sequence[MapObject], frame_id: str = "map", stamp: Any = None, *, messages: MessageFactory = plain_messages
) -> Any:
    """The objects of a map (`Mapper.objects`) as vision_msgs/Detection3DArray: id, box aligned with the map's frame,
    and state as class id: present, moved, unseen, or gone, then with its last box."""
    head = header(messages, frame_id, stamp)
    detections = [_detection(entry.id, entry.box, entry.state, 1.0, head, messages) for entry in objects]
    return messages("vision_msgs/msg/Detection3DArray", header=head, detections=detections)


def _detection(number: int, box: Box, name: str, score: float, head: Any, messages: MessageFactory) -> Any:
    position = messages("geometry_msgs/msg/Point", **_named(box.center, "xyz"))
    orientation = messages("geometry_msgs/msg/Quaternion", **_named(box.rotation_wxyz, "wxyz"))
    pose = messages("geometry_msgs/msg/Pose", position=position, orientation=orientation)
    size = messages("geometry_msgs/msg/Vector3", **_named(box.size, "xyz"))
    hypothesis = messages("vision_msgs/msg/ObjectHypothesis", class_id=name, score=score)
    uncertain = messages("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=np.zeros(36))
    result = messages("vision_msgs/msg/ObjectHypothesisWithPose", hypothesis=hypothesis, pose=uncertain)
    bbox = messages("vision_msgs/msg/BoundingBox3D", center=pose, size=size)
    return messages("vision_msgs/msg/Detection3D", header=head, results=[result], bbox=bbox, id=str(number))


def _named(values: NDArray[np.floating], names: str) -> dict[str, float]:
    return dict(zip(names, values.tolist(), strict=True))
