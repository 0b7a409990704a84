"""Correct a capture's mistakes on reading: axes, direction, scale, intrinsics, masks. Its files are not changed.

og-pointcloud repair kitchen axes=flipped
"""

from __future__ import annotations

import argparse
from pathlib import Path

from og_pointcloud.cli.common import Parser, add_option, add_shared, print_next
from og_pointcloud.errors import OgPointcloudError
from og_pointcloud.formats.atomic import write_json


def add(parser: Parser) -> None:
    from og_pointcloud.formats import repairs

    parser.epilog = f"{parser.epilog}\n\n{''.join((repairs.__doc__ or '').partition('  axes=')[1:])}"
    add_shared(parser, "capture")
    order = "repairs, applied in this order after those that the capture has; none: find them by checking the capture"
    add_option(parser, "repairs", "NAME=VALUE", order, nargs="*")
    parser.add_argument("--only", action="store_true", help="replace the repairs that the capture has")
    parser.add_argument("--undo", action="store_true", help="remove all repairs of the capture")


def run(arguments: argparse.Namespace) -> None:
    from og_pointcloud.checking.check import check_capture
    from og_pointcloud.cli.common import print_checks
    from og_pointcloud.formats.capture import read_capture
    from og_pointcloud.formats.repairs import REPAIRS_NAME, Repair, read_repairs

    capture: Path = arguments.capture
    file = capture / REPAIRS_NAME
    if arguments.undo:
        if arguments.repairs:
            raise OgPointcloudError("--undo takes no repairs: leave out one or the other")
        if not capture.is_dir():
            raise OgPointcloudError(f"{capture} is not a folder; expected the capture folder")
        file.unlink(missing_ok=True)
        print(f"{capture} has no repairs: its files are read as they are")
        return
    stated = [] if arguments.only else [str(repair) for repair in read_repairs(capture)]
    new = [str(Repair.parse(text)) for text in arguments.repairs]
    if not new:  # the repair that the checks suggest for the first doubt that has one
        checks = check_capture(read_capture(capture, repairs=stated))
        new = next((check.repair.split() for check in checks if check.verdict == "doubt" and check.repair), [])
        if not new:
            print_checks([check.as_dict() for check in checks], capture)
            doubts = any(check.verdict == "doubt" for check in checks)
            print("no known repair would help" if doubts else "nothing was found that needs a repair")
            return
    # Read with the repairs before writing them: repairs that the capture cannot be read with are refused here.
    checks = check_capture(read_capture(capture, repairs=[*stated, *new]))
    write_json(file, {"repairs": [*stated, *new]})
    print_checks([check.as_dict() for check in checks], capture)
    print(f"wrote {file} ({' '.join([*stated, *new])}): every command reads {capture} this way; --undo reverts it")
    print_next("fit", capture, "-o", f"{capture.resolve().name}.ogpc")
