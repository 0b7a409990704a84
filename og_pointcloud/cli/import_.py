"""Turn what an OpenGaussian run wrote into one .ogpc file.

og-pointcloud import output/ramen -o ramen.ogpc
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from og_pointcloud.cli.common import Parser, add_output, add_shared, describe_fit, print_fit, timed, write_fit


def add(parser: Parser) -> None:
    parser.add_argument("result", type=Path, metavar="RESULT", help="folder of the run, or its point_cloud.ply")
    add_output(parser, "-o", "--output", endings=(".ogpc",), required=True, help="the file to write")
    parser.add_argument(
        "--cluster-lang", type=Path, metavar="F.npz", help="features of the leaves (default: RESULT/cluster_lang.npz)"
    )
    parser.add_argument("--feature-space", metavar="NAME", help="their encoder (default: LangSplat's, if 512 wide)")
    add_shared(parser, "--text-features")


def run(arguments: argparse.Namespace) -> None:
    from og_pointcloud.bundle.vocabulary import scene_words
    from og_pointcloud.fitting.opengaussian import read_opengaussian

    stages: list[dict[str, Any]] = []
    with timed(stages, "read result"):
        cloud = read_opengaussian(arguments.result, arguments.cluster_lang, feature_space=arguments.feature_space)
        cloud = scene_words(cloud.space, text_features=arguments.text_features).added_to(cloud)
    cloud = write_fit(cloud, stages, arguments.output)
    report = describe_fit(cloud, arguments.result, arguments.output)
    for file in report["files"].values():
        print(f"read {file}")
    print_fit(report, cloud)
