"""Update the map of a place with a later capture of it, or of a part of it.

og-pointcloud update room.ogpc friday -o room_friday.ogpc --json changes.json
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from og_pointcloud.cli.common import Parser, add_option, add_output, add_shared, print_next, write_fit
from og_pointcloud.errors import counted
from og_pointcloud.formats.atomic import write_json
from og_pointcloud.journal import Journal

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from og_pointcloud.mapping.changes import Changes


def add(parser: Parser) -> None:
    add_option(parser, "map", "MAP.ogpc", "the map so far, from `fit`, `map` or `update`", type=Path)
    add_shared(parser, "capture", "--gaussians")
    add_output(parser, "-o", "--output", endings=(".ogpc",), required=True, help="the map after this visit")
    add_output(parser, "--json", endings=(".json",), help="also write what is gone, new, moved and unseen")


def run(arguments: argparse.Namespace) -> None:
    from og_pointcloud.ask.labelled_scene import load
    from og_pointcloud.bundle.vocabulary import carrier_of_encoder
    from og_pointcloud.mapping.merging import update

    before = load(arguments.map)
    journal = Journal(progress=False)
    with journal.stage("update"):
        updated = update(before, arguments.capture, gaussians=arguments.gaussians)
    write_fit(updated.cloud, journal, arguments.output, carrier_of_encoder(arguments.map))
    if arguments.json:
        write_json(arguments.json, updated.changes.to_dict())
    print_changes(updated.changes)
    sizes = f"{counted(len(updated.cloud), 'point')}, {counted(len(updated.cloud.instances), 'instance')}"
    print(f"wrote {arguments.output} ({sizes})")
    print_next("compare", arguments.map, arguments.output, "--html", arguments.output.with_suffix(".html"))


def print_changes(changes: Changes) -> None:
    print(changes)
    for name in ("gone", "new", "unseen"):
        if ids := getattr(changes, name):
            print(f"{name}: {', '.join(map(str, ids))}")
    for moved in changes.moved:
        print(f"moved: {moved.id} from {_place(moved.before)} to {_place(moved.after)}")


def _place(xyz: NDArray[np.float64]) -> str:
    return "(" + ", ".join(f"{value:.2f}" for value in xyz) + ")"
