"""The hard cases as a table, a CSV and a picture of condition against error.

make check                                            # python tests/hard_cases -o out/check
python tests/hard_cases --quick --only votes,needle   # three values of each condition, no slow case
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from hard_cases import find_cases
from hard_cases.case import Case, Row, run_case
from og_pointcloud.formats.tables import csv_text

COLUMNS = 4
FLOOR, TOP = 1e-12, 30.0
"""What the plots show as least, and as not a number."""
OURS, NAIVE, BOUND = "#1b6ca8", "#d1495b", "#8d99ae"
HEADER = ("family", "case", "condition", "kind", "error", "bound", "naive", "")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run, print, write; 1 if a case fails."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, metavar="DIR", help="folder for check.csv and check.png")
    parser.add_argument("--quick", action="store_true", help="three values of each condition, no slow case")
    parser.add_argument("--only", metavar="NAME[,NAME]", default="", help="these cases or families alone")
    options = parser.parse_args(arguments)
    try:
        cases = find_cases(options.only.split(",") if options.only else (), quick=options.quick)
    except KeyError as error:
        parser.error(error.args[0])
    print(LINE.format(*HEADER))
    rows = []
    for case in cases:
        made = run_case(case, quick=options.quick)
        rows += made
        print("\n".join(line for row in made for line in lines_of(row)), flush=True)
    failing = sorted({row.case.name for row in rows if not row.holds})
    counts = Counter(case.kind for case in cases)
    kinds = ", ".join(f"{counts[kind]} {kind}" for kind in ("float64", "exact", "refused"))
    print(f"{len(cases)} cases ({kinds}), {len(failing)} of them fail{': ' if failing else ''}{', '.join(failing)}")
    if options.output:
        options.output.mkdir(parents=True, exist_ok=True)
        write_csv(rows, options.output / "check.csv")
        plot(rows, options.output / "check.png")
        print(f"wrote {options.output / 'check.csv'} and check.png beside it")
    return int(bool(failing))


LINE = "{:<9} {:<34} {:<52} {:<8} {:>8} {:>8} {:>8}  {}"


def lines_of(row: Row) -> list[str]:
    """A row of the table, and why it fails."""
    case = row.case
    condition = "" if row.value is None else f"{case.condition}: {row.value:.3g}"
    numbers = [
        "" if value is None else f"{value:.1e}"
        for value in (row.error, case.bound if case.kind == "float64" else None, row.naive)
    ]
    line = LINE.format(case.family, case.name, condition, case.kind, *numbers, "" if row.holds else "FAILS")
    return [line.rstrip()] if row.holds else [line, f"    {row.note}"]


def write_csv(rows: Sequence[Row], path: Path) -> None:
    """A line a row. note: the text of a refusal, or why a case fails."""

    def line(row: Row) -> dict[str, object]:
        case, bound = row.case, None if row.case.refusal else row.case.bound
        numbers = {"value": row.value, "error": row.error, "bound": bound, "naive_error": row.naive}
        return {
            "name": case.name, "family": case.family, "kind": case.kind, "case": case.title,
            "condition": case.condition,
            **{name: "" if value is None else f"{value:.6g}" for name, value in numbers.items()},
            "holds": row.holds, "note": row.note,
        }  # fmt: skip

    path.write_text(csv_text([line(row) for row in rows]), encoding="utf-8")


def plot(rows: Sequence[Row], path: Path) -> None:
    """A PNG with a panel for every case that has a condition and a naive form: error against condition, both forms."""
    from matplotlib.figure import Figure

    by_case = [(case, list(own)) for case, own in groupby(rows, key=lambda row: row.case)]
    swept = [(case, own) for case, own in by_case if case.condition and any(row.naive is not None for row in own)]
    lines = max(1, -(-len(swept) // COLUMNS))
    figure = Figure(figsize=(4.1 * COLUMNS, 2.75 * lines + 0.9), layout="constrained")
    panels = figure.subplots(lines, COLUMNS, squeeze=False, sharey=True).ravel()
    for panel, (case, own) in zip(panels, swept, strict=False):
        _draw(panel, case, own)
    for panel in panels[len(swept) :]:
        panel.axis("off")
    for panel in panels[::COLUMNS]:
        panel.set_ylabel("error")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper right", ncols=max(1, len(labels)), frameon=False)
    failing = sum(not row.holds for row in rows)
    verdict = "all hold" if failing == 0 else f"{failing} of {len(rows)} rows fail"
    figure.suptitle(f"{len(by_case)} stiff and extreme cases, {verdict}", x=0.01, ha="left", fontsize=13)
    figure.savefig(path, dpi=120)


def _draw(panel: Any, case: Case, rows: Sequence[Row]) -> None:
    """One panel; a case that gets harder towards small values is drawn from right to left."""
    rows = [row for row in rows if row.value]  # a logarithmic axis has no zero
    values = np.array([row.value for row in rows], np.float64)
    panel.axhline(max(case.bound, FLOOR), color=BOUND, linewidth=1, linestyle=(0, (4, 3)), label="bound", zorder=1)
    for name, color, errors in (
        ("naive float32", NAIVE, [row.naive for row in rows]),
        ("og_pointcloud", OURS, [row.error for row in rows]),
    ):
        error = np.array([np.nan if e is None else e for e in errors], np.float64)
        lost = ~np.isfinite(error)
        shown = np.where(lost, TOP, np.maximum(error, FLOOR))
        panel.loglog(values, shown, color=color, marker="o", markersize=3.5, linewidth=1.6, label=name, zorder=3)
        panel.plot(values[lost], shown[lost], "x", color=color, markersize=8, markeredgewidth=2, zorder=4)
    panel.set_ylim(FLOOR / 3, TOP * 8)
    ticks = {FLOOR: r"$\leq 10^{-12}$", 1e-9: "$10^{-9}$", 1e-6: "$10^{-6}$", 1e-3: "$10^{-3}$", 1: "1", TOP: "NaN"}
    panel.set_yticks(list(ticks), list(ticks.values()))
    panel.minorticks_off()
    if values[0] > values[-1]:
        panel.invert_xaxis()
    panel.set_title(f"{case.family}: {case.name.replace('_', ' ')}", fontsize=10, loc="left", fontweight="bold")
    panel.set_xlabel(case.condition, fontsize=9)
    panel.tick_params(labelsize=8)
    panel.grid(alpha=0.25, linewidth=0.6)
    panel.spines[["top", "right"]].set_visible(False)


if __name__ == "__main__":
    sys.exit(main())
