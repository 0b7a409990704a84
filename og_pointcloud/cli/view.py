"""``og-pointcloud view``: features or instances of several views of a capture as one picture."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from og_pointcloud.cli.common import add_command, check_outputs, print_table, timed
from og_pointcloud.errors import OgPointcloudError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from og_pointcloud.scene import Scene


def add(commands: Any) -> None:
    parser = add_command(
        commands, "view", run, "Picture of learned features, or of instances, over several views of a capture.",
        "og-pointcloud view kitchen --features -o features.png",
    )  # fmt: skip
    parser.add_argument("capture", type=Path, metavar="CAPTURE", help="folder with poses, masks and mask features")
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--features", action="store_true", help="learn features; show them before and after clustering")
    what.add_argument("--instances", type=Path, metavar="S.ogpc", help="show the instances of a fit of this capture")
    parser.add_argument(
        "-o", "--output", type=Path, metavar="P.png", help="the picture (default: features.png or instances.png)"
    )
    parser.add_argument("--columns", type=int, default=4, metavar="N", help="views shown (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="of everything random (default: %(default)s)")


def run(arguments: argparse.Namespace) -> None:
    output = arguments.output or Path("features.png" if arguments.features else "instances.png")
    check_outputs({"-o": (output, [".png"])}, inputs=[arguments.capture, arguments.instances])
    if arguments.columns < 1:
        raise OgPointcloudError(f"--columns is {arguments.columns}; expected at least 1")
    from og_pointcloud.fitting import pictures
    from og_pointcloud.fitting.fit import prepare
    from og_pointcloud.fitting.geometry import near_plane
    from og_pointcloud.fitting.journal import Journal
    from og_pointcloud.formats.capture import read_capture

    stages: list[dict[str, Any]] = []
    with timed(stages, "read capture"):
        scene = read_capture(arguments.capture)
        near = near_plane(scene.points.xyz, scene.views)
    output.parent.mkdir(parents=True, exist_ok=True)
    with timed(stages, "prepare"):
        prepared = prepare(scene, journal=Journal(progress=sys.stderr.isatty()))
    if arguments.features:
        with timed(stages, "learn"):
            features = pictures.learned_stages(prepared.table, scene.points.xyz, seed=arguments.seed)
        with timed(stages, "draw"):
            pictures.feature_picture(prepared.gaussians, scene.views, near, features, output, arguments.columns)
    else:
        ids = instances_of(arguments.instances, scene)
        with timed(stages, "draw"):
            pictures.instance_picture(prepared.gaussians, scene.views, near, ids, output, arguments.columns)
    print_table(("stage", "seconds"), [(stage["name"], f"{stage['seconds']:.2f}") for stage in stages])
    print(f"wrote {output}")


def instances_of(bundle: Path, scene: Scene) -> dict[str, NDArray[np.int32]]:
    from og_pointcloud.bundle import read_bundle

    cloud = read_bundle(bundle).cloud
    if len(cloud) != len(scene.points):
        raise OgPointcloudError(
            f"{bundle} has {len(cloud)} points, the capture {len(scene.points)}; expected a fit of this capture"
        )
    return {f"{len(cloud.instances)} instances": cloud.instance_ids}
