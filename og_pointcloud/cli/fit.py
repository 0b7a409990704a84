"""Turn a capture folder (posed images with masks, and a cloud) into one .ogpc file.

og-pointcloud fit kitchen -o kitchen.ogpc
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args, get_type_hints

from og_pointcloud.cli.common import (
    Parser,
    add_output,
    add_shared,
    describe_fit,
    print_fit,
    replaceable,
    timed,
    write_fit,
    write_json,
)
from og_pointcloud.errors import OgPointcloudError
from og_pointcloud.settings import FitSettings, PaperSettings

if TYPE_CHECKING:
    from og_pointcloud.cloud import LabelledCloud

MODES = get_args(get_type_hints(FitSettings)["mode"])
MASK_LEVELS = ("default", "small", "medium", "large")


def add(parser: Parser) -> None:
    add_shared(parser, "capture")
    add_output(parser, "-o", "--output", endings=(".ogpc",), required=True, help="the file to write")
    parser.add_argument("--gaussians", type=Path, metavar="F.ply", help="geometry, in place of the capture's own")
    parser.add_argument("--mode", choices=MODES, default="auto", help="how to find instances (default: %(default)s)")
    parser.add_argument(
        "--schedule-share", type=float, metavar="X", help="shorten the published schedule (mode paper; default: 1)"
    )
    parser.add_argument(
        "--mask-level", choices=MASK_LEVELS, default="large", help="level of LangSplat masks (default: %(default)s)"
    )
    parser.add_argument(
        "--vocabulary", type=Path, metavar="F.npz",
        help="text features whose names can then be asked (default: the capture's text_features.npz)",
    )  # fmt: skip
    parser.add_argument(
        "--word-bank", type=Path, metavar="F.npz",
        help="text features of at least 50 everyday words, which labels are judged by (default: those of the feature "
        "space's text encoder, if it is found)",
    )  # fmt: skip
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="of everything random (default: %(default)s)")
    parser.add_argument(
        "--memory", metavar="4GB",
        help="what the fit may hold in memory; a larger table goes to disk (default: half of what is free)",
    )  # fmt: skip
    parser.add_argument(
        "--tile-points", type=int, metavar="N",
        help="fit in tiles of at most so many points (default: only where one fit would not fit into memory)",
    )  # fmt: skip
    parser.add_argument(
        "--work", type=replaceable, metavar="DIR",
        help="where the views of a long fit are kept until it ends, for a start after a kill (default: S.ogpc.work)",
    )  # fmt: skip
    add_output(parser, "--ply", endings=(".ply",), help="also write the labelled cloud for other tools")
    add_output(parser, "--json", endings=(".json",), help="also write timings and settings of this run")


def run(arguments: argparse.Namespace) -> None:
    settings = fit_settings(arguments)
    from og_pointcloud.bundle.vocabulary import scene_words
    from og_pointcloud.cloud import FeatureSpace
    from og_pointcloud.fitting.fit import fit
    from og_pointcloud.fitting.work_folder import kept_files
    from og_pointcloud.formats.capture import read_capture

    stages: list[dict[str, Any]] = []
    with timed(stages, "read capture"):
        scene = read_capture(arguments.capture, gaussians=arguments.gaussians, mask_level=arguments.mask_level)
        space = FeatureSpace(scene.feature_space, scene.feature_width)
        asked = {"text_features": arguments.vocabulary, "word_bank": arguments.word_bank}
        words = scene_words(space, **asked, capture=arguments.capture)
    work = arguments.work or arguments.output.with_name(f"{arguments.output.name}.work")
    try:
        cloud = words.added_to(fit(scene, settings, work=work))
    except KeyboardInterrupt:
        if views := kept_files(work, "view"):
            print(f"{views} views are kept in '{work}': the same command goes on behind them", file=sys.stderr)
        raise
    cloud = write_fit(cloud, stages + cloud.provenance["stages"], arguments.output)
    if arguments.ply:
        with timed(cloud.provenance["stages"], "write cloud"):
            write_cloud(cloud, arguments.output, arguments.ply)
    report = describe_fit(cloud, arguments.capture, arguments.output)
    if arguments.json:
        write_json(arguments.json, report)
    print_fit(report, cloud)


def fit_settings(arguments: argparse.Namespace) -> FitSettings:
    from og_pointcloud.fitting.memory import parse_memory

    memory = None if arguments.memory is None else parse_memory(arguments.memory)
    settings = FitSettings(mode=arguments.mode, seed=arguments.seed, memory=memory, tile_points=arguments.tile_points)
    if arguments.schedule_share is None:
        return settings
    if arguments.mode != "paper":
        raise OgPointcloudError(
            f"--schedule-share is {arguments.schedule_share:g} with --mode {arguments.mode}, which has no schedule; "
            "expected --mode paper: leave the option out, or take that mode"
        )
    return replace(settings, paper=PaperSettings(schedule_share=arguments.schedule_share))


def write_cloud(cloud: LabelledCloud, bundle: Path, path: Path) -> None:
    """The fitted cloud as .ply, coloured by the best word of each instance, or by instance where there are no words."""
    import numpy as np

    from og_pointcloud.ask.labelled_scene import segment
    from og_pointcloud.cloud import UNKNOWN
    from og_pointcloud.formats.colors import label_colors
    from og_pointcloud.formats.points import write_labelled_ply

    if cloud.vocabulary:
        segment(bundle).save(path)
        return
    ids, unknown = cloud.instance_ids, np.full(len(cloud), UNKNOWN, np.int32)
    colors = label_colors(np.maximum(ids, UNKNOWN))
    write_labelled_ply(path, cloud.xyz_world, colors, {"og_label": unknown, "og_instance": ids})
