"""Points of a growing map: one for each voxel of the map's spacing, in arrays that only grow, found by a voxel hash.

Further readings in a voxel move its point towards their mean. A point never changes its row, as votes and evidence
refer to it. Rows are also indexed by place, in packets of neighbors, so that a frame searches only the packets in front
of its camera.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.kernels import njit
from og_pointcloud.scene import Camera

MAX_VOXEL_INDEX = 1 << 20
"""Voxels to either side of the origin: three indices of 21 bits fit into one 64-bit key, which is never negative."""
MAX_READINGS = 32.0
"""Maximum number of readings that a point's mean counts for, so that it follows what is measured now."""
EMPTY_KEY = np.int64(-1)
"""Key of a free slot of the hash."""
BRICK_VOXELS = 16
"""Voxels along each side of a brick, by which rows are sorted in space."""
PACKET_ROWS = 128
"""Rows per packet; the last packet of each batch of new points may have fewer."""
REINDEX_GROWTH = 1.25
"""All points are indexed again once their number has grown by this factor since the last time."""


@dataclass
class Columns:
    """Arrays with one row per point that grow together, at least by half their length. FILL_VALUES: by name, of new
    rows, if not 0."""

    FILL_VALUES: ClassVar[dict[str, float]] = {}

    def grow(self, n: int) -> None:
        """Allocate rows for n points."""
        for name, rows in list(vars(self).items()):
            if isinstance(rows, np.ndarray) and n > len(rows):
                more = max(n - len(rows), len(rows) // 2)
                spare = np.full((more, *rows.shape[1:]), self.FILL_VALUES.get(name, 0), rows.dtype)
                setattr(self, name, np.concatenate([rows, spare]))


@dataclass
class VoxelHash:
    """Voxel -> row of its point, by open addressing. keys: (slots,) int64 of voxels, EMPTY_KEY where there is none;
    rows: (slots,) of their points. The number of slots is a power of two."""

    keys: NDArray[np.int64] = field(default_factory=lambda: np.full(4096, EMPTY_KEY))
    rows: NDArray[np.int32] = field(default_factory=lambda: np.zeros(4096, np.int32))

    def reserve(self, count: int) -> None:
        """Stay at most half full with this many keys: linear probing slows down beyond."""
        if 2 * count > len(self.keys):
            size, before = 1 << int(2 * count - 1).bit_length(), (self.keys, self.rows)
            self.keys, self.rows = np.full(size, EMPTY_KEY), np.zeros(size, np.int32)
            _index(*before, self.keys, self.rows)


@dataclass
class Packets:
    """Spatial index of rows. side: edge of a brick. order: (n,) int32, rows packet by packet; starts: (packets + 1,)
    int32, where each packet begins in it. low, high: (packets, 3) float32, box of its points when they were indexed.
    indexed: number of points when all were last indexed together."""

    side: float
    indexed: int = 0
    order: NDArray[np.int32] = field(default_factory=lambda: np.zeros(0, np.int32))
    starts: NDArray[np.int32] = field(default_factory=lambda: np.zeros(1, np.int32))
    low: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 3), np.float32))
    high: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 3), np.float32))

    def add(self, xyz: NDArray[np.float32]) -> None:
        """Index those of the points (n, 3) that are not indexed yet."""
        first, n = len(self.order), len(xyz)
        if n == first:
            return
        # Packets of new points lie between older ones in space, and their boxes overlap: from time to time, as the map
        # grows, all are indexed again. Growth by a constant factor keeps the cost per point constant.
        if n > REINDEX_GROWTH * self.indexed:
            first, self.indexed, self.starts, self.low, self.high = 0, n, self.starts[:1], self.low[:0], self.high[:0]
        order = first + np.argsort(_keys(xyz[first:], self.side), kind="stable").astype(np.int32)
        begins = np.arange(0, n - first, PACKET_ROWS)
        self.order = np.concatenate([self.order[:first], order])
        self.starts = np.concatenate([self.starts[:-1], first + begins, [n]]).astype(np.int32)
        self.low = np.concatenate([self.low, np.minimum.reduceat(xyz[order], begins)])
        self.high = np.concatenate([self.high, np.maximum.reduceat(xyz[order], begins)])

    def in_view(self, camera: Camera, edge: float, margin: float = 0.0) -> NDArray[np.int32]:
        """Rows of packets that may have points in an image, or within a share ``margin`` beyond its border: the sphere
        around the packet's box meets the frustum. edge: of a voxel; no point has moved by two of them since it was
        indexed, as it stays in its voxel."""
        fx, fy, cx, cy = camera.intrinsics
        across, down = margin * camera.width, margin * camera.height
        # The frustum is where all five dot products are positive: u > 0, for example, is fx x + cx z > 0. Its planes
        # pass through the camera, so each is just an inward normal in the camera's frame; the first is z = 0.
        left, right = (fx, 0, cx + across), (-fx, 0, camera.width + across - cx)
        sides = np.array([(0, 0, 1), left, right, (0, fy, cy + down), (0, -fy, camera.height + down - cy)])
        sides /= np.linalg.norm(sides, axis=1, keepdims=True)
        # In float64: in float32 the square of an outlier at 1e20 overflows.
        pose, low, high = camera.world_to_camera, self.low.astype(np.float64), self.high.astype(np.float64)
        reach = 2 * edge + np.linalg.norm(high - low, axis=1) / 2
        # (packets, 5) signed distance of the box center inside each plane, with the normals rotated into the map.
        inside = (low + high) / 2 @ (sides @ pose[:3, :3]).T + sides @ pose[:3, 3]
        return self._rows((inside > -reach[:, None]).all(axis=1))

    def in_box(self, low: NDArray[np.floating], high: NDArray[np.floating]) -> NDArray[np.int32]:
        """Rows of the packets that meet a box."""
        return self._rows(np.asarray(((self.low <= high) & (self.high >= low)).all(axis=1)))

    def _rows(self, chosen: NDArray[np.bool_]) -> NDArray[np.int32]:
        return self.order[np.repeat(chosen, np.diff(self.starts))]


@dataclass
class VoxelPoints(Columns):
    """n points; the arrays are longer, for those to come. edge: of a voxel. grows: whether measured points are added.
    weight: float32, number of readings in the mean of each, 0 for a point that left, which keeps its row for what may
    come there."""

    edge: float
    grows: bool
    n: int = 0
    hash: VoxelHash = field(default_factory=VoxelHash)
    packets: Packets = field(default_factory=lambda: Packets(0.0))
    _xyz: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 3), np.float32))
    _rgb: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 3), np.float32))
    weight: NDArray[np.float32] = field(default_factory=lambda: np.zeros(0, np.float32))
    _anchor: NDArray[np.int32] = field(default_factory=lambda: np.zeros(0, np.int32))

    def __post_init__(self) -> None:
        self.packets.side = self.packets.side or BRICK_VOXELS * self.edge

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
        """(n,) int32, the frame that first saw a point, -1 for points that no frame added."""
        return self._anchor[: self.n]

    def add_known(self, xyz: NDArray[np.float32], rgb: NDArray[np.uint8] | None) -> NDArray[np.int64]:
        """Add points that stay as they are, several per voxel if they are that dense. Returns (n,) their rows."""
        # Sorted by brick, so that neighbors have rows close to each other.
        order = np.argsort(_keys(xyz, self.packets.side), kind="stable")
        self._reserve(len(xyz))
        rows = slice(self.n, self.n + len(xyz))
        self._xyz[rows], self.weight[rows], self._anchor[rows] = xyz[order], MAX_READINGS, -1
        self._rgb[rows] = 128 if rgb is None else rgb[order]
        self.n += len(xyz)
        self.reindex()
        return np.argsort(order) + rows.start

    def add(
        self, xyz: NDArray[np.float32], rgb: NDArray[np.uint8], anchor: int, closed: NDArray[np.bool_] | None = None
    ) -> bool:
        """Add measured points (m, 3) of the frame ``anchor``: into the mean of their voxel's point, or as new ones.
        Returns whether any point is now of this frame: a new one, or one where others had left. closed: (n,) rows that
        take no readings; None: all do."""
        closed = np.zeros(self.n, np.bool_) if closed is None else closed
        self._reserve(len(xyz))
        voxels, points = (self.hash.keys, self.hash.rows), (self._xyz, self._rgb, self.weight, self._anchor, closed)
        self.n, brought = _insert(xyz, rgb, anchor, self.edge, voxels, points, self.n)
        self.packets.add(self.xyz)
        return brought

    def reindex(self) -> None:
        """Rebuild the hash and the spatial index after points were moved."""
        self.hash.keys[:] = EMPTY_KEY
        _index(_keys(self.xyz, self.edge), np.arange(self.n), self.hash.keys, self.hash.rows)
        self.packets = Packets(self.packets.side)
        self.packets.add(self.xyz)

    def _reserve(self, more: int) -> None:
        """Allocate room for this many more points."""
        self.grow(self.n + more)
        self.hash.reserve(self.n + more)


@njit(cache=True, nogil=True)
def turned(pose, p):  # noqa: ANN001, ANN201
    """A direction rotated into the camera's frame."""
    return (
        pose[0, 0] * p[0] + pose[0, 1] * p[1] + pose[0, 2] * p[2],
        pose[1, 0] * p[0] + pose[1, 1] * p[1] + pose[1, 2] * p[2],
        pose[2, 0] * p[0] + pose[2, 1] * p[1] + pose[2, 2] * p[2],
    )


@njit(cache=True, nogil=True)
def in_camera(pose, p):  # noqa: ANN001, ANN201
    """A point in the camera's frame."""
    x, y, z = turned(pose, p)
    return x + pose[0, 3], y + pose[1, 3], z + pose[2, 3]


@njit(cache=True, nogil=True)
def _key(x, y, z, edge):  # noqa: ANN001, ANN202
    """The voxel as one number, 21 bits per axis; all beyond MAX_VOXEL_INDEX are clamped to the outermost one."""
    key = np.int64(0)
    for value in (x, y, z):
        index = min(max(np.floor(value / edge), -MAX_VOXEL_INDEX), MAX_VOXEL_INDEX - 1)
        key = key * (2 * MAX_VOXEL_INDEX) + np.int64(index) + MAX_VOXEL_INDEX
    return key


@njit(cache=True, nogil=True)
def _keys(xyz, edge):  # noqa: ANN001, ANN202
    keys = np.empty(len(xyz), np.int64)
    for i in range(len(xyz)):
        keys[i] = _key(xyz[i, 0], xyz[i, 1], xyz[i, 2], edge)
    return keys


@njit(cache=True, nogil=True)
def _slot(key, keys):  # noqa: ANN001, ANN202
    """The slot of a key, or where it would be put: linear probing from its hash."""
    # Times 2^64 over the golden ratio (Knuth, The Art of Computer Programming, 6.4), so that neighboring voxels differ
    # in the upper bits; the shift brings these down to the lower ones, which the mask keeps.
    mask = np.uint64(len(keys) - 1)
    mixed = np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)
    slot = (mixed ^ (mixed >> np.uint64(32))) & mask
    while keys[slot] != key and keys[slot] != EMPTY_KEY:
        slot = (slot + np.uint64(1)) & mask
    return slot


@njit(cache=True, nogil=True)
def _index(new_keys, new_rows, keys, rows):  # noqa: ANN001, ANN202
    """Insert the keys that are not there yet; skips EMPTY_KEY."""
    for k in range(len(new_keys)):
        slot = _slot(new_keys[k], keys)
        if new_keys[k] != EMPTY_KEY and keys[slot] == EMPTY_KEY:
            keys[slot], rows[slot] = new_keys[k], new_rows[k]


@njit(cache=True, nogil=True)
def _insert(new, color, frame, edge, voxels, points, n):  # noqa: ANN001, ANN202
    """Number of points after the insertion, and whether any is of this frame. All readings of a point lie in its voxel,
    and so does their mean: its key does not change."""
    (keys, rows), (xyz, rgb, weight, anchor, closed) = voxels, points
    brought = False
    for i in range(len(new)):
        key = _key(new[i, 0], new[i, 1], new[i, 2], edge)
        slot = _slot(key, keys)
        if keys[slot] == EMPTY_KEY:
            keys[slot], rows[slot] = key, n
            xyz[n], rgb[n], weight[n], anchor[n] = new[i], color[i], 1, frame
            n, brought = n + 1, True
            continue
        # A running mean; with bounded weight it becomes an exponential moving one. Weight 1 is a point that had left (0
        # before): it starts again at the reading.
        row = rows[slot]
        if row < len(closed) and closed[row]:
            continue
        weight[row] = min(weight[row] + 1, MAX_READINGS)
        if weight[row] == 1:
            anchor[row], brought = frame, True
        for a in range(3):
            if anchor[row] >= 0:  # points that were known from the start stay where they are
                xyz[row, a] += (new[i, a] - xyz[row, a]) / weight[row]
            rgb[row, a] += (color[i, a] - rgb[row, a]) / weight[row]
    return n, brought
