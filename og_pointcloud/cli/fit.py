"""Turn a capture folder (posed images with masks, and a cloud) into one .ogpc file; or many folders, on many workers.

og-pointcloud fit kitchen -o kitchen.ogpc
og-pointcloud fit scans/* --out fitted --scheduler tcp://10.0.0.1:8786
"""

from __future__ import annotations

import argparse
import shlex
import sys
from contextlib import nullcontext, suppress
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, get_args, get_type_hints

import og_pointcloud as og
from og_pointcloud.cli import common
from og_pointcloud.cli.common import Parser, add_option, add_output, add_shared, replaceable
from og_pointcloud.errors import MissingExtraError, OgPointcloudError, counted, printable
from og_pointcloud.formats.atomic import write_json
from og_pointcloud.journal import Journal
from og_pointcloud.settings import FitSettings, PaperSettings

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from og_pointcloud.collection.fit_many import FitOptions

MODES = get_args(get_type_hints(FitSettings)["mode"])
MASK_LEVELS = ("default", "small", "medium", "large")
RERUN = "og_pointcloud.show.rerun_file"


def add(parser: Parser) -> None:
    option = partial(add_option, parser)
    option("capture", "CAPTURE", "folder with images and poses; several with --out", type=Path, nargs="+")
    target = parser.add_mutually_exclusive_group(required=True)
    add_output(target, "-o", "--output", endings=(".ogpc",), help="the file to write")
    add_option(target, "--out", "DIR", "folder for NAME.ogpc of each capture; existing ones are kept", type=replaceable)
    option("--scheduler", "ADDRESS", "Dask cluster for captures, or tiles of one (default: this machine)")
    add_shared(parser, "--gaussians")
    option("--mode", None, "how to find instances (default: %(default)s)", choices=MODES, default=MODES[0])
    option("--schedule-share", "X", "shorten the published schedule (mode paper; default: 1)", type=float)
    option("--mask-level", None, "level of LangSplat masks (default: large)", choices=MASK_LEVELS)
    option("--vocabulary", "F.npz", "words to store (default: the capture's text_features.npz)", type=Path)
    bank = "at least 50 everyday words to judge labels by (default: the capture's word_bank.npz, else the encoder's)"
    option("--word-bank", "F.npz", bank, type=Path)
    option("--seed", "N", "seed of all random choices (default: %(default)s)", type=int, default=0)
    option("--memory", "4GB", "a mask table larger than this goes to disk (default: half of the free memory)")
    option("--tile-points", "N", "fit in tiles of this many points (default: only if memory requires it)", type=int)
    option("--work", "DIR", "keeps views, so a killed fit can continue (default: OUT.ogpc.work)", type=replaceable)
    add_output(parser, "--rerun", endings=(".rrd",), help="also write the views and what they show, for Rerun's viewer")
    add_output(parser, "--json", endings=(".json",), help="also write timings and settings of this run")


def run(arguments: argparse.Namespace) -> None:
    alone = [name for name in ("work", "rerun") if getattr(arguments, name) is not None]
    if arguments.out is None and len(arguments.capture) > 1:
        raise OgPointcloudError(f"{len(arguments.capture)} captures and one output; expected --out DIR for several")
    if arguments.out is not None and alone:
        raise OgPointcloudError(f"--{alone[0]} needs a single output; expected -o S.ogpc with it, or leave it out")
    from og_pointcloud.ask.hosts import import_plugin

    settings = fit_settings(arguments)
    # Everything that can be refused is refused before the first capture is read.
    if arguments.rerun:
        import_plugin(RERUN, "rerun")  # fails before the work, if it is missing
    from og_pointcloud.collection.fit_many import FitOptions
    from og_pointcloud.fitting.tasks import dask_executor

    options = FitOptions(settings, arguments.gaussians, arguments.mask_level, arguments.vocabulary, arguments.word_bank)
    with dask_executor(arguments.scheduler) if arguments.scheduler else nullcontext() as executor:
        (fit_one if arguments.out is None else fit_several)(arguments, options, executor)


def fit_one(arguments: argparse.Namespace, options: FitOptions, executor: Executor | None) -> None:
    from og_pointcloud.ask.hosts import import_plugin
    from og_pointcloud.collection.fit_many import fit_capture
    from og_pointcloud.fitting.work_folder import kept_files

    capture = arguments.capture[0]
    work = arguments.work or arguments.output.with_name(f"{arguments.output.name}.work")
    try:
        with common.interruptible():
            cloud = fit_capture(capture, options, work=work, executor=executor, progress=True)
    except KeyboardInterrupt:
        if views := kept_files(work, "view"):
            print(f"kept in '{work}': {counted(views, 'view')}; the same command continues after them", file=sys.stderr)
        raise
    cloud = common.write_fit(cloud, Journal(False), arguments.output)
    if arguments.rerun:
        with Journal(False, cloud.provenance["stages"]).stage("write rerun"):
            scene = og.read_capture(capture, gaussians=options.gaussians, mask_level=options.mask_level)
            import_plugin(RERUN, "rerun").write_rerun(arguments.rerun, scene, cloud, progress=True)
    if training := cloud.provenance["notes"].get("training"):
        with suppress(MissingExtraError):  # no picture without OpenCV
            from og_pointcloud.show.fit_pictures import training_picture

            print(f"wrote {training_picture(training, arguments.output.with_suffix('.training.png'))}")
    report = common.describe_fit(cloud, capture, arguments.output)
    if arguments.json:
        write_json(arguments.json, report)
    common.print_fit(report, cloud)


def fit_several(arguments: argparse.Namespace, options: FitOptions, executor: Executor | None) -> None:
    from og_pointcloud.collection.fit_many import fit_many

    fits = fit_many(arguments.capture, arguments.out, executor, options=options)
    if arguments.json:
        write_json(arguments.json, {"fits": [asdict(fit) for fit in fits]})
    if made := [fit for fit in fits if fit.state == "fitted"]:
        rows = [(fit.name, f"{fit.points:,}", str(fit.instances), f"{fit.seconds:.1f}") for fit in made]
        common.print_table(("capture", "points", "instances", "seconds"), rows)
    # Failures are listed last and end in an error, so that a script notices; fitted files stay.
    failed = [fit for fit in fits if fit.state == "failed"]
    there = len(fits) - len(made) - len(failed)
    print(f"{len(made)} fitted, {there} already there, {len(failed)} failed, in {arguments.out}")
    for fit in made:
        if fit.doubts:
            doubts = ", ".join(fit.doubts)
            print(f"doubt: {fit.name}: {doubts} (og-pointcloud info {shlex.quote(fit.output)} says why)")
    for fit in failed:
        cause = fit.cause if fit.capture in fit.cause else f"{fit.capture}: {fit.cause}"
        print(f"failed: {printable(cause)}", file=sys.stderr)
    if len(failed) < len(fits):
        common.print_next("index", arguments.out, "-o", arguments.out / "atlas")
    if failed:
        raise OgPointcloudError(f"{len(failed)} of {len(fits)} captures failed: fix them, then repeat the same command")


def fit_settings(arguments: argparse.Namespace) -> FitSettings:
    from og_pointcloud.fitting.memory import parse_memory

    memory = None if arguments.memory is None else parse_memory(arguments.memory)
    settings = FitSettings(mode=arguments.mode, seed=arguments.seed, memory=memory, tile_points=arguments.tile_points)
    if arguments.schedule_share is None:
        return settings
    if arguments.mode != "paper":
        raise OgPointcloudError(
            f"--schedule-share is {arguments.schedule_share:g} with --mode {arguments.mode}, which has no schedule; "
            "expected --mode paper: leave the option out, or use that mode"
        )
    return replace(settings, paper=PaperSettings(schedule_share=arguments.schedule_share))
