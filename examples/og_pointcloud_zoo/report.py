"""The zoo's rows as text, as a CSV and as a picture: choosing and judging side by side."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np
from scipy.stats import spearmanr

from og_pointcloud.evaluate.sweep_report import require_matplotlib
from og_pointcloud.formats.atomic import replacing, write_file
from og_pointcloud.formats.tables import csv_text
from og_pointcloud_zoo.measure import Row

HALVES = {"choose": "for choosing", "judge": "for judging alone"}
COLORS = {"choose": "tab:blue", "judge": "tab:orange"}
UNITS = {
    "views": "views",
    "points": "points, share kept",
    "noise": "noise of points, spacings",
    "strays": "strays, share of points",
    "poses": "poses off by, pixels",
    "masks": "masks missing, share",
    "eroded": "masks end early by, pixels",
    "exposure": "exposure off by, share",
}
SHOWN = 5


def line(row: Row) -> str:
    """One scene on one line."""
    background = "   -  " if row.background is None else f"{100 * row.background:5.2f}%"
    text = f"{row.scene:22} {row.half:6} {row.points:9,} {row.views:4} {row.miou:6.3f} {background} {row.seconds:6.1f}"
    text += "".join("      -" if of is None else f" {of:6.3f}" for of in (row.recall, row.precision, row.reliability))
    if row.baseline is None or row.gain is None:
        return text
    gain = f"{row.gain:+.3f} ({row.gain_low:+.3f} to {row.gain_high:+.3f})"
    return f"{text}  {row.baseline_miou:.3f} {row.baseline:30} {gain}"


HEADER = (
    f"{'scene':22} {'half':6} {'points':>9} {'view':>4} {'mIoU':>6} {'called':>6} {'s':>6} {'recall':>6} {'precis':>6} "
    f"{'relia.':>6}  best baseline"
)


def summary(rows: Sequence[Row]) -> str:
    """Means, worst and best of each half, and how well a fit's reliability ranks the scenes."""
    parts: list[str] = []
    for half, title in HALVES.items():
        chosen = sorted((row for row in rows if row.half == half), key=lambda row: row.miou)
        if not chosen:
            continue
        parts.append(f"\n{len(chosen)} scenes {title}: {_means(chosen)}")
        if len(chosen) > 2 * SHOWN:
            parts += ["worst", *(f"  {line(row)}" for row in chosen[:SHOWN])]
            parts += ["best", *(f"  {line(row)}" for row in chosen[-SHOWN:])]
    return "\n".join(parts)


def _means(rows: Sequence[Row]) -> str:
    called = [row.background for row in rows if row.background is not None]
    text = f"mean mIoU {np.mean([row.miou for row in rows]):.4f}"
    if called:
        above = sum(share >= 0.01 for share in called)
        text += f", background called {100 * np.mean(called):.2f} % ({above} of {len(called)} scenes 1 % or more)"
    text += f", {sum(row.seconds for row in rows):.0f} s"
    text += f" ({sum(row.core_seconds for row in rows):.0f} s of cores)"
    things = [(row.recall, row.precision) for row in rows if row.recall is not None and row.precision is not None]
    if things:
        text += "; instances: recall {:.3f}, precision {:.3f}".format(*np.mean(things, axis=0))
    best = [row.baseline_miou for row in rows if row.baseline_miou is not None]
    if best:
        lost = [row.scene for row in rows if row.gain_high is not None and row.gain_high < 0]
        text += f"; best baselines {np.mean(best):.4f}, better than ours beyond the interval on {len(lost)}"
        text += f": {', '.join(lost)}" if lost else ""
    said = [(row.reliability, row.miou) for row in rows if row.reliability is not None]
    if len(said) > 2:
        text += f"; rank correlation of reliability and mIoU {spearmanr(said).statistic:.2f}"
    return text


def needs_table(rows: Sequence[Row]) -> str:
    """Means over the scenes for each way and amount of making them worse, in that order: Markdown."""
    text = "| made worse | mIoU | best baseline | background called | unknown | reliability |\n"
    text += "| --- | ---: | ---: | ---: | ---: | ---: |\n"
    for worse in dict.fromkeys(row.worse for row in rows):
        of = [row for row in rows if row.worse == worse]
        figures = [_mean([getattr(row, name) for row in of]) for name in ("miou", "baseline_miou")]
        figures.append(_mean([row.background for row in of], "{:.1%}"))
        figures += [_mean([getattr(row, name) for row in of]) for name in ("unknown", "reliability")]
        text += f"| {worse or 'as it is'} | {' | '.join(figures)} |\n"
    return text


def _mean(values: Iterable[float | None], form: str = "{:.3f}") -> str:
    known = [value for value in values if value is not None]
    return form.format(np.mean(known)) if known else "-"


def write_needs(rows: Sequence[Row], path: Path) -> Path:
    """Mean mIoU, ours and of the best baselines, against how much worse the scenes were made: one plot per way."""
    kinds = list(dict.fromkeys(row.worse.partition("=")[0] for row in rows if row.worse))
    figure = require_matplotlib()(figsize=(11, 6), layout="constrained")
    columns = -(-len(kinds) // 2)
    of_kind = figure.subplots(2, columns, sharey=True, squeeze=False).ravel()
    for unused in of_kind[len(kinds) :]:
        unused.set_axis_off()
    for axes, kind in zip(of_kind, kinds, strict=False):
        steps = ["", *dict.fromkeys(row.worse for row in rows if row.worse.startswith(f"{kind}="))]
        for label, name in (("ours", "miou"), ("best baseline", "baseline_miou")):
            means = [[getattr(row, name) for row in rows if row.worse == step] for step in steps]
            if None not in means[0]:
                axes.plot(range(len(steps)), [np.mean(values) for values in means], marker="o", label=label)
        axes.set_xticks(range(len(steps)), ["as it is", *(step.partition("=")[2] for step in steps[1:])])
        axes.set(title=UNITS.get(kind, kind), ylim=(0, 1), ylabel="mean mIoU" if axes in of_kind[::columns] else "")
        axes.grid(alpha=0.3)
    of_kind[0].legend(fontsize=9, frameon=False)
    with replacing(path) as file:
        figure.savefig(file, format="png", dpi=100)
    return path


def write_csv(rows: Sequence[Row], path: Path) -> Path:
    """One line per scene; written completely or not at all."""
    return write_file(path, csv_text([asdict(row) for row in rows]).encode())


def write_picture(rows: Sequence[Row], path: Path) -> Path:
    """Ours against the best baseline, error against seconds, and mIoU against the fit's reliability."""
    figure = require_matplotlib()(figsize=(15, 5), layout="constrained")
    ours, cost, own = figure.subplots(1, 3)
    for half, title in HALVES.items():
        chosen = [row for row in rows if row.half == half]
        style = {"color": COLORS[half], "label": title, "ls": "", "marker": "o", "ms": 5, "alpha": 0.8}
        beside = [row for row in chosen if row.baseline_miou is not None]
        ours.plot([row.baseline_miou for row in beside], [row.miou for row in beside], **style)
        cost.plot([row.seconds for row in chosen], [1 - row.miou for row in chosen], **style)
        said = [row for row in chosen if row.reliability is not None]
        if len(said) > 2:
            rank = spearmanr([(row.reliability or 0, row.miou) for row in said]).statistic
            style["label"] = f"{title}: rank correlation {rank:.2f}"
        own.plot([row.reliability for row in said], [row.miou for row in said], **style)
    ours.axline((0.5, 0.5), slope=1, color="0.6", lw=1)
    ours.set(xlabel="mIoU, best baseline", ylabel="mIoU, ours", title="Each scene beside its best baseline")
    cost.set(xlabel="seconds of the fit", ylabel="error, 1 - mIoU", xscale="log", title="Error against seconds")
    for set_formatter in (cost.xaxis.set_major_formatter, cost.xaxis.set_minor_formatter):
        set_formatter("{x:g}")  # 20, not 2 x 10^1
    own.set(xlabel="reliability, which needs no truth", ylabel="mIoU", title="What a fit says of itself")
    for axes in (ours, cost, own):
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8, frameon=False)
    with replacing(path) as file:
        figure.savefig(file, format="png", dpi=110)
    return path
