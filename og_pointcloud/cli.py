"""The command line: ``og-pointcloud fit | import | segment | pick | view | info | ablate | demo``.

A command imports what it needs when it runs, so that ``--help`` answers at once and ``segment`` and ``pick`` work on
the base install. Progress, warnings and errors go to stderr, results to stdout. Exit codes: 0 done, 2 bad use or bad
input, 130 interrupted.
"""

from __future__ import annotations

import argparse
import difflib
import json
import os
import re
import sys
import time
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, get_args, get_type_hints

from og_pointcloud.cli_output import (
    describe_bundle,
    describe_fit,
    describe_pick,
    describe_segmentation,
    next_fit_command,
    print_ablation,
    print_fit,
    print_import,
    print_info,
    print_pick,
    print_segmentation,
    print_table,
)
from og_pointcloud.errors import BundleError, FeatureSpaceError, MissingExtraError, OgPointcloudError
from og_pointcloud.settings import FitSettings, PaperSettings

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from og_pointcloud.cloud import LabelledCloud, Vocabulary
    from og_pointcloud.scene import Camera, Scene

__all__ = ["main"]

MODES = get_args(get_type_hints(FitSettings)["mode"])
MASK_LEVELS = ("default", "small", "medium", "large")


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; argv without the program's name, None for the process's own. Returns the exit code."""
    parser = build_parser()
    arguments, unknown = parser.parse_known_args(argv)
    try:
        if unknown:
            raise OgPointcloudError(describe_unknown_option(unknown[0], arguments))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # what libraries tell programmers
            warnings.simplefilter("always", UserWarning)
            warnings.showwarning = print_warning
            arguments.run(arguments)
    except (OgPointcloudError, MissingExtraError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("interrupted: the files of this command were not written", file=sys.stderr)
        return 130
    return 0


def print_warning(message: Warning | str, *_: object) -> None:
    """In place of Python's two lines with a file name, which say nothing to someone who typed a command."""
    print(f"warning: {message}", file=sys.stderr)


class Parser(argparse.ArgumentParser):
    """An argparse parser whose errors are one line, like every other error of the program."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        # Abbreviations would make `--mask` mean one thing today and another once an option is added.
        super().__init__(*args, allow_abbrev=False, formatter_class=argparse.RawDescriptionHelpFormatter, **kwargs)

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"error: {message} ('{self.prog} --help' explains)\n")


def build_parser() -> Parser:
    parser = Parser(prog="og-pointcloud", description="Ask a point cloud or Gaussian splat for things by name.")
    parser.add_argument("--version", action=VersionAction, help="print the version and leave")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    add_fit(commands)
    add_import(commands)
    add_segment(commands)
    add_pick(commands)
    add_view(commands)
    add_info(commands)
    add_ablate(commands)
    add_demo(commands)
    return parser


class VersionAction(argparse.Action):
    """Looks the version up only when it is asked for."""

    def __init__(self, option_strings: Sequence[str], dest: str, help: str | None = None) -> None:
        super().__init__(option_strings, dest, nargs=0, help=help)

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> NoReturn:
        from importlib.metadata import version

        print(f"og-pointcloud {version('og-pointcloud')}")
        parser.exit()


def add_command(commands: Any, name: str, run: Any, summary: str, example: str) -> Parser:
    parser = commands.add_parser(name, help=summary, description=summary, epilog=f"example:\n  {example}")
    parser.set_defaults(run=run, parser=parser)
    return parser


def add_fit(commands: Any) -> None:
    parser = add_command(
        commands, "fit", run_fit, "Turn a capture folder (posed images with masks, and a cloud) into one .ogpc file.",
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
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="of everything random (default: %(default)s)")
    parser.add_argument("--ply", type=Path, metavar="F.ply", help="also write the labelled cloud for other tools")
    parser.add_argument("--json", type=Path, metavar="F.json", help="also write timings and settings of this run")


def add_import(commands: Any) -> None:
    parser = add_command(
        commands, "import", run_import, "Turn what an OpenGaussian run wrote into one .ogpc file.",
        "og-pointcloud import output/ramen -o ramen.ogpc",
    )  # fmt: skip
    parser.add_argument("result", type=Path, metavar="RESULT", help="folder of the run, or its point_cloud.ply")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="S.ogpc", help="the file to write")
    parser.add_argument(
        "--cluster-lang", type=Path, metavar="F.npz", help="features of the leaves (default: RESULT/cluster_lang.npz)"
    )
    parser.add_argument("--feature-space", metavar="NAME", help="their encoder (default: LangSplat's, if 512 wide)")
    parser.add_argument("--text-features", type=Path, metavar="F.npz", help="names that can then be asked")


def add_segment(commands: Any) -> None:
    parser = add_command(
        commands, "segment", run_segment, "Label points by words: those of the fitted cloud, or of another one.",
        "og-pointcloud segment kitchen.ogpc --labels chair,table -o labels.npz",
    )  # fmt: skip
    parser.add_argument("bundle", type=Path, metavar="S.ogpc", help="what `fit` wrote")
    parser.add_argument("--labels", metavar="A,B,C", help="names to choose among (default: all that are known)")
    parser.add_argument("--text-features", type=Path, metavar="F.npz", help="names and vectors, from the same encoder")
    parser.add_argument("--points", type=Path, metavar="CLOUD", help="points to label (default: those fitted)")
    parser.add_argument("-o", "--output", type=Path, metavar="OUT", help="labels as .npz, or a coloured .ply")
    parser.add_argument("--json", action="store_true", help="print the counts as JSON")


def add_pick(commands: Any) -> None:
    parser = add_command(
        commands, "pick", run_pick, "Select the instance at a pixel of a view, or at a place; render its mask.",
        "og-pointcloud pick kitchen.ogpc --capture kitchen --view frame7 --pixel 320,240 -o mask.png",
    )  # fmt: skip
    parser.add_argument("bundle", type=Path, metavar="S.ogpc", help="what `fit` wrote")
    click = parser.add_mutually_exclusive_group(required=True)
    click.add_argument("--xyz", metavar="X,Y,Z", help="a place in world coordinates")
    click.add_argument("--pixel", metavar="U,V", help="a pixel of the view, column and row")
    # Else argparse takes -1,2,3 for an option.
    parser._negative_number_matcher = re.compile(r"-[\d.,-]+$")
    parser.add_argument("--capture", type=Path, metavar="CAPTURE", help="folder that the view is in")
    parser.add_argument("--view", metavar="NAME", help="file stem of the view's image")
    parser.add_argument("-o", "--output", type=Path, metavar="M.png", help="the instance's mask in the view")
    parser.add_argument("--text-features", type=Path, metavar="F.npz", help="names to rank (default: the file's own)")
    parser.add_argument("--json", action="store_true", help="print the answer as JSON")


def add_view(commands: Any) -> None:
    parser = add_command(
        commands, "view", run_view, "Picture of learned features, or of instances, over several views of a capture.",
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


def add_info(commands: Any) -> None:
    parser = add_command(
        commands, "info", run_info, "Say what a .ogpc file holds and how it was made.",
        "og-pointcloud info kitchen.ogpc",
    )  # fmt: skip
    parser.add_argument("bundle", type=Path, metavar="S.ogpc", help="what `fit` wrote")
    parser.add_argument("--json", action="store_true", help="print everything as JSON")


def add_ablate(commands: Any) -> None:
    parser = add_command(
        commands, "ablate", run_ablate,
        "The paper's ablations (losses, codebook, association) on captures with known labels: table, CSV and plot.",
        "og-pointcloud ablate --room 1,2 -o out/ablation",
    )  # fmt: skip
    parser.add_argument(
        "captures", type=Path, nargs="*", metavar="CAPTURE", help="folders that also hold gt.npz and text_features.npz"
    )
    parser.add_argument("--room", metavar="SEED[,SEED]", help="made rooms, in place of captures or beside them")
    parser.add_argument("--seeds", type=int, default=1, metavar="N", help="runs of all that is random (default: 1)")
    parser.add_argument("--paper", action="store_true", help="also the rows trained by rendering, as published (slow)")
    parser.add_argument(
        "--schedule-share", type=float, metavar="X", help="of --paper: part of the published schedule (default: 0.05)"
    )
    parser.add_argument(
        "-o", "--output", type=Path, default=Path("out/ablation"), metavar="DIR",
        help="folder for ablation.csv, ablation.png and the rooms (default: %(default)s)",
    )  # fmt: skip


def add_demo(commands: Any) -> None:
    parser = add_command(
        commands, "demo", run_demo_command, "Make a furnished room, fit it, ask it for things, score it and show it.",
        "og-pointcloud demo -o out/demo",
    )  # fmt: skip
    parser.add_argument("-o", "--output", type=Path, default=Path("out/demo"), metavar="DIR", help="folder to fill")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="another room (default: %(default)s)")
    parser.add_argument(
        "--mask-noise", type=float, default=1.0, metavar="X", help="0 clean masks, 1 realistic (default: %(default)s)"
    )


def describe_unknown_option(option: str, arguments: argparse.Namespace) -> str:
    known = arguments.parser._option_string_actions
    command = arguments.parser.prog
    return (
        f"'{option}' is unknown to '{command}'{did_you_mean(option.split('=')[0], known)} ('{command} --help' explains)"
    )


def did_you_mean(word: str, known: Iterable[str]) -> str:
    close = difflib.get_close_matches(word, list(known), n=3)
    return f"; did you mean {' or '.join(repr(match) for match in close)}?" if close else ""


def run_fit(arguments: argparse.Namespace) -> None:
    check_outputs(
        {
            "-o": (arguments.output, [".ogpc"]),
            "--ply": (arguments.ply, [".ply"]),
            "--json": (arguments.json, [".json"]),
        },
        inputs=[arguments.capture, arguments.gaussians, arguments.vocabulary],
    )
    settings = fit_settings(arguments)
    from og_pointcloud_export import write_bundle

    from og_pointcloud.fit import fit
    from og_pointcloud.formats.capture import read_capture

    stages: list[dict[str, Any]] = []
    with timed(stages, "read capture"):
        scene = read_capture(arguments.capture, gaussians=arguments.gaussians, mask_level=arguments.mask_level)
        vocabulary, left_out = vocabulary_for(scene, arguments)
    cloud = fit(scene, settings, progress=sys.stderr.isatty())
    stages += cloud.provenance["stages"]
    provenance = {**cloud.provenance, "stages": stages, "left_out": [*cloud.provenance["left_out"], *left_out]}
    cloud = replace(cloud, vocabulary=vocabulary, provenance=provenance)
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
    settings = FitSettings(mode=arguments.mode, seed=arguments.seed)
    if arguments.schedule_share is None:
        return settings
    if arguments.mode != "paper":
        raise OgPointcloudError(
            f"--schedule-share is {arguments.schedule_share:g} with --mode {arguments.mode}, which has no schedule; "
            "expected --mode paper: leave the option out, or take that mode"
        )
    return replace(settings, paper=PaperSettings(schedule_share=arguments.schedule_share))


def vocabulary_for(scene: Scene, arguments: argparse.Namespace) -> tuple[Vocabulary | None, list[dict[str, str]]]:
    """Words for the bundle, and what was left out: those asked for, else the capture's own if their space fits."""
    from og_pointcloud.text_features import read_text_features

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


def write_cloud(cloud: LabelledCloud, bundle: Path, path: Path) -> None:
    """The fitted cloud as .ply, coloured by the best word of each instance, or by instance where there are no words."""
    import numpy as np

    from og_pointcloud.formats.points import write_labelled_ply
    from og_pointcloud.runtime import segment
    from og_pointcloud.segmentation import UNKNOWN, label_colors

    path.parent.mkdir(parents=True, exist_ok=True)
    if cloud.vocabulary:
        segment(bundle).save(path)
        return
    ids, unknown = cloud.instance_ids, np.full(len(cloud), UNKNOWN)
    colors = label_colors(np.maximum(ids, UNKNOWN))
    write_labelled_ply(path, cloud.xyz_world, colors, ids, unknown, np.zeros(len(cloud)))


def run_segment(arguments: argparse.Namespace) -> None:
    check_outputs(
        {"-o": (arguments.output, [".npz", ".ply"])},
        inputs=[arguments.bundle, arguments.text_features, arguments.points],
    )
    from og_pointcloud.runtime import load, segment

    labels = (
        None if arguments.labels is None else [name.strip() for name in arguments.labels.split(",") if name.strip()]
    )
    stages: list[dict[str, Any]] = []
    with timed(stages, "load"):
        scene = load(arguments.bundle)
    with timed(stages, "segment"):
        result = segment(arguments.points or scene, labels, scene=scene, text_features=arguments.text_features)
    if arguments.output:
        with timed(stages, "save"):
            arguments.output.parent.mkdir(parents=True, exist_ok=True)
            result.save(arguments.output)
    report = describe_segmentation(result, stages, arguments.bundle, arguments.output)
    if arguments.json:
        print(json.dumps(report, indent=2, ensure_ascii=False))
    else:
        print_segmentation(report)


def run_import(arguments: argparse.Namespace) -> None:
    check_outputs(
        {"-o": (arguments.output, [".ogpc"])},
        inputs=[arguments.result, arguments.cluster_lang, arguments.text_features],
    )
    from og_pointcloud_export import write_bundle

    from og_pointcloud.formats.opengaussian import read_opengaussian

    stages: list[dict[str, Any]] = []
    with timed(stages, "read result"):
        cloud = read_opengaussian(arguments.result, arguments.cluster_lang, feature_space=arguments.feature_space)
        vocabulary = vocabulary_of(cloud, arguments.text_features)
    cloud = replace(cloud, vocabulary=vocabulary, provenance={**cloud.provenance, "stages": stages})
    with timed(stages, "write file"):
        arguments.output.parent.mkdir(parents=True, exist_ok=True)
        write_bundle(cloud, arguments.output)
    print_import(describe_fit(cloud, arguments.result, arguments.output), cloud)


def vocabulary_of(cloud: LabelledCloud, path: Path | None) -> Vocabulary | None:
    """The words of a text-features file, None without one; FeatureSpaceError unless the cloud can be asked them."""
    if path is None:
        return None
    from og_pointcloud.text_features import UNKNOWN_SPACE, read_text_features

    vocabulary, feature_space = read_text_features(path)
    spaces = {feature_space, cloud.feature_space}
    width, expected = vocabulary.vectors.shape[1], cloud.instances.descriptors.shape[1]
    if (len(spaces) > 1 and UNKNOWN_SPACE not in spaces) or width != expected:
        raise FeatureSpaceError(
            f"{path} is of feature space '{feature_space}' (width {width}), the leaves are of '{cloud.feature_space}' "
            f"(width {expected}): encode the names with the leaves' model, or name their space (--feature-space)"
        )
    return vocabulary


def run_pick(arguments: argparse.Namespace) -> None:
    check_outputs(
        {"-o": (arguments.output, [".png"])},
        inputs=[arguments.bundle, arguments.capture, arguments.text_features],
    )
    from og_pointcloud.picking import pick
    from og_pointcloud.runtime import load

    uses_view = arguments.pixel is not None or arguments.output is not None
    if uses_view and not (arguments.capture and arguments.view):
        raise OgPointcloudError("--pixel and -o need a camera: name it with --capture CAPTURE --view NAME")
    scene = load(arguments.bundle)
    camera = world_camera(arguments.capture, arguments.view) if uses_view else None
    if arguments.pixel is not None and camera is not None:
        hit = pick(scene, camera, numbers(arguments.pixel, "--pixel", 2))
    else:
        hit = pick(scene, numbers(arguments.xyz, "--xyz", 3))
    words = []
    if hit.found and (scene.vocabulary or arguments.text_features):
        words = hit.words(text_features=arguments.text_features)
    mask_pixels = None
    if arguments.output and camera is not None:
        mask = hit.mask(camera)
        mask_pixels = int(mask.sum())
        write_mask(arguments.output, mask)
    report = describe_pick(hit, words, arguments.output, mask_pixels)
    if arguments.json:
        print(json.dumps(report, indent=2, ensure_ascii=False))
    else:
        print_pick(report)


def numbers(text: str, option: str, count: int) -> list[float]:
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) != count:
        raise OgPointcloudError(f"{option} is '{text}'; expected {count} numbers with commas between them")
    return values


def world_camera(capture: Path, name: str) -> Camera:
    from og_pointcloud.formats.capture import read_capture
    from og_pointcloud.picking import in_world

    scene = read_capture(capture)
    cameras = {view.name: view.camera for view in scene.views}
    if name not in cameras:
        raise OgPointcloudError(
            f"--view is '{name}', which is not among the {len(cameras)} views of {capture}{did_you_mean(name, cameras)}"
        )
    return in_world(cameras[name], scene.points.origin)


def write_mask(path: Path, mask: NDArray[np.bool_]) -> None:
    """A grey PNG, 255 inside."""
    from og_pointcloud._atomic import replacing
    from og_pointcloud.formats.images import require_cv2

    png = require_cv2().imencode(".png", mask.astype("uint8") * 255)[1]
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as file:
        file.write(png.tobytes())


def run_view(arguments: argparse.Namespace) -> None:
    output = arguments.output or Path("features.png" if arguments.features else "instances.png")
    check_outputs({"-o": (output, [".png"])}, inputs=[arguments.capture, arguments.instances])
    if arguments.columns < 1:
        raise OgPointcloudError(f"--columns is {arguments.columns}; expected at least 1")
    from og_pointcloud import pictures
    from og_pointcloud.fit import prepare
    from og_pointcloud.formats.capture import read_capture
    from og_pointcloud.geometry import near_plane
    from og_pointcloud.journal import Journal

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


def run_info(arguments: argparse.Namespace) -> None:
    from og_pointcloud.runtime import load

    scene = load(arguments.bundle)
    if arguments.json:
        print(json.dumps(describe_bundle(scene, arguments.bundle), indent=2, ensure_ascii=False))
        return
    try:
        print_info(scene, arguments.bundle)
    except (KeyError, TypeError, ValueError):  # the one part of a file that reading it does not check
        raise BundleError(
            f"{arguments.bundle}: its provenance is not in the form that fit writes; see --json"
        ) from None


def run_ablate(arguments: argparse.Namespace) -> None:
    seeds, share = room_seeds(arguments.room), arguments.schedule_share
    if not arguments.captures and not seeds:
        raise OgPointcloudError("no CAPTURE and no --room; expected at least one, e.g. --room 1,2")
    if share is not None and not arguments.paper:
        raise OgPointcloudError("--schedule-share is of --paper; expected both, or neither")
    if arguments.seeds < 1:
        raise OgPointcloudError(f"--seeds is {arguments.seeds}; expected at least 1")
    table, picture = arguments.output / "ablation.csv", arguments.output / "ablation.png"
    check_outputs({"-o": (table, [".csv"]), "the plot": (picture, [".png"])}, inputs=arguments.captures)
    if arguments.paper and find_spec("torch") is None:
        raise MissingExtraError("torch", "learn")
    from og_pointcloud import ablation
    from og_pointcloud.formats.capture import read_capture

    ablation.require_matplotlib()
    rows_wanted = ablation.cases()
    if arguments.paper:
        published = ablation.cases("paper", 0.05 if share is None else share)
        rows_wanted = [*published[: -len(ablation.references())], *rows_wanted]
    captures = [*arguments.captures, *(made_room(seed, arguments.output) for seed in seeds)]
    # All are read before the first is worked on: what is missing in the last is said at once.
    subjects = []
    for folder in captures:
        scene = read_capture(folder)
        truth, vocabulary = ablation.read_truth(folder), ablation.read_vocabulary(folder, scene.feature_space)
        ablation.check_subject(scene, truth, vocabulary)
        subjects.append((folder.name, scene, truth, vocabulary))
    rows = [
        ablation.ablate(
            scene, truth, vocabulary, only=rows_wanted, seeds=range(arguments.seeds), name=name,
            progress=sys.stderr.isatty(),
        )
        for name, scene, truth, vocabulary in subjects
    ]  # fmt: skip
    arguments.output.mkdir(parents=True, exist_ok=True)
    means = ablation.average(rows)
    every = [row for of_capture in rows for row in of_capture]
    ablation.write_csv([*every, *means] if len(rows) > 1 else means, table)
    ablation.plot(means, picture, title=", ".join(name for name, *_ in subjects))
    print_ablation(means)
    print(f"wrote {table}\nwrote {picture}")
    print(f"next: {next_fit_command(captures[0], arguments.output)}")


def room_seeds(text: str | None) -> list[int]:
    if text is None:
        return []
    if not re.fullmatch(r"\d{1,9}(,\d{1,9})*", text):
        raise OgPointcloudError(f"--room is '{text}'; expected whole numbers with commas between them, e.g. 1,2")
    return list(dict.fromkeys(int(seed) for seed in text.split(",")))


def made_room(seed: int, output: Path) -> Path:
    """A furnished room as a capture folder, small enough for many fits."""
    require_room()
    from og_pointcloud_room.capture import CaptureSettings, make_capture, write_capture

    settings = CaptureSettings(views=40, width=320, height=240, samples_per_view=20_000)
    return write_capture(make_capture(seed, settings), output / f"room-{seed}")


def require_room() -> None:
    # The room's modules import these as they please: whoever lacks one needs the whole extra.
    for module in ("numba", "scipy", "cv2", "onnx", "open3d", "pyvista"):
        if find_spec(module) is None:
            raise MissingExtraError(module, "demo")


def run_demo_command(arguments: argparse.Namespace) -> None:
    require_room()
    from og_pointcloud_room.demo import run_demo

    run_demo(arguments.output, seed=arguments.seed, mask_noise=arguments.mask_noise)


def check_outputs(outputs: Mapping[str, tuple[Path | None, Sequence[str]]], inputs: Iterable[Path | None]) -> None:
    """Refuse, before any work, an output that cannot be written or that would replace an input.

    outputs: option -> (path or None, the endings it may have).
    """
    sources = [path.resolve() for path in inputs if path]
    taken: dict[Path, str] = {}
    for option, (path, endings) in outputs.items():
        if path is None:
            continue
        resolved = path.resolve()
        if path.suffix not in endings:
            raise OgPointcloudError(f"{option} is '{path}'; expected a name that ends in {' or '.join(endings)}")
        if path.is_dir():
            raise OgPointcloudError(f"{option} is '{path}', which is a folder; expected a file name")
        if replaces_input(resolved, sources):
            raise OgPointcloudError(
                f"{option} is '{path}', a file that is read; expected another name, so that it stays"
            )
        if resolved in taken:
            raise OgPointcloudError(f"{taken[resolved]} and {option} are both '{path}'; expected two names")
        taken[resolved] = option
        existing = next(parent for parent in resolved.parents if parent.exists())
        if not existing.is_dir() or not os.access(existing, os.W_OK):
            raise OgPointcloudError(f"{option} is '{path}', but '{existing}' is not a folder that can be written to")


def replaces_input(path: Path, sources: Sequence[Path]) -> bool:
    """Also true for what lies in a capture folder already, except a .ogpc, which is never an input of fit."""
    in_capture = any(source in path.parents for source in sources) and path.exists() and path.suffix != ".ogpc"
    return path in sources or in_capture


def write_json(path: Path, value: Mapping[str, Any]) -> None:
    from og_pointcloud._atomic import replacing

    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as file:
        file.write(json.dumps(value, indent=2, ensure_ascii=False).encode() + b"\n")


@contextmanager
def timed(stages: list[dict[str, Any]], name: str) -> Iterator[None]:
    """Append {"name", "seconds"} for what runs inside."""
    start = time.perf_counter()
    yield
    stages.append({"name": name, "seconds": round(time.perf_counter() - start, 4)})
