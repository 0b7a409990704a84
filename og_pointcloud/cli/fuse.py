"""Make a capture's cloud from its depth images, once, so that no later command has to.

og-pointcloud fuse scene0000_00
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import TYPE_CHECKING

from og_pointcloud.cli.common import Parser, add_output, check_output, print_next
from og_pointcloud.errors import OgPointcloudError

if TYPE_CHECKING:
    from og_pointcloud.scene import Points


def add(parser: Parser) -> None:
    parser.add_argument(
        "capture", type=Path, metavar="CAPTURE",
        help="folder with poses and depth images: depth/, nerfstudio's depth_file_path, ScanNet, 7-Scenes, Replica",
    )  # fmt: skip
    add_output(parser, "-o", "--output", endings=(".ply",), help="the cloud to write (default: CAPTURE/points.ply)")
    parser.add_argument(
        "--depth-unit", type=float, metavar="X",
        help="lengths of the poses' world in a stored step, e.g. 0.001 (default: what the data set or the type says)",
    )  # fmt: skip


def run(arguments: argparse.Namespace) -> None:
    unit, output = arguments.depth_unit, arguments.output or arguments.capture / "points.ply"
    if unit is not None and not 0 < unit < float("inf"):
        raise OgPointcloudError(f"--depth-unit is {unit:g}; expected a number above 0, such as 0.001")
    check_output("-o", output, [arguments.capture])
    from og_pointcloud.formats.capture import fuse_capture

    start = time.perf_counter()
    fused = fuse_capture(arguments.capture, unit)
    write_points(fused.points, output)
    print(
        f"{fused.frames} depth images in {time.perf_counter() - start:.1f} s: {len(fused.points):,} points, voxels of "
        f"{fused.survey.voxel:.3g}, noise {fused.survey.noise:.2g} at depth {fused.survey.depth:.3g}; "
        f"{fused.refused:,} voxels left out that other views looked through"
    )
    print(f"wrote {output}")
    if arguments.output is None:
        print_next("fit", arguments.capture, "-o", "scene.ogpc")


def write_points(points: Points, path: Path) -> None:
    """x y z (double where float would lose digits), red green blue where the points have colours; atomic."""
    from og_pointcloud.formats.ply import join_columns, write_ply
    from og_pointcloud.formats.tables import storable_positions

    columns = dict(zip("xyz", storable_positions(points.xyz_world).T, strict=True))
    if points.rgb is not None:
        columns |= dict(zip(("red", "green", "blue"), points.rgb.T, strict=True))
    write_ply(path, {"vertex": join_columns(columns)})
