"""Error against seconds: one panel a capture, every setting a dot, defaults ringed, the front joined."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Any

from og_pointcloud.report.measure import Row
from og_pointcloud.report.sweep import error, front
from og_pointcloud.scoring.plots import require_matplotlib

__all__ = ["asking_plot", "fit_plot", "is_asking"]

ASKING = ("lookup", "descriptors", "text")
"""Knobs of the finished file, whose seconds are of one frame."""
COLOURS = (
    "tab:blue",
    "tab:orange",
    "tab:green",
    "tab:red",
    "tab:purple",
    "tab:brown",
    "tab:pink",
    "tab:olive",
    "tab:cyan",
    "navy",
    "gold",
    "teal",
)
MARKERS = "osD^vPX*<>hp"

TICKS = (0, 0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1)


def is_asking(row: Row) -> bool:
    """Whether a row is of the finished file, not of a fit."""
    return row.knob in ASKING


def fit_plot(rows: Sequence[Row], capture: str) -> bytes:
    """PNG of a capture's fits: error (1 - mIoU, or disagreement with the default) against seconds, logarithmic."""
    own = [row for row in rows if row.capture == capture and not is_asking(row)]
    figure = require_matplotlib()(figsize=(9, 5), layout="constrained")
    axes = figure.subplots()
    knobs = list(dict.fromkeys(row.knob for row in own if row.knob != "default"))
    for index, knob in enumerate(knobs):
        of_knob = [row for row in own if row.knob == knob]
        axes.scatter(
            [row.seconds for row in of_knob], [error(row) for row in of_knob], s=34, zorder=3, label=knob,
            color=COLOURS[index % len(COLOURS)], marker=MARKERS[index % len(MARKERS)],
        )  # fmt: skip
        for row in of_knob:
            axes.annotate(
                row.value, (row.seconds, error(row)), (4, 4), textcoords="offset points", fontsize=6, color="0.35"
            )
    default = next(row for row in own if row.is_default)
    axes.scatter(
        [default.seconds],
        [error(default)],
        s=190,
        facecolors="none",
        edgecolors="black",
        linewidths=2,
        zorder=4,
        label="the default",
    )
    best = front(own)
    axes.step(
        [row.seconds for row in best], [error(row) for row in best], where="post", color="0.7", zorder=1, label="front"
    )
    known = default.miou is not None
    axes.set_yscale("symlog", linthresh=1e-3)  # 0 where there is nothing but the default to compare with
    errors = [error(row) for row in own]
    axes.set_yticks(TICKS, [f"{tick:g}" for tick in TICKS])
    axes.set_ylim(min(errors) / 1.3, max(errors) * 1.3 + 1e-4)
    _finish(axes, capture, "seconds of the whole fit", "error, 1 - mIoU" if known else "disagreement with the default")
    return _png(figure)


def asking_plot(rows: Sequence[Row], capture: str) -> bytes:
    """PNG of the ways to look points up: share of points that differ from the exact answer against milliseconds."""
    own = [row for row in rows if row.capture == capture and row.knob == "lookup"]
    figure = require_matplotlib()(figsize=(9, 3.4), layout="constrained")
    axes = figure.subplots()
    for index, row in enumerate(own):
        axes.scatter(
            [1e3 * row.seconds],
            [100 * row.disagreement],
            s=60,
            color=COLOURS[index],
            marker=MARKERS[index],
            label=row.value,
            zorder=3,
        )
    axes.set_ylim(bottom=-0.05 * max([100 * row.disagreement for row in own] + [0.1]))
    _finish(axes, capture, "milliseconds for 300,000 points", "% of points off the exact answer")
    return _png(figure)


def _finish(axes: Any, title: str, across: str, up: str) -> None:
    axes.set(xscale="log", xlabel=f"{across} (log)", ylabel=up, title=title)
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.xaxis.set_minor_formatter(lambda value, _: f"{value:g}" if f"{value:e}"[0] in "25" else "")
    axes.grid(alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(fontsize=7, loc="center left", bbox_to_anchor=(1, 0.5), frameon=False)


def _png(figure: Any) -> bytes:
    data = io.BytesIO()
    figure.savefig(data, format="png", dpi=110)
    return data.getvalue()
