"""List the instances with their places, boxes, evidence and best words.

og-pointcloud instances kitchen.ogpc --up 0,0,1 -o kitchen.csv
"""

from __future__ import annotations

import argparse

import og_pointcloud as og
from og_pointcloud.cli.common import (
    Parser,
    add_option,
    add_output,
    add_shared,
    check_at_least,
    direction,
    print_json,
    print_next,
)


def add(parser: Parser) -> None:
    add_shared(parser, "bundle", "--text-features", "--up", "--json")
    add_option(parser, "--words", "N", "words a row (default: %(default)s)", type=int, default=3)
    add_output(parser, "-o", "--output", endings=(".json", ".csv"), help="the whole table as .json or .csv")


def run(arguments: argparse.Namespace) -> None:
    check_at_least("--words", arguments.words, 0)
    options = {"text_features": arguments.text_features, "words": arguments.words}
    table = og.instance_table(arguments.bundle, up=direction(arguments.up), **options)
    if arguments.output:
        write = table.to_csv if arguments.output.suffix == ".csv" else table.to_json
        write(arguments.output)
    if arguments.json:
        print_json(table.to_json())
        return
    print(table)
    if arguments.output:
        print(f"wrote {arguments.output}")
        if largest := table.largest(1):
            file = arguments.output.with_name(f"instance_{largest[0].id}.ply")
            print_next(
                "edit", "extract", arguments.bundle, "--id", largest[0].id, "-o", file, hint="the largest alone: "
            )
    else:
        csv = arguments.bundle.with_suffix(".csv")
        print_next("instances", arguments.bundle, "-o", csv, hint="all rows, with oriented boxes: ")
