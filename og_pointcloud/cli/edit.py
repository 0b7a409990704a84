"""Remove, extract or recolor objects; write a .ply that other viewers open.

og-pointcloud edit remove kitchen.ogpc --word "red mug" --cloud kitchen.ply -o without.ply
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import og_pointcloud as og
from og_pointcloud.cli import common
from og_pointcloud.cli.common import Parser
from og_pointcloud.errors import OgPointcloudError, counted

if TYPE_CHECKING:
    from og_pointcloud.show.edit import What

VERBS = {"remove": "removed", "extract": "extracted", "recolor": "recolored"}
SUMMARIES = {
    "remove": "Write the cloud without an object.",
    "extract": "Write only an object.",
    "recolor": "Write the cloud with an object recolored.",
}


def add(parser: Parser) -> None:
    operations = parser.add_subparsers(dest="operation", required=True, metavar="OPERATION")
    for name, summary in SUMMARIES.items():
        color = " --color 40,70,220" if name == "recolor" else ""
        example = f'og-pointcloud edit {name} kitchen.ogpc --word "red mug"{color} --cloud kitchen.ply -o edited.ply'
        operation = common.add_command(operations, name, run, f"{summary}\n\n{example}")
        common.add_shared(operation, "bundle", "--text-features", "--cloud", "--json")
        what = operation.add_mutually_exclusive_group(required=True)
        common.add_option(what, "--word", "WORD", "all instances that this word fits better than other words do")
        common.add_option(what, "--id", "K,L", "instances by their ids (`og-pointcloud instances` lists them)")
        common.add_option(what, "--xyz", "X,Y,Z", "the instance at a position in world coordinates")
        near = "also edit unlabelled points within this many spacings (default: 0)"
        common.add_option(operation, "--halo", "N", near, type=float, default=0.0)
        endings, help = (".ply", ".spz"), "the edited cloud; .spz for splats"
        common.add_output(operation, "-o", "--output", endings=endings, required=True, help=help)
    common.add_option(operations.choices["recolor"], "--color", "R,G,B", "0 to 255 each", required=True)


def run(arguments: argparse.Namespace) -> None:
    scene = og.load(arguments.bundle)
    options = {"cloud": arguments.cloud, "halo": arguments.halo, "text_features": arguments.text_features}
    if arguments.operation == "recolor":
        color = common.numbers(arguments.color, "--color", 3)
        # Typed as 1 or 1.0, it is of 255: only in Python may a float of 1 mean full.
        options["color"] = [int(value) if value.is_integer() else value for value in color]
    done = getattr(og.edit, arguments.operation)(scene, what_to_edit(arguments), arguments.output, **options)
    record: dict[str, Any] = {"output": str(done.path), "operation": arguments.operation, "points": done.points}
    record |= {"changed": done.changed, "instances": list(done.instances), "notes": list(done.notes)}
    common.print_result(arguments, record, print_edit)
    if not arguments.json:
        given = [*common.as_given(arguments, "--text-features"), "--html", done.path.with_suffix(".html")]
        common.print_next("view", arguments.bundle, "--cloud", done.path, *given)


def what_to_edit(arguments: argparse.Namespace) -> What:
    if arguments.word is not None:
        return arguments.word
    if arguments.xyz is not None:
        return og.pick(arguments.bundle, common.numbers(arguments.xyz, "--xyz", 3))
    try:
        return [int(part) for part in arguments.id.split(",")]
    except ValueError:
        raise OgPointcloudError(f"--id is '{arguments.id}'; expected numbers separated by commas") from None


def print_edit(record: Mapping[str, Any]) -> None:
    """Print what was changed, what could not be kept, and the file."""
    instances = f"instance{'s' if len(record['instances']) > 1 else ''} {', '.join(map(str, record['instances']))}"
    print(f"{counted(record['changed'], 'point')} {VERBS[record['operation']]} ({instances})")
    for note in record["notes"]:
        print(f"note: {note}")
    print(f"wrote {record['output']} ({counted(record['points'], 'point')})")
