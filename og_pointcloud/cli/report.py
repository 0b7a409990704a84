"""``og-pointcloud report``: error against run time of every setting, on captures and made rooms, as one page."""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from og_pointcloud.cli.ablate import made_room, room_seeds
from og_pointcloud.cli.common import add_command, check_outputs, print_table
from og_pointcloud.errors import OgPointcloudError

if TYPE_CHECKING:
    from og_pointcloud.evaluate.report.measure import Row
    from og_pointcloud.evaluate.report.sweep import Tick


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
    parser.add_argument("--quick", action="store_true", help="the knobs that matter most")
    parser.add_argument(
        "--runs", type=int, default=1, metavar="N", help="runs of every setting, of the default at least 2 (default: 1)"
    )
    parser.add_argument("--paper", action="store_true", help="also the paper's training, 3 %% of its steps (minutes)")
    parser.add_argument(
        "-o", "--output", type=Path, default=Path("out/report"), metavar="DIR",
        help="folder for report.html, report.csv and the plots (default: %(default)s)",
    )  # fmt: skip


def run(arguments: argparse.Namespace) -> None:
    seeds, output, runs = room_seeds(arguments.room), arguments.output, arguments.runs
    if not arguments.captures and not seeds:
        raise OgPointcloudError("no CAPTURE and no --room; expected at least one, e.g. --room 1")
    if runs < 1:
        raise OgPointcloudError(f"--runs is {runs}; expected at least 1")
    page, table = output / "report.html", output / "report.csv"
    check_outputs({"the page": (page, [".html"]), "the table": (table, [".csv"])}, inputs=arguments.captures)
    from og_pointcloud.evaluate.plots import require_matplotlib
    from og_pointcloud.evaluate.report.page import write_page
    from og_pointcloud.evaluate.report.plots import fit_plot, knob_plot, mean_plot
    from og_pointcloud.evaluate.report.sweep import QUICK, Sweep, report_on, write_rows

    require_matplotlib()
    output.mkdir(parents=True, exist_ok=True)
    folders = [*arguments.captures, *(made_room(seed, output) for seed in seeds)]
    sweep = Sweep(knobs=QUICK if arguments.quick else None, runs=runs, paper=arguments.paper)
    check_names(folders)
    with progress() as tick:
        report = report_on(folders, sweep, tick)
    write_rows(report.rows, table)
    plots = {f"{name}-fits": fit_plot(report.rows, name) for name in report.pictures}
    plots |= {f"{name}-settings": knob_plot(report.rows, name) for name in report.pictures}
    plots["settings"] = mean_plot(report.rows)
    for name, png in plots.items():
        (output / f"{name}.png").write_bytes(png)
    write_page(report, page)
    print_defaults(report.rows)
    print(f"wrote {page}, {table} and {len(plots)} plots")
    print(f"next: open {shlex.quote(str(page))} in a browser")


def check_names(folders: Sequence[Path]) -> None:
    """Captures are told apart by their folders' names."""
    names = [folder.absolute().name for folder in folders]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise OgPointcloudError(f"two captures are in folders named '{twice}'; expected different names")


@contextmanager
def progress() -> Iterator[Tick]:
    """A bar a capture, of the settings it still has to come, where stderr is a terminal."""
    from tqdm import tqdm

    bars: dict[str, Any] = {}

    def tick(capture: str, what: str, left: int) -> None:
        if capture not in bars:
            for done in bars.values():
                done.close()
            bars[capture] = tqdm(total=left + 1, desc=capture, file=sys.stderr, disable=None, dynamic_ncols=True)
        bars[capture].set_postfix_str(what, refresh=False)
        bars[capture].update(bars[capture].total - left - bars[capture].n)

    try:
        yield tick
    finally:
        for bar in bars.values():
            bar.close()


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
