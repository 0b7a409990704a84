"""The results of a drive through the room: scores per frame against the truth of every ray, a picture, and a bag."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.ask.instances import Instances
from og_pointcloud.ask.segmentation import Reason, Segmentation
from og_pointcloud.formats.colors import label_colors
from og_pointcloud_room.robot import BACKGROUND, MOVED, NEW, NO_RETURN, Drive, LidarFrame

if TYPE_CHECKING:
    from matplotlib.axes import Axes

KEPT_PER_FRAME = 1200
CEILING_M = 2.3
SEEN_OFTEN = 0.1
"""Share of the frames that a box must be seen in to be drawn."""
CHANGED_COLOR = (0.85, 0.0, 0.1)


@dataclass
class DriveLog:
    """Per frame: seconds, detections, and shares in [0, 1] (NaN where a frame shows none of the kind).

    accuracy: share with the right label among rays on things that stand as mapped. unknown: share without a label among
    all returns; changed_unknown: among rays on what is new or moved. background_called: share with a label among rays
    on walls, floor and ceiling. path: (3,) of each frame. seen: number of frames in which each instance was detected.
    sample: for some of each frame's returns, places in the map, labels, whether too far, and the truth.
    """

    seconds: list[float] = field(default_factory=list)
    detections: list[int] = field(default_factory=list)
    accuracy: list[float] = field(default_factory=list)
    unknown: list[float] = field(default_factory=list)
    changed_unknown: list[float] = field(default_factory=list)
    background_called: list[float] = field(default_factory=list)
    path: list[NDArray[np.float64]] = field(default_factory=list)
    seen: Counter[int] = field(default_factory=Counter)
    sample: list[tuple[NDArray[Any], ...]] = field(default_factory=list)

    def add(self, frame: LidarFrame, result: Segmentation, detections: Any, seconds: float) -> None:
        """One frame. detections: a Detection3DArray."""
        truth, labels = frame.truth, result.labels
        self.seconds.append(seconds)
        self.detections.append(len(detections.detections))
        self.accuracy.append(_share(labels == truth, truth >= 0))
        self.unknown.append(_share(labels < 0, truth != NO_RETURN))
        self.changed_unknown.append(_share(labels < 0, (truth == NEW) | (truth == MOVED)))
        self.background_called.append(_share(labels >= 0, truth == BACKGROUND))
        self.path.append(frame.position)
        self.seen.update(int(detection.id) for detection in detections.detections)
        rng = np.random.default_rng(len(self.seconds))
        kept = rng.permutation(np.flatnonzero((truth != NO_RETURN) & (result.xyz[:, 2] < CEILING_M)))[:KEPT_PER_FRAME]
        too_far = result.reasons[kept] == Reason.TOO_FAR
        self.sample.append((result.xyz[kept], labels[kept], too_far, truth[kept]))

    def summary(self) -> str:
        """The text that the example prints."""
        median, slowest = 1e3 * np.median(self.seconds), 1e3 * np.max(self.seconds)
        return (
            f"{len(self.seconds)} frames, {median:.1f} ms each in the median ({slowest:.0f} ms the slowest): "
            f"{1e3 / median:.0f} frames a second, the LiDAR gives 10\n"
            f"right label on what stands as mapped: {_mean(self.accuracy):.1%}; label on bare walls and floor: "
            f"{_mean(self.background_called):.1%}\n"
            f"unknown: {_mean(self.unknown):.1%} of all returns, {_mean(self.changed_unknown):.1%} of those on what is "
            f"new or moved; {np.mean(self.detections):.1f} boxes a frame"
        )


def draw_drive(path: Path, log: DriveLog, instances: Instances) -> Path:
    """The room from above with labels, boxes, path and what is not in the map; beside it, curves over time."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(15, 8), layout="constrained")
    grid = figure.add_gridspec(3, 2, width_ratios=(1.25, 1))
    _draw_map(figure.add_subplot(grid[:, 0]), log, instances)
    seconds = np.arange(len(log.seconds)) / 10
    curves: tuple[tuple[str, tuple[tuple[str, list[float]], ...]], ...] = (
        ("ms a frame", (("labels and boxes", [1e3 * value for value in log.seconds]),)),
        ("share of the returns", (("unknown", log.unknown), ("unknown, of what is new or moved", log.changed_unknown))),
        (
            "share of the rays",
            (("right, on what is mapped", log.accuracy), ("label on walls and floor", log.background_called)),
        ),
    )
    for row, (title, lines) in enumerate(curves):
        axes = figure.add_subplot(grid[row, 1])
        for name, values in lines:
            axes.plot(seconds, values, label=name)
        if row == 0:
            axes.axhline(100, color="grey", linestyle="--", label="LiDAR at 10 Hz")
            axes.set_yscale("log")
        else:
            axes.set_ylim(-0.03, 1.03)
        axes.set(ylabel=title, xlabel="seconds of the drive" if row == len(curves) - 1 else "")
        axes.grid(alpha=0.3)
        axes.legend(loc="best", fontsize=8)
    figure.savefig(path, dpi=100)
    return path


def _draw_map(axes: Axes, log: DriveLog, instances: Instances) -> None:
    xyz, labels, too_far, truth = (np.concatenate(column) for column in zip(*log.sample, strict=True))
    # Walls and ceiling that the mapping camera never saw are "too far" as well; only what is on the floor is drawn.
    odd = too_far & (truth != BACKGROUND)
    known = labels >= 0
    for chosen, colors, size in ((~known & ~odd, "0.85", 0.5), (known, label_colors(labels[known]) / 255, 0.8)):
        axes.scatter(*xyz[chosen, :2].T, s=size, c=colors, linewidths=0, rasterized=True)
    axes.scatter(
        *xyz[odd, :2].T, s=4, color=CHANGED_COLOR, linewidths=0, label="too far from the map: new, moved or never seen"
    )
    axes.plot(*np.array(log.path)[:, :2].T, color="black", linewidth=1, label="path of the robot")
    often = [k for k, frames in log.seen.items() if frames > SEEN_OFTEN * len(log.path)]
    for instance in (instances[k] for k in sorted(often)):
        box = instance.oriented_box
        if box is not None and instance.words:
            axes.plot(*box.corners[[0, 1, 3, 2, 0], :2].T, color="0.2", linewidth=0.7)
            x, y = box.center[:2].tolist()
            axes.text(x, y, instance.words[0][0], fontsize=6, ha="center", va="center")
    axes.set(aspect="equal", xlabel="x in m", ylabel="y in m", title="labels, boxes and what the map does not know")
    axes.legend(loc="lower right", fontsize=8, markerscale=3)


def write_drive(folder: Path, drive: Drive) -> Path:
    """The drive as a ROS 2 bag: /points, /tf from map to base, /tf_static from base to lidar."""
    from og_pointcloud_ros import write_fields
    from og_pointcloud_ros.bags import ros2_types, rosbags_messages
    from og_pointcloud_ros.messages import header
    from rosbags.rosbag2 import Writer

    store = ros2_types()
    make = rosbags_messages(store)

    def transform(parent: str, child: str, pose: NDArray[np.float64], stamp: int) -> Any:
        half = float(np.arctan2(pose[1, 0], pose[0, 0])) / 2  # the robot turns about z alone
        turn = make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=np.sin(half), w=np.cos(half))
        place = make("geometry_msgs/msg/Vector3", **dict(zip("xyz", pose[:3, 3].tolist(), strict=True)))
        moved = make("geometry_msgs/msg/Transform", translation=place, rotation=turn)
        head = header(make, parent, stamp)
        stamped = make("geometry_msgs/msg/TransformStamped", header=head, child_frame_id=child, transform=moved)
        return make("tf2_msgs/msg/TFMessage", transforms=[stamped])

    tf, cloud = "tf2_msgs/msg/TFMessage", "sensor_msgs/msg/PointCloud2"
    with Writer(folder, version=8) as bag:
        topics = {name: bag.add_connection(name, tf, typestore=store) for name in ("/tf", "/tf_static")}
        points = bag.add_connection("/points", cloud, typestore=store)
        for number, frame in enumerate(drive):
            if number == 0:
                static = transform("base", "lidar", np.eye(4), frame.stamp)
                bag.write(topics["/tf_static"], frame.stamp, store.serialize_cdr(static, tf))
            moved = transform("map", "base", frame.sensor_to_map, frame.stamp)
            bag.write(topics["/tf"], frame.stamp, store.serialize_cdr(moved, tf))
            rows = frame.xyz.view([(axis, "<f4") for axis in "xyz"])[:, 0]
            rows = rows.reshape(drive.lidar.beams, drive.lidar.columns)
            message = write_fields(rows, "lidar", frame.stamp, messages=make)
            bag.write(points, frame.stamp, store.serialize_cdr(message, cloud))
    return folder


def _share(hit: NDArray[np.bool_], of: NDArray[np.bool_]) -> float:
    return float(hit[of].mean()) if of.any() else float("nan")


def _mean(values: list[float]) -> float:
    return float(np.nanmean(values)) if np.isfinite(values).any() else float("nan")
