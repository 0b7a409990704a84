"""What the features of two masks say of whether they show one thing: it depends on how masks are named in this scene.

One detector names a chair a chair in all of its masks; another names every third mask of it something else. To the
first two unlike masks are two things, to the second they tell little. Masks of the same extent are one thing whatever
their features say, and two masks of one view are mostly two. So with s and d, the shares of the pairs of the one kind
and of the other that are less alike than two masks, features make it

    L = s (1 - s) / d (1 - d)

times likelier that these two are one thing: in the middle of the pairs of one thing, at the end of the others, it is
large. What lies within another mask may be a part of its thing, or a thing of its own (the cup on the table) that its
view missed. Which of the two masks that most views show so are, their features tell for all of them together: the part
pi of them that are one thing is the one that makes their L likeliest (expectation maximization). Where that is less
than views say, p on average, their odds are believed ``trust`` times: pi / (1 - pi) to p / (1 - p), at most 1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.kernels import njit

ROUNDS = 50
"""Of expectation maximization of one number: from one half to .98 it is there in fewer than half of them."""
MOST_ODDS = 4.0
"""Odds at which views that all show two masks in one are believed where these are not alike: views miss alike."""


@dataclass(frozen=True)
class FeatureOdds:
    """same, different: cosines of pairs of masks of one thing, and of two, ascending. trust: in [0, 1]."""

    same: NDArray[np.float64]
    different: NDArray[np.float64]
    trust: float


def feature_odds(
    features: NDArray[np.floating],
    mask_view: NDArray[np.int32],
    same: tuple[NDArray[np.int32], NDArray[np.int32]],
    within: tuple[NDArray[np.int32], NDArray[np.int32]],
    shares: NDArray[np.float64],
) -> FeatureOdds:
    """The odds of a scene. features: (masks, D) unit rows, zero rows for masks without one, which say nothing. same:
    pairs of masks of one extent; within: pairs that most views show in one mask. shares: the part of the views, of
    each of these, that do so."""
    described = features.any(axis=1)
    different = cosines_of_different(features[described], mask_view[described])
    alike = np.sort(_cosines(features, *same)[described[same[0]] & described[same[1]]])
    known = described[within[0]] & described[within[1]]
    ratio = np.array([_ratio(cosine, alike, different) for cosine in _cosines(features, *within)[known]])
    if not len(ratio):
        return FeatureOdds(alike, different, 1.0)
    one = 0.5
    for _ in range(ROUNDS):
        # As if two more pairs were known, one of either kind.
        one = ((one * ratio / (one * ratio + 1 - one)).sum() + 1) / (len(ratio) + 2)
    said = np.minimum(shares[known], MOST_ODDS / (MOST_ODDS + 1)).mean()
    return FeatureOdds(alike, different, float(min(1, one / (1 - one) * (1 - said) / said)))


def cosines_of_different(features: NDArray[np.floating], mask_view: NDArray[np.int32]) -> NDArray[np.float64]:
    """Cosines of the features of two masks of one view, ascending. These are mostly different things, whatever the
    encoder: they calibrate its cosines."""
    cosines = [np.zeros(0)]
    for view in np.unique(mask_view):
        rows = features[mask_view == view][:200]  # 20,000 pairs of a view are enough
        cosines.append((rows @ rows.T)[np.triu_indices(len(rows), 1)])
    return np.sort(np.concatenate(cosines))


def _cosines(features: NDArray[np.floating], rows: NDArray[np.int32], cols: NDArray[np.int32]) -> NDArray[np.float64]:
    """Of pairs of masks; in parts, as pairs are many and features long."""
    found = np.empty(len(rows))
    for low in range(0, len(rows), 1 << 12):
        part = slice(low, low + (1 << 12))
        found[part] = (features[rows[part]].astype(np.float64) * features[cols[part]]).sum(axis=1)
    return found


@njit(cache=True)
def odds(cosine, same, different, trust):  # noqa: ANN001, ANN201
    """How far views are believed that show two masks of this cosine in one, in [0, 1]."""
    return min(1.0, trust * _ratio(cosine, same, different))


@njit(cache=True)
def _ratio(cosine, same, different):  # noqa: ANN001, ANN202
    """L of this cosine."""
    of_same, of_different = _share_below(cosine, same), _share_below(cosine, different)
    return of_same * (1 - of_same) / (of_different * (1 - of_different))


@njit(cache=True)
def _share_below(cosine, cosines):  # noqa: ANN001, ANN202
    """The share of these that are lower, as if one more were half so; never 0 or 1."""
    # The mean of the numbers with and without equal ones; cosines within rounding are equal.
    below = np.searchsorted(cosines, cosine - 1e-6, "left") + np.searchsorted(cosines, cosine + 1e-6, "right")
    return (0.5 * below + 0.5) / (len(cosines) + 1)
