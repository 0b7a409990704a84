"""Label the clouds of a ROS 2 bag; needs no ROS.

og-pointcloud ros-bag drive -o drive_labelled --scene room.ogpc --labels chair,table
"""

from __future__ import annotations

import argparse
import shlex
import time
from pathlib import Path
from typing import TYPE_CHECKING

import og_pointcloud as og
from og_pointcloud.cli.common import Parser, add_option, add_shared, names_in, print_shares
from og_pointcloud.errors import counted

if TYPE_CHECKING:
    from og_pointcloud_ros.bags import BagReport

SHOWN_REASONS = 3


def add(parser: Parser) -> None:
    add_option(parser, "bag", "IN", "a bag's folder, or one .db3 or .mcap file", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="OUT", help="folder to create")
    add_option(parser, "--scene", "S.ogpc", "file that `fit` wrote", type=Path, required=True)
    add_shared(parser, "--labels", "--text-features", "--frame")
    add_option(parser, "--topic", "T", "clouds to label; repeatable (default: every PointCloud2)", action="append")


def run(arguments: argparse.Namespace) -> None:
    from og_pointcloud_ros.bags import label_bag

    start = time.perf_counter()
    segmenter = og.Segmenter(arguments.scene, names_in(arguments.labels), text_features=arguments.text_features)
    options = {"topics": arguments.topic, "frame": arguments.frame, "progress": True}
    report = label_bag(arguments.bag, arguments.output, segmenter, **options)
    print_report(report, arguments.output, time.perf_counter() - start)


def print_report(report: BagReport, output: Path, seconds: float) -> None:
    print_shares(report.counts, report.points - report.counts.total(), report.unknown_because)
    if report.skipped:
        print(f"skipped {counted(report.skipped.total(), 'cloud')} without labels:")
        for reason, count in report.skipped.most_common(SHOWN_REASONS):
            print(f"  {count:,} x {reason}")
    pace = max(report.seconds, 1e-9)  # of the clouds alone, without reading and writing the bag
    done = counted(report.clouds, "cloud"), counted(report.points, "point"), counted(report.detections, "detection")
    print(f"{', '.join(done)} in {seconds:.1f} s")
    print(
        f"clouds only: {pace:.1f} s, {report.clouds / pace:.1f} clouds, {report.points / pace:,.0f} points per second"
    )
    print(f"wrote {output}: {', '.join(report.topics.values())}")
    shown = next(iter(report.topics.values()))
    play = shlex.join(["ros2", "bag", "play", str(output)])
    print(f"next: {play}, and in RViz show {shown} as PointCloud2, colored by rgb")
