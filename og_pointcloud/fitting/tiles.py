"""Clouds beyond memory: one fit, tile by tile.

What outgrows memory is the work per point: neighbors, splats, and what every view shows of every point. What forms an
instance does not: masks are joined by their overlaps, which a sample of the points measures. So nothing is labelled
tile by tile and sewn together afterwards:

    split       tiles of equally many points, cut across the longest side; a tile includes a margin around its borders
    spacing     tile by tile
    views       each is rendered once, with the points of all tiles in it: what stands in front hides what is behind.
                Points finer than its pixels are thinned. What it shows goes to a file, in order of tiles
    instances   masks are grouped once, by a sample of all points, and groups that the views contradict dismissed once
    points      tile by tile: the state of each, from all views that see it and from its neighbors
    evidence    features, areas and parts of the instances, from sums over the tiles

An object that crosses ten tiles is one instance because its masks are one group. No border can contradict another, and
the result does not depend on the order or place of the tiles, except for effects from beyond a margin.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, vstack

from og_pointcloud.errors import OgPointcloudError
from og_pointcloud.fitting.association import describe_instances
from og_pointcloud.fitting.colors import COLOR_DIFFERENCE_BINS
from og_pointcloud.fitting.grouping import MaskGroups, group_masks, indicator
from og_pointcloud.fitting.held_out import choose_scale, note_scale
from og_pointcloud.fitting.labellers import LABELLERS, Labelling, grouping, renumbered
from og_pointcloud.fitting.looks import Looks, by_look, looks_of_groups
from og_pointcloud.fitting.mask_table import (
    MaskTable,
    mask_table,
    require_sight,
    stacked_features,
    stacked_tracks,
    view_fingerprint,
)
from og_pointcloud.fitting.membership import SceneVotes, assign_and_correct_groups, assign_points
from og_pointcloud.fitting.memory import memory_left
from og_pointcloud.fitting.photographs import Photographs
from og_pointcloud.fitting.see_through import without_see_through
from og_pointcloud.fitting.seen_colors import (
    NO_DIFFERENCE,
    differences,
    sight_ratios,
    warn_of_faults,
    with_color_evidence,
    with_photograph,
)
from og_pointcloud.fitting.tasks import Share, run_tasks, share_here
from og_pointcloud.fitting.tiled_cloud import TiledCloud, vanished
from og_pointcloud.fitting.view_votes import view_votes
from og_pointcloud.fitting.work_folder import WorkFolder, fingerprint
from og_pointcloud.journal import Journal, LeftOut
from og_pointcloud.rendering.coverage import with_needed_views
from og_pointcloud.rendering.geometry import (
    drawn_spacing,
    isotropic,
    near_plane,
    neighborhood,
    position_hash,
    sample_of_points,
)
from og_pointcloud.rendering.pixel_cells import typical_spacing
from og_pointcloud.rendering.smoothing import smoothed
from og_pointcloud.rendering.splatting import ALPHA_MIN, FRUSTUM_MARGIN, LOW_PASS, Gaussians
from og_pointcloud.rendering.surface import sight_thickness, with_needed_points
from og_pointcloud.scene import Camera, Scene, View
from og_pointcloud.settings import FitSettings

SAMPLE_STEP = 50
"""Masks are grouped by at least one in this many points, even if that is more than a fit of the whole would sample."""
MIN_SPACING_PX = 0.35
"""Points closer together than this in an image are thinned to it. On a street of 600,000 points 0.2 % of the labels
then differ, 1.4 % at 0.5 and 17 % at 1, where a point no longer has a splat of its own in any image."""
MAX_SPLATS = 4_000_000
"""A view that would draw more splats than this is thinned further; drawing takes about 300 bytes a splat."""
SCALE_SAMPLE_POINTS = 1_000_000
"""The size of the splats is chosen on at most this many points, spread over the cloud."""
MIN_TILE_POINTS, MAX_TILE_POINTS = 125_000, 2_000_000
"""Points of a tile if memory decides, in powers of two, so that an interrupted fit finds the same tiles although the
free memory is never the same. Smaller tiles are mostly margin, larger ones save no time."""
POINT_TILE_BYTES = 1_500
"""Peak memory of a tile, in bytes per point."""
POINT_FIT_BYTES = 1_000
"""Memory of a fit of a whole cloud, in bytes per point."""
POINT_CLOUD_BYTES = 120
"""Memory of the cloud whatever the tiles, in bytes per point: positions, colors, spacings, ids, order."""

Rows = NDArray[np.integer]
Floats = NDArray[np.float32]
Entries = NDArray[np.void]
ENTRY = np.dtype([("point", "<i4"), ("row", "<i4"), ("value", "<f4")])
"""What a view with M masks shows of a point. Row < M: weight in that mask. M: weight in none. M + 1: exposure. M + 2:
exposure through holes. M + 3: 1 + the distance of its color from its pixel's (seen_colors.py)."""


def needs_tiles(scene: Scene, settings: FitSettings) -> bool:
    """Whether a fit in tiles is requested, or all points at once would take too much memory and tiles would help."""
    if settings.tile_points is not None:
        return True
    points = len(scene.points)
    return (
        LABELLERS[settings.mode] is grouping
        and points > MIN_TILE_POINTS
        and points * POINT_FIT_BYTES > memory_left(settings.memory)
    )


def fit_tiles(
    scene: Scene, settings: FitSettings, work: WorkFolder, journal: Journal, executor: Executor | None = None
) -> tuple[Labelling, float]:
    """Label a scene as `fit` does by grouping masks, in memory that the tiles bound, not the cloud. Returns the
    labelling of all its points, and their typical spacing.

    work: keeps the points, their neighbors and what the views show (110 bytes a point, and about 37 for each view that
    sees it). executor: takes tiles and views as tasks, and its workers read what they need, and write what is large, in
    the work folder; None: one after another, here.
    Raises SceneError where `fit` does, and OgPointcloudError for a mode that learns from all points at once.
    """
    if LABELLERS[settings.mode] is not grouping:
        raise OgPointcloudError(
            f'mode is "{settings.mode}", which learns from all points at once; expected "grouping" for a fit in tiles: '
            "use that, or thin the cloud until it fits into memory"
        )
    xyz = scene.points.xyz
    scene, row_of_point = with_needed_points(scene, journal)
    if settings.tile_points is None and needs_tiles(scene, settings):  # a dense cloud may fit into memory by now
        journal.leave_out(LeftOut.WHOLE_FIT, count=len(scene.points))
    scene = with_needed_views(scene, settings.geometry.enough_views, journal)
    count, run = len(scene.points), partial(run_tasks, executor, journal)
    most = settings.tile_points or _points_per_tile(count, _memory(count, settings, executor))
    with journal.stage("spacing"):
        cloud = TiledCloud.cut(scene.points, most, settings, work)
        journal.notes["tiles"] = np.diff(cloud.tiles.start).tolist()
        journal.notes["tile_margins"] = [float(f"{margin:.4g}") for margin in cloud.margins]
        spacing = partial(_spacing, cloud, settings)
        parts = range(len(cloud.tiles))
        work.arrays("spacing", cloud.key, lambda: _of_all_tiles(run(spacing, parts, "spacing")))
    with journal.stage("geometry"):
        drawing = _drawing(scene.views, cloud, settings, journal)
    with journal.stage("visibility"):
        render = partial(_render, cloud, drawing, settings)
        rendered = run(render, scene.views, "visibility")
        shown = _all_shown(scene, cloud, rendered, journal)
    with journal.stage("grouping"):
        grouped = _groups(cloud, shown, settings, journal)
    with journal.stage("membership"):
        # Points are decided without features: tasks that do not carry them are small.
        no_features = replace(shown, mask_features=np.zeros((len(shown.mask_view), 0), np.float32))
        decide = partial(_decide, cloud, no_features, grouped, settings)
        decided = run(decide, range(len(cloud.tiles)), "membership")
    with journal.stage("association"):
        labelling = _instances(cloud, shown, grouped.looks, decided, settings)
    return labelling.of_points(row_of_point), typical_spacing(xyz, cloud.spacing)


def _memory(points: int, settings: FitSettings, executor: Executor | None) -> int:
    """Bytes that a fit may still take, in this process and in a worker."""
    # In a worker the points are mapped, not held: they do not count against its share.
    left = memory_left(settings.memory)
    if executor is None or (share := executor.submit(share_here, Share()).result().memory) is None:
        return left
    return min(left, share + points * POINT_CLOUD_BYTES)


def _points_per_tile(points: int, left: int) -> int:
    """Points of a tile for a fit that may take ``left`` bytes: MIN_TILE_POINTS times a power of two."""
    fitting = (left - points * POINT_CLOUD_BYTES) // POINT_TILE_BYTES
    if fitting < MIN_TILE_POINTS:
        raise OgPointcloudError(
            f"{points:,} points take {points * POINT_CLOUD_BYTES / 1e9:.1f} GB beside the scene, and tiles of "
            f"{MIN_TILE_POINTS:,} points take {MIN_TILE_POINTS * POINT_TILE_BYTES / 1e9:.1f} GB; the fit has "
            f"{left / 1e9:.1f} GB: give it more memory, or thin the cloud"
        )
    return min(MIN_TILE_POINTS << (fitting // MIN_TILE_POINTS).bit_length() - 1, MAX_TILE_POINTS)


def _spacing(cloud: TiledCloud, settings: FitSettings, tile: int) -> tuple[Floats, Floats]:
    """(2, points of the tile) their spacing, and the spacing that they are drawn by; (points of the tile, 3) the
    positions at which they are drawn."""
    around, inner = cloud.neighbors(tile, settings.geometry), cloud.inner(tile)
    xyz = cloud.points.xyz[cloud.members[tile]]
    return np.stack([around.spacing, drawn_spacing(xyz, around)])[:, inner], smoothed(xyz, around)[inner]


def _of_all_tiles(parts: Sequence[tuple[Floats, Floats]]) -> list[Floats]:
    spacings, positions = zip(*parts, strict=True)
    return [np.concatenate(spacings, axis=1), np.concatenate(positions)]


# Views ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Drawing:
    """How points are drawn, the same in every tile. scale: of their splats, in spacings. near: depth of the near plane.
    typical: typical spacing of the cloud. Both in scene units."""

    scale: float
    near: float
    typical: float

    def splats(self, cloud: TiledCloud, rows: Rows, larger: NDArray[np.float32], opacity: float) -> Gaussians:
        """Splats of some points, each enlarged by the factor ``larger``."""
        return isotropic(cloud.drawn_points.take(rows), cloud.drawn_spacing[rows] * larger, self.scale, opacity)


def _drawing(views: Sequence[View], cloud: TiledCloud, settings: FitSettings, journal: Journal) -> _Drawing:
    """The size of the splats, once for all tiles."""
    points, geometry = cloud.points, settings.geometry
    near, typical = near_plane(points.xyz, (view.camera for view in views)), float(np.median(cloud.spacing))
    sample, spacing, drawn = points, cloud.spacing, cloud.drawn_spacing
    if len(points) > SCALE_SAMPLE_POINTS:
        journal.leave_out(LeftOut.CHOICE_POINTS, share=1 - SCALE_SAMPLE_POINTS / len(points))
        sample = points.take(sample_of_points(points.xyz, SCALE_SAMPLE_POINTS))
        around = neighborhood(sample.xyz, geometry)
        spacing, drawn = around.spacing, drawn_spacing(sample.xyz, around)
    thickness = sight_thickness(spacing, float(np.median(spacing)), geometry)
    choice = choose_scale(sample, drawn, thickness, views, near, settings, journal)
    note_scale(choice, journal)
    return _Drawing(choice.scale, near, typical)


@dataclass(frozen=True)
class _Shown:
    """What all views show. keys: of the array of ENTRY of each view in the cloud's work folder, sorted by point. first:
    (views, tiles + 1), where each tile's points begin in it. mask_view, mask_features, mask_track: as `MaskTable`, of
    the views; ``photographs`` are these views. sight_ratios: what their colors say (seen_colors.py)."""

    keys: tuple[str, ...]
    first: Rows
    mask_view: NDArray[np.int32]
    mask_features: NDArray[np.float32]
    mask_track: NDArray[np.int64] | None
    photographs: Photographs
    sight_ratios: NDArray[np.float32]

    def table(self, cloud: TiledCloud, rows: NDArray[np.integer]) -> MaskTable:
        """The mask table of some points, in ascending order, for photographs, not the views cut from them."""
        # place: the column of each point, -1 for others. Only entries of tiles with such points are read.
        place = np.full(len(cloud.points), -1, np.int32)
        place[rows] = np.arange(len(rows), dtype=np.int32)
        tiles = np.flatnonzero(np.diff(np.searchsorted(rows, cloud.tiles.start)))
        views, masks = len(self.keys), np.bincount(self.mask_view, minlength=len(self.keys))
        stacks = []
        for view in range(views):
            entries = cloud.work.arrays("view", self.keys[view], vanished)[0]
            pieces = [entries[self.first[view, tile] : self.first[view, tile + 1]] for tile in tiles]
            part = np.concatenate([piece[place[piece["point"]] >= 0] for piece in pieces])
            part["point"] = place[part["point"]]
            stacks.append(_stacked(part, int(masks[view]), len(rows)))
        *of_views, difference = zip(*stacks, strict=True)
        weights, outside, exposure, through = (csr_array(vstack(blocks, format="csr")) for blocks in of_views)
        no_pixels = np.zeros(len(self.mask_view), np.int32)  # needed only to find what lies behind an object
        masks_of_views = self.mask_view, no_pixels, self.mask_features, self.mask_track
        table = MaskTable(weights, outside, exposure, *masks_of_views, doubted=through)
        return self.photographs.joined(with_color_evidence(table, np.concatenate(difference), self.sight_ratios))


def _stacked(
    entries: Entries, masks: int, points: int
) -> tuple[csr_array, csr_array, csr_array, csr_array, NDArray[np.uint16]]:
    """Of one view: weights (masks, n); (1, n) outside, exposure and exposure through holes; and the color difference of
    each entry of the exposure."""
    matrix = csr_array((entries["value"], (entries["row"], entries["point"])), shape=(masks + 4, points))
    outside, exposure, through, differences = (csr_array(matrix[row : row + 1]) for row in range(masks, masks + 4))
    # Every exposure has a difference, in the same order; without a photograph none has.
    difference = differences.data - 1 if differences.nnz else np.full(exposure.nnz, NO_DIFFERENCE)
    return csr_array(matrix[:masks]), outside, exposure, through, difference.astype(np.uint16)


def _all_shown(scene: Scene, cloud: TiledCloud, rendered: Sequence[_RenderedView], journal: Journal) -> _Shown:
    """What the views show, all in the work folder. SceneError where no view shows a point, or no mask does."""
    if found := sum(view.was_there for view in rendered):
        journal.leave_out(LeftOut.RENDERING, count=found, folder=cloud.work.place().name)
    for view in rendered:
        cloud.work.adopt("view", view.key)
    require_sight(sum(int(view.first[-1]) for view in rendered), sum(view.masked for view in rendered), scene)
    drawn, inside = np.sum([view.drawn for view in rendered], axis=0).tolist()
    if drawn < inside:
        share = 1 - drawn / inside
        journal.leave_out(LeftOut.FINE_POINTS, share=share, finest_px=MIN_SPACING_PX, most=MAX_SPLATS)
    warn_of_faults([view.fault for view in rendered], journal)
    mask_view = np.repeat(np.arange(len(rendered), dtype=np.int32), [view.mask_count for view in scene.views])
    first = np.array([view.first for view in rendered])
    keys = tuple(view.key for view in rendered)
    return _Shown(
        keys,
        first,
        mask_view,
        stacked_features([view.mask_features for view in scene.views]),
        stacked_tracks([(view.mask_tracks, view.mask_count) for view in scene.views]),
        Photographs.of(scene.views),
        sight_ratios(np.sum([view.colors for view in rendered], axis=0)),
    )


@dataclass(frozen=True)
class _RenderedView:
    """A view in the work folder. first: (tiles + 1,), as in `_Shown`. masked: how many of its entries are in masks.
    drawn: how many points were drawn, and how many there are in the image. colors: as `differences` counts them.
    was_there: from an earlier run. fault: of its photograph, from `with_photograph`."""

    key: str
    first: Rows
    masked: int
    drawn: NDArray[np.int64]
    colors: NDArray[np.float64]
    was_there: bool
    fault: str


def _render(cloud: TiledCloud, drawing: _Drawing, settings: FitSettings, view: View) -> _RenderedView:
    """Render a view, or find it in the work folder; its entries stay there."""
    ids = view.mask_map()
    unread = replace(view, masks=ids, image=None if cloud.points.rgb is None else view.image)
    view, fault = with_photograph(unread)
    drawn_as = cloud.key, drawing, MIN_SPACING_PX, MAX_SPLATS
    key = fingerprint(*drawn_as, view.name, view.image, view_fingerprint(view, ids))
    was_there = cloud.work.has("view", key)
    entries, drawn, colors = cloud.work.arrays("view", key, partial(_entries, view, cloud, drawing, settings))
    first = np.searchsorted(np.ascontiguousarray(entries["point"]), cloud.tiles.start)
    masked = int(np.count_nonzero(entries["row"] < view.mask_count))
    return _RenderedView(key, first, masked, drawn, colors, was_there, fault)


def _entries(
    view: View, cloud: TiledCloud, drawing: _Drawing, settings: FitSettings
) -> tuple[Entries, NDArray[np.int64], NDArray[np.float64]]:
    """What one view shows, sorted by point; how many points were drawn, and how many there are in the image; and how
    often colors of points and pixels differ so far (`differences`)."""
    rows, larger, inside = _points_to_draw(view, cloud, drawing)
    counts = np.array([len(rows), inside])
    if len(rows) == 0:
        return np.zeros(0, ENTRY), counts, np.zeros((2, COLOR_DIFFERENCE_BINS))
    splats = drawing.splats(cloud, rows, larger, settings.geometry.opacity)
    thickness = sight_thickness(cloud.spacing[rows] * larger, drawing.typical, settings.geometry)
    table = mask_table(splats, [view], drawing.near, thickness)
    front, _ = without_see_through(table, splats, [view.camera], settings.membership)
    exposure = front.exposure
    distance, colors = differences(cloud.drawn_points.take(rows), view, drawing.near, exposure.indices, exposure.data)
    difference = csr_array((1 + distance.astype(np.float32), exposure.indices, exposure.indptr), shape=exposure.shape)
    # Blocks of rows, as ENTRY numbers them: masks, outside, exposure, exposure through holes, differences of color.
    masks = view.mask_count
    blocks = [(front.weights, 0), (front.outside, masks), (exposure, masks + 1)]
    blocks += [] if front.doubted is None else [(front.doubted, masks + 2)]
    blocks += [] if view.image is None else [(difference, masks + 3)]
    entries = np.empty(sum(block.nnz for block, _ in blocks), ENTRY)
    end = 0
    for block, first_row in blocks:
        begin, end = end, end + block.nnz
        entries["point"][begin:end] = rows[block.indices]
        entries["row"][begin:end] = first_row + np.repeat(np.arange(block.shape[0]), np.diff(block.indptr))
        entries["value"][begin:end] = block.data
    return entries[np.argsort(entries["point"], kind="stable")], counts, colors


def _points_to_draw(view: View, cloud: TiledCloud, drawing: _Drawing) -> tuple[Rows, NDArray[np.float32], int]:
    """The points of an image that are drawn, the factors that enlarge them, and the number of points in the image.

    Points at least MIN_SPACING_PX apart are all drawn. Closer ones are sampled to lie that far apart, and
    enlarged to cover what all of them did.
    """
    parts = [_in_image(view.camera, cloud, cloud.tiles.part(tile), drawing) for tile in range(len(cloud.tiles))]
    rows, spacing_px = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    # A point's probability leaves a surface's points ``finest`` apart: squared, as areas scale.
    finest = MIN_SPACING_PX
    while (part := np.minimum(1, (spacing_px / finest) ** 2, dtype=np.float32)).sum(dtype=np.float64) > MAX_SPLATS:
        finest *= 1.2
    drawn = position_hash(cloud.points.xyz[rows], view.name) < part
    return rows[drawn], (1 / np.sqrt(part[drawn])).astype(np.float32), len(rows)


def _in_image(camera: Camera, cloud: TiledCloud, part: slice, drawing: _Drawing) -> tuple[Rows, NDArray[np.float32]]:
    """Rows of a tile's points that may show in a pixel, and their spacing in pixels where they are.

    A splat reaches as many standard deviations, its own and the pixels' low-pass (splatting.py), as an opaque one needs
    to fall to ALPHA_MIN. The projection is linearized within a margin of the image: there a round one is widened.
    """
    points, spacing, size_of = cloud.drawn_points, cloud.spacing[part], drawing.scale * cloud.drawn_spacing[part]
    with np.errstate(divide="ignore", invalid="ignore"):
        uv_px, depth = camera.project(points.xyz[part])
        focal, center = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
        size = np.array([camera.width, camera.height])
        # The steepest slope that a projection is linearized at; there a sphere's image is longest, sqrt(1 + slope^2).
        slope = (np.maximum(center, size - center) + 0.5 * FRUSTUM_MARGIN * size) / focal
        own_px = focal * np.sqrt(1 + slope**2) * (size_of / depth)[:, None]
        reach_px = np.sqrt(-2 * np.log(ALPHA_MIN)) * (own_px + np.sqrt(LOW_PASS)) + 1
        shows = (depth > drawing.near) & ((uv_px > -reach_px) & (uv_px < size + reach_px)).all(axis=1)
    inside = np.flatnonzero(shows)
    spacing_px = np.sqrt(camera.fx * camera.fy) * spacing[inside] / depth[inside]
    return part.start + inside, spacing_px.astype(np.float32)


# Instances and points -------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Grouped:
    """What is decided for all tiles. groups: of masks, without those that the scene's views contradict. looks: of the
    groups. scene: what all votes say."""

    groups: MaskGroups
    looks: Looks
    scene: SceneVotes


def _groups(cloud: TiledCloud, shown: _Shown, settings: FitSettings, journal: Journal) -> _Grouped:
    """Masks grouped by a sample of all points."""
    count = max(settings.grouping.graph_points, len(cloud.points) // SAMPLE_STEP)
    sample = sample_of_points(cloud.points.xyz, count)
    table = shown.table(cloud, sample)
    votes = view_votes(table)
    groups = group_masks(table, settings.grouping)
    points = cloud.points.take(sample)
    around = neighborhood(points.xyz, settings.geometry)
    groups, judged = assign_and_correct_groups(table, votes, groups, around, settings, points.rgb)
    if groups.spanning.any():
        journal.leave_out(LeftOut.SPANNING_MASKS, count=int(groups.spanning.sum()))
    # Groups without a sure point in the sample have rate 0: the tiles know more about these.
    dismissed = judged.dismissed & (judged.detection_rate > 0)
    if dismissed.any():
        journal.leave_out(LeftOut.CONTRADICTED_GROUPS, count=int(dismissed.sum()), total=groups.count)
    is_noise = np.append(dismissed, False)[groups.group]  # the last for masks without a group, -1
    groups = replace(groups, group=np.where(is_noise, -1, groups.group))
    looks = looks_of_groups(table, groups.group, judged.instance_ids, groups.count)
    return _Grouped(groups, looks, judged.scene)


@dataclass(frozen=True)
class _Decided:
    """What is known of a tile's inner points. ids, certainty: as in `Membership`, but ids are looks. in_masks:
    (masks, looks), outside: (views, looks), sparse, what shows of each look's points in each mask, and outside."""

    ids: NDArray[np.int32]
    certainty: NDArray[np.float32]
    in_masks: csr_array
    outside: csr_array


def _decide(cloud: TiledCloud, shown: _Shown, grouped: _Grouped, settings: FitSettings, tile: int) -> _Decided:
    """Decide the state of a tile's points."""
    table = shown.table(cloud, cloud.members[tile])
    around = cloud.neighbors(tile, settings.geometry)
    # Which groups are noise was decided for all tiles.
    membership = replace(settings.membership, rate_share=0.0, missed_chance=0.0)
    votes, looks = view_votes(table), grouped.looks
    rgb = cloud.points.take(cloud.members[tile]).rgb
    state = assign_points(table, votes, grouped.groups, around, membership, rgb, grouped.scene)
    ids = by_look(votes, state.instance_ids, looks)
    # Points of the margin helped to decide; they belong to another tile, and are counted there.
    inner = cloud.inner(tile)
    inner_ids = np.full(len(ids), -1, np.int32)
    inner_ids[inner] = ids[inner]
    of_looks = indicator(inner_ids, len(looks.group)).T
    in_masks, outside = csr_array(table.weights @ of_looks), csr_array(table.outside @ of_looks)
    return _Decided(ids[inner], state.certainty[inner], in_masks, outside)


def _instances(
    cloud: TiledCloud, shown: _Shown, looks: Looks, decided: Sequence[_Decided], settings: FitSettings
) -> Labelling:
    """Looks that have points become instances, largest first; what is known of them comes from sums over the tiles."""
    look_of_point = np.empty(len(cloud.points), np.int32)
    look_of_point[cloud.tiles.order] = np.concatenate([tile.ids for tile in decided])
    certainty = np.empty(len(cloud.points), np.float32)
    certainty[cloud.tiles.order] = np.concatenate([tile.certainty for tile in decided])
    used, ids, mask_instance = renumbered(look_of_point, looks.look)
    table = _table_of_sums(ids, used, shown, decided)
    instances = describe_instances(table, mask_instance, ids, len(used))
    return Labelling(ids, instances, mask_instance, certainty)


def _table_of_sums(ids: NDArray[np.int32], used: Rows, shown: _Shown, decided: Sequence[_Decided]) -> MaskTable:
    """A mask table in which the first point of every instance stands for all its points.

    Once points have their ids, only sums over the points of an instance are read from a table: these are the sums.
    """
    first = np.zeros(len(used), np.int64)
    labelled = np.flatnonzero(ids >= 0)[::-1]  # from the last to the first, which is written last and stays
    first[ids[labelled]] = labelled

    def at_first(sums: csr_array) -> csr_array:
        entries = csr_array(sums[:, used]).tocoo()
        place = (entries.row, first[entries.col])
        return csr_array((entries.data.astype(np.float32), place), shape=(sums.shape[0], len(ids)))

    weights = at_first(sum((tile.in_masks for tile in decided[1:]), decided[0].in_masks))
    outside = at_first(sum((tile.outside for tile in decided[1:]), decided[0].outside))
    first, of_view = shown.photographs.first, shown.photographs.of_view
    masks = of_view[shown.mask_view[first]], np.zeros(len(first), np.int32), shown.mask_features[first]
    return MaskTable(weights, outside, csr_array(outside.shape), *masks)
