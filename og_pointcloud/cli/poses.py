"""Turn photographs without poses into a capture for `masks`, by structure from motion, where that succeeds.

og-pointcloud poses photographs -o desk
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from og_pointcloud.cli.common import Parser, add_option, check_at_least, print_next, some_of
from og_pointcloud.errors import counted


def add(parser: Parser) -> None:
    add_option(parser, "photographs", "FOLDER", "folder of photographs, or one with an images/ folder", type=Path)
    folder = "folder to create (default: FOLDER itself)"
    parser.add_argument("-o", "--output", type=Path, metavar="CAPTURE", help=folder)
    size = "larger images are shrunk to this (default: %(default)s)"
    add_option(parser, "--longest-side", "PX", size, type=int, default=1600)
    threads = "more are faster, and may give a slightly different model each time (default: %(default)s)"
    add_option(parser, "--threads", "N", threads, type=int, default=1)


def run(arguments: argparse.Namespace) -> None:
    check_at_least("--longest-side", arguments.longest_side, 100)
    check_at_least("--threads", arguments.threads, 1)
    from og_pointcloud.formats.structure_from_motion import find_poses

    poses = find_poses(
        arguments.photographs, arguments.output, longest_side=arguments.longest_side, threads=arguments.threads,
        progress=True,
    )  # fmt: skip
    features, matches, mapping = poses.seconds
    if poses.left_out:
        count = counted(len(poses.left_out), "photograph")
        print(f"warning: {count} could not be placed: {some_of(poses.left_out)}", file=sys.stderr)
    print(
        f"{poses.registered} of {poses.of} photographs have poses, {poses.points:,} points, mean error "
        f"{poses.error_px:.2f} px (features {features:.0f} s, matches {matches:.0f} s, mapping {mapping:.0f} s)"
    )
    print(f"wrote {poses.capture / 'sparse'}; its scale is arbitrary")
    print_next("masks", poses.capture)
