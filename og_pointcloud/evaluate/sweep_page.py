"""A sweep to look at: a chart of error against seconds, and an HTML page with it, the table and what was left out."""

from __future__ import annotations

import base64
import itertools
from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path
from string import Template
from typing import Any

from og_pointcloud.evaluate.knobs import FORCED
from og_pointcloud.evaluate.plots import png_bytes, require_matplotlib
from og_pointcloud.evaluate.sweep import BASELINE, Row, Sweep, front, machine
from og_pointcloud.formats.atomic import replacing

__all__ = ["chart", "table", "write_page"]

SHARES = {
    "mIoU": "miou", "without background": "labelled_miou", "paper": "published", "mAcc": "macc", "unknown": "unknown",
    "background called": "background", "agreement": "agreement",
}  # fmt: skip
"""Column -> field of `Row`, after setting, seconds, error and gain."""
COLOURS, MARKERS = [f"C{number}" for number in range(10)], "osD^vPX*<>hpd"
"""Together they tell 130 knobs apart: their numbers have no divisor in common."""
WIDTH, PANEL_HEIGHT = 11.0, 5.2
LINEAR_BELOW = 0.01
"""Errors are on a logarithmic axis down to this one, and linear from there to 0."""
TICKS = (0, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1)
PAGE = Template("""<!doctype html><html lang=en><meta charset=utf-8><title>$title</title><style>
body { font: 15px/1.5 system-ui, sans-serif; color: #222; max-width: 1120px; margin: 2em auto; padding: 0 1em }
table { border-collapse: collapse; font-size: 13px; margin: .6em 0 1.4em } th { border-bottom: 1px solid #999 }
td, th { padding: 2px 10px; text-align: right } td:first-child, th:first-child { text-align: left }
tr.default td { font-weight: 600 } tr.front td:first-child::after { content: " \\25cf"; color: #2a7 }
img { width: 100% }
</style><h1>$title</h1>
<p>Measured on $machine. Seconds are of a whole fit; compare them within one report; less than a tenth of them is noise.
A gain whose interval holds 0 may be chance.</p>
<p><img src="data:image/png;base64,$picture" alt="error against seconds"></p>
$failed
$captures
""")


def chart(sweep: Sweep) -> bytes:
    """A PNG, a panel a capture: error against seconds, both of every row; the default ringed, the front joined, its
    settings numbered and named beside it."""
    captures = sweep.captures
    figure = require_matplotlib()(figsize=(WIDTH, PANEL_HEIGHT * len(captures)), layout="constrained")
    for axes, capture in zip(figure.subplots(len(captures), squeeze=False).ravel(), captures, strict=True):
        _panel(axes, [row for row in sweep.rows if row.capture == capture])
        axes.set_title(capture, fontsize=11, fontweight="bold", loc="left")
    return png_bytes(figure)


def _panel(axes: Any, rows: Sequence[Row]) -> None:
    looks = zip(itertools.cycle(COLOURS), itertools.cycle(MARKERS))
    for knob in dict.fromkeys(row.knob for row in rows if not row.is_default):
        colour, marker = ("0.45", "x") if knob == BASELINE else next(looks)
        own = [row for row in rows if row.knob == knob]
        seconds, errors = [row.seconds for row in own], [row.error for row in own]
        axes.scatter(seconds, errors, s=34, label=knob, zorder=3, color=colour, marker=marker)
    for row in rows:
        if row.is_default:
            axes.plot(row.seconds, row.error, "o", ms=13, mfc="none", mew=2, color="black", label="the default")
    best = front(rows)
    axes.step([row.seconds for row in best], [row.error for row in best], where="post", color="0.7", label="front")
    for number, row in enumerate(best, 1):
        place = (0, -17 if number % 2 else 11)  # below and above in turn, so that neighbours do not cover each other
        axes.annotate(str(number), (row.seconds, row.error), place, textcoords="offset points", ha="center")
        axes.plot([], [], " ", label=f"{number}  {row.name}")
    axes.set_xscale("log")
    axes.set_yscale("symlog", linthresh=LINEAR_BELOW)
    axes.set_yticks(TICKS, [f"{tick:g}" for tick in TICKS])
    axes.set(xlabel="seconds of the whole fit (log)", ylabel=f"error, {error_name(rows)}")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=7.5, loc="center left", bbox_to_anchor=(1, 0.5), frameon=False)


def error_name(rows: Sequence[Row]) -> str:
    """What the error of these rows is."""
    return "1 - mIoU" if all(row.miou is not None for row in rows) else "1 - mask agreement (no truth)"


def write_page(sweep: Sweep, path: Path, title: str = "Error against run time") -> Path:
    """The page, whole or not at all; it needs nothing beside itself."""
    parts = []
    for capture in sweep.captures:
        rows = [row for row in sweep.rows if row.capture == capture]
        parts.append(f"<h2>{escape(capture)}</h2><p>Error is {error_name(rows)}; a dot marks the front.</p>")
        parts += [_list("Left out by the default", _left_out(row, rows)) for row in rows if row.is_default]
        parts.append(_html_table(rows))
    page = PAGE.substitute(
        title=escape(title),
        machine=escape(machine()),
        picture=base64.b64encode(chart(sweep)).decode(),
        failed=_list("Could not be run", (f"{what}: {why}" for what, why in sweep.failed.items())),
        captures="\n".join(parts),
    )
    with replacing(path) as file:
        file.write(page.encode())
    return path


def _list(heading: str, entries: Iterable[str]) -> str:
    items = "".join(f"<li>{escape(entry)}</li>" for entry in entries)
    return f"<h3>{heading}</h3><ul>{items}</ul>" if items else ""


def _left_out(default: Row, rows: Sequence[Row]) -> list[str]:
    """What the default's fit left out, and what that saved and cost, where it was forced back in."""
    forced = {row.value: row for row in rows if row.knob == FORCED}
    texts = []
    for entry in default.left_out:
        text, back = f"{entry['what']}: {entry['why']}", forced.get(entry.get("key", ""))
        if back is not None:
            seconds, error = back.seconds - default.seconds, back.error - default.error
            text += f". Forced back in: {seconds:+.2f} s, error {error:+.4f}"
        texts.append(text)
    return texts


def _html_table(rows: Sequence[Row]) -> str:
    best = {id(row) for row in front(rows)}
    header, *lines = table(rows)
    parts = [f"<tr>{''.join(f'<th>{escape(name)}</th>' for name in header)}</tr>"]
    for row, line in zip(rows, lines, strict=True):
        marks = ["default"] * row.is_default + ["front"] * (id(row) in best)
        parts.append(f'<tr class="{" ".join(marks)}">{"".join(f"<td>{escape(cell)}</td>" for cell in line)}</tr>')
    return f"<table>{''.join(parts)}</table>"


def table(rows: Sequence[Row]) -> list[tuple[str, ...]]:
    """A header, then the cells of each row; without the columns that no row has a figure for."""
    header = ("setting", "seconds", "error", "mIoU less the default's (95 %)", *SHARES, "instances")
    lines = [_cells(row) for row in rows]
    filled = [column for column in range(len(header)) if any(line[column] != "-" for line in lines)]
    return [tuple(line[column] for column in filled) for line in (header, *lines)]


def _cells(row: Row) -> tuple[str, ...]:
    error = f"{row.error:.4f}" + ("" if row.error_spread is None else f" ± {row.error_spread:.4f}")
    gain = "-"
    if row.gain is not None and not row.is_default:
        gain = f"{row.gain:+.4f} ({row.gain_low:+.4f} to {row.gain_high:+.4f})"
    shares = (getattr(row, name) for name in SHARES.values())
    instances = "-" if row.instances is None else f"{row.instances:.4g}"
    return (
        row.name, f"{row.seconds:.2f}", error, gain, *("-" if one is None else f"{one:.4f}" for one in shares),
        instances,
    )  # fmt: skip
