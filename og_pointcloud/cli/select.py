"""Rank the instances by a word, and say which it fits.

og-pointcloud select kitchen.ogpc "red mug"
"""

from __future__ import annotations

import argparse

import og_pointcloud as og
from og_pointcloud.cli.common import Parser, add_option, add_shared, calibration_hint, names_in, print_json, print_next


def add(parser: Parser) -> None:
    add_shared(parser, "bundle", "--text-features", "--json")
    add_option(parser, "text", "WORD", "a word or phrase")
    add_option(parser, "--against", "A,B,C", "words that compete with it (default: all that are known)")


def run(arguments: argparse.Namespace) -> None:
    against = names_in(arguments.against)
    selection = og.select(arguments.bundle, arguments.text, against=against, text_features=arguments.text_features)
    if arguments.json:
        print_json(selection.to_json())
        return
    print(selection)
    if selection.unknown:
        print(f"{selection.unknown} instances have no feature that a word could be compared with")
    if not selection.calibrated:
        print(f"not calibrated: scores are cosines. {calibration_hint(arguments.bundle)}")
    if selection.fitting:
        print_next("edit", "extract", arguments.bundle, "--word", arguments.text, "-o", "selected.ply")
