"""Every setting that trades error for time, tried: one table, one chart.

og-pointcloud report kitchen shelf --quick -o report
"""

from __future__ import annotations

import argparse
import sys
from functools import partial
from importlib.util import find_spec
from pathlib import Path

from og_pointcloud.cli.common import Parser, add_option, check_output, print_table
from og_pointcloud.errors import MissingExtraError, OgPointcloudError

SHARE = 0.05
"""Of the published schedule, where --paper names none: all of it takes hours on a CPU."""


def add(parser: Parser) -> None:
    option = partial(add_option, parser)
    option("captures", "CAPTURE", "folders; without gt.npz the error is 1 - reliability", type=Path, nargs="+")
    option("--knob", "NAME", "only this setting (may be given several times)", action="append")
    parser.add_argument("--quick", action="store_true", help="only the settings that matter most")
    parser.add_argument("--ablation", action="store_true", help="instead, the paper's: losses, codebook, association")
    parser.add_argument("--paper", action="store_true", help="of --ablation: trained by rendering, as published (slow)")
    option("--schedule-share", "X", "of --paper: part of it (default: %(default)s)", type=float, default=SHARE)
    folder = "folder for report.md, .csv and .png, or ablation.* (default: %(default)s)"
    parser.add_argument("-o", "--output", type=Path, default=Path("out/report"), metavar="DIR", help=folder)


def run(arguments: argparse.Namespace) -> None:
    check_options(arguments)
    stem = arguments.output / ("ablation" if arguments.ablation else "report")
    text, rows, picture = (stem.with_suffix(ending) for ending in (".md", ".csv", ".png"))
    for path in (text, rows, picture):
        check_output("-o", path, arguments.captures)
    from og_pointcloud.evaluate.knobs import QUICK, ablations, settings_of
    from og_pointcloud.evaluate.sweep import read_subject, sweep, write_rows
    from og_pointcloud.evaluate.sweep_report import require_matplotlib, table, write_chart, write_report

    require_matplotlib()
    if arguments.ablation:
        settings = ablations(arguments.schedule_share if arguments.paper else None)
    else:
        settings = settings_of(tuple(arguments.knob) if arguments.knob else QUICK if arguments.quick else None)
    # All are read before the first is worked on: what is missing in the last is told at once.
    subjects = [read_subject(folder) for folder in arguments.captures]
    unknown = [subject.name for subject in subjects if subject.truth is None]
    if arguments.ablation and unknown:
        raise OgPointcloudError(
            f"{unknown[0]} lacks gt.npz or text_features.npz; ablations compare words with the truth: take a capture "
            "that has both: og-pointcloud demo makes one"
        )
    found = sweep(subjects, settings)
    write_rows(found.rows, rows)
    write_chart(found, picture)
    write_report(found, text, picture, "Ablations" if arguments.ablation else "Error against run time")
    for capture in found.captures:
        (_, *header), *lines = table([row for row in found.rows if row.capture == capture])
        print_table((capture, *header), lines)
    for what, why in found.failed.items():
        print(f"warning: could not be run: {what}: {why}", file=sys.stderr)
    print(f"wrote {text}, {rows} and {picture}")


def check_options(arguments: argparse.Namespace) -> None:
    if arguments.paper and not arguments.ablation:
        raise OgPointcloudError("--paper is of --ablation; expected both, or neither")
    if arguments.ablation and (arguments.knob or arguments.quick):
        raise OgPointcloudError("--ablation has settings of its own; expected no --knob and no --quick beside it")
    names = [folder.absolute().name for folder in arguments.captures]
    if len(set(names)) < len(names):
        twice = max(names, key=names.count)
        raise OgPointcloudError(f"two captures are in folders named '{twice}'; expected different names")
    if arguments.paper and find_spec("torch") is None:
        raise MissingExtraError("torch", "learn")
