"""Try every setting that trades error for time: one table, one chart.

og-pointcloud report kitchen shelf --quick -o report
"""

from __future__ import annotations

import argparse
import sys
from functools import partial
from pathlib import Path

from og_pointcloud.cli.common import Parser, add_option, check_output, print_table
from og_pointcloud.errors import OgPointcloudError


def add(parser: Parser) -> None:
    option = partial(add_option, parser)
    option("captures", "CAPTURE", "capture folders; without gt.npz the error is 1 - reliability", type=Path, nargs="+")
    few = parser.add_mutually_exclusive_group()
    add_option(few, "--knob", "NAME", "only this setting; repeatable", action="append")
    few.add_argument("--quick", action="store_true", help="only the settings that matter most")
    folder = "folder for report.md, .csv and .png (default: %(default)s)"
    parser.add_argument("-o", "--output", type=Path, default=Path("out/report"), metavar="DIR", help=folder)


def run(arguments: argparse.Namespace) -> None:
    names = [folder.absolute().name for folder in arguments.captures]
    if len(set(names)) < len(names):
        twice = max(names, key=names.count)
        raise OgPointcloudError(f"two captures are in folders named '{twice}'; expected different names")
    text, rows, picture = (arguments.output / f"report{ending}" for ending in (".md", ".csv", ".png"))
    for path in (text, rows, picture):
        check_output("-o", path, arguments.captures)
    from og_pointcloud.evaluate.knobs import QUICK_KNOBS, settings_of
    from og_pointcloud.evaluate.sweep import read_subject, sweep, write_rows
    from og_pointcloud.evaluate.sweep_report import require_matplotlib, table, write_chart, write_report

    require_matplotlib()
    few = QUICK_KNOBS if arguments.quick else None
    settings = settings_of(tuple(arguments.knob) if arguments.knob else few)
    # All are read before work on the first begins: what the last one lacks is reported at once.
    subjects = [read_subject(folder) for folder in arguments.captures]
    swept = sweep(subjects, settings)
    write_rows(swept.rows, rows)
    write_chart(swept, picture)
    write_report(swept, text, picture)
    for capture in swept.captures:
        (_, *header), *lines = table([row for row in swept.rows if row.capture == capture])
        print_table((capture, *header), lines)
    for what, why in swept.failed.items():
        print(f"warning: could not be run: {what}: {why}", file=sys.stderr)
    print(f"wrote {text}, {rows} and {picture}")
