"""``og-pointcloud instances``: the instances of a .ogpc file as a table, with boxes and best words."""

from __future__ import annotations

import argparse
import shlex
from pathlib import Path
from typing import Any

from og_pointcloud.cli.common import add_command, check_outputs
from og_pointcloud.cli.pick import numbers


def add(commands: Any) -> None:
    parser = add_command(
        commands, "instances", run, "List the instances with their places, boxes, evidence and best words.",
        "og-pointcloud instances kitchen.ogpc --up 0,0,1 -o kitchen.csv",
    )  # fmt: skip
    parser.add_argument("bundle", type=Path, metavar="S.ogpc", help="what `fit` wrote")
    parser.add_argument("--text-features", type=Path, metavar="F.npz", help="words, instead of the scene's own")
    parser.add_argument("--words", type=int, default=3, metavar="N", help="words a row (default: %(default)s)")
    parser.add_argument("--up", metavar="X,Y,Z", help="direction that oriented boxes stand upright on")
    parser.add_argument("-o", "--output", type=Path, metavar="OUT", help="the whole table as .json or .csv")
    parser.add_argument("--json", action="store_true", help="print the whole table as JSON")


def run(arguments: argparse.Namespace) -> None:
    check_outputs(
        {"-o": (arguments.output, [".json", ".csv"])}, inputs=[arguments.bundle, arguments.text_features]
    )  # fmt: skip
    from og_pointcloud.ask.labelled_scene import instance_table
    from og_pointcloud.errors import OgPointcloudError

    if arguments.words < 0:
        raise OgPointcloudError(f"--words is {arguments.words}; expected 0 or more")
    up = None if arguments.up is None else numbers(arguments.up, "--up", 3)
    table = instance_table(arguments.bundle, text_features=arguments.text_features, up=up, words=arguments.words)
    if arguments.output:
        arguments.output.parent.mkdir(parents=True, exist_ok=True)
        write = table.to_csv if arguments.output.suffix == ".csv" else table.to_json
        write(arguments.output)
    if arguments.json:
        print(table.to_json(), end="")
        return
    print(table)
    if arguments.output:
        print(f"wrote {arguments.output}")
    else:
        command = ["og-pointcloud", "instances", str(arguments.bundle), "-o", str(arguments.bundle.with_suffix(".csv"))]
        print(f"next: all rows, with oriented boxes: {shlex.join(command)}")
