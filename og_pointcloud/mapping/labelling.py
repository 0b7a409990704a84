"""Kept views of a map -> a labelled cloud, as `fit` in mode grouping: the same masks, witnesses and votes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.cloud import InstanceTable, LabelledCloud
from og_pointcloud.fitting.fit import Prepared, fit_prepared, front_surfaces
from og_pointcloud.fitting.held_out import choose_scale
from og_pointcloud.journal import Journal
from og_pointcloud.mapping.frame import CheckedFrame
from og_pointcloud.mapping.growing_map import GrowingMap, drawn_points
from og_pointcloud.mapping.kept_views import KeptView
from og_pointcloud.mapping.merging import joined
from og_pointcloud.rendering.geometry import Neighborhood, drawn_spacing, isotropic, near_plane
from og_pointcloud.rendering.surface import Surface, sight_thickness
from og_pointcloud.scene import Points, Scene, View
from og_pointcloud.settings import FitSettings, GeometrySettings


def labelled(map_: GrowingMap, rows: NDArray[np.int64], around: Neighborhood, settings: FitSettings) -> LabelledCloud:
    """Some of a map's points, rows (n,), labelled by `fit`'s rule from the kept views. around: their neighborhood."""
    # Index of each map row among the points to label, -1 for those left out.
    place = np.full(map_.points.n, -1, np.int32)
    place[rows] = np.arange(len(rows), dtype=np.int32)
    points = Points(map_.points.xyz[rows], map_.origin, map_.points.rgb[rows].astype(np.uint8))
    settings, journal = replace(settings, mode="grouping"), Journal(progress=False)
    # First, as it may update what the frames without depth see, which the table is made of.
    spacing = drawn_spacing(points.xyz, around)
    thickness = sight_thickness(around.spacing, float(np.median(around.spacing)), settings.geometry)
    _choose_scale(map_, points, spacing, thickness, settings, journal)
    table = map_.kept.table(place, len(rows))
    # The table holds all that the masks say; the scene's views are there for their cameras.
    no_mask, width = np.zeros((0, 0), np.int32), table.mask_features.shape[1]
    no_feature = np.zeros((0, width), np.float32)
    kept = zip(table.names, map_.kept.views, strict=True)
    views = tuple(View(name, view.camera, no_mask, no_feature) for name, view in kept)
    scene, geometry = Scene(points, views, map_.space.name, "map"), settings.geometry
    drawn = isotropic(points, spacing, map_.scale or geometry.middle_scale, geometry.opacity)
    near = near_plane(points.xyz, (view.camera for view in views))
    surface = Surface(scene, None, around, drawn, near, thickness)
    table = front_surfaces(surface, table, settings, journal)
    return fit_prepared(Prepared(scene, surface, table), settings, journal)


def _choose_scale(
    map_: GrowingMap,
    points: Points,
    spacing: NDArray[np.float32],
    thickness: NDArray[np.float32],
    settings: FitSettings,
    journal: Journal,
) -> None:
    """Choose the size that points are drawn with, as `fit` does, from the kept views without depth. If it changes,
    compute again what these views see."""
    kept = map_.kept.views
    drawn = [k for k, view in enumerate(kept) if len(view.packed)]
    if len(drawn) == map_.drawn:  # no view more than last time
        return
    views = [View(f"{k:09d}", kept[k].camera, kept[k].masks, kept[k].features) for k in drawn]
    near = near_plane(points.xyz, (view.camera for view in views))
    scale = choose_scale(points, spacing, thickness, views, near, settings, journal).scale
    draw_again(map_, scale, len(drawn), settings.geometry)


def draw_again(map_: GrowingMap, scale: float | None, count: int, geometry: GeometrySettings) -> None:
    """Draw the map's points at another scale from now on, and for the ``count`` kept views without depth."""
    map_.drawn, before, map_.scale = count, map_.scale or geometry.middle_scale, scale
    for k, view in enumerate(map_.kept.views):
        if scale != before and len(view.packed):
            frame = CheckedFrame(view.camera, view.masks, view.features, None, None, view.stamp, map_.space)
            seen = drawn_points(frame, map_, geometry)
            map_.kept.views[k] = KeptView.of(frame, view.sequence, seen.found, seen.rows)


def matched_ids(
    ids: NDArray[np.int32], count: int, known: NDArray[np.int32], known_count: int
) -> tuple[NDArray[np.int64], int]:
    """(count,) id of each instance, and the number of ids afterwards. An instance gets the id of the known object with
    which it shares most points, each given once; the others get fresh ids from known_count on.

    ids, known: (n,) instance and known object of each point, below 0 none.
    """
    wanted = np.full(count, -1, np.int64)
    # Each pair encoded as one number, the largest overlap first.
    both = (ids >= 0) & (known >= 0)
    pairs, shared = np.unique(ids[both].astype(np.int64) * known_count + known[both], return_counts=True)
    for pair in pairs[np.lexsort((pairs, -shared))].tolist():
        instance, owner = divmod(pair, known_count)
        if wanted[instance] < 0 and owner not in wanted:
            wanted[instance] = owner
    fresh = np.flatnonzero(wanted < 0)
    wanted[fresh] = known_count + np.arange(len(fresh))
    return wanted, known_count + len(fresh)


def with_ids(cloud: LabelledCloud, wanted: NDArray[np.int64], count: int) -> LabelledCloud:
    """The cloud with instance k called wanted[k], in a table of ``count`` rows; rows without an instance are empty."""
    ids = np.append(wanted, [-2, -1])[cloud.instance_ids].astype(np.int32)  # states -2 and -1 index the last two
    none, no_share = np.zeros(0, np.int32), np.zeros(0, np.float32)
    nothing = InstanceTable(cloud.instances.descriptors[:0], none, none, none, none, no_share, no_share)
    return replace(cloud, instance_ids=ids, instances=joined(nothing, cloud.instances, wanted, ids, count))
