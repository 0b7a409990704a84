"""``og-pointcloud import``: what an OpenGaussian run wrote to one .ogpc file."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from og_pointcloud.cli.common import add_command, check_outputs, describe_fit, print_fit, timed

if TYPE_CHECKING:
    from og_pointcloud.cloud import LabelledCloud


def add(commands: Any) -> None:
    parser = add_command(
        commands, "import", run, "Turn what an OpenGaussian run wrote into one .ogpc file.",
        "og-pointcloud import output/ramen -o ramen.ogpc",
    )  # fmt: skip
    parser.add_argument("result", type=Path, metavar="RESULT", help="folder of the run, or its point_cloud.ply")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="S.ogpc", help="the file to write")
    parser.add_argument(
        "--cluster-lang", type=Path, metavar="F.npz", help="features of the leaves (default: RESULT/cluster_lang.npz)"
    )
    parser.add_argument("--feature-space", metavar="NAME", help="their encoder (default: LangSplat's, if 512 wide)")
    parser.add_argument("--text-features", type=Path, metavar="F.npz", help="names that can then be asked")


def run(arguments: argparse.Namespace) -> None:
    check_outputs(
        {"-o": (arguments.output, [".ogpc"])},
        inputs=[arguments.result, arguments.cluster_lang, arguments.text_features],
    )
    from og_pointcloud_export import write_bundle

    from og_pointcloud.bundle.scene_words import scene_words
    from og_pointcloud.fitting.opengaussian import read_opengaussian

    stages: list[dict[str, Any]] = []
    with timed(stages, "read result"):
        cloud = read_opengaussian(arguments.result, arguments.cluster_lang, feature_space=arguments.feature_space)
        cloud = scene_words(cloud.space, text_features=arguments.text_features).added_to(cloud)
    cloud = replace(cloud, provenance={**cloud.provenance, "stages": stages})
    with timed(stages, "write file"):
        arguments.output.parent.mkdir(parents=True, exist_ok=True)
        write_bundle(cloud, arguments.output)
    print_import(describe_fit(cloud, arguments.result, arguments.output), cloud)


def print_import(report: Mapping[str, Any], cloud: LabelledCloud) -> None:
    """What ``import`` closes with: the files it found, and the rest as ``fit``."""
    for file in report["files"].values():
        print(f"read {file}")
    print_fit(report, cloud)
