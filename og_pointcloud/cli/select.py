"""``og-pointcloud select``: instances ranked by a word."""

from __future__ import annotations

import argparse
import shlex
from pathlib import Path
from typing import Any

from og_pointcloud.cli.common import add_command, calibration_hint, names_in


def add(commands: Any) -> None:
    parser = add_command(
        commands, "select", run, "Rank the instances by a word, and say which it fits.",
        'og-pointcloud select kitchen.ogpc "red mug"',
    )  # fmt: skip
    parser.add_argument("bundle", type=Path, metavar="S.ogpc", help="what `fit` wrote")
    parser.add_argument("text", metavar="WORD", help="a word or phrase")
    parser.add_argument(
        "--against", metavar="A,B,C", help="words that compete with it (default: all others that are known)"
    )
    parser.add_argument("--text-features", type=Path, metavar="F.npz", help="names and vectors, from the same encoder")
    parser.add_argument("--json", action="store_true", help="print every instance as JSON")


def run(arguments: argparse.Namespace) -> None:
    from og_pointcloud.ask.selecting import select

    against = names_in(arguments.against)
    selection = select(arguments.bundle, arguments.text, against=against, text_features=arguments.text_features)
    if arguments.json:
        print(selection.to_json())
        return
    print(selection)
    if selection.unknown:
        print(f"{selection.unknown} instances have no feature that a word could be compared with")
    if not selection.calibrated:
        print(f"not calibrated: scores are cosines. {calibration_hint(arguments.bundle)}")
    if selection.fitting:
        command = ["og-pointcloud", "edit", "extract", str(arguments.bundle), "--word", arguments.text]
        print(f"next: {shlex.join([*command, '-o', 'selected.ply'])}")
