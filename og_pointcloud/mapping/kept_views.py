"""The rows of the mask table that a map keeps: what each frame's masks showed, without the frames.

A frame is kept while it shows places that few kept ones have shown: so memory follows the map and not the time, and a
second loop of the same path adds nothing. From these rows the batch rule (`fitting`) finds the instances.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from og_pointcloud.fitting.mask_table import MaskTable
from og_pointcloud.rendering.sightings import Sightings
from og_pointcloud.scene import Camera

__all__ = ["KeptView", "KeptViews", "Moment"]

ENOUGH_VIEWS = 48
"""Kept views of a point beyond which another one says nothing new of it: 10 bytes each, a point."""
FEW_VIEWS = 4
"""The same for a frame from where another kept one stood."""
SAME_PLACE, SAME_DIRECTION = 0.02, 0.9994
"""Share of the distance to what is seen, and cosine (2 degrees), within which two frames stand alike."""
NEW_SHARE = 0.05
"""A frame is kept if more than this share of what it shows has not been shown often enough."""


@dataclass(frozen=True)
class KeptView:
    """starts: (M + 2,) int32, columns, votes: rows of the masks, the last one of no mask, as in CSR; votes float16.
    seen: (s,) int32 points, openness: (s,) float16. pixels: (M,) int32. features: (M, D) float32. sequence: when."""

    camera: Camera
    stamp: float
    sequence: int
    starts: NDArray[np.int32]
    columns: NDArray[np.int32]
    votes: NDArray[np.float16]
    seen: NDArray[np.int32]
    openness: NDArray[np.float16]
    pixels: NDArray[np.int32]
    features: NDArray[np.float32]

    @property
    def nbytes(self) -> int:
        """What it takes in memory."""
        arrays = self.starts, self.columns, self.votes, self.seen, self.openness, self.pixels, self.features
        return sum(array.nbytes for array in arrays)


@dataclass(frozen=True)
class Moment:
    """Where and when a frame was taken. sequence: its number. distance: to what it sees, median."""

    camera: Camera
    stamp: float
    sequence: int
    distance: float


@dataclass
class KeptViews:
    """views: in the order in which they came. shown: (n,) uint8, how many of them show each point."""

    views: list[KeptView] = field(default_factory=list)
    shown: NDArray[np.uint8] = field(default_factory=lambda: np.zeros(0, np.uint8))

    def offer(
        self, moment: Moment, found: Sightings, rows: NDArray[np.int32], n: int, ids: NDArray[np.int32],
        features: NDArray[np.float32],
    ) -> bool:  # fmt: skip
        """Keep a frame if it shows something new. found: of the points ``rows``, of n. Returns whether it is kept."""
        if n > len(self.shown):
            self.shown = np.concatenate([self.shown, np.zeros(n - len(self.shown) + n // 2, np.uint8)])
        seen = rows[found.openness.indices]
        if len(features) == 0 or len(seen) == 0:
            return False
        enough = FEW_VIEWS if self._stood_here(moment) else ENOUGH_VIEWS
        if (self.shown[seen] < enough).mean() <= NEW_SHARE:
            return False
        self.shown[seen] = np.minimum(self.shown[seen], 254) + 1
        pixels = np.bincount(ids.ravel() + 1, minlength=len(features) + 1)[1:].astype(np.int32)
        of_masks = found.rows
        self.views.append(
            KeptView(
                moment.camera, moment.stamp, moment.sequence, of_masks.indptr.astype(np.int32), rows[of_masks.indices],
                of_masks.data.astype(np.float16), seen, found.openness.data.astype(np.float16), pixels, features,
            )
        )  # fmt: skip
        return True

    def _stood_here(self, moment: Moment) -> bool:
        """Whether a kept view looked from about the same place in about the same direction."""
        place, forward = moment.camera.center, moment.camera.world_to_camera[2, :3]
        return any(
            forward @ view.camera.world_to_camera[2, :3] > SAME_DIRECTION
            and np.linalg.norm(view.camera.center - place) < SAME_PLACE * moment.distance
            for view in self.views
        )

    @property
    def nbytes(self) -> int:
        """What they take in memory."""
        return sum(view.nbytes for view in self.views)

    def table(self, place: NDArray[np.int32], born: NDArray[np.int32], n: int) -> MaskTable:
        """The mask table of all kept views. place: (points,) int32, column of each point, -1 for those left out. born:
        (points,) int32, views before it are of something else that was there. n: columns."""
        weights, outside, exposure = _Rows(n), _Rows(n), _Rows(n)
        for view in self.views:
            last = view.starts[-2]
            kept = (place[view.columns] >= 0) & (born[view.columns] <= view.sequence)
            columns, votes = place[view.columns], view.votes.astype(np.float32)
            runs = np.add.reduceat(np.append(kept, False).astype(np.int32), view.starts[:-1])
            runs *= np.diff(view.starts) > 0  # reduceat gives an empty run its first entry
            weights.append(runs[:-1].tolist(), columns[:last][kept[:last]], votes[:last][kept[:last]])
            outside.append([int(runs[-1])], columns[last:][kept[last:]], votes[last:][kept[last:]])
            open_ = (place[view.seen] >= 0) & (born[view.seen] <= view.sequence)
            exposed = view.openness[open_].astype(np.float32)
            exposure.append([len(exposed)], place[view.seen][open_], exposed)
        width = max((view.features.shape[1] for view in self.views), default=0)
        counts = [len(view.pixels) for view in self.views]
        return MaskTable(
            weights.matrix(),
            outside.matrix(),
            exposure.matrix(),
            np.repeat(np.arange(len(self.views), dtype=np.int32), counts),
            np.concatenate([np.zeros(0, np.int32), *(view.pixels for view in self.views)]),
            np.concatenate([np.zeros((0, width), np.float32), *(view.features for view in self.views)]),
        )


class _Rows:
    """A sparse matrix of a width, made row by row."""

    def __init__(self, width: int) -> None:
        self._width = width
        self._lengths: list[int] = [0]
        self._columns, self._data = [np.zeros(0, np.int32)], [np.zeros(0, np.float32)]

    def append(self, lengths: list[int], columns: NDArray[np.int32], data: NDArray[np.float32]) -> None:
        self._lengths.extend(lengths)
        self._columns.append(columns)
        self._data.append(data)

    def matrix(self) -> csr_array:
        starts = np.cumsum(self._lengths).astype(np.int32)
        entries = np.concatenate(self._data), np.concatenate(self._columns)
        return csr_array((*entries, starts), shape=(len(starts) - 1, self._width))
