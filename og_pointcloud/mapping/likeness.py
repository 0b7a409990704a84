"""Whether two instances, of two visits, are the same thing: by descriptor, colour and size.

A descriptor is the mean of m mask features, each of which has the cosine a with it: that mean is off by a tangent of
about sqrt(s), s = (1 - a^2) / (a^2 m). So two descriptors of one thing do not reach the cosine 1, but

    c = 1 / sqrt((1 + s) (1 + s'))

and a cosine divided by c is what endless views would give. What it means the scene itself tells: 1 for one thing, and
for two the median over pairs of its instances, different things mostly. Colour and size only forbid: exposure, shade
and what was hidden change both.
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
LEAST_AGREEMENT = 0.3
"""Cosines of a mask's feature with its instance's descriptor below this tell no spread."""
MOST_ROWS = 1000
"""Descriptors that are compared with each other."""


@dataclass(frozen=True)
class Look:
    """descriptors: (r, D) float32 unit rows, r = 0 where no mask gave a feature. spread: the squared tangent that they
    are off by. color: (3,) median, or None. length: of its longest side, along the axes, without outliers."""

    descriptors: NDArray[np.float32]
    spread: float
    color: NDArray[np.float64] | None
    length: float

    @classmethod
    def of_points(
        cls,
        descriptors: NDArray[np.float32],
        spread: float,
        xyz: NDArray[np.float32],
        rgb: NDArray[np.uint8 | np.float32] | None,
    ) -> Look:
        """Of points xyz (n, 3), at least one, with rgb (n, 3) or None."""
        sides = np.ptp(np.percentile(xyz, [3, 97], axis=0), axis=0)
        color = None if rgb is None else np.median(rgb, axis=0).astype(np.float64)
        return cls(descriptors, spread, color, float(sides.max()))

    def has_color_of(self, other: Look, most: float = SAME_COLOR) -> bool:
        """Whether the two may be parts of one thing by their colours; True where these are not known."""
        return self.color is None or other.color is None or bool(np.abs(self.color - other.color).max() <= most)


def descriptors_of(table: InstanceTable, instance: int) -> tuple[NDArray[np.float32], float]:
    """(descriptors, spread) of one instance of a table."""
    spread = spread_of(table.agreement[instance], table.masks[instance])
    return table.descriptors[table.descriptor_instance == instance], float(spread)


def typical_of_table(table: InstanceTable) -> float:
    """The `typical_cosine` of a table's instances."""
    owner = table.descriptor_instance
    return typical_cosine(table.descriptors, owner, spread_of(table.agreement, table.masks)[owner])


def typical_cosine(rows: NDArray[np.floating], owner: NDArray[np.integer], spread: NDArray[np.float64]) -> float:
    """The median cosine of two instances, as endless views would give it; 0 where there are no two.

    rows: (r, D) descriptors, of the instance owner (r,), off by a squared tangent (r,).
    """
    rows, owner, widened = rows[:MOST_ROWS], owner[:MOST_ROWS], np.sqrt(1 + spread[:MOST_ROWS])
    cosines = (rows @ rows.T) * np.outer(widened, widened)
    different = np.triu(owner[:, None] != owner)
    return float(np.median(cosines[different])) if different.any() else 0.0


def likeness(one: Look, other: Look, typical: float) -> float:
    """How far the two are one thing: about 1 for one, 0 for two typical things of the scene, -inf if forbidden.

    typical: `typical_cosine` of the scene.
    """
    longer, shorter = max(one.length, other.length), min(one.length, other.length)
    if longer > OTHER_SIZE * shorter or not one.has_color_of(other, OTHER_COLOR):
        return -np.inf
    if not (len(one.descriptors) and len(other.descriptors)):
        return -np.inf
    cosine = float((one.descriptors @ other.descriptors.T).max()) * np.sqrt((1 + one.spread) * (1 + other.spread))
    return (cosine - typical) / max(1 - typical, 1e-6)


def spread_of(agreement: ArrayLike, masks: ArrayLike) -> NDArray[np.float64]:
    """The squared tangent that means of mask features are off by."""
    square = np.clip(np.asarray(agreement, np.float64), LEAST_AGREEMENT, 1) ** 2
    return (1 - square) / square / np.maximum(masks, 1)
