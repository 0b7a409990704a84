"""Whether two instances, of two visits, are the same thing: by descriptor, color and size.

A descriptor is the mean of m mask features. Let each of them have the cosine a with the mean over infinitely many
views: then the descriptor deviates from that mean by an angle whose tangent is about sqrt(s), s = (1 - a^2) / (a^2 m).
So two descriptors of one thing do not reach the cosine 1, but

    c = 1 / sqrt((1 + s) (1 + s'))

and a cosine divided by c is what infinitely many views would give. What such a cosine means is learned from the scene
itself: how alike the two visits show what has not moved, and how alike that is to other things that stand there. Color
and size can only rule a match out: exposure, shade and what was hidden change both.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from og_pointcloud.cloud import InstanceTable, best_of_rows

ALIKE = 0.5
"""Likeness from which on two are one thing: halfway between 0, as of different things, and 1, as of one thing."""
OTHER_COLOR = 48.0
"""Levels of 255 in any channel; if median colors differ by more, it is another thing."""
SAME_COLOR = 24.0
"""Levels up to which two adjoining parts may be of one thing."""
OTHER_SIZE = 5.0
"""Ratio of lengths above which it is another thing: the part of it that shows may be a third of the whole."""
LEAST_AGREEMENT = 0.05
"""Floor of a^2: below it the spread would grow without bound."""
USUAL_MASKS = 4.0
"""The agreement usual in the scene counts as so many masks beside an instance's own."""
FEWEST_SAME = 3
"""Fewer things that have not moved say nothing of the scene's cosines."""
MOST_ROWS = 1000
"""At most so many descriptors are compared with each other."""


@dataclass(frozen=True)
class Look:
    """How a thing looked, and where, so that it is recognized when it comes back. descriptors: (r, D) float32 unit
    rows, r = 0 where no mask gave a feature. spread: their s, as in the module's text. place: (3,) middle of its
    points, color: (3,) their median, or None. bounds: (2, 3) their lowest and highest coordinates. length: of the
    longest side, without outliers. Places are in world coordinates."""

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

    def has_color_of(self, other: Look, most: float = SAME_COLOR, shift: NDArray[np.float64] | float = 0.0) -> bool:
        """Whether the two may be of one thing by their colors; True where these are not known. shift: difference that
        all colors of the other's visit have, as under other light."""
        if self.color is None or other.color is None:
            return True
        return bool(np.abs(other.color - self.color - shift).max() <= most)


@dataclass(frozen=True)
class Scale:
    """What cosines mean in a scene; all are corrected for spread, as in the module's text. same: typical cosine of one
    thing in two visits. other: of different things. shift: (3,) by how much all later colors differ; color: levels,
    beyond that shift, up to which two colors may be of one thing."""

    same: float = 1.0
    other: float = 0.0
    shift: NDArray[np.float64] | float = 0.0
    color: float = OTHER_COLOR

    def likeness(self, one: Look, later: Look) -> float:
        """How likely the two are one thing: about 1 for one, 0 for two different ones, -inf where size or color rule
        it out."""
        # What rules a match out comes first; only then do descriptors count.
        longer, shorter = max(one.length, later.length), min(one.length, later.length)
        if longer > OTHER_SIZE * shorter or not one.has_color_of(later, self.color, self.shift):
            return -np.inf
        return self.cosine(one, later)

    def cosine(self, one: Look, later: Look) -> float:
        """The same by descriptors alone; -inf where one has none."""
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
    """(m, k) cosines of the two nearest descriptors of m instances of one table and k of the other, all different;
    corrected for spread, -inf without any."""
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
    """The median cosine of any two of the descriptors (r, D), each of another thing, corrected for their spread (r,); 0
    where there are no two."""
    rows, factors = rows[:MOST_ROWS], np.sqrt(1 + spread[:MOST_ROWS])
    between = ((rows @ rows.T) * np.outer(factors, factors))[np.triu_indices(len(rows), 1)]
    return float(np.median(between)) if len(between) else 0.0


def spread_of(agreement: ArrayLike, masks: ArrayLike) -> NDArray[np.float64]:
    """(n,) the spread s of means of mask features, as in the module's text.

    agreement: (n,) mean cosine of the features with their own mean; masks: (n,) how many there are, m. As each feature
    is part of the mean, the square of their agreement is expected to be a^2 + (1 - a^2) / m. Few masks say little of a:
    they are taken to agree as is usual in the scene.
    """
    masks = np.asarray(masks, np.float64)
    # Solved for a^2, that is (m agreement^2 - 1) / (m - 1): numerator and denominator add up over instances.
    excess, others = np.maximum(masks * np.asarray(agreement, np.float64) ** 2 - 1, 0), np.maximum(masks - 1, 0)
    usual = excess.sum() / max(others.sum(), 1e-12)
    square = np.clip((excess + USUAL_MASKS * usual) / (others + USUAL_MASKS), LEAST_AGREEMENT, 1)
    return (1 - square) / square / np.maximum(masks, 1)
