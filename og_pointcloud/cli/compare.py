"""Say what changed between two visits: gone, new, moved, not seen again.

og-pointcloud compare monday.ogpc friday.ogpc --json
"""

from __future__ import annotations

import argparse
from pathlib import Path

from og_pointcloud.cli.common import Parser, add_output, add_shared, numbers, print_result
from og_pointcloud.cli.update import print_changes


def add(parser: Parser) -> None:
    parser.add_argument("before", type=Path, metavar="A.ogpc", help="the earlier visit")
    parser.add_argument("after", type=Path, metavar="B.ogpc", help="the later one, in the same world frame")
    add_shared(parser, "--json")
    add_output(parser, "--html", endings=(".html",), help="also write a page that shows what changed")
    parser.add_argument("--up", metavar="X,Y,Z", help="what is up on that page (default: 0,0,1)")


def run(arguments: argparse.Namespace) -> None:
    import numpy as np

    from og_pointcloud.ask.labelled_scene import load
    from og_pointcloud.mapping.changes import compare

    before, after = load(arguments.before), load(arguments.after)
    changes = compare(before, after)
    if arguments.html:
        from og_pointcloud.show.changes_page import write_changes_page

        up = np.array([0.0, 0.0, 1.0]) if arguments.up is None else np.array(numbers(arguments.up, "--up", 3))
        write_changes_page(arguments.html, before.cloud, after.cloud, changes, up / np.linalg.norm(up))
    print_result(arguments, changes.to_dict(), lambda _: print_changes(changes))
    if arguments.html and not arguments.json:
        print(f"wrote {arguments.html}")
