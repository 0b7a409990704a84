"""List the instances with their places, boxes, evidence and best words.

og-pointcloud instances kitchen.ogpc --up 0,0,1 -o kitchen.csv
"""

from __future__ import annotations

import argparse

import og_pointcloud as og
from og_pointcloud.cli.common import Parser, add_output, add_shared, check_at_least, numbers, print_next


def add(parser: Parser) -> None:
    add_shared(parser, "bundle", "--text-features", "--json")
    parser.add_argument("--words", type=int, default=3, metavar="N", help="words a row (default: %(default)s)")
    parser.add_argument("--up", metavar="X,Y,Z", help="direction that oriented boxes stand upright on")
    add_output(parser, "-o", "--output", endings=(".json", ".csv"), help="the whole table as .json or .csv")


def run(arguments: argparse.Namespace) -> None:
    check_at_least("--words", arguments.words, 0)
    up = None if arguments.up is None else numbers(arguments.up, "--up", 3)
    table = og.instance_table(arguments.bundle, text_features=arguments.text_features, up=up, words=arguments.words)
    if arguments.output:
        write = table.to_csv if arguments.output.suffix == ".csv" else table.to_json
        write(arguments.output)
    if arguments.json:
        print(table.to_json(), end="")
        return
    print(table)
    if arguments.output:
        print(f"wrote {arguments.output}")
    else:
        csv = arguments.bundle.with_suffix(".csv")
        print_next("instances", arguments.bundle, "-o", csv, hint="all rows, with oriented boxes: ")
