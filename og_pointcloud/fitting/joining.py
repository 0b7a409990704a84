"""Masks that witnesses call one thing -> groups, joined bottom-up, as far as what the masks show lets witnesses.

Masks of the same extent are one thing whatever their features say, and two masks of one view are mostly two. What lies
within another mask may be a part of its thing, or a thing of its own that the view missed: the cup on the table. Their
features tell, but how much depends on the scene: one detector names a chair a chair in all of its masks, another names
every third mask of it something else. So with s and d, the shares of the pairs of the one kind and of the other that
are less alike than two masks, features make it

    L = s (1 - s) / d (1 - d)

times likelier that these two are one thing: it is large in the middle of the pairs of one thing and at the end of those
of two. How many of the masks within others are one thing with them, their features tell together: the part pi that
makes all their L likeliest (expectation maximization). Where views say so of more of them, p on average, the views are
trusted the less, by pi / (1 - pi) to p / (1 - p).
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.kernels import njit

ROUNDS = 50
"""Of expectation maximization of one number: from one half to .98 it is there in fewer than half of them."""
MOST_ODDS = 4.0
"""Odds at which views that all show two masks in one are believed where these are not alike: views miss alike."""


@dataclass(frozen=True)
class Witnesses:
    """What views, and the tracker, say of pairs of masks.

    rows, cols: the pairs that any of them shows as one thing, both ways, rows ascending. one: how many say so.
    same_extent: how many of these count whatever the features say: all if the two masks have the same extent, else the
    tracker alone. speaks, hears: (masks, ...); speaks[i] @ hears[j] is how many witnesses say anything of a pair: views
    in which both have a container, or one does and the other is left out; and the tracker where both tracks are the
    same or were in one image.
    """

    rows: NDArray[np.int32]
    cols: NDArray[np.int32]
    one: NDArray[np.float64]
    same_extent: NDArray[np.float64]
    speaks: NDArray[np.float64]
    hears: NDArray[np.float64]


class FeatureOdds(NamedTuple):
    """same, different: cosines of pairs of masks of one thing, and of two, ascending. trust: in [0, 1], how far views
    are trusted that show one mask within another. most: odds, MOST_ODDS."""

    same: NDArray[np.float64]
    different: NDArray[np.float64]
    trust: float
    most: float


def join_masks(
    witnesses: Witnesses,
    features: NDArray[np.float32],
    mask_view: NDArray[np.int32],
    usable: NDArray[np.bool_],
    majority: float,
) -> NDArray[np.int64]:
    """Join the pair of groups with the most agreement until no majority is left; a group number per mask, -1 unused.

    The agreement of two groups is the share of their pooled witnesses that say "one thing"; those that show one mask
    within another are believed as far as features let them.
    Of pairs with the same agreement the one with more witnesses comes first, then the one with more similar features:
    the order of views and masks does not matter.
    """
    # A group's number is that of its lowest mask. Of features the sum and the number are kept, for means over pairs.
    w, everyone = witnesses, np.arange(len(usable) + 1)
    kept = np.flatnonzero(usable[w.rows] & usable[w.cols])
    links = np.searchsorted(w.rows[kept], everyone), w.cols[kept].astype(np.int64), w.one[kept], w.same_extent[kept]
    group, total = np.where(usable, everyone[:-1], -1), features.astype(np.float64)
    said = w.speaks.copy(), w.hears.copy(), total, features.any(axis=1).astype(np.float64)
    _join(group, links, said, feature_odds(witnesses, kept, total, mask_view, majority), majority)
    return _roots(group)


def feature_odds(
    witnesses: Witnesses,
    kept: NDArray[np.intp],
    features: NDArray[np.float64],
    mask_view: NDArray[np.int32],
    majority: float,
) -> FeatureOdds:
    """What features say in a scene. kept: the pairs of witnesses that are asked. features: (masks, D) unit rows; masks
    without one, zero rows, say nothing."""
    described: NDArray[np.bool_] = (features != 0).any(axis=1)
    different = cosines_of_different(features[described], mask_view[described])
    rows, cols = witnesses.rows[kept], witnesses.cols[kept]
    share = witnesses.one[kept] / _dots(rows, cols, witnesses.speaks, witnesses.hears)
    cosine, both = _dots(rows, cols, features, features), described[rows] & described[cols]
    extent = witnesses.same_extent[kept] > 0
    same = np.sort(cosine[both & extent])
    within = both & ~extent & (share > majority) & (mask_view[rows] != mask_view[cols])
    if not within.any():
        return FeatureOdds(same, different, 1.0, MOST_ODDS)
    ratio, one = _ratio(cosine[within], same, different), 0.5
    for _ in range(ROUNDS):
        # As if two more pairs were known, one of either kind.
        one = ((one * ratio / (one * ratio + 1 - one)).sum() + 1) / (len(ratio) + 2)
    said = np.minimum(share[within], MOST_ODDS / (MOST_ODDS + 1)).mean()
    return FeatureOdds(same, different, float(min(1, one / (1 - one) * (1 - said) / said)), MOST_ODDS)


def cosines_of_different(features: NDArray[np.floating], mask_view: NDArray[np.int32]) -> NDArray[np.float64]:
    """Cosines of the features of two masks of one view, ascending. These are mostly different things, whatever the
    encoder: they calibrate its cosines."""
    cosines = [np.zeros(0)]
    for view in np.unique(mask_view):
        rows = features[mask_view == view][:200]  # 20,000 pairs of a view are enough
        cosines.append((rows @ rows.T)[np.triu_indices(len(rows), 1)])
    return np.sort(np.concatenate(cosines))


@njit(cache=True)
def _join(group, links, said, scene, majority):  # noqa: ANN001, ANN202
    """Writes to ``group``, at first each mask's own number or -1, which lower one it was joined with.

    links: sparse rows of masks: (start, other masks, one, same extent). said: (speaks, hears, features, how many) of
    each mask; here they become the sums of groups. scene: `FeatureOdds`.
    """
    start, others, one, same_extent = links
    speaks, hears, features, described = said
    rows = [slice(start[a], start[a + 1]) for a in range(len(group))]
    linked = [(others[row], one[row], same_extent[row]) for row in rows]
    version, place = np.zeros(len(group), np.int64), np.full(len(group), -1)
    # Of pairs of groups, the best on top: minus agreement, witnesses and cosine, the two, and their versions then. (An
    # empty list of a known type, which numba needs.)
    heap = [(0.0, 0.0, 0.0, 0, 0, 0, 0) for _ in range(0)]
    for a in range(len(group)):
        _offer(heap, a, a, linked[a], said, version, scene, majority)
    while len(heap):
        _, _, _, a, b, seen_a, seen_b = heapq.heappop(heap)
        # Stale: one of the two has grown or joined another since it was offered; what it is now was offered anew.
        if version[a] != seen_a or version[b] != seen_b or group[a] != a or group[b] != b:
            continue
        # The higher number joins the lower one, which takes on all that either says.
        group[b] = a
        version[a] += 1
        speaks[a] += speaks[b]
        hears[a] += hears[b]
        features[a] += features[b]
        described[a] += described[b]
        linked[a] = _pooled(linked[a], linked[b], a, group, place)
        linked[b] = others[:0], one[:0], same_extent[:0]
        _offer(heap, a, -1, linked[a], said, version, scene, majority)


@njit(cache=True)
def _offer(heap, a, above, links, said, version, scene, majority):  # noqa: ANN001, ANN202
    """Puts on the heap the pairs of group a and those linked to it, of numbers above one, that most witnesses join."""
    speaks, hears, features, described = said
    for b, one, same_extent in zip(*links):  # noqa: B905
        asked = np.dot(speaks[b], hears[a])
        if b <= above or one / asked <= majority:  # features only ever take agreement away
            continue
        # The mean over pairs of masks, as the scene's cosines are of pairs: sums have less noise, and are more alike.
        pairs = described[a] * described[b]
        cosine = np.dot(features[a], features[b]) / pairs if pairs > 0 else 0.0
        agreed = _agreement(one, same_extent, asked, cosine if pairs > 0 else np.nan, scene)
        if agreed > majority:
            low, high = min(a, b), max(a, b)
            heapq.heappush(heap, (-agreed, -asked, -cosine, low, high, version[low], version[high]))


@njit(cache=True)
def _pooled(first, second, a, group, place):  # noqa: ANN001, ANN202
    """The links of group a, of those that both parts of it had before, each other group once.

    place: (masks,) all -1, and so again in the end.
    """
    most = len(first[0]) + len(second[0])
    others, one, same_extent = np.empty(most, np.int64), np.zeros(most), np.zeros(most)
    count = 0
    for links in (first, second):
        for b, of_one, of_same_extent in zip(*links):  # noqa: B905
            while group[b] != b:  # which joined another since
                b = group[b]
            if b == a:
                continue
            if place[b] < 0:
                place[b], others[count], count = count, b, count + 1
            one[place[b]] += of_one
            same_extent[place[b]] += of_same_extent
    place[others[:count]] = -1
    return others[:count], one[:count], same_extent[:count]


@njit(cache=True)
def _agreement(one, same_extent, asked, cosine, scene):  # noqa: ANN001, ANN202
    """How far the views that were asked agree that two groups of masks are one thing, in [0, 1].

    one: views that say so; same_extent: those of them that say so whatever features say. cosine: of the two, the mean
    over pairs of masks; NaN where they have no features.
    """
    believed = scene.trust
    if not np.isnan(cosine):
        believed = min(1.0, scene.trust * _ratio(cosine, scene.same, scene.different))
    contained = one - same_extent
    speaks_for = same_extent + believed * contained
    return speaks_for / (speaks_for + max(asked - one, (1 - believed) * contained / scene.most))


@njit(cache=True)
def _ratio(cosine, same, different):  # noqa: ANN001, ANN202
    """L of a cosine, or of each of several."""
    of_same, of_different = _share_below(cosine, same), _share_below(cosine, different)
    return of_same * (1 - of_same) / (of_different * (1 - of_different))


@njit(cache=True)
def _share_below(cosine, cosines):  # noqa: ANN001, ANN202
    """The share of ``cosines`` that are lower, as if one more were half so; never 0 or 1."""
    # The mean of the numbers with and without equal ones; cosines within rounding are equal.
    below = np.searchsorted(cosines, cosine - 1e-6, "left") + np.searchsorted(cosines, cosine + 1e-6, "right")
    return (0.5 * below + 0.5) / (len(cosines) + 1)


@njit(cache=True)
def _dots(rows, cols, left, right):  # noqa: ANN001, ANN202
    """(pairs,) left[row] @ right[col] of each pair."""
    found = np.empty(len(rows))
    for i in range(len(rows)):
        found[i] = np.dot(left[rows[i]], right[cols[i]])
    return found


def _roots(group: NDArray[np.int64]) -> NDArray[np.int64]:
    """Follow each mask to the group it ended in."""
    while True:
        parent = np.where(group >= 0, group[group], -1)
        if (parent == group).all():
            return group
        group = parent
