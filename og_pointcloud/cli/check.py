"""``og-pointcloud check``: the catalogue of stiff and extreme cases."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from og_pointcloud.cli.common import add_command, check_outputs
from og_pointcloud.errors import MissingExtraError, OgPointcloudError

if TYPE_CHECKING:
    from hard_cases import Case, Row


def add(commands: Any) -> None:
    parser = add_command(
        commands, "check", run,
        "Stiff and extreme cases, each held against a float64 reference and a plain float32 form: table, CSV and plot.",
        "og-pointcloud check -o out/check",
    )  # fmt: skip
    parser.add_argument("-o", "--output", type=Path, metavar="DIR", help="folder for check.csv and check.png")
    parser.add_argument("--quick", action="store_true", help="three values of each condition, no slow case: seconds")
    parser.add_argument("--only", metavar="NAME[,NAME]", help="these cases or families alone")


def run(arguments: argparse.Namespace) -> None:
    table, picture = ((arguments.output or Path()) / name for name in ("check.csv", "check.png"))
    if arguments.output:
        check_outputs({"-o": (table, [".csv"]), "the plot": (picture, [".png"])}, inputs=[])
    for module in ("numba", "scipy", "cv2", "onnx"):
        if find_spec(module) is None:
            raise MissingExtraError(module, "fit")
    from hard_cases import find_cases, run_catalogue
    from hard_cases.report import plot, write_csv

    only = [word.strip() for word in arguments.only.split(",")] if arguments.only else ()
    cases = find_cases(only, quick=arguments.quick)
    rows = run_catalogue(cases, quick=arguments.quick, progress=announce if sys.stderr.isatty() else None)
    print_rows(rows)
    if arguments.output:
        arguments.output.mkdir(parents=True, exist_ok=True)
        print(f"wrote {write_csv(rows, table)}")
        try:
            print(f"wrote {plot(rows, picture)}")
        except MissingExtraError as error:
            print(f"no plot: {error}", file=sys.stderr)
    failing = list(dict.fromkeys(row.case.name for row in rows if row.outcome == "FAILS"))
    if failing:
        count = len({row.case.name for row in rows})
        raise OgPointcloudError(f"{len(failing)} of {count} cases fail: {', '.join(failing)}")


def announce(case: Case) -> None:
    print(f"\r\033[K{case.family}: {case.name}", end="", file=sys.stderr, flush=True)


def print_rows(rows: Sequence[Row]) -> None:
    """A line a row, words to the left and numbers to the right; below, why a row fails."""
    if sys.stderr.isatty():
        print("\r\033[K", end="", file=sys.stderr)
    header = ("name", "family", "condition", "error", "bound", "naive", "outcome")
    cells = [
        (
            row.case.name,
            row.case.family,
            "" if row.value is None else f"{row.case.condition}: {row.value:.3g}",
            number(row.error),
            "" if row.case.refusal else number(row.case.bound),
            number(row.naive),
            row.outcome,
        )
        for row in rows
    ]
    widths = [max(map(len, column)) for column in zip(header, *cells, strict=True)]
    for line in (header, *cells):
        name, family, condition, *numbers, outcome = map(str.ljust, line, widths)
        numbers = (cell.strip().rjust(len(cell)) for cell in numbers)
        print("  ".join([name, family, condition, *numbers, outcome]).rstrip())
    for row in rows:
        if row.outcome == "FAILS":
            print(f"{row.case.name}{'' if row.value is None else f' at {row.value:.3g}'}: {row.note}")


def number(value: float | None) -> str:
    return "" if value is None else f"{value:.1e}"
