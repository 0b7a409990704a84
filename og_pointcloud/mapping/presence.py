"""Whether points of a map are still there, from all that later views measured: bounded odds by point.

A view that measures a surface where a point lies speaks for it, one that looks through its place against it. Of a map
that grows the sum is bounded, so that a long history cannot outvote what is seen today. One place alone refutes
nothing: a point is absent only where it was seen through from two directions. A view in which no mask shows a thing is
no evidence at all.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.kernels import njit
from og_pointcloud.mapping.sight import AGREES, HIDDEN, THROUGH, MeasuredView, states_of_points
from og_pointcloud.mapping.voxels import Columns

APART = 0.998
"""Cosine between two directions of sight, from the point, that are two places: 3.6 degrees."""


@dataclass
class Presence(Columns):
    """Evidence about n points. tolerance: distance from a surface, at right angles to it, up to which a point is of it.
    most: what the odds are bounded by. odds: (n,) float32, views that bear a point out less those that see through it,
    bounded. refuted: (n,) uint8, directions, up to two, from which it was seen through; first: (n, 3), the first of
    them. seen_at: (n,) float64, the latest stamp of a view that measured it, or its place; -inf where none did.
    hidden: (n,) bool, some view measured a surface before it."""

    tolerance: float
    most: float = np.inf
    odds: NDArray[np.float32] = field(default_factory=lambda: np.zeros(0, np.float32))
    refuted: NDArray[np.uint8] = field(default_factory=lambda: np.zeros(0, np.uint8))
    seen_at: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    hidden: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, bool))
    first: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 3), np.float32))
    SPARE: ClassVar[dict[str, float]] = {"seen_at": -np.inf}

    @staticmethod
    def by(views: Iterable[MeasuredView], tolerance: float, *clouds: NDArray[np.float32]) -> list[Presence]:
        """What views say of all points of clouds, each (n, 3)."""
        found = [Presence(tolerance) for _ in clouds]
        for presence, xyz in zip(found, clouds, strict=True):
            presence.grow(len(xyz))
        for view in views:
            for presence, xyz in zip(found, clouds, strict=True):
                states = states_of_points(xyz, tolerance, view)
                presence.take(np.arange(len(xyz)), xyz, states, view.camera.center, 0.0)
        return found

    def take(
        self, rows: NDArray[np.integer], xyz: NDArray[np.float32], states: NDArray[np.int8],
        center: NDArray[np.float64], stamp: float,
    ) -> None:  # fmt: skip
        """Take in the states (m,) of some rows of xyz (n, 3), seen from a centre. What is older than a point's
        latest word is not counted: a frame that comes late cannot bring back what has left since."""
        self.hidden[rows[states == HIDDEN]] = True
        _count(rows, xyz, states, center, stamp, self.most, self.odds, self.refuted, self.seen_at, self.first)

    @property
    def present(self) -> NDArray[np.bool_]:
        """(n,) bool: borne out by more views than see through."""
        return self.odds > 0

    @property
    def absent(self) -> NDArray[np.bool_]:
        """(n,) bool: seen through by more views than bear it out, from two places."""
        return (self.odds < 0) & (self.refuted > 1)


@njit(cache=True, nogil=True)
def _count(rows, xyz, states, center, stamp, most, odds, refuted, seen_at, first):  # noqa: ANN001, ANN202
    for k in range(len(states)):
        i = rows[k]
        if (states[k] != AGREES and states[k] != THROUGH) or stamp < seen_at[i]:
            continue
        seen_at[i] = stamp
        if states[k] == AGREES:
            odds[i] = min(odds[i] + 1, most)
            continue
        odds[i] = max(odds[i] - 1, -most)
        if refuted[i] < 2:
            x, y, z = center[0] - xyz[i, 0], center[1] - xyz[i, 1], center[2] - xyz[i, 2]
            length = max(np.sqrt(x * x + y * y + z * z), 1e-12)
            x, y, z = x / length, y / length, z / length
            if refuted[i] == 0:
                first[i] = x, y, z
            if refuted[i] == 0 or x * first[i, 0] + y * first[i, 1] + z * first[i, 2] < APART:
                refuted[i] += 1
