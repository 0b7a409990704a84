"""Remove, extract, recolour or insert objects; write a .ply that other viewers open.

og-pointcloud edit remove kitchen.ogpc --word "red mug" --cloud kitchen.ply -o without.ply
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import og_pointcloud as og
from og_pointcloud.cli.common import Parser, add_command, add_option, add_output, add_shared, numbers, print_result
from og_pointcloud.errors import OgPointcloudError

if TYPE_CHECKING:
    from og_pointcloud.show.edit import Edit, What

VERBS = {"remove": "removed", "extract": "extracted", "recolour": "recoloured", "insert": "inserted"}
SUMMARIES = {
    "remove": "Write the cloud without an object.",
    "extract": "Write an object alone.",
    "recolour": "Write the cloud with an object recoloured.",
}


def add(parser: Parser) -> None:
    operations = parser.add_subparsers(dest="operation", required=True, metavar="OPERATION")
    for name, summary in SUMMARIES.items():
        color = " --color 40,70,220" if name == "recolour" else ""
        example = f'og-pointcloud edit {name} kitchen.ogpc --word "red mug"{color} --cloud kitchen.ply -o edited.ply'
        operation = add_command(operations, name, run, f"{summary}\n\n{example}")
        add_shared(operation, "bundle", "--text-features", "--cloud")
        what = operation.add_mutually_exclusive_group(required=True)
        add_option(what, "--word", "WORD", "every instance that it fits better than other words do")
        add_option(what, "--id", "K,L", "instances by their ids (`og-pointcloud instances` lists them)")
        add_option(what, "--xyz", "X,Y,Z", "the instance at a place in world coordinates")
        near = "also unlabelled points so near, in spacings (default: 0)"
        add_option(operation, "--halo", "N", near, type=float, default=0.0)
    add_option(operations.choices["recolour"], "--color", "R,G,B", "0 to 255 each", required=True)
    insert = add_command(operations, "insert", run_insert, run_insert.__doc__)
    add_option(insert, "cloud", "CLOUD", "plain cloud or 3DGS file", type=Path)
    add_option(insert, "other", "OTHER", "what is put into it, of either kind", type=Path)
    place = insert.add_mutually_exclusive_group()
    add_option(place, "--pose", "T.txt", "4x4 matrix that takes OTHER to CLOUD's frame", type=Path)
    add_option(place, "--at", "X,Y,Z", "move it by this, without turning it")
    for operation in operations.choices.values():
        endings, help = (".ply", ".spz"), "the edited cloud; .spz of splats"
        add_output(operation, "-o", "--output", endings=endings, required=True, help=help)
        add_shared(operation, "--json")


def run(arguments: argparse.Namespace) -> None:
    scene = og.load(arguments.bundle)
    options = {"cloud": arguments.cloud, "halo": arguments.halo, "text_features": arguments.text_features}
    if arguments.operation == "recolour":
        options["color"] = numbers(arguments.color, "--color", 3)
    edit, what = getattr(og.edit, arguments.operation), what_to_edit(arguments)
    report(edit(scene, what, arguments.output, **options), arguments)


def run_insert(arguments: argparse.Namespace) -> None:
    """Write a cloud with another one put into it.

    og-pointcloud edit insert kitchen.ply mug.ply --at 0.4,0,0 -o two_mugs.ply
    """
    import numpy as np

    pose = np.eye(4)
    if arguments.at is not None:
        pose[:3, 3] = numbers(arguments.at, "--at", 3)
    elif arguments.pose is not None:
        text = ",".join(arguments.pose.read_text().replace(",", " ").split())
        pose = np.reshape(numbers(text, str(arguments.pose), 16), (4, 4))
    report(og.edit.insert(arguments.cloud, arguments.other, arguments.output, pose), arguments)


def what_to_edit(arguments: argparse.Namespace) -> What:
    if arguments.word is not None:
        return arguments.word
    if arguments.xyz is not None:
        return og.pick(arguments.bundle, numbers(arguments.xyz, "--xyz", 3))
    try:
        return [int(part) for part in arguments.id.split(",")]
    except ValueError:
        raise OgPointcloudError(f"--id is '{arguments.id}'; expected numbers with commas between them") from None


def report(done: Edit, arguments: argparse.Namespace) -> None:
    """What was changed, what could not be kept, and the file."""
    record: dict[str, Any] = {"output": str(done.path), "operation": arguments.operation, "points": done.points}
    record |= {"changed": done.changed, "instances": list(done.instances), "notes": list(done.notes)}
    print_result(arguments, record, print_edit)


def print_edit(record: Mapping[str, Any]) -> None:
    of = f" (instance {', '.join(map(str, record['instances']))})" if record["instances"] else ""
    print(f"{record['changed']:,} points {VERBS[record['operation']]}{of}")
    for note in record["notes"]:
        print(f"note: {note}")
    print(f"wrote {record['output']} ({record['points']:,} points)")
