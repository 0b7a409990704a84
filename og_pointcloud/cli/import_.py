"""Turn the result of an OpenGaussian run into one .ogpc file, or a scanner's E57 file into a capture folder.

og-pointcloud import output/ramen -o ramen.ogpc
og-pointcloud import house.e57 -o house
"""

from __future__ import annotations

import argparse
from pathlib import Path

from og_pointcloud.cli import common
from og_pointcloud.cli.common import Parser, add_option
from og_pointcloud.errors import OgPointcloudError
from og_pointcloud.formats.atomic import replacing_folder
from og_pointcloud.journal import Journal


def add(parser: Parser) -> None:
    add_option(parser, "result", "RESULT", "folder of the run, or its point_cloud.ply, or a .e57 file", type=Path)
    output = "the file to write; for a .e57 file, the folder"
    common.add_output(parser, "-o", "--output", endings=(".ogpc", ""), required=True, help=output)
    features = "features of the leaves (default: RESULT/cluster_lang.npz)"
    add_option(parser, "--cluster-lang", "F.npz", features, type=Path)
    add_option(parser, "--feature-space", "NAME", "their encoder (default: LangSplat's, if they have 512 dimensions)")
    common.add_shared(parser, "--text-features")


def run(arguments: argparse.Namespace) -> None:
    if arguments.result.suffix.lower() == ".e57":
        if arguments.output.suffix == ".ogpc":
            raise OgPointcloudError(f"-o is {arguments.output}; expected a folder name: a .e57 file becomes a folder")
        unpack(arguments.result, arguments.output)
        return
    if arguments.output.suffix != ".ogpc":
        raise OgPointcloudError(f"-o is {arguments.output}; expected a file that ends in .ogpc")
    from og_pointcloud.bundle.vocabulary import scene_words
    from og_pointcloud.fitting.opengaussian import read_opengaussian

    journal = Journal(progress=False)
    with journal.stage("read result"):
        cloud = read_opengaussian(arguments.result, arguments.cluster_lang, feature_space=arguments.feature_space)
        cloud = scene_words(cloud.space, text_features=arguments.text_features).added_to(cloud)
    cloud = common.write_fit(cloud, journal, arguments.output)
    report = common.describe_fit(cloud, arguments.result, arguments.output)
    for file in report["files"].values():
        print(f"read {file}")
    common.print_fit(report, cloud)


def unpack(file: Path, folder: Path) -> None:
    """An E57 file as a capture folder."""
    from og_pointcloud.formats.e57 import unpack_e57

    if folder.exists():
        raise OgPointcloudError(f"{folder} already exists; expected a new folder: name another (-o)")
    with replacing_folder(folder) as made:
        made.mkdir()
        images, unused = unpack_e57(file, made)
    for line in unused:
        print(f"left out: {line}")
    print(f"wrote {folder}: {images} images with poses, and the cloud of all scans")
    common.print_next("masks", folder)
