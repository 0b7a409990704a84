"""List what changed between two visits: gone, new, moved, not seen again.

og-pointcloud compare monday.ogpc friday.ogpc --json
"""

from __future__ import annotations

import argparse
from pathlib import Path

from og_pointcloud.cli.common import Parser, add_option, add_output, add_shared, direction, print_next, print_result
from og_pointcloud.cli.update import print_changes
from og_pointcloud.errors import OgPointcloudError


def add(parser: Parser) -> None:
    add_option(parser, "before", "A.ogpc", "the earlier visit", type=Path)
    add_option(parser, "after", "B.ogpc", "the later visit, in the same world frame", type=Path)
    add_shared(parser, "--json", "--up")
    add_output(parser, "--html", endings=(".html",), help="also write a page that shows what changed")


def run(arguments: argparse.Namespace) -> None:
    import numpy as np

    from og_pointcloud.ask.labelled_scene import load
    from og_pointcloud.mapping.changes import compare

    if arguments.up and not arguments.html:
        raise OgPointcloudError(f"--up is '{arguments.up}' without --html; expected both: it orients the page's view")
    up = np.array(direction(arguments.up or "z"), np.float64)  # fails before the work, if invalid
    before, after = load(arguments.before), load(arguments.after)
    changes = compare(before, after)
    if arguments.html:
        from og_pointcloud.show.changes_page import write_changes_page

        write_changes_page(arguments.html, before.cloud, after.cloud, changes, up)
    print_result(arguments, changes.to_dict(), lambda _: print_changes(changes))
    if arguments.json:
        return
    if arguments.html:
        print(f"wrote {arguments.html}")
    elif any(changes.to_dict().values()):
        print_next("compare", arguments.before, arguments.after, "--html", "changes.html", hint="to see it: ")
