"""Whether two instances of two visits are the same thing, judged by descriptor, color and size.

A descriptor is the mean of m mask features. If each of them has the cosine a with the mean over infinitely many views,
the descriptor deviates from that mean by an angle whose tangent is about sqrt(s), s = (1 - a^2) / (a^2 m). So the
cosine of two descriptors of one thing is not 1, but

    c = 1 / sqrt((1 + s) (1 + s'))

and a cosine divided by c is what infinitely many views would give. The meaning of such a cosine is learned from the
scene itself: from the similarity of things that have not moved to themselves and to other things. Color and size can
only rule a match out: exposure, shade and occlusion change both.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from og_pointcloud.cloud import InstanceTable, best_of_rows

MIN_LIKENESS = 0.5
"""Two instances are one thing above this likeness, halfway between 0, typical of different things, and 1, of one."""
MAX_COLOR_DIFFERENCE = 48.0
"""Levels of 255 in any channel; two instances whose median colors differ by more are different things."""
SAME_COLOR_LEVELS = 24.0
"""Levels of 255 by which the colors of two adjoining parts of one thing may differ."""
MAX_SIZE_RATIO = 5.0
"""Ratio of lengths above which two instances are different things: only a third of a thing may be visible."""
MIN_SQUARED_AGREEMENT = 0.05
"""Lower bound of a^2: below it the spread would grow without bound."""
PRIOR_MASKS = 4.0
"""Number of masks that the scene's usual agreement counts as, beside an instance's own."""
MIN_UNMOVED_THINGS = 3
"""Fewer things that have not moved say nothing about the scene's cosines."""
MAX_COMPARED_DESCRIPTORS = 1000
"""At most this many descriptors are compared with each other."""


@dataclass(frozen=True)
class Look:
    """Appearance and place of a thing, to recognize it when it comes back. descriptors: (r, D) float32 unit rows, r = 0
    where no mask gave a feature. spread: their s, see the module's docstring. place: (3,) middle of its points. color:
    (3,) their median color, or None. bounds: (2, 3) their lowest and highest coordinates. length: of the longest side,
    without outliers. All in world coordinates."""

    descriptors: NDArray[np.float32]
    spread: float
    place: NDArray[np.float64]
    color: NDArray[np.float64] | None
    bounds: NDArray[np.float64]
    length: float

    @classmethod
    def of_points(
        cls,
        descriptors: NDArray[np.float32],
        spread: float,
        place: NDArray[np.float64],
        xyz: NDArray[np.float32],
        origin: NDArray[np.float64],
        rgb: NDArray[np.uint8 | np.float32] | None,
    ) -> Look:
        """The look of points xyz (n, 3), at least one, world = xyz + origin; rgb (n, 3) or None."""
        sides = np.ptp(np.percentile(xyz, [3, 97], axis=0), axis=0)  # votes give a thing some points far off it
        color = None if rgb is None else np.median(rgb, axis=0).astype(np.float64)
        bounds = np.array([xyz.min(axis=0), xyz.max(axis=0)], np.float64) + origin
        return cls(descriptors, spread, place, color, bounds, float(sides.max()))

    def moved_to(self, place: NDArray[np.float64]) -> Look:
        """The look of the thing elsewhere; its bounds keep their size."""
        return replace(self, place=place, bounds=self.bounds + (place - self.place))

    def has_color_of(
        self, other: Look, limit: float = SAME_COLOR_LEVELS, shift: NDArray[np.float64] | float = 0.0
    ) -> bool:
        """Whether the colors allow the two to be one thing; True where they are unknown. shift: offset of all colors of
        the other's visit, as under different light."""
        if self.color is None or other.color is None:
            return True
        return bool(np.abs(other.color - self.color - shift).max() <= limit)


@dataclass(frozen=True)
class LikenessScale:
    """Calibration of cosines in a scene, all corrected for spread, see the module's docstring. same: typical cosine of
    one thing in two visits. other: of different things. shift: (3,) offset of all later colors. color: levels, beyond
    that shift, by which the colors of one thing may differ."""

    same: float = 1.0
    other: float = 0.0
    shift: NDArray[np.float64] | float = 0.0
    color: float = MAX_COLOR_DIFFERENCE

    def likeness(self, one: Look, later: Look) -> float:
        """About 1 for one thing, 0 for two different ones, -inf where size or color rule a match out."""
        # Size and color first, which can rule a match out; only then do descriptors count.
        longer, shorter = max(one.length, later.length), min(one.length, later.length)
        if longer > MAX_SIZE_RATIO * shorter or not one.has_color_of(later, self.color, self.shift):
            return -np.inf
        return self.cosine(one, later)

    def cosine(self, one: Look, later: Look) -> float:
        """Likeness by descriptors alone; -inf where one has none."""
        if not (len(one.descriptors) and len(later.descriptors)):
            return -np.inf
        cosine = float((one.descriptors @ later.descriptors.T).max()) * np.sqrt((1 + one.spread) * (1 + later.spread))
        return (cosine - self.other) / max(self.same - self.other, 1e-6)


def descriptors_of(table: InstanceTable, instance: int) -> tuple[NDArray[np.float32], float]:
    """(descriptors, spread) of one instance of a table."""
    spread = spread_of(table.agreement, table.masks)[instance]
    return table.descriptors[table.descriptor_instance == instance], float(spread)


def cosines(
    one: InstanceTable, of_one: NDArray[np.integer], other: InstanceTable, of_other: NDArray[np.integer]
) -> NDArray[np.float64]:
    """(m, k) cosines, corrected for spread, of the two nearest descriptors of m instances of one table and k of the
    other, without repeats; -inf without descriptors."""
    rows, owners, factors = [], [], []
    for table, chosen in ((one, of_one), (other, of_other)):
        place = np.full(len(table), -1)
        place[chosen] = np.arange(len(chosen))
        owner = place[table.descriptor_instance]
        rows.append(table.descriptors[owner >= 0])
        owners.append(owner[owner >= 0])
        factors.append(np.sqrt(1 + spread_of(table.agreement, table.masks))[chosen])
    nearest = best_of_rows(best_of_rows(rows[0] @ rows[1].T, owners[0], len(of_one)).T, owners[1], len(of_other)).T
    return nearest * np.outer(*factors)


def typical_cosine(rows: NDArray[np.floating], spread: NDArray[np.float64]) -> float:
    """Median cosine over all pairs of descriptors (r, D), each of a different thing, corrected for their spread (r,); 0
    with fewer than two."""
    rows, factors = rows[:MAX_COMPARED_DESCRIPTORS], np.sqrt(1 + spread[:MAX_COMPARED_DESCRIPTORS])
    between = ((rows @ rows.T) * np.outer(factors, factors))[np.triu_indices(len(rows), 1)]
    return float(np.median(between)) if len(between) else 0.0


def spread_of(agreement: ArrayLike, masks: ArrayLike) -> NDArray[np.float64]:
    """(n,) the spread s of means of mask features, see the module's docstring.

    agreement: (n,) mean cosine of the features with their own mean; masks: (n,) their number m. As each feature is part
    of the mean, the squared agreement has the expectation a^2 + (1 - a^2) / m. Few masks say little about a: it is
    shrunk towards what is usual in the scene.
    """
    masks = np.asarray(masks, np.float64)
    # Solved for a^2, that is (m agreement^2 - 1) / (m - 1): numerator and denominator add up over instances.
    excess, others = np.maximum(masks * np.asarray(agreement, np.float64) ** 2 - 1, 0), np.maximum(masks - 1, 0)
    usual = excess.sum() / max(others.sum(), 1e-12)
    square = np.clip((excess + PRIOR_MASKS * usual) / (others + PRIOR_MASKS), MIN_SQUARED_AGREEMENT, 1)
    return (1 - square) / square / np.maximum(masks, 1)
