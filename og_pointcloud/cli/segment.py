"""Label points by words: those of the fitted cloud, or of another one.

og-pointcloud segment kitchen.ogpc --labels chair,table -o labels.npz
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import og_pointcloud as og
from og_pointcloud.cli import common
from og_pointcloud.cli.common import Parser
from og_pointcloud.errors import OgPointcloudError
from og_pointcloud.journal import Journal

SAVED_AS = (".npz", ".ply", ".las", ".laz", ".glb", ".spz")
"""Same as `og_pointcloud.ask.segmentation.SAVED_AS`, repeated because --help must not import numpy."""


def add(parser: Parser) -> None:
    common.add_shared(parser, "bundle", "--labels", "--text-features", "--json")
    common.add_option(parser, "--points", "CLOUD", "points to label (default: the fitted ones)", type=Path)
    pose = "pose of CLOUD in the scene: a text file of 4 x 4 numbers, from its coordinates to the scene's"
    kept = "; moved points keep neither splats nor the attributes of .las and .laz"
    common.add_option(parser, "--pose", "POSE.txt", pose + kept, type=Path)
    files = "labels as .npz, or a colored .ply, .las, .laz or .glb; for splats .glb or .spz"
    common.add_output(parser, "-o", "--output", endings=SAVED_AS, metavar="OUT", help=files)


def run(arguments: argparse.Namespace) -> None:
    from og_pointcloud.formats.poses import read_numbers

    if arguments.pose and not arguments.points:
        raise OgPointcloudError(f"--pose is '{arguments.pose}' without --points; expected the cloud that it places")
    if arguments.pose and arguments.output and arguments.output.suffix == ".spz":
        raise OgPointcloudError(f"-o is '{arguments.output}', but --pose moves no splats; expected a .ply of points")
    journal = Journal(progress=False)
    with journal.stage("load"):
        scene = og.load(arguments.bundle)
    with journal.stage("segment"):
        labels = common.names_in(arguments.labels)
        pose = None if arguments.pose is None else read_numbers(arguments.pose, 4)
        features = arguments.text_features
        # Splat formats are written as splats if the labelled points are splats; row by row, without those left out.
        takes_splats = arguments.points and arguments.output and arguments.output.suffix in (".glb", ".spz")
        points = og.read_points(arguments.points) if takes_splats else None
        splats = points if points is not None and points.are_gaussians else None
        result = og.segment(splats or arguments.points or scene, labels, scene, pose=pose, text_features=features)
    # Splats and the attributes of LAS points are kept as in the file, unless a pose moves them.
    unmoved, left_out = None if arguments.pose else arguments.points, None
    if arguments.output:
        with journal.stage("save"):
            result.save(arguments.output, splats if unmoved else None, unmoved)
        if arguments.pose and splats:
            left_out = "splats, which --pose moves: points are written"
        elif arguments.pose and {arguments.points.suffix.lower(), arguments.output.suffix} <= {".las", ".laz"}:
            left_out = f"attributes and coordinate system of {arguments.points}, whose points --pose moves"
    report = describe_segmentation(result, journal, arguments.bundle, arguments.output, left_out)
    common.print_result(arguments, report, print_segmentation)
    if arguments.json:
        return
    words = common.as_given(arguments, "--labels", "--text-features")
    if not (result.labels >= 0).any():
        return  # the warning says what helps; there is nothing to save or view
    if arguments.output is None:
        words += [*common.as_given(arguments, "--points", "--pose"), "-o", common.labels_file(arguments.bundle)]
        common.print_next("segment", arguments.bundle, *words, hint="to keep the labels: ")
    else:
        cloud = ["--cloud", unmoved] if unmoved else []
        common.print_next("view", arguments.bundle, *words, *cloud)


def describe_segmentation(
    result: og.Segmentation, journal: Journal, bundle: Path, output: Path | None, left_out: str | None = None
) -> dict[str, Any]:
    """The output of ``segment --json``: points of each name, why the others are unknown, what the file lacks."""
    return {
        "bundle": str(bundle),
        "output": str(output) if output else None,
        "left_out": left_out,
        "points": len(result),
        "counts": result.counts(),
        "unknown": int((result.labels < 0).sum()),
        "unknown_because": {str(reason): count for reason, count in result.unknown_because().items()},
        "calibrated": result.calibrated,
        "seconds": {stage["name"]: stage["seconds"] for stage in journal.stages},
    }


def print_segmentation(report: Mapping[str, Any]) -> None:
    """Print the names that were found, in the given order, and the share that stays unknown."""
    common.print_shares(report["counts"], report["unknown"], report["unknown_because"])
    absent = [name for name, count in report["counts"].items() if not count]
    if absent:
        print(f"no points: {common.some_of(absent)}")
    if not report["calibrated"]:
        print(
            "not calibrated: every instance gets its best label, however badly it fits. "
            f"{common.calibration_hint(report['bundle'])}"
        )
    print(", ".join(f"{name} {seconds:.2f} s" for name, seconds in report["seconds"].items()))
    if report["left_out"]:
        print(f"left out: {report['left_out']}")
    if report["output"]:
        print(f"wrote {report['output']}")
