"""Rank the instances by a word, and mark those that it fits.

og-pointcloud select kitchen.ogpc "red mug"
"""

from __future__ import annotations

import argparse

import og_pointcloud as og
from og_pointcloud.cli import common
from og_pointcloud.cli.common import Parser
from og_pointcloud.errors import counted


def add(parser: Parser) -> None:
    common.add_shared(parser, "bundle", "--text-features", "--json")
    common.add_option(parser, "text", "WORD", "a word or phrase")
    common.add_option(parser, "--against", "A,B,C", "words that compete with it (default: all known words)")


def run(arguments: argparse.Namespace) -> None:
    against = common.names_in(arguments.against)
    selection = og.select(arguments.bundle, arguments.text, against=against, text_features=arguments.text_features)
    if arguments.json:
        common.print_json(selection.to_json())
        return
    print(selection)
    if selection.unknown:
        print(f"no feature to compare with words: {counted(selection.unknown, 'instance')}")
    if not selection.calibrated:
        print(f"not calibrated: scores are cosines. {common.calibration_hint(arguments.bundle)}")
    if selection.fitting:
        # `edit --word` chooses instances among all known words: after a choice among other words, ids are given.
        word = ["--word", arguments.text, *common.as_given(arguments, "--text-features")]
        what = word if against is None else ["--id", ",".join(map(str, selection.instances))]
        common.print_next("edit", "extract", arguments.bundle, *what, "-o", "selected.ply")
