"""What rows are worth: beside the default and the exact answer, and whether each default lies on the front of its knob.

The front is Pareto's: a setting is on it where no other value of its knob is at least as fast and at least as good, and
better in one. Seconds vary from run to run, and an mIoU over the points of one scene has an interval: a default is
called *off* the front only where another value is faster beyond that noise and no worse, or surely better and no
slower; where it is beaten by less it is *within noise*.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.evaluate.intervals import Interval, bootstrap, miou_difference
from og_pointcloud.evaluate.metrics import adjusted_rand_index
from og_pointcloud.evaluate.report.asking import DEFAULTS as ASKED_DEFAULTS
from og_pointcloud.evaluate.report.asking import REASONS
from og_pointcloud.evaluate.report.knobs import EXACT, FAST, KNOBS, base_of
from og_pointcloud.evaluate.report.measure import Row, Subject
from og_pointcloud.evaluate.report.shared import ON_SHARED, Measured
from og_pointcloud.formats.capture import read_capture
from og_pointcloud.rendering.geometry import neighbourhood
from og_pointcloud.settings import GeometrySettings

__all__ = [
    "Mean",
    "Verdict",
    "base_row",
    "disagreement",
    "error",
    "fits_of",
    "front",
    "is_asking",
    "judged",
    "knob_reasons",
    "mean_over_captures",
    "noise_of",
    "verdict",
]

WITHIN = 0.05
"""Seconds that differ by less than this share are alike, whatever the runs say."""
SAME = 1e-9
"""Errors that differ by less are the same."""

Labels = NDArray[np.integer]


def judged(subject: Subject, measured: Sequence[Measured]) -> list[Row]:
    """The rows of one capture, held against its default, its exact answer, and the base of their knob."""
    labels = {(row.knob, row.value): found for row, found in measured if found is not None}
    default, exact = labels["default", ""], labels.get((EXACT.knob, EXACT.value))
    gains = _Gains(subject, default) if subject.truth is not None else None
    rows = []
    for row, found in measured:
        if found is not None:
            base = labels.get((FAST.knob, FAST.value), default) if base_of(row.knob) == FAST else default
            row = replace(
                row,
                disagreement=disagreement(found, default, subject),
                off_exact=None if exact is None else disagreement(found, exact, subject),
                **({} if gains is None else gains.over(found, base)),
            )
        rows.append(row)
    return rows


def disagreement(labels: Labels, others: Labels, subject: Subject) -> float:
    """How far labels are from others, in [0, 1]."""
    if subject.vocabulary is None:
        return 1 - adjusted_rand_index(labels, others)
    return float((labels != others).mean())


class _Gains:
    """Paired intervals over the blocks of space of one capture."""

    def __init__(self, subject: Subject, default: Labels) -> None:
        assert subject.truth is not None
        assert subject.vocabulary is not None
        points = read_capture(subject.folder).points
        self.truth, self.names, self.xyz = subject.truth, subject.vocabulary.names, points.xyz
        self.spacing = float(np.median(neighbourhood(points.xyz, GeometrySettings()).spacing))
        self.classes = self.truth.score(default, self.names).classes

    def over(self, labels: Labels, base: Labels) -> dict[str, Any]:
        """How much larger the mIoU of labels is than that of the base, as Row has it."""
        if (labels == base).all():
            return {"gain": 0.0, "gain_low": 0.0, "gain_high": 0.0}
        if not self.classes:
            return {}
        first, second = (self.truth.class_of(found, self.names) for found in (labels, base))
        interval = miou_difference(first, second, self.truth, self.xyz, self.spacing, self.classes)
        return {"gain": interval.mean, "gain_low": interval.low, "gain_high": interval.high}


def is_asking(row: Row) -> bool:
    """Whether a row is of the finished file, not of a fit."""
    return row.knob in ASKED_DEFAULTS


def error(row: Row) -> float:
    """1 - mIoU; where the truth is not known, and for the finished file, the disagreement with the exact answer; where
    that is not known either, with the default."""
    if row.miou is not None and not is_asking(row):
        return 1 - row.miou
    return row.disagreement if row.off_exact is None else row.off_exact


def fits_of(rows: Sequence[Row], capture: str) -> list[Row]:
    """The fits of one capture: no other methods, and nothing of the finished file."""
    return [row for row in rows if row.capture == capture and not is_asking(row) and row.knob != "baseline"]


def front(rows: Sequence[Row]) -> list[Row]:
    """Rows that no other beats in both seconds and error, by seconds (Pareto)."""
    best: list[Row] = []
    for row in sorted(rows, key=lambda row: (row.seconds, error(row))):
        if not best or error(row) < error(best[-1]):
            best.append(row)
    return best


def base_row(rows: Sequence[Row], row: Row) -> Row:
    """What a row is held against: the default of its knob, measured in the same way."""
    if is_asking(row):
        name = row.knob, ASKED_DEFAULTS[row.knob]
    elif base_of(row.knob) == FAST:
        name = FAST.knob, FAST.value
    else:
        name = ("default", ON_SHARED[row.shares].value if row.shares in ON_SHARED else "")
    own = [other for other in rows if other.capture == row.capture]
    found = {(other.knob, other.value): other for other in own}
    return found.get(name) or found["default", ""]


def noise_of(base: Row, rows: Sequence[Row]) -> float:
    """The share by which seconds differ from run to run: of the base's runs, or of the default's."""
    own = [base] if is_asking(base) else [row for row in rows if row.capture == base.capture and row.knob == "default"]
    return max([WITHIN, *(row.seconds_most / row.seconds - 1 for row in own)])


@dataclass(frozen=True)
class Verdict:
    """Where the default of a knob stands on one capture. by: the value that beats it most, None on the front.
    saved: the share of the default's seconds that value saves. error: its error less the default's."""

    capture: str
    knob: str
    state: Literal["front", "noise", "off"]
    by: Row | None = None
    saved: float = 0.0
    error: float = 0.0


def verdict(rows: Sequence[Row], capture: str, knob: str) -> Verdict | None:
    """Of one knob on one capture; None where it was not tried there."""
    tried = [row for row in rows if row.capture == capture and row.knob == knob]
    found: list[Verdict] = []
    for row in tried:
        base = base_row(rows, row)
        if base is row:
            continue
        noise, saved, more = noise_of(base, rows), 1 - row.seconds / base.seconds, error(row) - error(base)
        more = 0.0 if abs(more) < SAME else more
        surely_better = more < 0 if row.gain_low is None else row.gain_low > 0
        if (saved > noise and more <= 0) or (surely_better and saved > -noise):
            found.append(Verdict(capture, knob, "off", row, saved, more))
        elif saved >= 0 and more <= 0 and (saved > 0 or more < 0):
            found.append(Verdict(capture, knob, "noise", row, saved, more))
        else:
            found.append(Verdict(capture, knob, "front"))
    order = ("front", "noise", "off")
    return max(found, key=lambda one: (order.index(one.state), one.saved - one.error), default=None)


@dataclass(frozen=True)
class Mean:
    """A value over all captures on which it was tried. ratio: of its seconds to the default's, geometric mean. error:
    less the default's, mean, with its 95 % bootstrap interval over captures. points: (ratio, error) of each."""

    knob: str
    value: str
    ratio: float
    error: Interval
    points: tuple[tuple[float, float], ...]


def mean_over_captures(rows: Sequence[Row], knob: str) -> list[Mean]:
    """Every value of a knob but its default, in the order they were tried."""
    means = []
    for value in dict.fromkeys(row.value for row in rows if row.knob == knob):
        pairs = [(row, base_row(rows, row)) for row in rows if (row.knob, row.value) == (knob, value)]
        points = [(row.seconds / base.seconds, error(row) - error(base)) for row, base in pairs if row is not base]
        if points:
            ratios, errors = np.array(points).T
            ratio = float(np.exp(np.log(ratios).mean()))
            means.append(Mean(knob, value, ratio, bootstrap(errors), tuple(points)))
    return means


def knob_reasons() -> dict[str, tuple[str, str]]:
    """knob -> (its default, why it is there), of fits and of the finished file, in the order of the pipeline."""
    of_fits = {knob.name: (knob.default_value, knob.why) for knob in KNOBS}
    return of_fits | {knob: (value, REASONS[knob]) for knob, value in ASKED_DEFAULTS.items()}
