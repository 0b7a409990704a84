"""Make or update an index of all .ogpc files in a folder, for `find`.

og-pointcloud index scans -o atlas
"""

from __future__ import annotations

import argparse
import sys
from contextlib import suppress
from pathlib import Path

import og_pointcloud as og
from og_pointcloud.cli.common import Parser, add_option, check_output, print_next, replaceable
from og_pointcloud.errors import OgPointcloudError, counted, printable


def add(parser: Parser) -> None:
    add_option(parser, "folder", "DIR", "folder with .ogpc files, also in its subfolders", type=Path)
    index = "the index file; if it exists, only changed scenes are read"
    parser.add_argument("-o", "--output", type=replaceable, required=True, metavar="ATLAS", help=index)
    add_option(parser, "--lance", "URI", "also write it for LanceDB, to a folder or an object store (s3://...)")


def run(arguments: argparse.Namespace) -> None:
    from og_pointcloud.collection.collection import Collection

    check_output("-o", arguments.output, [])
    if arguments.output.suffix == ".ogpc":
        raise OgPointcloudError(f"-o is '{arguments.output}'; expected another ending: .ogpc is that of a scene")
    collection = Collection.index(arguments.folder, arguments.output)
    changes = collection.changes
    assert changes is not None
    for name, cause in changes.left_out:
        print(f"warning: {printable(name, 200)} is left out: {cause}", file=sys.stderr)
    scenes = counted(len(collection.scenes), "scene")
    instances = counted(sum(entry.instances for entry in collection.entries), "instance")
    print(f"{changes}: {scenes} with {instances} in {arguments.output}")
    if changes.left_out and not collection.scenes:
        raise OgPointcloudError(f"none of {counted(len(changes.left_out), 'file')} could be read: make them again")
    if arguments.lance:
        from og_pointcloud.collection.lance import write_lance

        write_lance(arguments.output, arguments.lance)
        print(f"wrote {arguments.lance}")
    if with_words := [entry for entry in collection.entries if entry.vocabulary]:
        # The word that fits the largest scene best: the first word of a data set's list may be an airplane.
        largest = max(with_words, key=lambda entry: entry.instances)
        with suppress(OgPointcloudError):  # words of another width than its features
            table = og.instance_table(collection.file(largest.name), words=1)
            if best := [row.words[0] for row in table if row.points and row.words]:
                print_next("find", arguments.output, max(best, key=lambda word: word[1])[0])
