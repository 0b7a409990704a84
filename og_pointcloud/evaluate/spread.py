"""How sure a score is, and what abstaining buys: bootstrap intervals of paired scores, risk against coverage."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.errors import OgPointcloudError

__all__ = ["Interval", "RiskCoverage", "bootstrap", "paired_bootstrap", "risk_coverage"]

Doubles = NDArray[np.float64]

DRAWS = 10_000
CHUNK = 1 << 22
"""Drawn values held at once."""


@dataclass(frozen=True)
class Interval:
    """A mean and the middle 95 % of its bootstrap distribution (Efron's percentile interval)."""

    mean: float
    low: float
    high: float


@dataclass(frozen=True)
class RiskCoverage:
    """coverage: (k,) share of points answered, ascending to 1. risk: (k,) share of these that is wrong. area: of the
    curve, the mean risk over all coverages; lower is better, and confidences that order well lower it."""

    coverage: Doubles
    risk: Doubles
    area: float


def bootstrap(scores: NDArray[np.floating], seed: int = 0, draws: int = DRAWS) -> Interval:
    """Of the mean of n items' scores (scenes, or frame-object pairs): items are drawn again, with replacement.

    A NaN item has no score and is left out before. One item alone has no spread; none at all is an error.
    """
    values = np.asarray(scores, np.float64)
    values = values[np.isfinite(values)]
    if values.ndim != 1 or len(values) == 0:
        raise OgPointcloudError("no finite score to draw from; expected one or more")
    random = np.random.default_rng(seed)
    step = max(1, CHUNK // len(values))
    means = [
        values[random.integers(0, len(values), (min(step, draws - start), len(values)))].mean(axis=1)
        for start in range(0, draws, step)
    ]
    low, high = np.percentile(np.concatenate(means), (2.5, 97.5))
    return Interval(float(values.mean()), float(low), float(high))


def paired_bootstrap(
    first: NDArray[np.floating], second: NDArray[np.floating], seed: int = 0, draws: int = DRAWS
) -> Interval:
    """Of the mean difference ``first - second`` of two methods on the same items; far narrower than two intervals,
    since hard items are hard for both. Items that either has no score for are left out."""
    a, b = np.asarray(first, np.float64), np.asarray(second, np.float64)
    if a.shape != b.shape:
        raise OgPointcloudError(f"scores have shapes {a.shape} and {b.shape}; expected both methods on the same items")
    return bootstrap(a - b, seed, draws)


def risk_coverage(correct: NDArray[np.bool_], confidence: NDArray[np.floating]) -> RiskCoverage:
    """Answering the surest points first: share answered against share wrong. Equal confidences are answered together.

    correct: (n,) bool. confidence: (n,), larger is surer; -inf for what is answered last of all.
    """
    if correct.shape != confidence.shape or correct.ndim != 1 or len(correct) == 0:
        raise OgPointcloudError(f"{correct.shape} answers with confidences {confidence.shape}; expected n >= 1 of both")
    order = np.argsort(-confidence, kind="stable")
    ordered = confidence[order]
    last = np.flatnonzero(np.append(ordered[1:] != ordered[:-1], True))
    answered = last + 1
    wrong = np.cumsum(~correct[order])[last]
    risk = wrong / answered
    # Within a group of equal confidence any order is as likely: the curve runs straight from group to group.
    coverage = answered / len(correct)
    area = float(np.sum(risk * np.diff(coverage, prepend=0.0)))
    return RiskCoverage(coverage, risk, area)
