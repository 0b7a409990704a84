"""The catalogue's rows as a table, and as a picture of condition against error."""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from hard_cases.case import Case, Row
from og_pointcloud.errors import MissingExtraError
from og_pointcloud.formats.atomic import replacing

__all__ = ["plot", "write_csv"]

COLUMNS = 4
FLOOR, TOP = 1e-12, 30.0
"""What the plots show as least, and as not a number."""
OURS, NAIVE, BOUND = "#1b6ca8", "#d1495b", "#8d99ae"


def write_csv(rows: Sequence[Row], path: str | os.PathLike[str]) -> Path:
    """A line a row: name, family, what it is, condition, value, error, bound, naive error, outcome, note."""
    path, text = Path(path), io.StringIO(newline="")
    lines = csv.writer(text)
    lines.writerow(["name", "family", "case", "condition", "value", "error", "bound", "naive_error", "outcome", "note"])
    for row in rows:
        case = row.case
        bound = None if case.refusal else case.bound
        numbers = ["" if value is None else f"{value:.6g}" for value in (row.value, row.error, bound, row.naive)]
        lines.writerow([case.name, case.family, case.title, case.condition, *numbers, row.outcome, row.note])
    with replacing(path) as file:
        file.write(text.getvalue().encode())
    return path


def plot(rows: Sequence[Row], path: str | os.PathLike[str]) -> Path:
    """A PNG with a panel for every case that has a condition and a naive form: error against condition, both forms.

    MissingExtraError where matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise MissingExtraError("matplotlib", "report") from error
    path = Path(path)
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
    figure.legend(handles, labels, loc="outside upper right", ncols=len(labels), frameon=False)
    failing = sum(row.outcome == "FAILS" for row in rows)
    verdict = "all hold" if failing == 0 else f"{failing} of {len(rows)} rows fail"
    figure.suptitle(f"{len(by_case)} stiff and extreme cases, {verdict}", x=0.01, ha="left", fontsize=13)
    data = io.BytesIO()
    figure.savefig(data, format="png", dpi=120)
    with replacing(path) as file:
        file.write(data.getvalue())
    return path


def _draw(panel: Any, case: Case, rows: Sequence[Row]) -> None:
    """One panel; a case that gets harder towards small values is drawn from right to left."""
    rows = [row for row in rows if row.value]  # a logarithmic axis has no zero
    values = np.array([row.value for row in rows], np.float64)
    panel.axhline(max(case.bound, FLOOR), color=BOUND, linewidth=1, linestyle=(0, (4, 3)), label="bound", zorder=1)
    for name, colour, errors in (
        ("naive float32", NAIVE, [row.naive for row in rows]),
        ("og_pointcloud", OURS, [row.error for row in rows]),
    ):
        error = np.array([np.nan if e is None else e for e in errors], np.float64)
        lost = ~np.isfinite(error)
        shown = np.where(lost, TOP, np.maximum(error, FLOOR))
        panel.loglog(values, shown, color=colour, marker="o", markersize=3.5, linewidth=1.6, label=name, zorder=3)
        panel.plot(values[lost], shown[lost], "x", color=colour, markersize=8, markeredgewidth=2, zorder=4)
    panel.set_ylim(FLOOR / 3, TOP * 8)
    panel.set_yticks(
        [FLOOR, 1e-9, 1e-6, 1e-3, 1, TOP], [r"$\leq 10^{-12}$", "$10^{-9}$", "$10^{-6}$", "$10^{-3}$", "1", "NaN"]
    )
    panel.minorticks_off()
    if values[0] > values[-1]:
        panel.invert_xaxis()
    panel.set_title(f"{case.family}: {case.name.replace('_', ' ')}", fontsize=10, loc="left", fontweight="bold")
    panel.set_xlabel(case.condition, fontsize=9)
    panel.tick_params(labelsize=8)
    panel.grid(alpha=0.25, linewidth=0.6)
    panel.spines[["top", "right"]].set_visible(False)
