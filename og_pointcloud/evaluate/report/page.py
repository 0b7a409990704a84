"""The report as one HTML page that needs nothing else: tables, plots and pictures, per capture."""

from __future__ import annotations

import base64
import math
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from html import escape
from pathlib import Path

from og_pointcloud.evaluate.plots import risk_coverage_png
from og_pointcloud.evaluate.report.judging import (
    Mean,
    Verdict,
    base_row,
    error,
    fits_of,
    front,
    is_asking,
    knob_reasons,
    mean_over_captures,
    noise_of,
    verdict,
)
from og_pointcloud.evaluate.report.knobs import ALWAYS_FORCED, EXACT, FAST, SEEDS, Setting, forced_by
from og_pointcloud.evaluate.report.measure import Row
from og_pointcloud.evaluate.report.plots import asking_plot, fit_plot, knob_plot, mean_plot
from og_pointcloud.evaluate.report.shared import ON_SHARED
from og_pointcloud.evaluate.report.sweep import Report, own_version, rows_as_csv
from og_pointcloud.formats.atomic import replacing

__all__ = ["write_page"]

STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #222; max-width: 1120px; margin: 2em auto; padding: 0 1em }
h1, h2, h3 { line-height: 1.2 } h2 { margin-top: 2.2em; border-top: 1px solid #ddd; padding-top: 1em }
table { border-collapse: collapse; font-size: 13px; margin: .6em 0 1.4em }
td, th { padding: 2px 10px; text-align: right; vertical-align: top }
.word { text-align: left } tr:nth-child(even) { background: #f6f6f6 }
tr.default td { font-weight: 600 } tr.front td:first-child::after { content: " \\25cf"; color: #2a7 }
.others { font-size: 12px; white-space: nowrap } .why { min-width: 14em; max-width: 20em; display: inline-block }
small { color: #666; white-space: nowrap }
.off { color: #b30; font-weight: 600 } .on { color: #175 } .noise { color: #777 }
th { border-bottom: 1px solid #999 } img { max-width: 100% } figure { margin: 1em 0 }
p.small, figcaption { color: #666; font-size: 13px } summary { cursor: pointer; color: #246 }
nav a { margin-right: 1em }
"""
KINDS = {
    "views": "views$",
    "pixels": "of the pixels$",
    "points": r"^\d+ points$",
    "masks": r"^\d+ masks$",
    "instances": "groups of masks$|^instances",
    "stages": "features and codebook|^choice of",
}
"""What a fit may leave out, and how its list names it."""
SCORES = ("seconds", "mIoU", "mAcc", "unknown", "background called")


def write_page(report: Report, path: Path) -> Path:
    """Write the page, whole or not at all."""
    rows, captures = report.rows, list(report.pictures)
    csv = base64.b64encode(rows_as_csv(rows).encode()).decode()
    parts = [
        "<!doctype html><html lang=en><meta charset=utf-8><title>Error against run time</title>",
        f"<style>{STYLE}</style><h1>Error against run time</h1>",
        f"<p>og_pointcloud {own_version()}. {len(rows)} rows in {report.seconds / 60:.0f} min on "
        f'{escape(report.machine)}. <a download="report.csv" href="data:text/csv;base64,{csv}">All rows as CSV</a></p>',
        f"<nav>{''.join(f'<a href=#{escape(name)}>{escape(name)}</a>' for name in captures)}</nav>",
        _summary(rows, captures),
        _defaults(rows, captures),
        _baselines(rows, captures),
        _repeats(rows, captures),
        _method(report),
    ]
    parts += [_capture(report, capture) for capture in captures]
    with replacing(path) as file:
        file.write("\n".join(parts).encode())
    return path


def _summary(rows: Sequence[Row], captures: Sequence[str]) -> str:
    body = []
    for name in captures:
        fits = fits_of(rows, name)
        default, best = _default(rows, name), min(fits, key=lambda row: (error(row), row.seconds))
        told = "the default" if error(best) >= error(default) else f"{best.knob}: {best.value} ({_number(best.miou)})"
        body.append((name, *_scores(default), _megabytes(default), told))
    return "<h2>The default, and the best of all that was tried</h2>" + _table(
        ("capture", *SCORES, "peak MB", "lowest error of all (its mIoU)"), body
    )


def _defaults(rows: Sequence[Row], captures: Sequence[str]) -> str:
    """Why each default is where it is, and whether this run agrees."""
    lines = []
    for knob, (value, why) in knob_reasons().items():
        verdicts = [found for name in captures if (found := verdict(rows, name, knob)) is not None]
        if verdicts:
            others = "<br>".join(_mean_line(mean) for mean in mean_over_captures(rows, knob))
            reason = f"<span class=why>{escape(why)}</span>"
            lines.append(
                (escape(knob), escape(value), reason, f"<div class=others>{others}</div>", _verdicts(verdicts))
            )
    header = ("setting", "default", "why there", "other values: seconds, error, over all captures", "on the front")
    return (
        "<h2>Why each default is where it is</h2>"
        "<p>Seconds of the whole fit and error, each less the default's; in brackets the 95&nbsp;% bootstrap interval "
        "over captures. <span class=off>Off</span>: another value is faster beyond the noise and no worse, or surely "
        "better and no slower. <span class=noise>Within noise</span>: it is ahead by less than runs differ.</p>"
        + _table(header, lines, words=5, clean=True)
        + _figure(mean_plot(rows), "Every setting over all captures, relative to its default (ring). Grey: captures.")
    )


def _mean_line(mean: Mean) -> str:
    known = len(mean.points) > 1 and mean.error.low < mean.error.high
    interval = f" ({mean.error.low:+.4f} to {mean.error.high:+.4f})" if known else ""
    return f"{escape(mean.value)}: {mean.ratio - 1:+.0%}, {mean.error.mean:+.4f}{interval}"


def _verdicts(verdicts: Sequence[Verdict]) -> str:
    on, noise = (sum(one.state == state for one in verdicts) for state in ("front", "noise"))
    parts = [f"<span class=on>on {on} of {len(verdicts)}</span>"]
    parts += [f"<span class=noise>within noise {noise}</span>"] if noise else []
    for one in verdicts:
        if one.state == "off" and one.by is not None:
            told = f"{one.capture}: {one.by.value} {-one.saved:+.1%}, {one.error:+.4f}"
            parts.append(f"<span class=off>off</span> {escape(told)}")
    return "<br>".join(parts)


def _baselines(rows: Sequence[Row], captures: Sequence[str]) -> str:
    names = list(dict.fromkeys(row.value for row in rows if row.knob == "baseline"))
    names += list(dict.fromkeys(row.value for row in rows if row.knob == "mode" and row.value.startswith("paper")))
    found = {(row.capture, row.value): row for row in rows if row.knob in ("baseline", "mode")}
    if not names or not any(row.gain is not None for row in found.values()):
        return ""
    body = [(escape(name), *(_ahead(found.get((capture, name))) for capture in captures)) for name in names]
    return (
        "<h2>Ours less other methods, mIoU</h2>"
        "<p>On the same mask table, words and machine; below it the paired 95&nbsp;% bootstrap interval over "
        "blocks of space. The methods know no background and name whatever a mask's rays reach; <i>where masked</i> "
        "leaves out points whose visible weight lies mostly outside of masks.</p>"
        + _table(("method", *captures), body, clean=True)
    )


def _ahead(row: Row | None) -> str:
    if row is None or row.gain is None or row.gain_low is None or row.gain_high is None:
        return "-"
    return f"{-row.gain:+.3f}<br><small>{-row.gain_high:+.3f} to {-row.gain_low:+.3f}</small>"


def _repeats(rows: Sequence[Row], captures: Sequence[str]) -> str:
    """What chance has to say: runs, seeds, processes."""
    body = []
    for name in captures:
        own = {(row.knob, row.value): row for row in fits_of(rows, name)}
        default, shared = own["default", ""], own.get(("default", ON_SHARED["table"].value))
        fast = [own[key] for key in ((FAST.knob, FAST.value), *((s.knob, s.value) for s in SEEDS[1:])) if key in own]
        seed = own.get((SEEDS[0].knob, SEEDS[0].value))
        body.append((
            name, f"{default.seconds:.2f} to {default.seconds_most:.2f} ({default.runs})",
            _same(default.runs_alike), _same(None if shared is None else shared.digest == default.digest),
            _same(None if seed is None else seed.digest == default.digest), _spread(fast),
        ))  # fmt: skip
    different = [f"{row.capture}, {row.knob} {row.value}" for row in rows if not row.runs_alike]
    warning = f"<p class=off>Runs differ in their answer: {escape('; '.join(different))}.</p>" if different else ""
    header = ("capture", "seconds of the default (runs)", "its runs", "a table shared", "another seed",
              "mode fast, mIoU of seeds 0, 1, 2")  # fmt: skip
    return (
        "<h2>Repeats</h2><p>Instance ids, descriptors and certainty, compared bit for bit with the default's. By "
        "default no stage draws by the seed; features and codebook of mode fast do.</p>"
        + warning
        + _table(header, body)
    )


def _same(same: bool | None) -> str:
    return "-" if same is None else "same bits" if same else "DIFFERENT"


def _spread(rows: Sequence[Row]) -> str:
    if len(rows) < 2:
        return "-"
    return ", ".join(_number(row.miou) for row in rows)


def _method(report: Report) -> str:
    failed = "; ".join(f"{what} ({why})" for what, why in report.failed.items())
    return (
        "<details><summary>How it was measured</summary><p class=small>A fit of a few points comes first in each "
        "process and is discarded. Settings that change how points are drawn, or which views are used, are whole fits, "
        "each in a process of its own. Settings of later stages take over the default's choice of Gaussians, or its "
        "mask table, in one process a capture; the seconds of what they take over are added. Seconds are the least of "
        "the runs; where there are two figures, least and most. Peak memory is the process's. mIoU: a point without a "
        "label is a miss, a class called on known background a false alarm. <i>Off exact</i>: share of points labelled "
        f"otherwise than by a fit that approximates nothing ({escape(EXACT.value)}).</p>"
        f"{f'<p>Could not be run: {escape(failed)}</p>' if failed else ''}</details>"
    )


def _capture(report: Report, capture: str) -> str:
    rows = [row for row in report.rows if row.capture == capture]
    parts = [
        f"<h2 id={escape(capture)}>{escape(capture)}</h2>",
        _figure(report.pictures[capture], "The default fit over several views; grey is background or without truth."),
        _figure(fit_plot(rows, capture), "All fits and the other methods; the front and those methods are named."),
        _figure(knob_plot(rows, capture), "A panel a setting: its default (ring), its values, their front."),
        "<h3>What this fit left out, and what it costs to force it back in</h3>",
        _left_out(rows, _default(rows, capture)),
    ]
    if capture in report.risks:
        risk = report.risks[capture]
        png = risk_coverage_png({"the default": risk.curve}, {"the default": risk.answered})
        parts.append(_figure(png, "Risk against coverage, surest points first: cosine times certainty of the point."))
    if any(row.knob == "lookup" for row in rows):
        parts += [
            "<h3>Asking the finished file</h3>",
            _figure(asking_plot(rows, capture), "The instance of a point, against the exact nearest point's."),
        ]
    return "\n".join([*parts, _all_rows(rows)])


def _all_rows(rows: Sequence[Row]) -> str:
    fits, asking = [row for row in rows if not is_asking(row)], [row for row in rows if is_asking(row)]
    best = {id(row) for row in front(fits)}
    marks = [("default " if row.is_default else "") + ("front" if id(row) in best else "") for row in fits]
    header = ("setting", *SCORES, "mIoU less the default's", "differs", "off exact", "instances", "peak MB", "runs",
              "seed")  # fmt: skip
    of_file = _table(
        ("the finished file", "mIoU", "off exact", "ms", "MB"),
        [_asking_cells(row) for row in asking],
        marks=["default" if base_row(rows, row) is row else "" for row in asking],
    )
    return (
        f"<details><summary>All {len(rows)} rows; a dot marks the front of all fits</summary>"
        f"{_table(header, [_fit_cells(row) for row in fits], marks=marks)}{of_file}</details>"
    )


def _left_out(rows: Sequence[Row], default: Row) -> str:
    """Time saved and error it cost: the forced fit's seconds less the default's, and its error taken off."""
    body = []
    for entry in default.left_out:
        forced = forced_by(entry["what"])
        body.append((entry["what"], entry["why"], *_cost(rows, forced)))
    body += [(entry.words, "always", *_cost(rows, entry.setting)) for entry in ALWAYS_FORCED]
    header = ("left out", "because", "forced back by", "seconds saved", "error it cost (95 % interval)")
    kept = [name for name, words in KINDS.items() if not any(re.search(words, e["what"]) for e in default.left_out)]
    nothing = f" Nothing was left out of: {', '.join(kept)}." if kept else ""
    return f"<p>A cost below 0: the fit is better without it.{nothing}</p>" + _table(header, body, words=3)


def _cost(rows: Sequence[Row], forced: Setting | str) -> tuple[str, str, str]:
    if isinstance(forced, str):
        return f"not forced: {forced}", "-", "-"
    row = next((row for row in rows if (row.knob, row.value) == (forced.knob, forced.value)), None)
    if row is None:
        return f"{forced.value}: could not be run", "-", "-"
    base = base_row(rows, replace(row, knob="left out"))  # whatever knob it is also a value of
    saved = row.seconds - base.seconds
    # What is shared does not vary: of a shared table only the base's own runs tell how sure a difference is.
    own, whole = base.seconds_most - base.seconds, noise_of(base, rows) * base.seconds
    doubt = " (noise)" if abs(saved) <= (own if row.shares == "table" else whole) else ""
    cost = error(base) - error(row)
    interval = ""
    if row.gain_low is not None and row.gain_high is not None:
        interval = f" ({row.gain_low:+.4f} to {row.gain_high:+.4f})"
    name = forced.value if forced.knob == "left out" else f"{forced.knob} {forced.value}"
    return name, f"{saved:+.2f}{doubt}", f"{cost:+.4f}{interval}"


def _default(rows: Sequence[Row], capture: str) -> Row:
    return next(row for row in rows if row.capture == capture and row.is_default)


def _scores(row: Row) -> tuple[str, ...]:
    return _seconds(row), _number(row.miou), _number(row.macc), _number(row.unknown), _number(row.background)


def _fit_cells(row: Row) -> tuple[str, ...]:
    name = "the default" if row.is_default else f"{row.knob}: {row.value}"
    gain = "-"
    if row.gain is not None and row.gain_low is not None and row.gain_high is not None and not row.is_default:
        gain = f"{row.gain:+.4f} ({row.gain_low:+.4f} to {row.gain_high:+.4f})"
    off = "-" if row.off_exact is None else f"{row.off_exact:.2%}"
    return (
        name, *_scores(row), gain, f"{row.disagreement:.2%}", off, str(row.instances or "-"), _megabytes(row),
        str(row.runs), str(row.seed),
    )  # fmt: skip


def _asking_cells(row: Row) -> tuple[str, ...]:
    size = "-" if row.megabytes is None else f"{row.megabytes:.3g}"
    times = f"{1e3 * row.seconds:.2f} to {1e3 * row.seconds_most:.2f}"
    return f"{row.knob}: {row.value}", _number(row.miou), f"{error(row):.4%}", times, size


def _seconds(row: Row) -> str:
    alone = row.seconds_most <= row.seconds
    return f"{row.seconds:.2f}" if alone else f"{row.seconds:.2f} to {row.seconds_most:.2f}"


def _megabytes(row: Row) -> str:
    return "-" if math.isnan(row.peak_mb) else f"{row.peak_mb:.0f}"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.4f}"


def _table(
    header: Sequence[str],
    body: Iterable[Sequence[str]],
    words: int = 1,
    marks: Sequence[str] | None = None,
    clean: bool = False,
) -> str:
    """words: columns from the left that hold text. marks: a class of each line. clean: the cells are HTML already."""
    plain: Callable[[str], str] = str if clean else escape

    def line(cells: Sequence[str], kind: str = "td", mark: str = "") -> str:
        filled = (
            f"<{kind}{' class=word' if index < words else ''}>{plain(cell)}</{kind}>"
            for index, cell in enumerate(cells)
        )
        return f'<tr class="{mark}">{"".join(filled)}</tr>'

    lines = [line(cells, mark=marks[index] if marks else "") for index, cells in enumerate(body)]
    return f"<table>{line(header, 'th')}{''.join(lines)}</table>" if lines else "<p class=small>nothing</p>"


def _figure(png: bytes, caption: str) -> str:
    data = base64.b64encode(png).decode()
    image = f'<img src="data:image/png;base64,{data}" alt="{escape(caption)}">'
    return f"<figure>{image}<figcaption>{escape(caption)}</figcaption></figure>"
