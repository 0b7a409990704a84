"""``og-pointcloud eval``: scores by the protocols of published tables and of captures, from their own files."""

from __future__ import annotations

from typing import Any

from og_pointcloud.cli.common import Parser, add_command
from og_pointcloud.cli.eval_ import capture, lerf, scannet


def add(commands: Any) -> None:
    parser = add_command(
        commands, "eval", None, "Score labels against a data set's, or a capture's, own truth.",
        "og-pointcloud eval capture kitchen kitchen.ogpc",
    )  # fmt: skip
    protocols = parser.add_subparsers(dest="protocol", required=True, metavar="PROTOCOL", parser_class=Parser)
    for protocol in (capture, scannet, lerf):
        protocol.add(protocols)
