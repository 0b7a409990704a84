"""Say what changed between two visits: gone, new, moved, not seen again.

og-pointcloud compare monday.ogpc friday.ogpc --json
"""

from __future__ import annotations

import argparse
from pathlib import Path

from og_pointcloud.cli.common import Parser, add_output, add_shared, print_result
from og_pointcloud.cli.update import print_changes


def add(parser: Parser) -> None:
    parser.add_argument("before", type=Path, metavar="A.ogpc", help="the earlier visit")
    parser.add_argument("after", type=Path, metavar="B.ogpc", help="the later one, in the same world frame")
    add_shared(parser, "--json")
    add_output(parser, "--html", endings=(".html",), help="also write a page that shows both, with arrows")


def run(arguments: argparse.Namespace) -> None:
    from og_pointcloud.mapping.changes import compare

    changes = compare(arguments.before, arguments.after)
    print_result(arguments, changes.to_dict(), lambda _: print_changes(changes))
