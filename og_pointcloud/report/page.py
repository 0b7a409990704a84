"""The report as one HTML page that needs nothing else: tables, plots and pictures, per capture."""

from __future__ import annotations

import base64
import math
import tempfile
from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path

from og_pointcloud._atomic import replacing
from og_pointcloud.fitting.fit import prepare
from og_pointcloud.fitting.pictures import instance_picture
from og_pointcloud.formats.capture import read_capture
from og_pointcloud.report.knobs import FORCED, KNOBS, Knob
from og_pointcloud.report.measure import Row
from og_pointcloud.report.plots import asking_plot, fit_plot, is_asking
from og_pointcloud.report.sweep import Report, error, front

__all__ = ["write_page"]

STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #222; max-width: 1060px; margin: 2em auto; padding: 0 1em }
h1, h2, h3 { line-height: 1.2 } h2 { margin-top: 2.2em; border-top: 1px solid #ddd; padding-top: 1em }
table { border-collapse: collapse; font-size: 13px; margin: .6em 0 1.4em }
td, th { padding: 2px 10px; text-align: right }
.word { text-align: left } tr:nth-child(even) { background: #f6f6f6 }
tr.default td { font-weight: 600 } tr.front td:first-child::after { content: " \\25cf"; color: #2a7 }
th { border-bottom: 1px solid #999 } img { max-width: 100% } p.small, figcaption { color: #666; font-size: 13px }
"""
WITHIN = 0.05
"""A default is as good as the front where no setting is both this share faster and at least as good."""


def write_page(report: Report, path: Path) -> Path:
    """Write the page, whole or not at all."""
    captures = list(dict.fromkeys(row.capture for row in report.rows))
    parts = [
        "<!doctype html><html lang=en><meta charset=utf-8><title>Error against run time</title>",
        f"<style>{STYLE}</style><h1>Error against run time</h1>",
        f"<p>{len(report.rows)} rows in {report.seconds:.0f} s on {escape(report.machine)}. A dot after a name marks "
        "the front: no other fit of the capture is both faster and better. Seconds are the least of the runs; each fit "
        "ran in a process of its own, after one that was discarded.</p>",
        _summary(report.rows, captures),
        _defaults(report.rows, captures),
    ]
    parts += [_capture(report, capture) for capture in captures]
    with replacing(path) as file:
        file.write("\n".join(parts).encode())
    return path


def _summary(rows: Sequence[Row], captures: Sequence[str]) -> str:
    default = {row.capture: row for row in rows if row.is_default}
    best = {name: max((r for r in _fits(rows, name)), key=lambda row: (-error(row), -row.seconds)) for name in captures}
    body = [
        (name, *_scores(default[name]), f"{best[name].knob} {best[name].value}".strip(), _number(best[name].miou))
        for name in captures
    ]
    return "<h2>The default, and the best of all that was tried</h2>" + _table(
        ("capture", *SCORES, "best of all", "its mIoU"), body
    )


def _defaults(rows: Sequence[Row], captures: Sequence[str]) -> str:
    """Why each default is where it is, and whether this run agrees."""
    body = []
    for knob in KNOBS:
        if any(row.knob == knob.name for row in rows):
            default = next((setting.value for setting in knob.values if setting.is_default), "")
            value = default or ("all" if knob.values[0].is_default else "of mode fast")
            body.append((knob.name, value, knob.why, _verdict(rows, captures, knob)))
    return "<h2>Why each default is where it is</h2>" + _table(
        ("setting", "default", "reason", "this run"), body, words=4
    )


def _verdict(rows: Sequence[Row], captures: Sequence[str], knob: Knob) -> str:
    """Settings that are clearly faster and no worse, or better and no slower, by the captures they are that on."""
    beaten: dict[str, list[str]] = {}
    for capture in captures:
        own = [row for row in rows if row.capture == capture]
        default = next(row for row in own if row.is_default)
        for row in own:
            faster = row.seconds_most < (1 - WITHIN) * default.seconds and error(row) <= error(default) + 1e-3
            better = error(row) < error(default) - 1e-3 and row.seconds <= (1 + WITHIN) * default.seconds_most
            if row.knob == knob.name and (faster or better):
                beaten.setdefault(row.value, []).append(capture)
    if not beaten:
        return "on the front everywhere"
    return "; ".join(f"{value} is as good or better on {', '.join(names)}" for value, names in beaten.items())


def _capture(report: Report, capture: str) -> str:
    rows = [row for row in report.rows if row.capture == capture]
    default = next(row for row in rows if row.is_default)
    fits = [row for row in rows if not is_asking(row)]
    asking = [row for row in rows if is_asking(row)]
    best = {id(row) for row in front(fits)}
    parts = [
        f"<h2>{escape(capture)}</h2>",
        _figure(_picture(report, capture), "Instances of the default fit over several views."),
        _figure(
            fit_plot(rows, capture), "Every setting of the fit, other methods on the same mask table, and the front."
        ),
        _table(
            ("setting", *SCORES, "differs", "instances", "peak MB", "runs"),
            [_fit_cells(row) for row in fits],
            marks=[("default " if row.is_default else "") + ("front" if id(row) in best else "") for row in fits],
        ),
        "<h3>What this fit left out, and what it costs to force it back in</h3>",
        _table(
            ("left out", "because", "forced back"),
            [(entry["what"], entry["why"], _forced(rows, default, entry["what"])) for entry in default.left_out],
            words=3,
        ),
    ]
    if asking:
        parts += [
            "<h3>Asking the finished file</h3>",
            _figure(asking_plot(rows, capture), "Looking up the instance of a point, against the exact nearest point."),
            _table(
                ("setting", "mIoU", "differs from exact", "ms least", "ms most"),
                [
                    (f"{row.knob}: {row.value}", _number(row.miou), f"{row.disagreement:.4%}",
                     f"{1e3 * row.seconds:.2f}", f"{1e3 * row.seconds_most:.2f}")
                    for row in asking
                ],
            ),
        ]  # fmt: skip
    if not all(row.runs_alike for row in rows):
        different = ", ".join(f"{row.knob} {row.value}" for row in rows if not row.runs_alike)
        parts.append(f"<p><b>Runs differ in their labels: {escape(different)}.</b></p>")
    elif default.runs > 1:
        parts.append(f"<p class=small>All {default.runs} runs of every fit gave every point the same label.</p>")
    return "\n".join(parts)


def _forced(rows: Sequence[Row], default: Row, what: str) -> str:
    """What the fit with it took and reached, against the default's."""
    named = {setting.value for words, setting in FORCED if words in what}
    forced = [row for row in rows if row.knob == "left out" and row.value in named]
    return (
        "; ".join(
            f"{row.value}: {row.seconds - default.seconds:+.1f} s, error {error(row) - error(default):+.4f}"
            for row in forced
        )
        or "not forced"
    )


def _picture(report: Report, capture: str) -> bytes:
    scene = read_capture(report.folders[capture])
    prepared = prepare(scene)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "instances.png"
        ids = {"instances": report.clouds[capture].instance_ids}
        instance_picture(prepared.gaussians, scene.views, prepared.near, ids, path, columns=4)
        return path.read_bytes()


SCORES = ("seconds", "mIoU", "mAcc", "unknown", "background called")


def _scores(row: Row) -> tuple[str, ...]:
    return _seconds(row), _number(row.miou), _number(row.macc), _number(row.unknown), _number(row.background)


def _fit_cells(row: Row) -> tuple[str, ...]:
    name = "the default" if row.is_default else f"{row.knob}: {row.value}"
    differs = "" if row.is_default else f"{row.disagreement:.2%}"
    memory = "" if math.isnan(row.peak_mb) else f"{row.peak_mb:.0f}"
    return name, *_scores(row), differs, str(row.instances or ""), memory, str(row.runs)


def _seconds(row: Row) -> str:
    alone = row.seconds_most <= row.seconds
    return f"{row.seconds:.2f}" if alone else f"{row.seconds:.2f} to {row.seconds_most:.2f}"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.4f}"


def _fits(rows: Sequence[Row], capture: str) -> list[Row]:
    return [row for row in rows if row.capture == capture and not is_asking(row) and row.knob != "baseline"]


def _table(
    header: Sequence[str], body: Iterable[Sequence[str]], words: int = 1, marks: Sequence[str] | None = None
) -> str:
    """words: columns from the left that hold text. marks: a class of each line."""

    def line(cells: Sequence[str], kind: str = "td", mark: str = "") -> str:
        filled = (
            f"<{kind}{' class=word' if index < words else ''}>{escape(cell)}</{kind}>"
            for index, cell in enumerate(cells)
        )
        return f'<tr class="{mark}">{"".join(filled)}</tr>'

    lines = [line(cells, mark=marks[index] if marks else "") for index, cells in enumerate(body)]
    return f"<table>{line(header, 'th')}{''.join(lines)}</table>" if lines else "<p class=small>nothing</p>"


def _figure(png: bytes, caption: str) -> str:
    data = base64.b64encode(png).decode()
    image = f'<img src="data:image/png;base64,{data}" alt="{escape(caption)}">'
    return f"<figure>{image}<figcaption>{escape(caption)}</figcaption></figure>"
