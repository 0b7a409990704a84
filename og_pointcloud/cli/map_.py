"""Make a map from a ROS 2 bag, frame by frame; needs no ROS.

og-pointcloud map drive -o room.ogpc
"""

from __future__ import annotations

import argparse
import shutil
import sys
from collections import defaultdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from og_pointcloud.cli.common import (
    SHOWN,
    Parser,
    add_option,
    add_output,
    add_shared,
    interruptible,
    print_next,
    replaceable,
)
from og_pointcloud.cli.update import print_changes
from og_pointcloud.errors import OgPointcloudError, SceneError, counted

if TYPE_CHECKING:
    from og_pointcloud.mapping.mapper import Mapper


def add(parser: Parser) -> None:
    option = partial(add_option, parser)
    option("bag", "BAG", "with depth, masks, their features, camera_info and tf (docs/maps.md)", type=Path)
    add_output(parser, "-o", "--output", endings=(".ogpc",), required=True, help="the map to write")
    parser.add_argument("--resume", action="store_true", help="continue an interrupted run")
    option("--start", "MAP.ogpc", "a map to continue (default: an empty one)", type=Path)
    add_shared(parser, "--frame")
    option("--feature-space", "NAME", "encoder of the features (default: %(default)s)", default="unknown")
    option("--work", "DIR", "where the map is kept while it grows (default: OUT.ogpc.map)", type=replaceable)


def run(arguments: argparse.Namespace) -> None:
    from og_pointcloud.mapping.map_journal import holds_map

    work = arguments.work or arguments.output.with_name(f"{arguments.output.name}.map")
    if work.exists() and not holds_map(work):  # it is removed at the end
        raise OgPointcloudError(f"--work is '{work}', which has other files than a map; expected a new folder name")
    if work.exists() and not arguments.resume:
        raise OgPointcloudError(f"'{work}' contains an interrupted map: add --resume, or remove it")
    try:
        with interruptible():
            mapper, taken = saved_map(arguments, work)
    except KeyboardInterrupt:
        if work.exists():
            print(f"kept in '{work}': the map so far; --resume continues it", file=sys.stderr)
        raise
    shutil.rmtree(work)
    if mapper.changes is not None:
        print_changes(mapper.changes)
    cloud = mapper.snapshot().cloud
    made = (taken, "frame"), (len(cloud), "point"), (int((cloud.instances.points > 0).sum()), "object")
    print(", ".join(counted(count, thing) for count, thing in made))
    print(f"wrote {arguments.output}")
    print_next("info", arguments.output)


def saved_map(arguments: argparse.Namespace, work: Path) -> tuple[Mapper, int]:
    """The map of a bag, saved, and the number of frames that went in now. work: of its journal."""
    from og_pointcloud_ros.map_bags import BagFrames
    from tqdm import tqdm

    from og_pointcloud.mapping.mapper import Mapper

    frames, refused, taken = BagFrames(arguments.bag, arguments.frame), defaultdict[str, list[str]](list), 0
    with Mapper(arguments.start, feature_space=arguments.feature_space, journal=work) as mapper:
        for frame in tqdm(frames, desc="frames", disable=None, leave=False):
            if arguments.resume and frame.stamp is not None and mapper.holds(frame.stamp):
                continue
            try:
                mapper.integrate(frame)
                taken += 1
            except OgPointcloudError as error:
                # What many frames have in common is said once, without their names.
                refused[str(error).replace(f"frame {frame.stamp or 0:.15g}", "a frame")].append(str(error))
        reasons = {said[0] if len(said) == 1 else why: len(said) for why, said in refused.items()}
        print_left_out([*frames.dropped.items(), *reasons.items()])
        try:
            mapper.snapshot()
        except SceneError:  # nothing to save, nor to resume
            if not arguments.resume:
                shutil.rmtree(work)
            raise
        mapper.save(arguments.output)
    return mapper, taken


def print_left_out(reasons: list[tuple[str, int]]) -> None:
    for why, count in reasons[:SHOWN]:
        print(f"left out: {count} x {why}", file=sys.stderr)
    if rest := reasons[SHOWN:]:
        print(f"left out: {sum(count for _, count in rest)} more, for {len(rest)} other reasons", file=sys.stderr)
