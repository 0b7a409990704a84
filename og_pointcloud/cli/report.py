"""``og-pointcloud report``: error against run time of every setting, on captures and made rooms, as one page."""

from __future__ import annotations

import argparse
import shlex
import sys
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from og_pointcloud.cli.ablate import made_room, room_seeds
from og_pointcloud.cli.common import add_command, check_outputs, print_table
from og_pointcloud.errors import OgPointcloudError

if TYPE_CHECKING:
    from og_pointcloud.report.knobs import Setting
    from og_pointcloud.report.measure import Row


def add(commands: Any) -> None:
    parser = add_command(
        commands, "report", run,
        "Every setting that trades error for time, tried: a table, plots and one page.",
        "og-pointcloud report kitchen shelf --quick -o report",
    )  # fmt: skip
    parser.add_argument(
        "captures", type=Path, nargs="*", metavar="CAPTURE",
        help="folders; with gt.npz and text_features.npz errors are known, else all is held against the default",
    )  # fmt: skip
    parser.add_argument("--room", metavar="SEED[,SEED]", help="made rooms, in place of captures or beside them")
    parser.add_argument("--quick", action="store_true", help="the knobs that matter most, one run each")
    parser.add_argument("--runs", type=int, metavar="N", help="runs of every setting (default: 2, with --quick 1)")
    parser.add_argument("--paper", action="store_true", help="also the paper's training, 3 %% of its steps (minutes)")
    parser.add_argument(
        "-o", "--output", type=Path, default=Path("out/report"), metavar="DIR",
        help="folder for report.html, report.csv and the plots (default: %(default)s)",
    )  # fmt: skip


def run(arguments: argparse.Namespace) -> None:
    seeds, output = room_seeds(arguments.room), arguments.output
    if not arguments.captures and not seeds:
        raise OgPointcloudError("no CAPTURE and no --room; expected at least one, e.g. --room 1")
    runs = arguments.runs if arguments.runs is not None else 1 if arguments.quick else 2
    if runs < 1:
        raise OgPointcloudError(f"--runs is {runs}; expected at least 1")
    page, table = output / "report.html", output / "report.csv"
    check_outputs({"the page": (page, [".html"]), "the table": (table, [".csv"])}, inputs=arguments.captures)
    from og_pointcloud.report.page import write_page
    from og_pointcloud.report.plots import fit_plot
    from og_pointcloud.report.sweep import QUICK, Sweep, report_on, write_rows
    from og_pointcloud.scoring.plots import require_matplotlib

    require_matplotlib()
    output.mkdir(parents=True, exist_ok=True)
    folders = [*arguments.captures, *(made_room(seed, output) for seed in seeds)]
    sweep = Sweep(knobs=QUICK if arguments.quick else None, runs=runs, paper=arguments.paper)
    with tempfile.TemporaryDirectory() as work:
        report = report_on(folders, Path(work), sweep, steps)
    write_rows(report.rows, table)
    for name in report.clouds:
        (output / f"{name}.png").write_bytes(fit_plot(report.rows, name))
    write_page(report, page)
    print_defaults(report.rows)
    print(f"wrote {page}, {table} and {len(report.clouds)} plots")
    print(f"next: open {shlex.quote(str(page))} in a browser")


def steps(settings: list[Setting], capture: str) -> Iterable[Setting]:
    """The settings, with a bar and the remaining time where stderr is a terminal."""
    from tqdm import tqdm

    return tqdm(settings, desc=capture, file=sys.stderr, disable=None, dynamic_ncols=True)


def print_defaults(rows: Iterable[Row]) -> None:
    """The default of each capture, and the method that does without instances."""
    shown = [row for row in rows if row.is_default or row.value == "direct uplift"]
    cells = [
        (
            row.capture, row.value or "the default", f"{row.seconds:.1f}", _number(row.miou), _number(row.macc),
            _number(row.unknown), _number(row.background),
        )
        for row in shown
    ]  # fmt: skip
    print_table(("capture", "method", "seconds", "mIoU", "mAcc", "unknown", "background called"), cells)


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.4f}"
