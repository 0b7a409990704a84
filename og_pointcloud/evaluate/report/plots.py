"""Error against seconds, time logarithmic: a panel a knob with its default ringed, over all captures and of each."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from og_pointcloud.evaluate.plots import require_matplotlib
from og_pointcloud.evaluate.report.judging import (
    base_row,
    error,
    fits_of,
    front,
    is_asking,
    knob_reasons,
    mean_over_captures,
)
from og_pointcloud.evaluate.report.measure import Row

__all__ = ["asking_plot", "fit_plot", "knob_plot", "mean_plot"]

COLUMNS = 4
WIDTH, PANEL_HEIGHT = 11.0, 2.3
"""Inches; at 110 dots each the page's width."""
NOT_IN_ALL = ("seed", "seed of mode fast")
"""Knobs that would only repeat others' dots in the figure of all fits."""
DOT, RING, LINE, FAINT = "tab:blue", "black", "0.75", "0.8"
COLOURS = ("tab:blue", "tab:orange", "tab:green", "tab:red", "tab:purple", "tab:brown", "tab:pink", "tab:olive",
           "tab:cyan", "navy", "gold", "teal", "orchid", "slategrey", "lime")  # fmt: skip
MARKERS = "osD^vPX*<>hpd8"
NARROWEST_FACTOR, LEAST_RANGE = 1.25, 0.004
"""Of an axis of seconds and of errors: what differs by less than this is drawn close together."""
TICKS = (0, 0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1)


@dataclass(frozen=True)
class _Dot:
    name: str
    x: float
    y: float
    is_base: bool = False
    others: tuple[tuple[float, float], ...] = ()


def mean_plot(rows: Sequence[Row]) -> bytes:
    """PNG: every value of every knob over all captures, relative to its default, which is at (1, 0)."""
    panels = {}
    for knob, (default, _) in knob_reasons().items():
        means = mean_over_captures(rows, knob)
        if means and knob != "lookup":  # which has a figure of its own a capture
            dots = [_Dot(mean.value, mean.ratio, mean.error.mean, others=mean.points) for mean in means]
            panels[knob] = [_Dot(default, 1.0, 0.0, is_base=True), *dots]
    return _panels(panels, "seconds, of the default's", "error less the default's")


def knob_plot(rows: Sequence[Row], capture: str) -> bytes:
    """PNG: every knob of the fits of one capture, with the front of its own values."""
    panels = {}
    for knob, (default, _) in knob_reasons().items():
        own = [row for row in rows if (row.capture, row.knob) == (capture, knob) and not is_asking(row)]
        bases = {id(base): base for base in (base_row(rows, row) for row in own)}
        base_dots = [_Dot(default, base.seconds, error(base), is_base=True) for base in bases.values()]
        if own:
            panels[knob] = [*base_dots, *(_Dot(row.value, row.seconds, error(row)) for row in own)]
    return _panels(panels, "seconds of the whole fit", _error_name(fits_of(rows, capture)))


def fit_plot(rows: Sequence[Row], capture: str) -> bytes:
    """PNG of all fits of a capture and the other methods, in one: the default ringed, the front joined."""
    own = [row for row in rows if row.capture == capture and not is_asking(row) and row.knob not in NOT_IN_ALL]
    figure = require_matplotlib()(figsize=(WIDTH, 5.6), layout="constrained")
    axes = figure.subplots()
    for index, knob in enumerate(dict.fromkeys(row.knob for row in own if row.knob != "default")):
        of_knob = [row for row in own if row.knob == knob]
        axes.scatter(
            [row.seconds for row in of_knob], [error(row) for row in of_knob], s=34, zorder=3, label=knob,
            color=COLOURS[index % len(COLOURS)], marker=MARKERS[index % len(MARKERS)],
        )  # fmt: skip
    best = front(own)
    named = {id(row): row for row in (*best, *(row for row in own if row.knob == "baseline")) if not row.is_default}
    default = next(row for row in own if row.is_default)
    ring = {"s": 190, "facecolors": "none", "edgecolors": RING, "linewidths": 2, "zorder": 4}
    axes.scatter([default.seconds], [error(default)], label="the default", **ring)
    axes.step([row.seconds for row in best], [error(row) for row in best], where="post", color=LINE, label="front")
    axes.set_yscale("symlog", linthresh=1e-3)  # 0 where there is nothing but the default to compare with
    errors = [error(row) for row in own]
    axes.set_yticks(TICKS, [f"{tick:g}" for tick in TICKS])
    axes.set_ylim(min(errors) / 1.3, max(errors) * 1.3 + 1e-4)
    _log_seconds(axes, [row.seconds for row in own])
    axes.set(xlabel="seconds of the whole fit (log)", ylabel=_error_name(own))
    _plain(axes)
    names = {key: row.value if row.knob == "baseline" else f"{row.knob} {row.value}" for key, row in named.items()}
    _name_dots(axes, [_Dot(names[key], row.seconds, error(row)) for key, row in named.items()], 7)
    axes.legend(fontsize=7.5, loc="center left", bbox_to_anchor=(1, 0.5), frameon=False)
    return _png(figure)


def asking_plot(rows: Sequence[Row], capture: str) -> bytes:
    """PNG of the ways to look points up: share of points off the exact answer against milliseconds."""
    own = [row for row in rows if row.capture == capture and row.knob == "lookup"]
    figure = require_matplotlib()(figsize=(WIDTH, 3.2), layout="constrained")
    axes = figure.subplots()
    for index, row in enumerate(own):
        look = {"color": COLOURS[index % len(COLOURS)], "marker": MARKERS[index % len(MARKERS)]}
        axes.scatter([1e3 * row.seconds], [100 * error(row)], s=60, label=row.value, zorder=3, **look)
    base = base_row(rows, own[0])
    ring = {"s": 190, "facecolors": "none", "edgecolors": RING, "linewidths": 2, "zorder": 4}
    axes.scatter([1e3 * base.seconds], [100 * error(base)], label="the default", **ring)
    axes.set_ylim(-0.06 * max([100 * error(row) for row in own] + [0.1]))
    _log_seconds(axes, [1e3 * row.seconds for row in own])
    axes.set(xlabel="milliseconds for 300,000 points (log)", ylabel="% of points off the exact answer")
    _plain(axes)
    axes.legend(fontsize=8, loc="center left", bbox_to_anchor=(1, 0.5), frameon=False)
    return _png(figure)


def _panels(panels: dict[str, list[_Dot]], across: str, up: str) -> bytes:
    lines = -(-len(panels) // COLUMNS)
    figure = require_matplotlib()(figsize=(WIDTH, 0.5 + PANEL_HEIGHT * max(1, lines)), layout="constrained")
    grid = figure.subplots(max(1, lines), COLUMNS, squeeze=False).ravel()
    for axes, (knob, dots) in zip(grid, panels.items(), strict=False):
        _panel(axes, knob, dots)
    for axes in grid[len(panels) :]:
        axes.set_visible(False)
    figure.supxlabel(f"{across} (log)", fontsize=10)
    figure.supylabel(up, fontsize=10)
    return _png(figure)


def _panel(axes: Any, title: str, dots: Sequence[_Dot]) -> None:
    for dot in dots:
        axes.plot(*zip(*dot.others, strict=True), ".", ms=4, color=FAINT, zorder=1) if dot.others else None
    best, least = [], np.inf
    for dot in sorted(dots, key=lambda dot: (dot.x, dot.y)):
        if dot.y < least:
            best, least = [*best, dot], dot.y
    axes.step([dot.x for dot in best], [dot.y for dot in best], where="post", color=LINE, lw=1.2, zorder=2)
    own = [dot for dot in dots if not dot.is_base]
    axes.scatter([dot.x for dot in own], [dot.y for dot in own], s=22, color=DOT, zorder=3)
    base = [dot for dot in dots if dot.is_base]
    ring = {"s": 90, "facecolors": "none", "edgecolors": RING, "linewidths": 1.6, "zorder": 4}
    axes.scatter([dot.x for dot in base], [dot.y for dot in base], **ring)
    every = [place for dot in dots for place in ((dot.x, dot.y), *dot.others)]
    _log_seconds(axes, [x for x, _ in every])
    low, high = min(y for _, y in every), max(y for _, y in every)
    room = max(LEAST_RANGE, high - low)
    middle = (low + high) / 2
    axes.set_ylim(middle - 0.68 * room, middle + 0.78 * room)
    axes.yaxis.set_major_locator(_locator(4))
    axes.tick_params(labelsize=7)
    axes.set_title(title, fontsize=9.5, fontweight="bold")
    _plain(axes)
    _name_dots(axes, [*base[:1], *own], 6.5)


def _name_dots(axes: Any, dots: Sequence[_Dot], size: float) -> None:
    """Names beside their dots; those of dots that nearly coincide stand together, and no name covers another."""
    to_share = axes.transData + axes.transAxes.inverted()
    places = [tuple(to_share.transform((dot.x, dot.y))) for dot in dots]
    box, figure = axes.get_position(), axes.figure.get_size_inches()
    wide, high = box.width * figure[0], box.height * figure[1]  # inches; before the layout they are about these
    line, aside = 1.45 * size / 72 / high, 0.07 / wide
    taken: list[tuple[float, float, float]] = []
    for names, (x, y), is_base in sorted(
        _together(dots, places, (0.2 / wide, 0.1 / high)), key=lambda one: (not one[2], -one[1][1])
    ):
        width = 0.56 * size / 72 * len(names) / wide
        leftwards = x + aside + width > 1.05 and x - width > -0.1
        start = x - aside - width if leftwards else x + aside
        height = y + line / 2
        while any(abs(height - h) < line and start < end and begin < start + width for begin, end, h in taken):
            height -= line / 3
        taken.append((start, start + width, height))
        axes.text(
            x + (-aside if leftwards else aside), height, names, transform=axes.transAxes, fontsize=size, va="center",
            ha="right" if leftwards else "left", zorder=5, color=RING if is_base else "0.3",
            fontweight="bold" if is_base else "normal", in_layout=False,
        )  # fmt: skip


def _together(
    dots: Sequence[_Dot], places: Sequence[tuple[float, float]], near: tuple[float, float]
) -> list[tuple[str, tuple[float, float], bool]]:
    """Names of dots that nearly coincide, joined; the base's stands alone."""
    groups: list[tuple[list[str], tuple[float, float], bool]] = []
    for dot, (x, y) in zip(dots, places, strict=True):
        others = (one for one in groups if not (one[2] or dot.is_base) and abs(one[1][0] - x) < near[0])
        group = next((one for one in others if abs(one[1][1] - y) < near[1]), None)
        if group is None:
            groups.append(([dot.name], (x, y), dot.is_base))
        else:
            group[0].append(dot.name)
    return [(" · ".join(names), place, is_base) for names, place, is_base in groups]


def _log_seconds(axes: Any, seconds: Sequence[float]) -> None:
    """A logarithmic axis that names a few round figures however narrow it is."""
    low, high = min(seconds), max(seconds)
    widen = max(1.0, np.sqrt(NARROWEST_FACTOR * low / high)) * (high / low) ** 0.12
    low, high = low / widen, high * widen
    axes.set_xscale("log")
    axes.set_xlim(low, high)
    digits = (1, 2, 5) if high / low > 6 else (1, 1.5, 2, 3, 4, 5, 7)
    ticks = [d * 10.0**e for e in range(-6, 7) for d in digits if low <= d * 10.0**e <= high]
    if len(ticks) < 2:
        ticks = [tick for tick in _locator(3).tick_values(low, high) if low <= tick <= high]
    axes.set_xticks(ticks, [f"{tick:.4g}" for tick in ticks])
    axes.set_xticks([], minor=True)


def _locator(count: int) -> Any:
    from matplotlib.ticker import MaxNLocator

    return MaxNLocator(count)


def _plain(axes: Any) -> None:
    axes.grid(alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)


def _error_name(rows: Sequence[Row]) -> str:
    if all(row.miou is not None for row in rows):
        return "error, 1 - mIoU"
    return "disagreement with the " + ("default" if any(row.off_exact is None for row in rows) else "exact answer")


def _png(figure: Any) -> bytes:
    data = io.BytesIO()
    figure.savefig(data, format="png", dpi=110)
    return data.getvalue()
