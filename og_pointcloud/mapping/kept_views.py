"""The rows of the mask table that a map keeps: which points each frame's masks showed, without the images.

A frame is kept only if it shows points that few kept ones have shown. So memory grows with the map and not with time:
more loops along the same path eventually add nothing. The batch rule (`fitting`) finds the instances from these rows.
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

MAX_VIEWS = 48
"""Kept views of a point beyond which another one adds nothing. Each costs about 10 bytes per point."""
MAX_REPEATS = 8
"""The same for a frame with the viewpoint of another kept one. Its pose has another error, and its masks err elsewhere:
with 4, a map of a camera that hardly moves loses .25 mIoU where poses are off by 1 cm, with 8 it loses .07."""
SAME_PLACE_SHARE, SAME_DIRECTION_COSINE = 0.02, 0.9994
"""Two frames have the same viewpoint if they are closer to each other than this share of the distance to what they see,
and the cosine between their optical axes is above this one (2 degrees)."""
MIN_NEW_SHARE = 0.05
"""A frame is kept if more than this share of its points have not been shown often enough."""


@dataclass(frozen=True)
class KeptView:
    """What one frame's M masks showed. starts: (M + 2,) int32, columns, votes (float16): a sparse matrix in CSR layout,
    a row for each mask and a last one for points in no mask; columns are rows of the map's points. seen: (s,) int32
    visible points. openness: (s,) float16, their visibility. pixels: (M,) int32. features: (M, D) float32. sequence:
    the frame's number. packed: its compressed mask image, if it had no depth: what it sees then depends on the size
    that points are drawn with, and is computed again when that changes."""

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
        """The view of a frame. found: which map points ``rows`` it sees, by index into ``rows``."""
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
        # Never decompressed to more than the image holds, whatever a damaged journal says.
        ids = zlib.decompressobj().decompress(self.packed.tobytes(), 4 * shape[0] * shape[1])
        return np.frombuffer(ids, np.int32).reshape(shape)

    @property
    def nbytes(self) -> int:
        """Its size in memory."""
        return sum(array.nbytes for array in vars(self).values() if isinstance(array, np.ndarray))

    def has_viewpoint_of(self, other: KeptView, distance: float) -> bool:
        """Whether the two look from about the same place in about the same direction. distance: to what they see."""
        if self.camera.world_to_camera[2, :3] @ other.camera.world_to_camera[2, :3] <= SAME_DIRECTION_COSINE:
            return False
        return bool(np.linalg.norm(self.camera.center - other.camera.center) < SAME_PLACE_SHARE * distance)


@dataclass
class KeptViews(Columns):
    """views: in order of arrival. shown: (n,) uint8, number of them that show each point. born: (n,) int32, the frame
    that added what is there now: views of an earlier sequence show something else at that point."""

    views: list[KeptView] = field(default_factory=list)
    shown: NDArray[np.uint8] = field(default_factory=lambda: np.zeros(0, np.uint8))
    born: NDArray[np.int32] = field(default_factory=lambda: np.zeros(0, np.int32))

    def offer(self, view: KeptView, distance: float) -> None:
        """Keep a view if it shows something new. distance: to what it sees."""
        if len(view.seen) == 0:
            return
        enough = MAX_REPEATS if any(view.has_viewpoint_of(other, distance) for other in self.views) else MAX_VIEWS
        if (self.shown[view.seen] < enough).mean() > MIN_NEW_SHARE:
            self.shown[view.seen] = np.minimum(self.shown[view.seen], 254) + 1  # stays at the largest uint8
            self.views.append(view)

    @property
    def nbytes(self) -> int:
        """Their size in memory."""
        return sum(view.nbytes for view in self.views)

    def table(self, place: NDArray[np.int32], n: int) -> MaskTable:
        """The mask table of all kept views. place: (points,) int32, column of each point, -1 for those left out. n:
        number of columns."""
        entries, points = (sum(len(getattr(view, name)) for view in self.views) for name in ("columns", "seen"))
        weights, outside, exposure = (SparseRows(most, n, False) for most in (entries, entries, points))
        for view in self.views:
            # Votes for what was at a point before do not count for what is there now.
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
