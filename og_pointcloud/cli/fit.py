"""``og-pointcloud fit``: a capture folder to one .ogpc file."""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args, get_type_hints

from og_pointcloud.cli.common import add_command, check_outputs, describe_fit, print_fit, timed, write_json
from og_pointcloud.errors import FeatureSpaceError, OgPointcloudError
from og_pointcloud.settings import FitSettings, PaperSettings

if TYPE_CHECKING:
    from og_pointcloud.cloud import LabelledCloud, Vocabulary, WordBank
    from og_pointcloud.scene import Scene

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
    parser.add_argument("--mode", choices=MODES, default="auto", help="which road to take (default: %(default)s)")
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

    from og_pointcloud.fitting import table_store, tiles
    from og_pointcloud.formats.capture import read_capture

    stages: list[dict[str, Any]] = []
    with timed(stages, "read capture"):
        scene = read_capture(arguments.capture, gaussians=arguments.gaussians, mask_level=arguments.mask_level)
        vocabulary, left_out = vocabulary_for(scene, arguments)
        bank = word_bank_for(scene, arguments.word_bank)
    work = arguments.work or arguments.output.with_name(f"{arguments.output.name}.work")
    try:
        cloud = labelled(scene, settings, arguments.tile_points, work)
    except KeyboardInterrupt:
        if views := table_store.kept_views(work) or tiles.kept_views(work):
            print(f"{views} views are kept in '{work}': the same command goes on behind them", file=sys.stderr)
        raise
    stages += cloud.provenance["stages"]
    provenance = {**cloud.provenance, "stages": stages, "left_out": [*cloud.provenance["left_out"], *left_out]}
    cloud = replace(cloud, vocabulary=vocabulary, word_bank=bank, provenance=provenance)
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


def labelled(scene: Scene, settings: FitSettings, tile_points: int | None, work: Path) -> LabelledCloud:
    """The scene fitted whole, or in tiles where that is asked for or needed."""
    from og_pointcloud.fitting.fit import fit
    from og_pointcloud.fitting.tiles import fit_tiles, needs_tiles

    progress = sys.stderr.isatty()
    if tile_points is None and not needs_tiles(scene, settings):
        return fit(scene, settings, progress=progress, work=work)
    if tile_points is None:
        print(
            f"{len(scene.points):,} points are more than one fit holds in memory: fitted in tiles; --memory or "
            "--tile-points would say how large",
            file=sys.stderr,
        )
    return fit_tiles(scene, settings, points_per_tile=tile_points, work=work, progress=progress)


def fit_settings(arguments: argparse.Namespace) -> FitSettings:
    settings = FitSettings(mode=arguments.mode, seed=arguments.seed, memory=arguments.memory)
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


def vocabulary_for(scene: Scene, arguments: argparse.Namespace) -> tuple[Vocabulary | None, list[dict[str, str]]]:
    """Words for the bundle, and what was left out: those asked for, else the capture's own if their space fits."""
    from og_pointcloud.text.text_features import read_text_features

    path = arguments.vocabulary or arguments.capture / "text_features.npz"
    if not arguments.vocabulary and not path.is_file():
        return None, []
    vocabulary, feature_space = read_text_features(path)
    width = vocabulary.vectors.shape[1]
    if feature_space == scene.feature_space and width == (scene.feature_width or width):
        return vocabulary, []
    why = (
        f"{path} is of feature space '{feature_space}' (width {width}), the masks are of '{scene.feature_space}' "
        f"(width {scene.feature_width}): encode the names with the masks' model"
    )
    if arguments.vocabulary:
        raise FeatureSpaceError(why)
    return None, [{"what": "vocabulary", "why": why}]


def word_bank_for(scene: Scene, path: Path | None) -> WordBank | None:
    """The bank asked for, else that of the encoder that is found for the scene, if any; checked before the fit."""
    from og_pointcloud.bundle.vocabulary import read_bank
    from og_pointcloud.text.encoder import find_encoder
    from og_pointcloud.text.text_features import UNKNOWN_SPACE

    if path is not None:
        bank, feature_space = read_bank(path)
    elif (encoder := find_encoder(scene.feature_space)) and encoder.word_bank:
        path, bank, feature_space = Path(encoder.where), encoder.word_bank, encoder.feature_space
    else:
        return None
    width, spaces = bank.vectors.shape[1], {feature_space, scene.feature_space}
    if (len(spaces) > 1 and UNKNOWN_SPACE not in spaces) or width != (scene.feature_width or width):
        raise FeatureSpaceError(
            f"{path} is of feature space '{feature_space}' (width {width}), the masks are of '{scene.feature_space}' "
            f"(width {scene.feature_width}): encode the words with the masks' model"
        )
    return bank


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
