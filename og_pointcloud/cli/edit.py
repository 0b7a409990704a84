"""``og-pointcloud edit``: objects removed from, kept of, recoloured in or inserted into a cloud or 3DGS file."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from og_pointcloud.cli.common import Parser, add_command, check_outputs
from og_pointcloud.cli.pick import numbers
from og_pointcloud.errors import OgPointcloudError

if TYPE_CHECKING:
    from og_pointcloud.show.edit import Edit, What

VERBS = {"remove": "removed", "extract": "extracted", "recolour": "recoloured", "insert": "inserted"}


def add(commands: Any) -> None:
    parser = add_command(
        commands, "edit", run, "Remove, extract, recolour or insert objects; write a .ply that other viewers open.",
        'og-pointcloud edit remove kitchen.ogpc --word "red mug" --cloud kitchen.ply -o without.ply',
    )  # fmt: skip
    operations = parser.add_subparsers(dest="operation", required=True, metavar="OPERATION")
    _add_edit(operations, "remove", "Write the cloud without an object.")
    _add_edit(operations, "extract", "Write an object alone.")
    recolour = _add_edit(operations, "recolour", "Write the cloud with an object recoloured.", "--color 40,70,220 ")
    recolour.add_argument("--color", required=True, metavar="R,G,B", help="0 to 255 each")
    recolour.add_argument("--flat", action="store_true", help="without the object's own light and dark")
    insert = add_command(
        operations, "insert", run_insert, "Write a cloud with another one put into it.",
        "og-pointcloud edit insert kitchen.ply mug.ply --at 0.4,0,0 -o two_mugs.ply",
    )  # fmt: skip
    insert.add_argument("cloud", type=Path, metavar="CLOUD", help="plain cloud or 3DGS file")
    insert.add_argument("other", type=Path, metavar="OTHER", help="what is put into it, of either kind")
    place = insert.add_mutually_exclusive_group()
    place.add_argument("--pose", type=Path, metavar="T.txt", help="4x4 matrix that takes OTHER to CLOUD's frame")
    place.add_argument("--at", metavar="X,Y,Z", help="move it by this, without turning it")
    _add_output(insert)


def _add_edit(operations: Any, name: str, summary: str, example: str = "") -> Parser:
    parser = add_command(
        operations, name, run, summary,
        f'og-pointcloud edit {name} kitchen.ogpc --word "red mug" {example}--cloud kitchen.ply -o edited.ply',
    )  # fmt: skip
    parser.add_argument("bundle", type=Path, metavar="S.ogpc", help="what `fit` wrote")
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--word", metavar="WORD", help="every instance that it fits better than other words do")
    what.add_argument("--id", metavar="K,L", help="instances by their ids (`og-pointcloud instances` lists them)")
    what.add_argument("--xyz", metavar="X,Y,Z", help="the instance at a place in world coordinates")
    parser.add_argument("--text-features", type=Path, metavar="F.npz", help="names and vectors, from the same encoder")
    parser.add_argument("--cloud", type=Path, metavar="CLOUD", help="what to edit (default: the scene's own points)")
    parser.add_argument(
        "--halo", type=float, default=0.0, metavar="N", help="also unlabelled points so near, in spacings (default: 0)"
    )
    _add_output(parser)
    return parser


def _add_output(parser: Parser) -> None:
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="OUT.ply", help="the edited cloud")
    parser.add_argument("--json", action="store_true", help="print what was done as JSON")


def run(arguments: argparse.Namespace) -> None:
    inputs = [arguments.bundle, arguments.cloud, arguments.text_features]
    check_outputs({"-o": (arguments.output, [".ply"])}, inputs)
    from og_pointcloud.ask.labelled_scene import load
    from og_pointcloud.show import edit

    scene = load(arguments.bundle)
    what = meant(arguments)
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    options = {"cloud": arguments.cloud, "halo": arguments.halo, "text_features": arguments.text_features}
    if arguments.operation == "recolour":
        color = numbers(arguments.color, "--color", 3)
        done = edit.recolour(scene, what, arguments.output, color, keep_shading=not arguments.flat, **options)
    else:
        verb = edit.remove if arguments.operation == "remove" else edit.extract
        done = verb(scene, what, arguments.output, **options)
    report(done, arguments)


def run_insert(arguments: argparse.Namespace) -> None:
    check_outputs({"-o": (arguments.output, [".ply"])}, [arguments.cloud, arguments.other, arguments.pose])
    import numpy as np

    from og_pointcloud.show import edit

    pose = np.eye(4)
    if arguments.at is not None:
        pose[:3, 3] = numbers(arguments.at, "--at", 3)
    elif arguments.pose is not None:
        pose = read_pose(arguments.pose.read_text(), arguments.pose)
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    report(edit.insert(arguments.cloud, arguments.other, arguments.output, pose), arguments)


def meant(arguments: argparse.Namespace) -> What:
    from og_pointcloud.ask.picking import pick

    if arguments.word is not None:
        return arguments.word
    if arguments.xyz is not None:
        return pick(arguments.bundle, numbers(arguments.xyz, "--xyz", 3))
    try:
        return [int(part) for part in arguments.id.split(",")]
    except ValueError:
        raise OgPointcloudError(f"--id is '{arguments.id}'; expected numbers with commas between them") from None


def read_pose(text: str, path: Path) -> Sequence[Sequence[float]]:
    try:
        values = [float(word) for word in text.replace(",", " ").split()]
    except ValueError:
        values = []
    if len(values) != 16:
        raise OgPointcloudError(f"{path}: expected 16 numbers, the rows of a 4x4 matrix")
    return [values[row : row + 4] for row in range(0, 16, 4)]


def report(done: Edit, arguments: argparse.Namespace) -> None:
    """What was changed, what could not be kept, and the file."""
    if arguments.json:
        record = {"output": str(done.path), "operation": arguments.operation, "points": done.points}
        record |= {"changed": done.changed, "instances": list(done.instances), "notes": list(done.notes)}
        print(json.dumps(record, indent=2, ensure_ascii=False))
        return
    of = f" (instance {', '.join(map(str, done.instances))})" if done.instances else ""
    print(f"{done.changed:,} points {VERBS[arguments.operation]}{of}")
    for note in done.notes:
        print(f"note: {note}")
    print(f"wrote {done.path} ({done.points:,} points)")
