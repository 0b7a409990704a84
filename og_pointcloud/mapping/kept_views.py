"""The rows of the mask table that a map keeps: which points each frame's masks showed, without the images.

A frame is kept only if it shows places that few kept ones have shown. So memory grows with the map and not with time:
more loops along the same path add nothing in the end. From these rows the batch rule (`fitting`) finds the instances.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.fitting.mask_table import MaskTable, SparseRows
from og_pointcloud.mapping.frame import CheckedFrame
from og_pointcloud.mapping.voxels import Columns
from og_pointcloud.rendering.sightings import Sightings
from og_pointcloud.scene import Camera

ENOUGH_VIEWS = 48
"""Kept views of a point beyond which another one says nothing new of it. Each costs about 10 bytes a point."""
FEW_VIEWS = 8
"""The same for a frame that looks from where another kept one did. Its pose is off by another error, and its masks err
elsewhere: of 4 a map of a camera that hardly moves loses .25 mIoU where poses are off by 1 cm, of 8 .07."""
SAME_PLACE, SAME_DIRECTION = 0.02, 0.9994
"""Two frames look from one place if they stand within this share of the distance to what they see, and their optical
axes differ by less than this cosine (2 degrees)."""
NEW_SHARE = 0.05
"""A frame is kept if more than this share of the points it shows have not been shown often enough."""


@dataclass(frozen=True)
class KeptView:
    """What one frame's M masks showed. starts: (M + 2,) int32, columns, votes (float16): a sparse matrix in CSR layout,
    a row for each mask and a last one for what is in no mask; columns are rows of the map's points. seen: (s,) int32
    points that it sees, openness: (s,) float16, how openly. pixels: (M,) int32. features: (M, D) float32. sequence: the
    frame's number. packed: its mask image, compressed, if it had no depth: what it sees then depends on how large
    points are drawn, and is found again when that changes."""

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
    packed: NDArray[np.uint8]

    @classmethod
    def of(cls, frame: CheckedFrame, sequence: int, found: Sightings, rows: NDArray[np.int32]) -> KeptView:
        """The view of a frame. found: what it sees of the points ``rows`` of the map, by place in ``rows``."""
        pixels = np.bincount(frame.ids.ravel() + 1, minlength=len(frame.features) + 1)[1:]  # without those of id -1
        masks, open_ = found.rows, found.openness
        packed = zlib.compress(frame.ids.tobytes(), 1) if frame.view is None else b""
        return cls(
            frame.camera, frame.stamp, sequence, masks.indptr.astype(np.int32), rows[masks.indices],
            masks.data.astype(np.float16), rows[open_.indices], open_.data.astype(np.float16), pixels.astype(np.int32),
            frame.features, np.frombuffer(packed, np.uint8),
        )  # fmt: skip

    @property
    def masks(self) -> NDArray[np.int32]:
        """(H, W) the mask image of a view that had no depth."""
        shape = self.camera.height, self.camera.width
        # It never unpacks to more than the image holds, whatever a damaged journal says.
        ids = zlib.decompressobj().decompress(self.packed.tobytes(), 4 * shape[0] * shape[1])
        return np.frombuffer(ids, np.int32).reshape(shape)

    @property
    def nbytes(self) -> int:
        """What it takes in memory."""
        return sum(array.nbytes for array in vars(self).values() if isinstance(array, np.ndarray))

    def stands_like(self, other: KeptView, distance: float) -> bool:
        """Whether the two looked from about the same place in about the same direction. distance: to what they see."""
        if self.camera.world_to_camera[2, :3] @ other.camera.world_to_camera[2, :3] <= SAME_DIRECTION:
            return False
        return bool(np.linalg.norm(self.camera.center - other.camera.center) < SAME_PLACE * distance)


@dataclass
class KeptViews(Columns):
    """views: in the order in which they came. shown: (n,) uint8, how many of them show each point. born: (n,) int32,
    the frame that brought what is there now: views of an earlier sequence show something else at that point."""

    views: list[KeptView] = field(default_factory=list)
    shown: NDArray[np.uint8] = field(default_factory=lambda: np.zeros(0, np.uint8))
    born: NDArray[np.int32] = field(default_factory=lambda: np.zeros(0, np.int32))

    def offer(self, view: KeptView, distance: float) -> None:
        """Keep a view if it shows something new. distance: to what it sees."""
        if len(view.seen) == 0:
            return
        enough = FEW_VIEWS if any(view.stands_like(other, distance) for other in self.views) else ENOUGH_VIEWS
        if (self.shown[view.seen] < enough).mean() > NEW_SHARE:
            self.shown[view.seen] = np.minimum(self.shown[view.seen], 254) + 1  # stays at the largest uint8
            self.views.append(view)

    @property
    def nbytes(self) -> int:
        """What they take in memory."""
        return sum(view.nbytes for view in self.views)

    def table(self, place: NDArray[np.int32], n: int) -> MaskTable:
        """The mask table of all kept views. place: (points,) int32, column of each point, -1 for those left out. n:
        columns."""
        entries, points = (sum(len(getattr(view, name)) for view in self.views) for name in ("columns", "seen"))
        weights, outside, exposure = (SparseRows(most, n, False) for most in (entries, entries, points))
        for view in self.views:
            # What stood at a point before what is there now does not speak for it.
            kept = (place[view.columns] >= 0) & (self.born[view.columns] <= view.sequence)
            # How many entries of each CSR row are kept; the last row (in no mask) begins at the border.
            lengths = np.diff(np.append(0, np.cumsum(kept))[view.starts])
            columns, votes, border = place[view.columns][kept], view.votes[kept].astype(np.float32), lengths[:-1].sum()
            weights.append(lengths[:-1], columns[:border], votes[:border])
            outside.append(lengths[-1], columns[border:], votes[border:])
            open_ = (place[view.seen] >= 0) & (self.born[view.seen] <= view.sequence)
            exposure.append(open_.sum(), place[view.seen][open_], view.openness[open_].astype(np.float32))
        counts = [len(view.pixels) for view in self.views]
        return MaskTable(
            weights.matrix(),
            outside.matrix(),
            exposure.matrix(),
            np.repeat(np.arange(len(self.views), dtype=np.int32), counts),
            np.concatenate([view.pixels for view in self.views]),
            np.concatenate([view.features for view in self.views]),
            names=tuple(map(str, range(len(self.views)))),
        )
