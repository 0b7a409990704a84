"""List the instances with their positions, boxes, evidence and best words.

og-pointcloud instances kitchen.ogpc --up 0,0,1 -o kitchen.csv
"""

from __future__ import annotations

import argparse

import og_pointcloud as og
from og_pointcloud.cli import common
from og_pointcloud.cli.common import Parser


def add(parser: Parser) -> None:
    common.add_shared(parser, "bundle", "--text-features", "--up", "--json")
    common.add_option(parser, "--words", "N", "words per row (default: %(default)s)", type=int, default=3)
    common.add_output(parser, "-o", "--output", endings=(".json", ".csv"), help="the whole table as .json or .csv")


def run(arguments: argparse.Namespace) -> None:
    common.check_at_least("--words", arguments.words, 0)
    options = {"text_features": arguments.text_features, "words": arguments.words}
    table = og.instance_table(arguments.bundle, up=common.direction(arguments.up), **options)
    if arguments.output:
        write = table.to_csv if arguments.output.suffix == ".csv" else table.to_json
        write(arguments.output)
    if arguments.json:
        common.print_json(table.to_json())
        return
    print(table)
    if arguments.output:
        print(f"wrote {arguments.output}")
        if largest := table.largest(1):
            thing = largest[0].id
            given = ["--id", thing, "-o", arguments.output.with_name(f"instance_{thing}.ply")]
            common.print_next("edit", "extract", arguments.bundle, *given, hint="only the largest: ")
    else:
        given = [*common.as_given(arguments, "--text-features", "--up"), "-o", arguments.bundle.with_suffix(".csv")]
        common.print_next("instances", arguments.bundle, *given, hint="all rows, with oriented boxes: ")
