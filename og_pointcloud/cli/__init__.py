"""The command line: ``og-pointcloud fit | import | segment | pick | view | info | vocabulary | ...``.

A file a command: its docstring is the help (what it does, and an example), ``add`` declares its options, ``run`` does
the work. A command imports what it needs when it runs, so that ``--help`` answers at once and ``segment`` and ``pick``
work on the base install. Progress, warnings and errors go to stderr, results to stdout. Exit codes: 0 done, 2 bad use
or bad input, 130 interrupted.
"""

from __future__ import annotations

import argparse
import sys
import warnings
from collections.abc import Sequence
from importlib import import_module
from typing import NoReturn

from og_pointcloud.cli.common import Parser, add_command, check_outputs, did_you_mean
from og_pointcloud.errors import MissingExtraError, OgPointcloudError

__all__ = ["main"]

COMMANDS = (
    "masks", "models", "fit", "update", "compare", "fuse", "import", "segment", "select", "pick", "instances", "index",
    "find", "edit", "view", "serve", "ros-bag", "info", "vocabulary", "export", "eval", "report", "demo",
)  # fmt: skip
MODULES = {"import": "import_", "eval": "evaluate", "ros-bag": "ros_bag"}
"""Command -> its module, where they are not called the same."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; argv without the program's name, None for the process's own. Returns the exit code."""
    parser = build_parser()
    arguments, unknown = parser.parse_known_args(argv)
    try:
        if unknown:
            raise OgPointcloudError(describe_unknown_option(unknown[0], arguments))
        check_outputs(arguments)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # what libraries tell programmers
            warnings.simplefilter("always", UserWarning)
            warnings.showwarning = print_warning
            arguments.run(arguments)
    except (OgPointcloudError, MissingExtraError, OSError, UnicodeError, MemoryError) as error:
        print(f"error: {str(error) or 'out of memory'}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("interrupted: the files of this command were not written", file=sys.stderr)
        return 130
    return 0


def print_warning(message: Warning | str, *_: object) -> None:
    """In place of Python's two lines with a file name, which say nothing to someone who typed a command."""
    print(f"warning: {message}", file=sys.stderr)


def build_parser() -> Parser:
    parser = Parser(prog="og-pointcloud", description="Ask a point cloud or Gaussian splat for things by name.")
    parser.add_argument("--version", action=VersionAction, help="print the version and leave")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name in COMMANDS:
        module = import_module(f"og_pointcloud.cli.{MODULES.get(name, name)}")
        module.add(add_command(commands, name, getattr(module, "run", None), module.__doc__))
    return parser


class VersionAction(argparse.Action):
    """Looks the version up only when it is asked for."""

    def __init__(self, option_strings: Sequence[str], dest: str, help: str | None = None) -> None:
        super().__init__(option_strings, dest, nargs=0, help=help)

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> NoReturn:
        from importlib.metadata import version

        print(f"og-pointcloud {version('og-pointcloud')}")
        parser.exit()


def describe_unknown_option(option: str, arguments: argparse.Namespace) -> str:
    known = arguments.parser._option_string_actions
    command = arguments.parser.prog
    return (
        f"'{option}' is unknown to '{command}'{did_you_mean(option.split('=')[0], known)} ('{command} --help' explains)"
    )
