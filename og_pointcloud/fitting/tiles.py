"""Clouds beyond memory: one fit, tile by tile.

What outgrows memory is the work per point: neighbours, splats, and what every view shows of every point. What an
instance is does not: masks are joined by how they overlap, and a sample of the points says that. So nothing is
labelled tile by tile and sewn together afterwards:

    split       tiles of equally many points, cut across the longest side; a tile looks a margin over its borders
    spacing     tile by tile
    views       each is rendered once, with all that is in it, whatever tile it lies in: what stands in front hides what
                is behind. Points finer than its pixels are thinned. What it shows goes to a file, in order of tiles
    instances   masks are grouped once, by a sample of all points, and groups that the views contradict dismissed once
    points      tile by tile: the state of each, from all views that see it and from its neighbours
    evidence    features, areas and parts of the instances, from sums over the tiles

An object that crosses ten tiles is one instance because its masks are one group. No border can contradict another, and
neither the order nor the place of the tiles shows in the result, but for what happens farther away than a margin.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from hashlib import blake2b
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, vstack
from scipy.spatial import cKDTree

from og_pointcloud.cloud import LabelledCloud
from og_pointcloud.errors import OgPointcloudError, SceneError
from og_pointcloud.fitting.association import describe_instances
from og_pointcloud.fitting.fit import (
    check_scene,
    cutoffs,
    labelled_cloud,
    note_choice,
    pixel_stride,
    with_distinct_points,
    with_needed_views,
)
from og_pointcloud.fitting.grouping import MaskGroups, group_masks, indicator
from og_pointcloud.fitting.labellers import Labelling
from og_pointcloud.fitting.mask_table import FRUSTUM_MARGIN, Gaussians, MaskTable, mask_table
from og_pointcloud.fitting.membership import assign_points, without_see_through
from og_pointcloud.fitting.memory import free_memory, memory_in_use
from og_pointcloud.fitting.parts import part_of
from og_pointcloud.fitting.view_votes import hear_views
from og_pointcloud.formats.atomic import replacing
from og_pointcloud.journal import Journal
from og_pointcloud.kernels import njit, prange
from og_pointcloud.rendering.geometry import (
    Neighbourhood,
    chance_of_place,
    choose_gaussians,
    isotropic,
    near_plane,
    neighbourhood,
    sample_of_points,
    thinned,
)
from og_pointcloud.scene import Points, Scene, View
from og_pointcloud.settings import FitSettings

__all__ = ["Tiles", "fit_tiles", "kept_views", "needs_tiles", "split"]

MODES = ("auto", "grouping")
"""Modes that need no more than masks; the others learn from all points at once."""

MARGIN = 32.0
"""How far a tile looks over its borders, in spacings of its sparser points: what settles a point is seldom farther."""
SAMPLE_STEP = 50
"""Masks are grouped by at least one in so many points, also where that is more than a whole fit would take."""
FINEST_PX = 0.35
"""Points closer together than this in an image are thinned to it. On a street of 600,000 points 0.2 % of the labels
then differ, 1.4 % at 0.5 and 17 % at 1, where a point no longer has a splat of its own in any image."""
MOST_SPLATS = 4_000_000
"""A view that would draw more than this is thinned further; drawing takes about 300 bytes a splat."""
CHOICE_POINTS = 1_000_000
"""Size and opacity of the splats are chosen on so many points, spread over the cloud."""
LEAST_TILE, LARGEST_TILE = 125_000, 2_000_000
"""Points of a tile where memory decides, in steps of twice as many: a fit that is taken up finds the same tiles.
Smaller ones are mostly margin, larger ones save no time."""
TILE_BYTES = 1_500
"""Bytes that a tile takes at its peak, per point."""
FIT_BYTES = 1_000
"""Bytes that one fit of a whole cloud takes, per point."""
CLOUD_BYTES = 120
"""Bytes that every point takes, whatever the tiles: positions, colours, spacings, ids, order."""
SUFFIX = ".tile.npy"
"""Ends the names of files in a work folder."""
PROBES = 2_000
"""Points of a tile that are asked for their spacing before its margin is known."""

Rows = NDArray[np.integer]
Entries = NDArray[np.void]
ENTRY = np.dtype([("point", "<i4"), ("row", "<i4"), ("value", "<f4")])
"""What a view with M masks shows of a point. Row below M: weight in that mask. M: weight in none. M + 1: exposure.
M + 2 + mask: weight in that mask, but behind its object, which is believed where enough views see the point."""


def needs_tiles(scene: Scene, settings: FitSettings) -> bool:
    """Whether one fit of all points would take more memory than it may, and tiles would help it."""
    return settings.mode in MODES and len(scene.points) * FIT_BYTES > _room(settings)


def kept_views(work: Path) -> int:
    """How many views an interrupted fit in tiles has left in its work folder."""
    return len(list(work.glob(f"view-*{SUFFIX}")))


def fit_tiles(
    scene: Scene,
    settings: FitSettings | None = None,
    *,
    points_per_tile: int | None = None,
    work: str | os.PathLike[str] | None = None,
    progress: bool = True,
) -> LabelledCloud:
    """Label a scene as `fit` does by grouping masks, in memory that the tiles bound, not the cloud.

    points_per_tile: at most; None: what the memory of the settings allows. work: a folder for the neighbours of the
    points and for what the views show (80 bytes a point, and about 25 for each view that sees it). It is kept where
    the fit is interrupted, taken up by the next fit of the same scene and settings, and emptied by one that ends well.
    None: a temporary folder.

    Deterministic. Raises SceneError where `fit` does, and OgPointcloudError for a mode that learns from all points at
    once.
    """
    settings = settings or FitSettings()
    journal = Journal(progress)
    _check(scene, settings, journal)
    whole = scene
    views = with_needed_views(scene, settings, journal).views
    scene, place = with_distinct_points(scene, journal)
    most = points_per_tile or _points_per_tile(len(scene.points), settings)
    with _Kept.open(Path(work) if work else None, _key(scene.points, settings, most)) as kept:
        with journal.stage("spacing"):
            cloud = _tiled(scene.points, most, settings, kept, journal)
        with journal.stage("geometry"):
            drawing = _drawing(views, cloud, settings, journal)
        with journal.stage("visibility"):
            shown = _look(views, cloud, drawing, settings, kept, journal)
        with journal.stage("grouping"):
            groups = _instances(cloud, shown, settings, journal)
        with journal.stage("membership"):
            tiles = journal.steps(range(len(cloud.tiles)), "membership")
            settled = [_settle(tile, cloud, shown, groups, settings, kept) for tile in tiles]
        with journal.stage("association"):
            labelling = _evidence(cloud, shown, groups, settled, settings)
    if settings.mode == "auto":
        journal.leave_out(
            "learned features and codebook", "they learn from all points at once, which tiles do not hold"
        )
    return labelled_cloud(whole, labelling, place, cloud.spacing, settings, journal)


def _check(scene: Scene, settings: FitSettings, journal: Journal) -> None:
    if settings.mode not in MODES:
        raise OgPointcloudError(
            f'mode is "{settings.mode}", which learns from all points at once; expected "auto" or "grouping" for a fit '
            "in tiles: take one of these, or thin the cloud until it fits whole"
        )
    check_scene(scene, journal)


def _room(settings: FitSettings) -> int:
    """Bytes that a fit may take beside what the process holds."""
    return settings.memory - memory_in_use() if settings.memory else free_memory() // 2


def _points_per_tile(points: int, settings: FitSettings) -> int:
    room = _room(settings)
    fitting = (room - points * CLOUD_BYTES) // TILE_BYTES
    if fitting < LEAST_TILE:
        raise OgPointcloudError(
            f"{points:,} points take {points * CLOUD_BYTES / 1e9:.1f} GB beside the scene, and tiles of {LEAST_TILE:,} "
            f"{LEAST_TILE * TILE_BYTES / 1e9:.1f} GB; the fit has {max(room, 0) / 1e9:.1f} GB: give it more memory, or "
            "thin the cloud"
        )
    return min(LEAST_TILE << (fitting // LEAST_TILE).bit_length() - 1, LARGEST_TILE)


# Tiles ----------------------------------------------------------------------------------------------------------


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
    """As few tiles of equally many points as hold at most ``most`` each, where points do not coincide.

    What holds more is cut across its longer side (that of the middle 90 % of its points: strays are no extent), so
    that tiles are compact, small where points are dense, and never empty.
    """
    leaves: list[Rows] = []

    def cut(rows: Rows, count: int) -> None:
        low, high = np.quantile(xyz[rows], [0.05, 0.95], axis=0) if count > 1 else (np.zeros(0), np.zeros(0))
        for axis in np.argsort(low - high, kind="stable"):
            along = xyz[rows, axis]
            place = len(rows) * (count // 2) // count
            before = along < np.partition(along, place)[place]
            if before.any():
                cut(rows[before], count // 2)
                cut(rows[~before], count - count // 2)
                return
        leaves.append(rows)

    cut(np.arange(len(xyz)), -(-len(xyz) // most))
    return Tiles(np.concatenate(leaves), np.cumsum([0, *map(len, leaves)]))


@dataclass(frozen=True)
class _TiledCloud:
    """points, spacing (n,): in the order of the tiles. members: per tile, its points and those within its margin,
    ascending; they are int32 as there are many."""

    tiles: Tiles
    points: Points
    spacing: NDArray[np.float32]
    members: tuple[NDArray[np.int32], ...]

    def own(self, tile: int) -> slice:
        """A tile's own points among its members."""
        part = self.tiles.part(tile)
        first, last = np.searchsorted(self.members[tile], [part.start, part.stop])
        return slice(int(first), int(last))


def _tiled(points: Points, most: int, settings: FitSettings, kept: _Kept, journal: Journal) -> _TiledCloud:
    tiles = split(points.xyz, most)
    points = _rows_of(points, tiles.order)
    parts = [tiles.part(tile) for tile in range(len(tiles))]
    boxes = np.array([[points.xyz[part].min(axis=0), points.xyz[part].max(axis=0)] for part in parts])
    margins = [MARGIN * _sparse_spacing(points.xyz[part]) for part in parts]
    members = tuple(_within(points.xyz, parts, boxes, tile, margin) for tile, margin in enumerate(margins))
    cloud = _TiledCloud(tiles, points, np.empty(len(points), np.float32), members)
    for tile in journal.steps(range(len(tiles)), "spacing"):
        cloud.spacing[parts[tile]] = _neighbours(tile, cloud, settings, kept).spacing[cloud.own(tile)]
    journal.notes["tiles"] = [part.stop - part.start for part in parts]
    journal.notes["tile_margins"] = [float(f"{margin:.4g}") for margin in margins]
    return cloud


def _rows_of(points: Points, rows: Rows) -> Points:
    """Some of the points, in that order; without normals, which no stage needs."""
    names = ("rgb", "scale", "rotation", "opacity")
    columns: dict[str, Any] = {name: getattr(points, name) for name in names}
    return Points(
        points.xyz[rows],
        points.origin,
        **{name: None if all_ is None else all_[rows] for name, all_ in columns.items()},
    )


def _sparse_spacing(xyz: NDArray[np.float32]) -> float:
    """The spacing that 95 % of the points do not exceed, by some of them."""
    tree = cKDTree(xyz, balanced_tree=False, compact_nodes=False)
    distance, _ = tree.query(xyz[:: 1 + len(xyz) // PROBES], k=[2, 3, 4])
    known = np.where(np.isfinite(distance), distance, np.nan)  # fewer than four points
    spacing = np.nanmean(known, axis=1) if np.isfinite(known).any() else np.zeros(1)
    return float(np.quantile(spacing, 0.95))


def _within(
    xyz: NDArray[np.float32], parts: Sequence[slice], boxes: NDArray[np.float32], tile: int, margin: float
) -> NDArray[np.int32]:
    """The points of a tile and, of the others, those that lie within the margin of its box."""
    low, high = boxes[tile, 0] - margin, boxes[tile, 1] + margin
    rows = []
    for other, part in enumerate(parts):
        index = np.arange(part.start, part.stop, dtype=np.int32)
        if other != tile:
            apart = (boxes[other, 0] > high).any() or (boxes[other, 1] < low).any()
            index = index[:0] if apart else index[((xyz[part] >= low) & (xyz[part] <= high)).all(axis=1)]
        rows.append(index)
    return np.concatenate(rows)


def _neighbours(tile: int, cloud: _TiledCloud, settings: FitSettings, kept: _Kept) -> Neighbourhood:
    """The neighbourhood of a tile's members, numbered as these."""

    def find() -> NDArray[Any]:
        around = neighbourhood(cloud.points.xyz[cloud.members[tile]], settings.geometry)
        width = around.index.shape[1]
        kind = [("spacing", "<f4"), ("index", "<i4", (width,)), ("adjoining", "?", (width,))]
        records = np.empty(len(around.index), kind)
        records["spacing"], records["index"], records["adjoining"] = around.spacing, around.index, around.adjoining
        return records

    records = kept.array(f"neighbours-{tile:04d}", find)
    return Neighbourhood(*(np.ascontiguousarray(records[name]) for name in ("spacing", "index", "adjoining")))


# Views ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Drawing:
    """How points are drawn, the same in every tile. scale, opacity: of a plain cloud's splats, in spacings; None for
    Gaussians. near, typical: lengths. stride: every stride-th row and column of the images."""

    scale: float | None
    opacity: float | None
    near: float
    typical: float
    stride: int

    def splats(self, cloud: _TiledCloud, rows: Rows, larger: NDArray[np.float32]) -> Gaussians:
        """Splats of some points, each so many times larger than it would be."""
        chosen = _rows_of(cloud.points, rows)
        if self.scale is None or self.opacity is None:
            splats = Gaussians.from_points(chosen)
            return replace(splats, scale=splats.scale * larger[:, None])
        return isotropic(chosen, cloud.spacing[rows] * larger, self.scale, self.opacity)


def _drawing(views: Sequence[View], cloud: _TiledCloud, settings: FitSettings, journal: Journal) -> _Drawing:
    """Size and opacity of the splats, and the share of the pixels that are worth a look, once for all tiles."""
    points, geometry = cloud.points, settings.geometry
    near, typical = near_plane(points.xyz, views), float(np.median(cloud.spacing))
    if points.are_gaussians:
        journal.leave_out("choice of scale and opacity", "the file holds Gaussians")
        return _Drawing(None, None, near, typical, 1)
    few, spacing = points, cloud.spacing
    if len(points) > CHOICE_POINTS:
        left_out = f"{1 - CHOICE_POINTS / len(points):.0%} of the points in the choice of scale and opacity"
        journal.leave_out(left_out, "the rest say enough")
        few = _rows_of(points, sample_of_points(points.xyz, CHOICE_POINTS))
        spacing = neighbourhood(few.xyz, geometry).spacing
    choice = choose_gaussians(few, spacing, views, near, geometry, partial(journal.steps, name="geometry"))
    note_choice(choice, journal)
    stride = pixel_stride(points, cloud.spacing, views, geometry, journal)
    return _Drawing(choice.scale, choice.opacity, near, typical, stride)


@dataclass(frozen=True)
class _Shown:
    """What all views show. entries: per view, reads its array of ENTRY, sorted by point. first: (views, tiles + 1),
    where each tile's points begin in it. mask_view, mask_features: as in `MaskTable`."""

    entries: tuple[Callable[[], Entries], ...]
    first: Rows
    mask_view: NDArray[np.int32]
    mask_features: NDArray[np.float32]

    def table(self, cloud: _TiledCloud, rows: NDArray[np.integer], few_views: int) -> MaskTable:
        """The mask table of some points, given in ascending order.

        Weight behind a mask's object counts as outside the mask where fewer views see the point than could contradict
        the mask (membership.without_see_through).
        """
        place = np.full(len(cloud.points), -1, np.int32)
        place[rows] = np.arange(len(rows), dtype=np.int32)
        tiles = np.flatnonzero(np.diff(np.searchsorted(rows, cloud.tiles.start)))
        views, masks = len(self.entries), np.bincount(self.mask_view, minlength=len(self.entries))
        witnesses = np.zeros(len(rows), np.int32)
        parts = []
        for view in range(views):
            entries = self.entries[view]()
            pieces = [entries[self.first[view, tile] : self.first[view, tile + 1]] for tile in tiles]
            part = np.concatenate([piece[place[piece["point"]] >= 0] for piece in pieces])
            part["point"] = place[part["point"]]
            witnesses[part["point"][part["row"] == masks[view] + 1]] += 1
            parts.append(part)
        seldom = witnesses < few_views
        stacks = [_stacked(part, count, seldom) for part, count in zip(parts, masks.tolist(), strict=True)]
        weights, outside, exposure = (csr_array(vstack(blocks, format="csr")) for blocks in zip(*stacks, strict=True))
        no_pixels = np.zeros(len(self.mask_view), np.int32)  # asked only where what is behind an object is found
        return MaskTable(weights, outside, exposure, self.mask_view, no_pixels, self.mask_features)


def _stacked(entries: Entries, masks: int, seldom: NDArray[np.bool_]) -> tuple[csr_array, csr_array, csr_array]:
    """Weights (masks, n), outside (1, n) and exposure (1, n) of one view."""
    row, point = entries["row"], entries["point"]
    row = np.where(row > masks + 1, np.where(seldom[point], masks, row - masks - 2), row)
    matrix = csr_array((entries["value"], (row, point)), shape=(masks + 2, len(seldom)))
    return matrix[:masks], matrix[masks : masks + 1], matrix[masks + 1 :]


def _look(
    views: Sequence[View], cloud: _TiledCloud, drawing: _Drawing, settings: FitSettings, kept: _Kept, journal: Journal
) -> _Shown:
    """Render every view once. What is left of an interrupted fit is not rendered again."""
    readers, first = [], []
    thinning: list[tuple[int, int]] = []
    for view in journal.steps(views, "visibility"):
        view = thinned(view, drawing.stride)
        view = replace(view, masks=view.mask_map())
        show = partial(_entries, view, cloud, drawing, settings, thinning)
        read = partial(kept.array, f"view-{_mark(view, drawing)}", show)
        readers.append(read)
        first.append(np.searchsorted(np.ascontiguousarray(read()["point"]), cloud.tiles.start))
    if not any(row[-1] for row in first):
        raise SceneError(
            f"no camera sees the cloud: {len(cloud.points)} points, {len(views)} views, none in any image; check that "
            "poses and cloud share one frame and that poses are camera-to-world (transforms.json) as documented"
        )
    drawn, inside = np.sum(thinning, axis=0) if thinning else (0, 0)
    if drawn < inside:
        why = f"closer together than {FINEST_PX:g} px, or more than {MOST_SPLATS:,} in one: larger ones stand in"
        journal.leave_out(f"{1 - drawn / inside:.0%} of the points in the images", why)
    mask_view = np.repeat(np.arange(len(views), dtype=np.int32), [view.mask_count for view in views])
    features = np.concatenate([view.mask_features for view in views if view.mask_count])
    return _Shown(tuple(readers), np.array(first), mask_view, features)


def _entries(
    view: View, cloud: _TiledCloud, drawing: _Drawing, settings: FitSettings, thinning: list[tuple[int, int]]
) -> Entries:
    """What one view shows. thinning: gets how many points were drawn, and how many there are in the image."""
    rows, larger, inside = _worth_drawing(view, cloud, drawing, settings.visibility.alpha_min)
    thinning.append((len(rows), inside))
    if len(rows) == 0:
        return np.zeros(0, ENTRY)
    splats = drawing.splats(cloud, rows, larger)
    apart = np.maximum(cloud.spacing[rows] * larger, drawing.typical)
    thickness = (settings.geometry.thickness * apart + 3 * splats.scale.max(axis=1)).astype(np.float32)
    whole = mask_table(splats, [view], drawing.near, thickness, cutoffs=cutoffs(settings))
    camera = view.camera
    # In a table of one view each point has too few of them to contradict a mask: all that is behind is found.
    front, _ = without_see_through(
        whole, splats, camera.world_to_camera[2:3], np.sqrt([camera.fx * camera.fy]), settings.membership
    )
    behind = csr_array(whole.weights - front.weights)
    behind.eliminate_zeros()
    masks = view.mask_count
    blocks = [(front.weights, 0), (whole.outside, masks), (whole.exposure, masks + 1), (behind, masks + 2)]
    entries = np.empty(sum(block.nnz for block, _ in blocks), ENTRY)
    end = 0
    for block, first_row in blocks:
        begin, end = end, end + block.nnz
        entries["point"][begin:end] = rows[block.indices]
        entries["row"][begin:end] = first_row + np.repeat(np.arange(block.shape[0]), np.diff(block.indptr))
        entries["value"][begin:end] = block.data
    return entries[np.argsort(entries["point"], kind="stable")]


def _worth_drawing(
    view: View, cloud: _TiledCloud, drawing: _Drawing, alpha_min: float
) -> tuple[Rows, NDArray[np.float32], int]:
    """The points in an image that are drawn, how much larger than they are, and how many there are in it.

    Those that lie FINEST_PX apart or more are all drawn; of others a part, by chance, such that they do. Larger in
    proportion, they cover what all of them did.
    """
    camera, points = view.camera, cloud.points
    widest = cloud.spacing * np.float32(drawing.scale) if points.scale is None else points.scale.max(axis=1)
    intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
    size, reach = (camera.width, camera.height), np.sqrt(-2 * np.log(alpha_min))
    pose = camera.world_to_camera
    apart = _apart_px(points.xyz, cloud.spacing, widest, reach, pose, intrinsics, size, drawing.near)
    rows = np.flatnonzero(apart)
    apart, finest = apart[rows], FINEST_PX
    while (part := np.minimum(1, (apart / finest) ** 2, dtype=np.float32)).sum(dtype=np.float64) > MOST_SPLATS:
        finest *= 1.2
    drawn = chance_of_place(points.xyz[rows], view.name) < part
    return rows[drawn], (1 / np.sqrt(part[drawn])).astype(np.float32), len(rows)


@njit(cache=True, parallel=True, error_model="numpy")
def _apart_px(xyz, spacing, widest, reach, pose, intrinsics, size, near):  # noqa: ANN001, ANN202
    """(n,) float32: how many pixels apart points lie where they are; 0 where they are surely in no pixel.

    A splat reaches ``reach`` standard deviations, its own and those of the pixels' low-pass (splatting.py).
    """
    apart = np.zeros(len(xyz), np.float32)
    fx, fy, cx, cy = intrinsics
    width, height = size
    low_x, high_x = -cx / fx - FRUSTUM_MARGIN * 0.5 * width / fx, (width - cx) / fx + FRUSTUM_MARGIN * 0.5 * width / fx
    low_y, high_y = (
        -cy / fy - FRUSTUM_MARGIN * 0.5 * height / fy,
        (height - cy) / fy + FRUSTUM_MARGIN * 0.5 * height / fy,
    )
    for g in prange(len(xyz)):
        x, y, z = np.float64(xyz[g, 0]), np.float64(xyz[g, 1]), np.float64(xyz[g, 2])
        depth = pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z + pose[2, 3]
        if not depth > near:
            continue
        tx = (pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z + pose[0, 3]) / depth
        ty = (pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z + pose[1, 3]) / depth
        # The projection is linearised within a margin of the image: there a round splat is widened by its direction.
        jx, jy = min(max(tx, low_x), high_x), min(max(ty, low_y), high_y)
        reach_x = reach * (fx * widest[g] / depth * np.sqrt(1 + jx * jx) + 0.6) + 1
        reach_y = reach * (fy * widest[g] / depth * np.sqrt(1 + jy * jy) + 0.6) + 1
        u, v = fx * tx + cx, fy * ty + cy
        if -reach_x < u < width + reach_x and -reach_y < v < height + reach_y:
            apart[g] = np.sqrt(fx * fy) * spacing[g] / depth
    return apart


# Instances and points -------------------------------------------------------------------------------------------


def _instances(cloud: _TiledCloud, shown: _Shown, settings: FitSettings, journal: Journal) -> MaskGroups:
    """Masks grouped by a sample of all points; without those groups that the scene's views contradict."""
    count = max(settings.grouping.graph_points, len(cloud.points) // SAMPLE_STEP)
    sample = sample_of_points(cloud.points.xyz, count)
    table = shown.table(cloud, sample, settings.membership.few_views)
    testimony = hear_views(table)
    groups = group_masks(table, testimony, settings.grouping)
    if groups.spanning.any():
        journal.leave_out(f"{groups.spanning.sum()} masks", "most views show each of them as several things")
    around = neighbourhood(cloud.points.xyz[sample], settings.geometry)
    judged = assign_points(table, testimony, groups, around, settings.membership)
    # Groups of which the sample shows no sure point have rate 0: of these the tiles know more.
    dismissed = judged.dismissed & (judged.detection_rate > 0)
    if dismissed.any():
        journal.leave_out(
            f"{dismissed.sum()} of {groups.count} groups of masks",
            "views that see their points mostly show no such mask, far more often than the proposer's misses explain",
        )
    return replace(groups, group=np.where((groups.group >= 0) & dismissed[groups.group], -1, groups.group))


@dataclass(frozen=True)
class _Settled:
    """Of a tile's own points: ids, the group of each, BACKGROUND or UNOBSERVED, and certainty; in_masks (masks, groups)
    and outside (views, groups), sparse, what shows of each group's points there."""

    ids: NDArray[np.int32]
    certainty: NDArray[np.float32]
    in_masks: csr_array
    outside: csr_array


def _settle(
    tile: int, cloud: _TiledCloud, shown: _Shown, groups: MaskGroups, settings: FitSettings, kept: _Kept
) -> _Settled:
    """Decide the state of a tile's points."""
    table = shown.table(cloud, cloud.members[tile], settings.membership.few_views)
    around = _neighbours(tile, cloud, settings, kept)
    # Which groups are noise was decided for all tiles.
    membership = replace(settings.membership, rate_share=0.0)
    decided = assign_points(table, hear_views(table), groups, around, membership)
    ids, mine = decided.instance_ids, cloud.own(tile)
    own = np.full(len(ids), -1, np.int32)
    own[mine] = ids[mine]
    of_groups = indicator(own, groups.count).T
    in_masks, outside = csr_array(table.weights @ of_groups), csr_array(table.outside @ of_groups)
    return _Settled(ids[mine], decided.certainty[mine], in_masks, outside)


def _evidence(
    cloud: _TiledCloud, shown: _Shown, groups: MaskGroups, settled: Sequence[_Settled], settings: FitSettings
) -> Labelling:
    """Groups that have points become instances, largest first; what is known of them comes from sums over the tiles."""
    in_order = np.concatenate([tile.ids for tile in settled])
    used = np.unique(in_order[in_order >= 0])
    number = np.full(groups.count + 2, -1, np.int32)
    number[used] = np.arange(len(used), dtype=np.int32)
    ids = np.empty(len(in_order), np.int32)
    ids[cloud.tiles.order] = np.where(in_order >= 0, number[in_order], in_order)
    certainty = np.empty(len(ids), np.float32)
    certainty[cloud.tiles.order] = np.concatenate([tile.certainty for tile in settled])
    group = number[groups.group]
    table = _table_of_sums(ids, used, shown, settled)
    instances = describe_instances(table, group, ids, len(used), settings.association)
    return Labelling(ids, replace(instances, part_of=part_of(table, group, ids, len(used))), group, certainty)


def _table_of_sums(ids: NDArray[np.int32], used: Rows, shown: _Shown, settled: Sequence[_Settled]) -> MaskTable:
    """A mask table in which the first point of every instance stands for all its points.

    What is asked of a table once the points have their ids are sums over the points of an instance: here they are.
    """
    first = np.zeros(len(used), np.int64)
    labelled = np.flatnonzero(ids >= 0)[::-1]
    first[ids[labelled]] = labelled

    def at_first(sums: csr_array) -> csr_array:
        entries = csr_array(sums[:, used]).tocoo()
        place = (entries.row, first[entries.col])
        return csr_array((entries.data.astype(np.float32), place), shape=(sums.shape[0], len(ids)))

    weights = at_first(sum((tile.in_masks for tile in settled[1:]), settled[0].in_masks))
    outside = at_first(sum((tile.outside for tile in settled[1:]), settled[0].outside))
    no_pixels = np.zeros(len(shown.mask_view), np.int32)
    return MaskTable(weights, outside, csr_array(outside.shape), shown.mask_view, no_pixels, shown.mask_features)


# The work folder ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Kept:
    """Arrays on disk by name, and a key to what they are of: a file of another key is not taken up."""

    folder: Path
    key: str

    @classmethod
    @contextmanager
    def open(cls, folder: Path | None, key: str) -> Iterator[_Kept]:
        """In a folder, whose files go when the block ends well; or in a temporary one, which goes in any case."""
        if folder is None:
            large = "/var/tmp"  # more than memory, where /tmp may be memory
            place = None if os.environ.get("TMPDIR") or not os.access(large, os.W_OK) else large
            with tempfile.TemporaryDirectory(prefix="og-pointcloud-", dir=place) as temporary:
                yield cls(Path(temporary), key)
            return
        folder.mkdir(parents=True, exist_ok=True)
        yield cls(folder, key)
        for path in [*folder.glob(f"*{SUFFIX}"), *folder.glob(f".*{SUFFIX}.*.tmp")]:  # the latter of a killed fit
            path.unlink()
        with suppress(OSError):
            folder.rmdir()  # there is more in it

    def array(self, name: str, make: Callable[[], NDArray[Any]]) -> NDArray[Any]:
        """The array of that name, mapped; made and kept, whole or not at all, where it is not there yet."""
        path = self.folder / f"{name}-{self.key}{SUFFIX}"
        if not path.exists():
            try:
                with replacing(path) as file:
                    np.lib.format.write_array(file, make(), allow_pickle=False)
            except OSError as error:
                raise OgPointcloudError(
                    f"no room for '{path}' ({error.strerror}); give a work folder on a larger disk"
                ) from error
        return np.load(path, mmap_mode="r", allow_pickle=False)


def _key(points: Points, settings: FitSettings, most: int) -> str:
    """A fingerprint of all that the kept arrays depend on, but for the views."""
    digest = blake2b(f"1 {settings} {most} {MARGIN} {FINEST_PX} {MOST_SPLATS}".encode(), digest_size=12)
    for array in (points.xyz, points.scale, points.rotation, points.opacity):
        digest.update(b"" if array is None else np.ascontiguousarray(array).data)
    return digest.hexdigest()


def _mark(view: View, drawing: _Drawing) -> str:
    """A fingerprint of what a view shows, points and settings being the same."""
    camera, ids = view.camera, view.mask_map()
    numbers = camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy, view.mask_count
    digest = blake2b(f"{view.name} {numbers} {drawing}".encode(), digest_size=12)
    digest.update(np.ascontiguousarray(camera.world_to_camera).data)
    digest.update(ids.data)
    return digest.hexdigest()
