"""A robot drives through the room after it was mapped: labels, boxes and "unknown" for every LiDAR frame.

python examples/07_robot.py -o OUT [--scene room.ogpc] [--frames N]

Writes 07_robot.png, the drive as a bag, and the bag with labels. Since mapping, a chair was moved and two things are
new: these should be unknown.
"""

import argparse
import shutil
import time
from pathlib import Path

import numpy as np
from og_pointcloud_room.furniture import CLASS_NAMES
from og_pointcloud_room.robot import Drive
from og_pointcloud_room.robot_log import DriveLog, draw_drive, write_drive
from og_pointcloud_ros import read_fields, to_detections
from og_pointcloud_ros.bags import label_bag, open_bag, ros2_types

import og_pointcloud as og

parser = argparse.ArgumentParser(description="A robot in the demo room.")
parser.add_argument("-o", "--output", type=Path, default=Path("out/robot"), metavar="OUT", help="folder")
parser.add_argument("--scene", type=Path, help="the demo's room.ogpc, seed 0 (default: make it, a minute)")
parser.add_argument("--frames", type=int, help="of the lap (default: all at 10 Hz)")
arguments = parser.parse_args()
out = arguments.output
out.mkdir(parents=True, exist_ok=True)
if arguments.scene is None:
    from og_pointcloud_room.demo import run_demo

    arguments.scene = run_demo(out / "demo", pictures=False).bundle

scene = og.load(arguments.scene)
segmenter = og.Segmenter(scene, CLASS_NAMES)
instances = og.instance_table(scene, up=(0, 0, 1))
drive, log, streamed = Drive(0, frames=arguments.frames), DriveLog(), []
# Boxes, and the lookup of places between points, are built on first use: here, so that no frame waits for them.
_ = [row.oriented_box for row in instances], segmenter(scene.xyz + scene.cloud.reach / 2)
for frame in drive:
    start = time.perf_counter()
    result = segmenter(frame.xyz, frame.sensor_to_map)
    detections = to_detections(instances, result, "map", frame.stamp, minimum_points=10)
    log.add(frame, result, detections, time.perf_counter() - start)
    streamed.append(result.labels)
print(log.summary())
print(f"wrote {draw_drive(out / '07_robot.png', log, instances)}")

for name in ("07_robot_drive", "07_robot_labelled"):
    shutil.rmtree(out / name, ignore_errors=True)
report = label_bag(write_drive(out / "07_robot_drive", drive), out / "07_robot_labelled", segmenter)
print(f"bag: {report.clouds} clouds, {report.points / report.seconds:,.0f} points a second")
store, same = ros2_types(), []
with open_bag(out / "07_robot_labelled") as bag:
    topic = [connection for connection in bag.connections if connection.topic == "/points/labelled"]
    for labels, (connection, _, data) in zip(streamed, bag.messages(topic), strict=True):
        rows = read_fields(store.deserialize_cdr(data, connection.msgtype))
        same.append((rows["label"].ravel() == np.where(labels < 0, 65535, labels)).mean())
print(f"read back: {np.mean(same):.2%} of the labels as in the stream")
