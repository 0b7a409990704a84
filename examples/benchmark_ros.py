"""PointCloud2 conversion beside segmentation, and a bag of clouds: milliseconds, and points a second.

python examples/benchmark_ros.py SCENE.ogpc [--points 300000] [--clouds 100] [--rounds 9] [-o OUT.csv]
"""

from __future__ import annotations

import argparse
import csv
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from og_pointcloud_ros import from_pointcloud2, to_detections, to_pointcloud2, write_fields
from og_pointcloud_ros.bags import label_bag
from og_pointcloud_ros.typestore import ros2_types, rosbags_messages
from rosbags.rosbag2 import Writer

import og_pointcloud as og

CLOUD = "sensor_msgs/msg/PointCloud2"


def median_ms(ask: Callable[[], Any], rounds: int) -> float:
    """Of ``rounds`` calls, after one that is not counted."""
    ask()
    seconds = []
    for _ in range(rounds):
        start = time.perf_counter()
        ask()
        seconds.append(time.perf_counter() - start)
    return 1e3 * float(np.median(seconds))


def sampled_cloud(scene: og.LabelledScene, count: int, seed: int) -> np.ndarray:
    """(count,) fields x y z intensity ring, as LiDAR drivers lay them out: noisy points of the scene."""
    rng = np.random.default_rng(seed)
    xyz = scene.xyz[rng.integers(0, len(scene.xyz), count)] + 0.5 * scene.cloud.spacing * rng.normal(size=(count, 3))
    rows = np.zeros(count, [*((axis, "<f4") for axis in "xyz"), ("intensity", "<f4"), ("ring", "<u2")])
    for axis, values in zip("xyz", xyz.T, strict=True):
        rows[axis] = values
    return rows


def bag_row(scene: og.LabelledScene, segmenter: og.Segmenter, points: int, clouds: int) -> dict[str, Any]:
    """Points a second of a whole ``ros-bag`` run: read, label, write."""
    store = ros2_types()
    make = rosbags_messages(store)
    with tempfile.TemporaryDirectory() as folder:
        with Writer(Path(folder) / "drive", version=8) as bag:
            topic = bag.add_connection("/points", CLOUD, typestore=store)
            for number in range(clouds):
                message = write_fields(sampled_cloud(scene, points, number), "map", number, messages=make)
                bag.write(topic, number, store.serialize_cdr(message, CLOUD))
        start = time.perf_counter()
        report = label_bag(Path(folder) / "drive", Path(folder) / "out", segmenter)
        seconds = time.perf_counter() - start
    what = f"bag of {clouds} clouds: points a second, {report.points / seconds:,.0f}; of the clouds alone"
    return {"what": what, "points": report.points, "value": round(report.points / report.seconds["clouds"])}


def main() -> None:
    """Print and write one table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("scene", type=Path)
    parser.add_argument("--points", type=int, default=300_000)
    parser.add_argument("--clouds", type=int, default=100)
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("-o", "--output", type=Path, metavar="OUT.csv")
    arguments = parser.parse_args()
    scene = og.load(arguments.scene)
    segmenter = og.Segmenter(scene)
    message = write_fields(sampled_cloud(scene, arguments.points, 0), "map")
    xyz = from_pointcloud2(message)
    result = segmenter(xyz)
    store = ros2_types()
    make = rosbags_messages(store)
    tasks: dict[str, Callable[[], Any]] = {
        "from_pointcloud2, ms": lambda: from_pointcloud2(message),
        "Segmenter, ms": lambda: segmenter(xyz),
        "to_pointcloud2, ms": lambda: to_pointcloud2(result),
        "to_detections, boxes known, ms": lambda: to_detections(scene, result),
        "CDR of the labelled cloud, ms": lambda: store.serialize_cdr(to_pointcloud2(result, messages=make), CLOUD),
    }
    rows = [
        {"what": name, "points": arguments.points, "value": round(median_ms(ask, arguments.rounds), 2)}
        for name, ask in tasks.items()
    ]
    rows.append(bag_row(scene, segmenter, arguments.points // 10, arguments.clouds))
    for row in rows:
        print(f"{row['what']:<72} {row['points']:>10,} points {row['value']:>14,}")
    if arguments.output:
        with arguments.output.open("w", newline="") as file:
            writer = csv.DictWriter(file, list(rows[0]))
            writer.writeheader()
            writer.writerows(rows)


if __name__ == "__main__":
    main()
