"""Points of a growing map: one a voxel of the map's spacing, in arrays that only grow, found by a hash of the voxel.

What is measured again moves its point towards the mean. A point keeps its row for good: votes and evidence refer to it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.kernels import njit

__all__ = ["Columns", "VoxelHash", "VoxelPoints"]

ACROSS = 1 << 20
"""Voxels to either side of the origin: three indices fit one 64-bit key."""
MOST_WEIGHT = 32.0
"""Readings that a point's mean counts for at most, so that it follows."""
EMPTY = np.int64(-1)


@dataclass
class Columns:
    """Arrays with a row a point, that grow together in steps of half. SPARE: what rows of a name hold at first, if not
    0."""

    SPARE: ClassVar[dict[str, float]] = {}

    def grow(self, n: int) -> None:
        """Room for n points."""
        for name, rows in list(vars(self).items()):
            if isinstance(rows, np.ndarray) and n > len(rows):
                more = max(n - len(rows), len(rows) // 2)
                spare = np.full((more, *rows.shape[1:]), self.SPARE.get(name, 0), rows.dtype)
                setattr(self, name, np.concatenate([rows, spare]))


@dataclass
class VoxelHash:
    """Open addressing. keys: (slots,) int64 of voxels, EMPTY where there is none; rows: (slots,) of their points."""

    keys: NDArray[np.int64] = field(default_factory=lambda: np.full(4096, EMPTY))
    rows: NDArray[np.int32] = field(default_factory=lambda: np.zeros(4096, np.int32))


@dataclass
class VoxelPoints(Columns):
    """n points. edge: of a voxel. grows: whether measured points are added. weight: (n,) float32 readings, 0 for a
    point that left: it keeps its row, for what may come to its voxel."""

    edge: float
    grows: bool
    n: int = 0
    hash: VoxelHash = field(default_factory=VoxelHash)
    _xyz: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 3), np.float32))
    _rgb: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 3), np.float32))
    weight: NDArray[np.float32] = field(default_factory=lambda: np.zeros(0, np.float32))
    _anchor: NDArray[np.int32] = field(default_factory=lambda: np.zeros(0, np.int32))

    def __len__(self) -> int:
        return self.n

    @property
    def xyz(self) -> NDArray[np.float32]:
        """(n, 3) float32, local frame."""
        return self._xyz[: self.n]

    @property
    def rgb(self) -> NDArray[np.float32]:
        """(n, 3) float32, 0 to 255."""
        return self._rgb[: self.n]

    @property
    def alive(self) -> NDArray[np.bool_]:
        """(n,) bool: points that are there."""
        return self.weight[: self.n] > 0

    @property
    def anchor(self) -> NDArray[np.int32]:
        """(n,) int32, the frame that a point was first seen by, -1 for points that no frame brought."""
        return self._anchor[: self.n]

    def add_known(self, xyz: NDArray[np.float32], rgb: NDArray[np.uint8] | None) -> None:
        """Points that are kept as they are, several in a voxel if they are so dense."""
        self._reserve(len(xyz))
        rows = slice(self.n, self.n + len(xyz))
        self._xyz[rows], self.weight[rows], self._anchor[rows] = xyz, MOST_WEIGHT, -1
        self._rgb[rows] = 128 if rgb is None else rgb
        self.n += len(xyz)
        self.rehash()

    def add(self, xyz: NDArray[np.float32], rgb: NDArray[np.uint8], anchor: int) -> None:
        """Take measured points (m, 3) in: into the mean of their voxel's point, or as a new one."""
        if self.grows:
            self._reserve(len(xyz))
            arrays = self._xyz, self._rgb, self.weight, self._anchor
            self.n = _insert(xyz, rgb, anchor, self.edge, self.hash.keys, self.hash.rows, *arrays, self.n)

    def rehash(self) -> None:
        """After points were moved."""
        self.hash.keys[:] = EMPTY
        _index(self.xyz, self.edge, self.hash.keys, self.hash.rows)

    def _reserve(self, more: int) -> None:
        """Room for so many more points; the hash stays less than half full."""
        need = self.n + more
        self.grow(need)
        if 2 * need > len(self.hash.keys):
            size = 1 << int(2 * need - 1).bit_length()
            self.hash = VoxelHash(np.full(size, EMPTY), np.zeros(size, np.int32))
            self.rehash()


@njit(cache=True, nogil=True)
def _key(x, y, z, edge):  # noqa: ANN001, ANN202
    """The voxel as one number; beyond ACROSS voxels they share one, at the border."""
    key = np.int64(0)
    for value in (x, y, z):
        index = min(max(np.floor(value / edge), -ACROSS), ACROSS - 1)
        key = key * (2 * ACROSS) + np.int64(index) + ACROSS
    return key


@njit(cache=True, nogil=True)
def _slot(key, keys):  # noqa: ANN001, ANN202
    """Where a key is, or would be put: linear probing from its hash."""
    mask = np.uint64(len(keys) - 1)
    mixed = np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)
    slot = (mixed ^ (mixed >> np.uint64(32))) & mask
    while keys[slot] != key and keys[slot] != EMPTY:
        slot = (slot + np.uint64(1)) & mask
    return slot


@njit(cache=True, nogil=True)
def _index(xyz, edge, keys, rows):  # noqa: ANN001, ANN202
    for i in range(len(xyz)):
        key = _key(xyz[i, 0], xyz[i, 1], xyz[i, 2], edge)
        slot = _slot(key, keys)
        if keys[slot] == EMPTY:
            keys[slot], rows[slot] = key, i


@njit(cache=True, nogil=True)
def _insert(new, color, frame, edge, keys, rows, xyz, rgb, weight, anchor, n):  # noqa: ANN001, ANN202
    """The number of points after the new ones are in. A point that moves out of its voxel keeps its place in the hash:
    it is the mean of what was measured there."""
    for i in range(len(new)):
        key = _key(new[i, 0], new[i, 1], new[i, 2], edge)
        slot = _slot(key, keys)
        if keys[slot] == EMPTY:
            keys[slot], rows[slot] = key, n
            xyz[n], rgb[n], weight[n], anchor[n] = new[i], color[i], 1, frame
            n += 1
            continue
        row = rows[slot]
        weight[row] = min(weight[row] + 1, MOST_WEIGHT)
        for a in range(3):
            if anchor[row] >= 0 or weight[row] == 1:  # known points stay where they are
                xyz[row, a] += (new[i, a] - xyz[row, a]) / weight[row]
            rgb[row, a] += (color[i, a] - rgb[row, a]) / weight[row]
    return n
