"""``og-pointcloud fit``: a capture folder to one .ogpc file."""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args, get_type_hints

from og_pointcloud.cli.common import add_command, check_outputs, describe_fit, print_fit, timed, write_json
from og_pointcloud.errors import OgPointcloudError
from og_pointcloud.settings import FitSettings, PaperSettings

if TYPE_CHECKING:
    from og_pointcloud.cloud import LabelledCloud

MODES = get_args(get_type_hints(FitSettings)["mode"])
MASK_LEVELS = ("default", "small", "medium", "large")


def add(commands: Any) -> None:
    parser = add_command(
        commands, "fit", run, "Turn a capture folder (posed images with masks, and a cloud) into one .ogpc file.",
        "og-pointcloud fit kitchen -o kitchen.ogpc",
    )  # fmt: skip
    parser.add_argument("capture", type=Path, metavar="CAPTURE", help="folder with poses, masks and mask features")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="S.ogpc", help="the file to write")
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
        "--memory", type=memory, metavar="4GB",
        help="what the fit may hold in memory; a larger table goes to disk (default: half of what is free)",
    )  # fmt: skip
    parser.add_argument(
        "--tile-points", type=positive, metavar="N",
        help="fit in tiles of at most so many points (default: only where one fit would not fit into memory)",
    )  # fmt: skip
    parser.add_argument(
        "--work", type=Path, metavar="DIR",
        help="where the views of a long fit are kept until it ends, for a start after a kill (default: S.ogpc.work)",
    )  # fmt: skip
    parser.add_argument("--ply", type=Path, metavar="F.ply", help="also write the labelled cloud for other tools")
    parser.add_argument("--json", type=Path, metavar="F.json", help="also write timings and settings of this run")


def run(arguments: argparse.Namespace) -> None:
    check_outputs(
        {
            "-o": (arguments.output, [".ogpc"]),
            "--ply": (arguments.ply, [".ply"]),
            "--json": (arguments.json, [".json"]),
        },
        inputs=[arguments.capture, arguments.gaussians, arguments.vocabulary, arguments.word_bank],
    )
    settings = fit_settings(arguments)
    from og_pointcloud_export import write_bundle

    from og_pointcloud.bundle.scene_words import scene_words
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
    stages += cloud.provenance["stages"]
    cloud = replace(cloud, provenance={**cloud.provenance, "stages": stages})
    with timed(stages, "write file"):
        arguments.output.parent.mkdir(parents=True, exist_ok=True)
        write_bundle(cloud, arguments.output)
    if arguments.ply:
        with timed(stages, "write cloud"):
            write_cloud(cloud, arguments.output, arguments.ply)
    report = describe_fit(cloud, arguments.capture, arguments.output)
    if arguments.json:
        write_json(arguments.json, report)
    print_fit(report, cloud)


def fit_settings(arguments: argparse.Namespace) -> FitSettings:
    settings = FitSettings(
        mode=arguments.mode, seed=arguments.seed, memory=arguments.memory, tile_points=arguments.tile_points
    )
    if arguments.schedule_share is None:
        return settings
    if arguments.mode != "paper":
        raise OgPointcloudError(
            f"--schedule-share is {arguments.schedule_share:g} with --mode {arguments.mode}, which has no schedule; "
            "expected --mode paper: leave the option out, or take that mode"
        )
    return replace(settings, paper=PaperSettings(schedule_share=arguments.schedule_share))


def positive(text: str) -> int:
    if not text.isdecimal() or int(text) == 0:
        raise argparse.ArgumentTypeError(f"'{text}' is no number of points; expected a whole number from 1")
    return int(text)


def memory(text: str) -> int:
    from og_pointcloud.fitting.memory import parse_memory

    try:
        return parse_memory(text)
    except OgPointcloudError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def write_cloud(cloud: LabelledCloud, bundle: Path, path: Path) -> None:
    """The fitted cloud as .ply, coloured by the best word of each instance, or by instance where there are no words."""
    import numpy as np

    from og_pointcloud.ask.labelled_scene import segment
    from og_pointcloud.cloud import UNKNOWN
    from og_pointcloud.formats.colors import label_colors
    from og_pointcloud.formats.points import write_labelled_ply

    path.parent.mkdir(parents=True, exist_ok=True)
    if cloud.vocabulary:
        segment(bundle).save(path)
        return
    ids, unknown = cloud.instance_ids, np.full(len(cloud), UNKNOWN, np.int32)
    colors = label_colors(np.maximum(ids, UNKNOWN))
    write_labelled_ply(path, cloud.xyz_world, colors, {"og_label": unknown, "og_instance": ids})
