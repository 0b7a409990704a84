"""Report of a sweep: a chart of error against seconds, and the tables as Markdown, with what was left out."""

from __future__ import annotations

import io
import itertools
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from og_pointcloud.errors import naming_extra
from og_pointcloud.evaluate.sweep import BASELINE, Row, Sweep, front, machine
from og_pointcloud.formats.atomic import write_file

SHARES = {
    "mIoU": "miou", "mAcc": "macc", "unknown": "unknown",
    "background called": "background", "reliability": "reliability",
}  # fmt: skip
"""Column -> field of `Row`, after setting, seconds, error and gain."""
COLORS, MARKERS = [f"C{number}" for number in range(10)], "osD^vPX*<>hpd"
"""Together they tell 130 knobs apart: their counts have no common divisor."""
WIDTH, PANEL_HEIGHT = 11.0, 5.2
LINEAR_BELOW = 0.01
"""The error axis is logarithmic down to this error, and linear from there to 0."""
TICKS = (0, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1)
FRONT_MARK = " *"
"""Follows the settings of the front in tables."""


def require_matplotlib() -> Any:
    """The class matplotlib.figure.Figure; MissingExtraError where matplotlib is not installed."""
    with naming_extra("matplotlib", "report"):
        from matplotlib.figure import Figure
    return Figure


def write_chart(sweep: Sweep, path: Path) -> Path:
    """A PNG with one panel per capture: error against seconds of every row; the default is ringed, the front joined.
    Written whole or not at all."""
    captures = sweep.captures
    figure = require_matplotlib()(figsize=(WIDTH, PANEL_HEIGHT * len(captures)), layout="constrained")
    for axes, capture in zip(figure.subplots(len(captures), squeeze=False).ravel(), captures, strict=True):
        _panel(axes, [row for row in sweep.rows if row.capture == capture])
        axes.set_title(capture, fontsize=11, fontweight="bold", loc="left")
    data = io.BytesIO()
    figure.savefig(data, format="png", dpi=110)
    return write_file(path, data.getvalue())


def _panel(axes: Any, rows: Sequence[Row]) -> None:
    from matplotlib.ticker import LogFormatter

    looks = zip(itertools.cycle(COLORS), itertools.cycle(MARKERS))
    for knob in dict.fromkeys(row.knob for row in rows if not row.is_default):
        color, marker = ("0.45", "x") if knob == BASELINE else next(looks)
        own = [row for row in rows if row.knob == knob]
        seconds, errors = [row.seconds for row in own], [row.error for row in own]
        axes.scatter(seconds, errors, s=34, label=knob, zorder=3, color=color, marker=marker)
    for row in rows:
        if row.is_default:
            axes.plot(row.seconds, row.error, "o", ms=13, mfc="none", mew=2, color="black", label="the default")
    best = front(rows)
    axes.step([row.seconds for row in best], [row.error for row in best], where="post", color="0.7", label="front")
    axes.set_xscale("log")
    for set_formatter in (axes.xaxis.set_major_formatter, axes.xaxis.set_minor_formatter):
        set_formatter(LogFormatter())  # 20, not 2 x 10^1
    axes.set_yscale("symlog", linthresh=LINEAR_BELOW)
    axes.set_yticks(TICKS, [f"{tick:g}" for tick in TICKS])
    axes.set(xlabel="seconds for the whole fit (log)", ylabel=f"error, {error_name(rows)}")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=7.5, loc="center left", bbox_to_anchor=(1, 0.5), frameon=False)


def error_name(rows: Sequence[Row]) -> str:
    """How tables and charts name the error of these rows."""
    return "1 - mIoU" if all(row.miou is not None for row in rows) else "1 - reliability (no truth)"


def write_report(sweep: Sweep, path: Path, chart: Path) -> Path:
    """The tables as Markdown, with the chart that lies beside it; written whole or not at all."""
    parts = [
        "# Error against run time",
        f"Measured on {machine()}. Seconds are for a whole fit: compare them within one report; differences "
        "below a tenth are noise. A gain whose interval contains 0 may be chance.",
        f"![error against seconds]({chart.name})",
        *_list("Could not be run", (f"{what}: {why}" for what, why in sweep.failed.items())),
    ]
    for capture in sweep.captures:
        rows = [row for row in sweep.rows if row.capture == capture]
        parts += [f"## {capture}", f"Error is {error_name(rows)};{FRONT_MARK} marks the front."]
        for row in rows:
            if row.is_default:
                parts += _list("Left out by the default", (f"{one['what']}: {one['why']}" for one in row.left_out))
        header, *lines = table(rows)
        parts.append("\n".join(map(_markdown, [header, ["---", *["---:"] * (len(header) - 1)], *lines])))
    return write_file(path, "\n\n".join(parts).encode() + b"\n")


def _list(heading: str, entries: Iterable[str]) -> list[str]:
    items = [f"- {entry}" for entry in entries]
    return [f"### {heading}", "\n".join(items)] if items else []


def _markdown(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cell.replace('|', '&#124;') for cell in cells)} |"


def table(rows: Sequence[Row]) -> list[tuple[str, ...]]:
    """A header, then the cells of each row, without columns that are empty in all rows."""
    header = ("setting", "seconds", "error", "mIoU less the default's (95 %)", *SHARES, "instances")
    best = {id(row) for row in front(rows)}
    lines = [_cells(row, FRONT_MARK if id(row) in best else "") for row in rows]
    filled = [column for column in range(len(header)) if any(line[column] != "-" for line in lines)]
    return [tuple(line[column] for column in filled) for line in (header, *lines)]


def _cells(row: Row, mark: str) -> tuple[str, ...]:
    gain = "-"
    if row.gain is not None and not row.is_default:
        gain = f"{row.gain:+.4f} ({row.gain_low:+.4f} to {row.gain_high:+.4f})"
    shares = (getattr(row, name) for name in SHARES.values())
    instances = "-" if row.instances is None else str(row.instances)
    return (
        row.name + mark, f"{row.seconds:.2f}", f"{row.error:.4f}", gain,
        *("-" if one is None else f"{one:.4f}" for one in shares), instances,
    )  # fmt: skip
