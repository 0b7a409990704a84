"""Whether two instances, of two visits, are the same thing: by descriptor, colour and size.

A descriptor is the mean of m mask features, each of which has the cosine a with what endless views would give: it is
off by a tangent of about sqrt(s), s = (1 - a^2) / (a^2 m). So two descriptors of one thing do not reach the cosine 1,
but

    c = 1 / sqrt((1 + s) (1 + s'))

and a cosine divided by c is what endless views would give. What it means the scene itself tells: how alike the two
visits show what has not moved, and how alike it is to what else stands there. Colour and size only forbid: exposure,
shade and what was hidden change both.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from og_pointcloud.cloud import InstanceTable

ALIKE = 0.5
"""From here on two are one thing: nearer to what one thing has than to what different things have."""
OTHER_COLOR = 48.0
"""Levels of 255 in some channel by which the medians of one thing do not differ."""
SAME_COLOR = 24.0
"""Levels up to which two adjoining parts may be of one thing."""
OTHER_SIZE = 5.0
"""Times that one is longer than the other: a part that shows may be a third of the whole."""
LEAST_AGREEMENT = 0.05
"""Squared cosines of mask features with what endless views would give, below which they tell no spread."""
USUAL_MASKS = 4.0
"""Masks for which the agreement that is usual in the scene counts, beside an instance's own."""
FEWEST_SAME = 3
"""Things that have not moved, of which fewer tell nothing."""
MOST_ROWS = 1000
"""Descriptors that are compared with each other."""


@dataclass(frozen=True)
class Look:
    """How a thing looked, and where, so that it is known when it comes back. descriptors: (r, D) float32 unit rows,
    r = 0 where no mask gave a feature. spread: the squared tangent that they are off by. place: (3,) middle of its
    points, world coordinates. color: (3,) median, or None. size: (3,) along the axes; length: of the longest side,
    without outliers."""

    descriptors: NDArray[np.float32]
    spread: float
    place: NDArray[np.float64]
    color: NDArray[np.float64] | None
    size: NDArray[np.float64]
    length: float

    @classmethod
    def of_points(
        cls,
        descriptors: NDArray[np.float32],
        spread: float,
        place: NDArray[np.float64],
        xyz: NDArray[np.float32],
        rgb: NDArray[np.uint8 | np.float32] | None,
    ) -> Look:
        """Of points xyz (n, 3), at least one, in any frame of the world's axes, with rgb (n, 3) or None."""
        sides = np.ptp(np.percentile(xyz, [3, 97], axis=0), axis=0)
        color = None if rgb is None else np.median(rgb, axis=0).astype(np.float64)
        size = np.ptp(xyz.astype(np.float64), axis=0)
        return cls(descriptors, spread, place, color, size, float(sides.max()))

    def has_color_of(self, other: Look, most: float = SAME_COLOR, shift: NDArray[np.float64] | float = 0.0) -> bool:
        """Whether the two may be of one thing by their colours; True where these are not known. shift: by how much the
        other's colors differ all over."""
        if self.color is None or other.color is None:
            return True
        return bool(np.abs(other.color - self.color - shift).max() <= most)


@dataclass(frozen=True)
class Scale:
    """What cosines mean in a scene, as endless views would give them. same: of one thing, seen twice. other: of
    different things. shift: (3,) by how much later colours differ; color: levels beside it by which one thing's do not.
    """

    same: float = 1.0
    other: float = 0.0
    shift: NDArray[np.float64] | float = 0.0
    color: float = OTHER_COLOR

    def likeness(self, one: Look, later: Look) -> float:
        """How far the two are one thing: about 1 for one, 0 for two different ones, -inf if forbidden."""
        longer, shorter = max(one.length, later.length), min(one.length, later.length)
        if longer > OTHER_SIZE * shorter or not one.has_color_of(later, self.color, self.shift):
            return -np.inf
        return self.cosine(one, later)

    def cosine(self, one: Look, later: Look) -> float:
        """The same by their descriptors alone; -inf where one has none."""
        if not (len(one.descriptors) and len(later.descriptors)):
            return -np.inf
        cosine = float((one.descriptors @ later.descriptors.T).max()) * np.sqrt((1 + one.spread) * (1 + later.spread))
        return (cosine - self.other) / max(self.same - self.other, 1e-6)


def descriptors_of(table: InstanceTable, instance: int) -> tuple[NDArray[np.float32], float]:
    """(descriptors, spread) of one instance of a table."""
    spread = spread_of(table.agreement, table.masks)[instance]
    return table.descriptors[table.descriptor_instance == instance], float(spread)


def cosines(one: InstanceTable, other: InstanceTable) -> NDArray[np.float64]:
    """(len(one), len(other)) cosines as endless views would give them, of the nearest descriptors; -inf without."""
    wide = [np.sqrt(1 + spread_of(table.agreement, table.masks))[table.descriptor_instance] for table in (one, other)]
    found = np.full((len(one), len(other)), -np.inf)
    rows = np.ix_(one.descriptor_instance, other.descriptor_instance)
    np.maximum.at(found, rows, (one.descriptors @ other.descriptors.T) * np.outer(*wide))
    return found


def typical_cosine(rows: NDArray[np.floating], spread: NDArray[np.float64]) -> float:
    """The median cosine of two of some descriptors (r, D), each of another thing and off by a squared tangent (r,), as
    endless views would give it; 0 where there are no two."""
    rows, wide = rows[:MOST_ROWS], np.sqrt(1 + spread[:MOST_ROWS])
    between = ((rows @ rows.T) * np.outer(wide, wide))[np.triu_indices(len(rows), 1)]
    return float(np.median(between)) if len(between) else 0.0


def spread_of(agreement: ArrayLike, masks: ArrayLike) -> NDArray[np.float64]:
    """(n,) the squared tangent that means of mask features are off by.

    agreement: (n,) mean cosine of the features with their own mean; masks: (n,) how many there are. As each is in the
    mean, the agreement's square is expected to be a^2 + (1 - a^2) / m. Few masks tell little: they are taken to agree
    as is usual in the scene.
    """
    masks = np.asarray(masks, np.float64)
    others, told = np.maximum(masks - 1, 0), np.maximum(masks * np.asarray(agreement, np.float64) ** 2 - 1, 0)
    usual = told.sum() / max(others.sum(), 1e-12)
    square = np.clip((told + USUAL_MASKS * usual) / (others + USUAL_MASKS), LEAST_AGREEMENT, 1)
    return (1 - square) / square / np.maximum(masks, 1)
