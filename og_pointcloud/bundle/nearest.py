"""Exact search of the nearest cloud point within reach: hashed voxels in numpy, for queries that the brick grid leaves
open."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

NONE_WITHIN_REACH = -1
"""Index returned for a query without a cloud point within reach."""

SURFACE_PER_SPACING, SURFACE_PER_REACH = 1.5, 1 / 3

QUERIES_PER_CHUNK = 8192
CANDIDATES_PER_CHUNK = 1_000_000
"""Queries, and points compared with them, at once: they limit the memory of a search to about 60 MB."""
LEVEL_FACTOR = 1.5
"""Ratio of the radii of successive searches. Most queries lie within one spacing of the cloud: the first suffices."""
EDGE_SLACK = 1e-6
"""Voxels are wider than the radius by this share: rounding must not put a point at that distance two voxels away."""
HASH_X, HASH_Y = 73856093, 19349663
"""Primes of Teschner et al. 2003, "Optimized Spatial Hashing"; the factor along z is 1, so buckets are adjacent."""


def surface_distance(spacing: float, reach: float) -> float:
    """Distance from the cloud up to which a query is on its surface; beyond it, up to the reach, it is near."""
    return max(SURFACE_PER_SPACING * spacing, SURFACE_PER_REACH * reach)


class VoxelBuckets:
    """Points sorted by a hash of their voxel; neighboring voxels along z are in neighboring buckets.

    Hash collisions do no harm: such points are farther away, and true distances decide.

    xyz: (n, 3) float32. edge: length of a voxel's edge, in the same unit.
    """

    def __init__(self, xyz: NDArray[np.float32], edge: float) -> None:
        self.edge = edge
        self.mask = (1 << max(6, (2 * len(xyz)).bit_length())) - 1  # a power of two, at least two buckets a point
        bucket = self.bucket(self.voxel(xyz.astype(np.float64)))
        order = np.argsort(bucket, kind="stable")  # stable: among equal distances the lowest index wins
        starts = np.zeros(self.mask + 2, np.int64)
        np.cumsum(np.bincount(bucket, minlength=self.mask + 1), out=starts[1:])
        # The first two buckets are repeated at the end, so that a run of three may start at the last one.
        self.starts = np.concatenate([starts, len(xyz) + starts[1:3]])
        self.point = np.concatenate([order, order[: starts[2]]])
        """Index of each sorted point in the cloud."""
        self.x, self.y, self.z = np.ascontiguousarray(xyz[self.point].T, np.float64)

    def voxel(self, xyz: NDArray[np.float64]) -> NDArray[np.int64]:
        """Integer coordinates of the voxel of each point."""
        # The clip keeps coordinates of 1e30, which are far from anything, within int64.
        return np.floor(np.clip(xyz / self.edge, -1e15, 1e15)).astype(np.int64)

    def bucket(self, voxel: NDArray[np.int64]) -> NDArray[np.int64]:
        """Bucket of each voxel; integer overflow wraps, which does no harm to a hash."""
        return (voxel[..., 0] * HASH_X + voxel[..., 1] * HASH_Y + voxel[..., 2]) & self.mask


class NearestPoint:
    """Finds the nearest cloud point within reach of any query point.

    Distances are compared in float64 on the float32 coordinates; ties go to the lowest index; a distance of exactly
    ``reach`` is within reach. Time grows with (distance / spacing)^2 of a query, memory is bounded.

    xyz: (n, 3) float32, local frame. spacing, reach: lengths in its unit.
    """

    def __init__(self, xyz: NDArray[np.float32], spacing: float, reach: float) -> None:
        self._xyz = xyz
        self._reach = reach
        # Radii grow from one spacing to the reach. A query ends at the first radius at which any point is found: all
        # points within that radius were compared.
        count = max(0, int(np.ceil(np.log(reach / spacing) / np.log(LEVEL_FACTOR))))
        self._radii = [spacing * LEVEL_FACTOR**level for level in range(count)] + [reach]
        self._levels: dict[float, VoxelBuckets] = {}

    def query(self, points: NDArray[np.float32]) -> NDArray[np.int64]:
        """(m,) index of the nearest cloud point, or NONE_WITHIN_REACH. points: (m, 3) float32, finite, local frame."""
        nearest = np.full(len(points), NONE_WITHIN_REACH, np.int64)
        if len(self._xyz) == 0:
            return nearest
        pending = np.arange(len(points))
        for radius in self._radii:
            if len(pending) == 0:
                break
            if radius not in self._levels:  # wider ones are built when first needed, which is often never
                self._levels[radius] = VoxelBuckets(self._xyz, radius * (1 + EDGE_SLACK))
            index = _nearest_within(self._levels[radius], points[pending].astype(np.float64), radius)
            nearest[pending] = index
            pending = pending[index == NONE_WITHIN_REACH]
        return nearest

    def distance(self, points: NDArray[np.float32], nearest: NDArray[np.int64]) -> NDArray[np.float64]:
        """(m,) distance from each query to the cloud point that ``query`` found; infinity if it found none."""
        has_nearest = nearest != NONE_WITHIN_REACH
        distance = np.full(len(points), np.inf)
        difference = points[has_nearest].astype(np.float64) - self._xyz[nearest[has_nearest]]
        distance[has_nearest] = np.sqrt((difference * difference).sum(axis=1))
        return distance


_COLUMNS = np.array([(x, y) for x in (-1, 0, 1) for y in (-1, 0, 1)])


def _nearest_within(buckets: VoxelBuckets, points: NDArray[np.float64], radius: float) -> NDArray[np.int64]:
    """Index of the nearest point no farther than radius (just under the voxels' edge), else NONE_WITHIN_REACH."""
    nearest = np.full(len(points), NONE_WITHIN_REACH, np.int64)
    for first in range(0, len(points), QUERIES_PER_CHUNK):
        chunk = points[first : first + QUERIES_PER_CHUNK]
        # The 27 voxels around a point are 9 columns of three consecutive buckets.
        voxel = np.repeat(buckets.voxel(chunk)[:, None] - [0, 0, 1], len(_COLUMNS), axis=1)
        voxel[..., :2] += _COLUMNS
        bucket = buckets.bucket(voxel)
        start = buckets.starts[bucket]
        count = buckets.starts[bucket + 3] - start
        # Queries are split into runs of about CANDIDATES_PER_CHUNK candidates: some have far more than others.
        candidates = np.cumsum(count.sum(axis=1))
        parts = np.searchsorted(candidates, np.arange(CANDIDATES_PER_CHUNK, candidates[-1], CANDIDATES_PER_CHUNK))
        edges = np.unique(np.concatenate([[0], parts, [len(chunk)]]))
        for low, high in itertools.pairwise(edges):
            rows = slice(low, high)
            nearest[first + low : first + high] = _nearest_among(buckets, chunk[rows], start[rows], count[rows], radius)
    return nearest


def _nearest_among(
    buckets: VoxelBuckets,
    points: NDArray[np.float64],
    start: NDArray[np.int64],
    count: NDArray[np.int64],
    radius: float,
) -> NDArray[np.int64]:
    """Nearest of each point's candidates: sorted points start..start + count of its nine columns; both are (m, 9)."""
    nearest = np.full(len(points), NONE_WITHIN_REACH, np.int64)
    # The ranges start..start + count of all columns, concatenated: one entry per candidate.
    per_query = count.sum(axis=1)
    per_column = count.ravel()
    end = np.cumsum(per_column)
    if end[-1] == 0:
        return nearest
    candidate = np.arange(end[-1]) + np.repeat(start.ravel() - end + per_column, per_column)
    # One coordinate at a time, in place: a fraction of the memory of (candidates, 3).
    squared = np.zeros(len(candidate))
    for axis, coordinate in enumerate((buckets.x, buckets.y, buckets.z)):
        difference = coordinate[candidate]
        difference -= np.repeat(points[:, axis], per_query)
        difference *= difference
        squared += difference

    # The smallest distance of each query with candidates; reduceat takes no empty groups.
    queries = np.flatnonzero(per_query)
    first = (np.cumsum(per_query) - per_query)[queries]
    smallest = np.minimum.reduceat(squared, first)
    smallest = np.where(smallest <= radius * radius, smallest, -1.0)
    # All candidates at that distance, none if it is beyond the radius (-1); ties go to the lowest index in the cloud.
    hit = np.flatnonzero(squared == np.repeat(smallest, per_query[queries]))
    if len(hit):
        query = queries[np.searchsorted(first, hit, side="right") - 1]
        begins = np.flatnonzero(np.diff(query, prepend=-1))
        nearest[query[begins]] = np.minimum.reduceat(buckets.point[candidate[hit]], begins)
    return nearest
