"""A sweep to look at: a chart of error against seconds, and an HTML page with it, the table and what was left out."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import Any

from og_pointcloud.evaluate.knobs import FORCED
from og_pointcloud.evaluate.plots import require_matplotlib
from og_pointcloud.evaluate.sweep import BASELINE, Row, Sweep, front, machine
from og_pointcloud.formats.atomic import replacing

__all__ = ["chart", "table", "write_page"]

COLUMNS = (
    "setting", "seconds", "error", "mIoU less the default's (95 %)", "mIoU", "without background", "paper", "mAcc",
    "unknown", "background called", "agreement", "instances",
)  # fmt: skip
COLOURS = ("tab:blue", "tab:orange", "tab:green", "tab:red", "tab:purple", "tab:brown", "tab:pink", "tab:olive",
           "tab:cyan", "navy", "gold", "teal", "orchid", "slategrey", "lime")  # fmt: skip
MARKERS = "osD^vPX*<>hpd8"
WIDTH, PANEL_HEIGHT, DPI = 11.0, 5.2, 110
LINEAR_BELOW = 0.01
"""Errors are on a logarithmic axis down to this one, and linear from there to 0."""
TICKS = (0, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1)
STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #222; max-width: 1120px; margin: 2em auto; padding: 0 1em }
table { border-collapse: collapse; font-size: 13px; margin: .6em 0 1.4em } th { border-bottom: 1px solid #999 }
td, th { padding: 2px 10px; text-align: right } td:first-child, th:first-child { text-align: left }
tr.default td { font-weight: 600 } tr.front td:first-child::after { content: " \\25cf"; color: #2a7 }
img { width: 100% }
"""


def chart(sweep: Sweep) -> bytes:
    """A PNG, a panel a capture: error against seconds, both of every row; the default ringed, the front joined, its
    settings numbered and named beside it."""
    captures = sweep.captures
    figure = require_matplotlib()(figsize=(WIDTH, PANEL_HEIGHT * len(captures)), layout="constrained")
    for axes, capture in zip(figure.subplots(len(captures), squeeze=False).ravel(), captures, strict=True):
        rows = [row for row in sweep.rows if row.capture == capture]
        _panel(axes, rows)
        axes.set_title(capture, fontsize=11, fontweight="bold", loc="left")
    data = io.BytesIO()
    figure.savefig(data, format="png", dpi=DPI)
    return data.getvalue()


def _panel(axes: Any, rows: Sequence[Row]) -> None:
    knobs = list(dict.fromkeys(row.knob for row in rows if not row.is_default))
    for number, knob in enumerate(knobs):
        own = [row for row in rows if row.knob == knob]
        look = {"color": "0.45", "marker": "x"} if knob == BASELINE else {
            "color": COLOURS[number % len(COLOURS)], "marker": MARKERS[number % len(MARKERS)]
        }  # fmt: skip
        axes.scatter([row.seconds for row in own], [row.error for row in own], s=34, label=knob, zorder=3, **look)
    for row in rows:
        if row.is_default:
            ring = {"s": 190, "facecolors": "none", "edgecolors": "black", "linewidths": 2, "zorder": 4}
            axes.scatter([row.seconds], [row.error], label="the default", **ring)
    best = front(rows)
    axes.step([row.seconds for row in best], [row.error for row in best], where="post", color="0.7", label="front")
    for number, row in enumerate(best, 1):
        axes.annotate(
            str(number), (row.seconds, row.error), (0, -17 if number % 2 else 11), textcoords="offset points",
            fontsize=9, ha="center", fontweight="bold", zorder=5,
        )  # fmt: skip
        axes.plot([], [], " ", label=f"{number}  {row.name}")
    others = [row for row in rows if row.knob == BASELINE]
    for row in sorted(others, key=lambda row: row.error)[:1]:
        axes.annotate(
            row.value, (row.seconds, row.error), (6, 5), textcoords="offset points", fontsize=7.5, color="0.3"
        )
    axes.set_xscale("log")
    axes.set_yscale("symlog", linthresh=LINEAR_BELOW)
    axes.set_yticks(TICKS, [f"{tick:g}" for tick in TICKS])
    errors = [row.error for row in rows]
    axes.set_ylim(max(min(errors) / 1.5, -0.1 * LINEAR_BELOW) - 1e-3, min(1.5 * max(errors) + 1e-3, 1.05))
    for axis in (axes.xaxis.set_major_formatter, axes.xaxis.set_minor_formatter):
        axis(lambda value, _: f"{value:g}" if f"{value:e}"[0] in "1235" else "")
    axes.set(xlabel="seconds of the whole fit (log)", ylabel=f"error, {error_name(rows)}")
    axes.grid(alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(fontsize=7.5, loc="center left", bbox_to_anchor=(1, 0.5), frameon=False)


def error_name(rows: Sequence[Row]) -> str:
    """What the error of these rows is."""
    return "1 - mIoU" if all(row.miou is not None for row in rows) else "1 - mask agreement (no truth)"


def write_page(sweep: Sweep, path: Path, title: str = "Error against run time") -> Path:
    """The page, whole or not at all; it needs nothing beside itself."""
    picture = base64.b64encode(chart(sweep)).decode()
    parts = [
        f"<!doctype html><html lang=en><meta charset=utf-8><title>{title}</title><style>{STYLE}</style><h1>{title}</h1>"
        f"<p>{len(sweep.rows)} rows, measured on {escape(machine())}. Seconds are of a whole fit; compare them within "
        "one report; less than a tenth of them is noise. A gain whose interval holds 0 may be chance.</p>",
        f'<p><img src="data:image/png;base64,{picture}" alt="error against seconds"></p>',
    ]
    if sweep.failed:
        failed = "".join(f"<li>{escape(what)}: {escape(why)}</li>" for what, why in sweep.failed.items())
        parts.append(f"<h2>Could not be run</h2><ul>{failed}</ul>")
    for capture in sweep.captures:
        rows = [row for row in sweep.rows if row.capture == capture]
        parts.append(f"<h2>{escape(capture)}</h2><p>Error is {error_name(rows)}; a dot marks the front.</p>")
        parts += [_left_out(row, rows) for row in rows if row.is_default and row.left_out]
        parts.append(_table(rows))
    with replacing(path) as file:
        file.write("\n".join(parts).encode())
    return path


def _left_out(default: Row, rows: Sequence[Row]) -> str:
    """What the default's fit left out, and what that saved and cost, where it was forced back in."""
    forced = {row.value: row for row in rows if row.knob == FORCED}
    items = []
    for entry in default.left_out:
        text, back = f"{entry['what']}: {entry['why']}", forced.get(entry.get("key", ""))
        if back is not None:
            text += (
                f". Forced back in: {back.seconds - default.seconds:+.2f} s, error {back.error - default.error:+.4f}"
            )
        items.append(f"<li>{escape(text)}</li>")
    return f"<h3>Left out by the default</h3><ul>{''.join(items)}</ul>"


def _table(rows: Sequence[Row]) -> str:
    best = {id(row) for row in front(rows)}
    header, *lines = table(rows)
    parts = [f"<tr>{''.join(f'<th>{escape(name)}</th>' for name in header)}</tr>"]
    for row, line in zip(rows, lines, strict=True):
        marks = ("default " if row.is_default else "") + ("front" if id(row) in best else "")
        columns = "".join(f"<td>{escape(cell)}</td>" for cell in line)
        parts.append(f'<tr class="{marks.strip()}">{columns}</tr>')
    return f"<table>{''.join(parts)}</table>"


def table(rows: Sequence[Row]) -> list[tuple[str, ...]]:
    """A header, then the cells of each row; without the columns that no row has a figure for."""
    lines = [_cells(row) for row in rows]
    filled = [column for column in range(len(COLUMNS)) if any(line[column] != "-" for line in lines)]
    return [tuple(line[column] for column in filled) for line in (COLUMNS, *lines)]


def _cells(row: Row) -> tuple[str, ...]:
    seconds = f"{row.seconds:.2f}" + (f" to {row.seconds_most:.2f}" if row.seconds_most > 1.01 * row.seconds else "")
    error = f"{row.error:.4f}" + ("" if row.error_spread is None else f" ± {row.error_spread:.4f}")
    gain = "-" if row.gain is None or row.is_default else f"{row.gain:+.4f}"
    if gain != "-" and row.gain_low is not None and row.gain_high is not None:
        gain += f" ({row.gain_low:+.4f} to {row.gain_high:+.4f})"
    shares = (
        row.miou, row.labelled_miou, row.published, row.macc, row.unknown, row.background, row.agreement,
    )  # fmt: skip
    instances = "-" if row.instances is None else f"{row.instances:.4g}"
    return (row.name, seconds, error, gain, *("-" if one is None else f"{one:.4f}" for one in shares), instances)
