"""The command line: ``og-pointcloud fit | import | segment | pick | view | info | vocabulary | ...``.

One file per command: its docstring is the help (what it does, and an example), ``add`` declares its options, ``run``
does the work. A command imports what it needs when it runs, so that ``--help`` answers at once and ``segment`` and
``pick`` work on the base install. Progress, warnings and errors go to stderr, results to stdout. Exit codes: 0 done,
2 bad usage or bad input, 130 interrupted, 141 broken pipe.

Names and notes in files may come from strangers: everything printed goes through `printable`.
"""

from __future__ import annotations

import argparse
import io
import os
import sys
import warnings
from collections.abc import Sequence
from contextlib import redirect_stdout
from importlib import import_module
from typing import Any

import og_pointcloud as og
from og_pointcloud.cli.common import LONGEST_CELL, Parser, add_command, check_outputs, interruptible
from og_pointcloud.errors import MissingExtraError, OgPointcloudError, did_you_mean, missing_extra, printable

__all__ = ["main"]

COMMANDS = (
    "poses", "masks", "fit", "map", "update", "compare", "fuse", "repair", "import", "segment", "select",
    "pick", "instances", "index", "find", "edit", "view", "serve", "ros-bag", "info", "vocabulary", "export", "eval",
    "report", "demo",
)  # fmt: skip
MODULES = {"import": "import_", "eval": "evaluate", "map": "map_", "ros-bag": "ros_bag"}
"""Command -> its module, where their names differ."""
LONGEST_UNFORESEEN = 300
"""Characters shown of an error that is not one of ours."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; argv without the program's name, None for the process's own. Returns the exit code."""
    arguments = argparse.Namespace(debug=True)
    # Terminals may lack characters, and file names may hold any bytes: such characters are escaped, not an error.
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    try:
        arguments, unknown = build_parser().parse_known_args(argv)
        if unknown:
            raise OgPointcloudError(describe_unknown_option(unknown[0], arguments))
        check_outputs(arguments)
        plain: Any = Plain(sys.stdout or io.StringIO())
        with warnings.catch_warnings(), redirect_stdout(plain), interruptible():
            warnings.simplefilter("ignore")  # warnings of libraries to programmers
            warnings.simplefilter("always", UserWarning)  # warnings of this library to users
            warnings.showwarning = print_warning
            arguments.run(arguments)
            sys.stdout.flush()
    except KeyboardInterrupt:
        print("interrupted: unfinished results are not written; the same command does the rest", file=sys.stderr)
        return 130
    except BrokenPipeError:  # as by `| head`: nothing more may be printed, not even at exit
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    except Exception as error:
        if arguments.debug:
            raise
        print(f"error: {describe_error(error)}", file=sys.stderr)
        return 2
    return 0


class Plain:
    """A stream that passes on what is printed to it, made `printable`."""

    def __init__(self, stream: Any) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        return self._stream.write("\n".join(map(printable, text.split("\n"))))

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def describe_error(error: Exception) -> str:
    """One line: the text of our own errors; a path and the system's message; for any other error its type too."""
    error = missing_extra(error) or error
    if isinstance(error, MemoryError):
        return "out of memory"
    if isinstance(error, UnicodeEncodeError):  # bytes in a file name, which Python keeps as lone surrogates
        name = error.object[max(0, error.start - LONGEST_CELL // 2) :]
        return f"'{printable(name, LONGEST_CELL)}' contains bytes that are not UTF-8: rename the file or folder"
    if isinstance(error, OSError) and error.strerror:
        return printable(f"'{error.filename}': {error.strerror}" if error.filename else error.strerror)
    text = printable(str(error), None if isinstance(error, OgPointcloudError) else LONGEST_UNFORESEEN)
    if isinstance(error, (OgPointcloudError, MissingExtraError, OSError)):
        return text
    return f"{type(error).__name__}: {text}; 'og-pointcloud --debug COMMAND ...' shows where: report it as a bug"


def print_warning(message: Warning | str, *_: object) -> None:
    """In place of Python's two lines with a source file name, which do not help someone who typed a command."""
    print(f"warning: {printable(str(message))}", file=sys.stderr)


def build_parser() -> Parser:
    parser = Parser(prog="og-pointcloud", description="Find objects in a point cloud or Gaussian splat by name.")
    parser.add_argument("--version", action="version", version=f"og-pointcloud {og.__version__}")
    parser.add_argument("--debug", action="store_true", help="show where in the program an error came from")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name in COMMANDS:
        module = import_module(f"og_pointcloud.cli.{MODULES.get(name, name)}")
        module.add(add_command(commands, name, getattr(module, "run", None), module.__doc__))
    return parser


def describe_unknown_option(option: str, arguments: argparse.Namespace) -> str:
    known = arguments.parser._option_string_actions
    command = arguments.parser.prog
    hint = did_you_mean(option.split("=")[0], known)
    if not option.startswith("-") and getattr(arguments, "labels", None):
        hint = "; several words take commas: --labels chair,table"
    return f"'{command}' does not accept '{option}'{hint} (see '{command} --help')"
