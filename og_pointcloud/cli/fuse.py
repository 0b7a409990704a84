"""Make a capture's cloud from its depth images, once, so that no later command has to.

og-pointcloud fuse scene0000_00
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

from og_pointcloud.cli.common import Parser, add_option, add_output, check_output, print_next, warn_of_poses
from og_pointcloud.errors import OgPointcloudError


def add(parser: Parser) -> None:
    formats = "depth/, nerfstudio's depth_file_path, ScanNet, 7-Scenes, Replica"
    add_option(parser, "capture", "CAPTURE", f"folder with poses and depth images: {formats}", type=Path)
    add_output(parser, "-o", "--output", endings=(".ply",), help="the cloud to write (default: CAPTURE/points.ply)")
    unit = "world units per stored depth step, e.g. 0.001 (default: as the data set or image type implies)"
    add_option(parser, "--depth-unit", "X", unit, type=float)


def run(arguments: argparse.Namespace) -> None:
    unit, output = arguments.depth_unit, arguments.output or arguments.capture / "points.ply"
    if unit is not None and not 0 < unit < float("inf"):
        raise OgPointcloudError(f"--depth-unit is {unit:g}; expected a number above 0, such as 0.001")
    if arguments.output is None and output.exists():
        raise OgPointcloudError(f"'{output}' already exists and is kept; to fuse again, name another file (-o)")
    check_output("-o", output, [arguments.capture])
    from og_pointcloud.formats.capture import fuse_capture
    from og_pointcloud.formats.langsplat import LANGUAGE_FEATURES_FOLDER
    from og_pointcloud.formats.mask_files import FEATURES_NAME
    from og_pointcloud.formats.ply import plain_rows, write_ply

    start = time.perf_counter()
    fused = fuse_capture(arguments.capture, unit)
    warn_of_poses(arguments.capture, fused.points)
    write_ply(output, {"vertex": plain_rows(fused.points.xyz_world, fused.points.rgb)})
    print(
        f"{fused.frames} depth images in {time.perf_counter() - start:.1f} s: {len(fused.points):,} points, voxels of "
        f"{fused.survey.voxel:.3g}, noise {fused.survey.noise:.2g} at depth {fused.survey.depth:.3g}; "
        f"{fused.refused:,} voxels left out because other views saw through them"
    )
    print(f"wrote {output}")
    if arguments.output is None:
        masked = any((arguments.capture / name).exists() for name in (FEATURES_NAME, LANGUAGE_FEATURES_FOLDER))
        print_next(*(("fit", arguments.capture, "-o", "scene.ogpc") if masked else ("masks", arguments.capture)))
