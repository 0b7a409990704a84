"""A cloud cut into tiles, in files of a work folder that all workers of a fit map."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from og_pointcloud.errors import OgPointcloudError
from og_pointcloud.fitting.work_folder import WorkFolder, fingerprint
from og_pointcloud.rendering.geometry import Neighborhood, neighborhood
from og_pointcloud.scene import Points
from og_pointcloud.settings import FitSettings, GeometrySettings

MARGIN_SPACINGS = 32.0
"""Margin around a tile, in spacings of its sparser points: all that decides about a point lies within it."""
SPACING_SAMPLE_POINTS = 2_000
"""Approximate number of points that a tile's spacing, and so its margin, is computed from."""

Rows = NDArray[np.integer]


@dataclass(frozen=True)
class Tiles:
    """order: (n,) rows of the cloud, tile by tile, ascending within a tile. start: (tiles + 1,) where each begins."""

    order: Rows
    start: Rows

    def __len__(self) -> int:
        return len(self.start) - 1

    def part(self, tile: int) -> slice:
        """A tile's points in arrays that are in ``order``."""
        return slice(int(self.start[tile]), int(self.start[tile + 1]))


def split(xyz: NDArray[np.float32], most: int) -> Tiles:
    """The fewest tiles of equally many points, at most ``most`` each unless points coincide.

    A part with more is cut across its longest side, measured over the middle 90 % of its points to ignore strays. So
    tiles are compact, small where points are dense, and never empty.
    """
    leaves: list[Rows] = []

    def cut(rows: Rows, count: int) -> None:
        """Cut rows into ``count`` tiles, by halves of that number; a part without extent stays one, however large."""
        low, high = np.quantile(xyz[rows], [0.05, 0.95], axis=0) if count > 1 else (np.zeros(0), np.zeros(0))
        for axis in np.argsort(low - high, kind="stable"):
            along = xyz[rows, axis]
            place = len(rows) * (count // 2) // count
            before = along < np.partition(along, place)[place]
            if before.any():  # else so many points share the lowest coordinate: try a shorter side
                cut(rows[before], count // 2)
                cut(rows[~before], count - count // 2)
                return
        leaves.append(rows)

    cut(np.arange(len(xyz)), -(-len(xyz) // most))
    return Tiles(np.concatenate(leaves), np.cumsum([0, *map(len, leaves)]))


class TiledCloud:
    """A cloud in the order of its tiles, read-only. Made by `TiledCloud.cut`.

    points, spacing (n,), drawn_points: the last two only once a stage has put them into the work folder. members: per
    tile, its points and those within its margin, ascending; int32 as there are many. margins: (tiles,) lengths in the
    scene's unit. key: fingerprint of points, tiles and settings. work: where all of it is, for other processes too.
    """

    def __init__(self, work: WorkFolder, key: str) -> None:
        self.work, self.key = work, key
        order, start, self.margins, ends, members, xyz, origin, rgb = work.arrays("cloud", key, vanished)
        self.tiles, self.points = Tiles(order, start), Points(xyz, origin, rgb if len(rgb) else None)
        self.members = tuple(members[first:last] for first, last in pairwise(ends.tolist()))

    @classmethod
    def cut(cls, points: Points, most: int, settings: FitSettings, work: WorkFolder) -> TiledCloud:
        """Tiles of at most ``most`` points, and the points within their margins."""
        key = fingerprint(points.xyz, points.rgb, settings, most, MARGIN_SPACINGS)

        def arrays() -> list[NDArray[Any]]:
            tiles = split(points.xyz, most)
            ordered = points.take(tiles.order)
            parts = [tiles.part(tile) for tile in range(len(tiles))]
            margins = [MARGIN_SPACINGS * _sparse_spacing(ordered.xyz[part]) for part in parts]
            members = [_within(ordered.xyz, part, margin) for part, margin in zip(parts, margins, strict=True)]
            # A file holds a flat list of arrays: members of all tiles in one, colors empty where there are none.
            ends, rgb = np.cumsum([0, *map(len, members)]), ordered.rgb
            cloud = ordered.xyz, ordered.origin, np.zeros((0, 3), np.uint8) if rgb is None else rgb
            return [tiles.order, tiles.start, np.array(margins), ends, np.concatenate(members), *cloud]

        work.arrays("cloud", key, arrays)
        return cls(work, key)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickled as a folder and a key: a task carries no points, its worker maps them."""
        return _opened, (self.work.place(), self.key)

    def __len__(self) -> int:
        return len(self.points)

    @cached_property
    def spacing(self) -> NDArray[np.float32]:
        """(n,) float32, as `Neighborhood.spacing`."""
        return self.work.arrays("spacing", self.key, vanished)[0][0]

    @cached_property
    def drawn_spacing(self) -> NDArray[np.float32]:
        """(n,) float32, as `geometry.drawn_spacing`."""
        return self.work.arrays("spacing", self.key, vanished)[0][1]

    @cached_property
    def drawn_points(self) -> Points:
        """The points at the positions at which they are drawn (smoothing.py)."""
        return replace(self.points, xyz=self.work.arrays("spacing", self.key, vanished)[1])

    def inner(self, tile: int) -> slice:
        """The slice of a tile's members that are its own points, not its margin's."""
        part = self.tiles.part(tile)
        first, last = np.searchsorted(self.members[tile], [part.start, part.stop])
        return slice(int(first), int(last))

    def neighbors(self, tile: int, settings: GeometrySettings) -> Neighborhood:
        """The neighborhood of a tile's members, numbered as these; it stays in the work folder."""

        def find() -> tuple[NDArray[np.generic], ...]:
            around = neighborhood(self.points.xyz[self.members[tile]], settings)
            return around.spacing, around.index, around.adjoining

        return Neighborhood(*map(np.array, self.work.arrays(f"neighbors-{tile:04d}", self.key, find)))


@lru_cache(maxsize=1)
def _opened(folder: Path, key: str) -> TiledCloud:
    """In another process: one cloud for all of its tasks, so that each file's checksum is read once."""
    return TiledCloud(WorkFolder(folder), key)


def vanished() -> NoReturn:
    """Called to make arrays that another process should have made already: raises."""
    raise OgPointcloudError(
        "a file of the work folder is missing or damaged, or a worker cannot see it; expected a folder "
        "that all workers share: give such a work folder, or set TMPDIR to one"
    )


def _sparse_spacing(xyz: NDArray[np.float32]) -> float:
    """The spacing that 95 % of the points do not exceed, by a sample of them."""
    # Fast to build rather than to query: few points are looked up. The first neighbor is the point itself.
    tree = cKDTree(xyz, balanced_tree=False, compact_nodes=False)
    distance, _ = tree.query(xyz[:: 1 + len(xyz) // SPACING_SAMPLE_POINTS], k=[2, 3, 4])
    known = np.where(np.isfinite(distance), distance, np.nan)  # fewer than four points
    spacing = np.nanmean(known, axis=1) if np.isfinite(known).any() else np.zeros(1)
    return float(np.quantile(spacing, 0.95))


def _within(xyz: NDArray[np.float32], part: slice, margin: float) -> NDArray[np.int32]:
    """The points of a tile and those of others that lie within the margin of its box."""
    low, high = xyz[part].min(axis=0) - margin, xyz[part].max(axis=0) + margin
    return np.flatnonzero(((xyz >= low) & (xyz <= high)).all(axis=1)).astype(np.int32)
