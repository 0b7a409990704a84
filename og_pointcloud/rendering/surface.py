"""Scene -> surface: which points a fit needs, and how each is drawn."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.journal import Journal, LeftOut
from og_pointcloud.rendering.coverage import with_needed_views
from og_pointcloud.rendering.geometry import (
    Neighborhood,
    distinct_positions,
    isotropic,
    morton_order,
    near_plane,
    neighborhood,
    thinned,
)
from og_pointcloud.rendering.pixel_cells import with_points_of_cells
from og_pointcloud.rendering.splatting import Gaussians
from og_pointcloud.scene import Points, Scene, View
from og_pointcloud.settings import FitSettings, GeometrySettings


@dataclass(frozen=True)
class Surface:
    """A scene's points as they are drawn, and the views that they are drawn in.

    scene: with the points that are needed (`with_needed_points`; in mode paper all Gaussians stay), in Morton order; n
    points, at the positions at which they are drawn (smoothing.py). In mode paper large images are thinned.
    row_of_point: (all points,) int64, the row here that stands for each point of the whole scene; None: all are here,
    in the same order.
    neighborhood: spacing and neighbors of the n points as measured. gaussians: how the n points are drawn.
    near: depth of the near plane, scene units.
    thickness: (n,) float32, `sight_thickness`, scene units.
    """

    scene: Scene
    row_of_point: NDArray[np.int64] | None
    neighborhood: Neighborhood
    gaussians: Gaussians
    near: float
    thickness: NDArray[np.float32]

    def of_points(self, values: NDArray[Any]) -> NDArray[Any]:
        """Values (n, ...) of the points here, for each point of the whole scene."""
        return values if self.row_of_point is None else values[self.row_of_point]


def reconstruct_surface(scene: Scene, settings: FitSettings, journal: Journal) -> Surface:
    """Find the points that are needed, their spacing, and the Gaussians that they are drawn as."""
    is_paper = settings.mode == "paper"
    row_of_point = None
    with journal.stage("spacing"):
        if not is_paper:
            scene, row_of_point = with_needed_points(scene, journal)
        elif not scene.points.are_gaussians:  # overlapping Gaussians look right only together
            scene, row_of_point = with_distinct_points(scene, journal)
        scene, row_of_point = _in_morton_order(scene, row_of_point)
        if not is_paper:  # mode paper draws its own views, one per step
            scene = with_needed_views(scene, settings.geometry.enough_views, journal)
        near = near_plane(scene.points.xyz, (view.camera for view in scene.views))
        around = neighborhood(scene.points.xyz, settings.geometry)
    with journal.stage("geometry"):
        gaussians = _gaussians(scene, around, settings, journal)
        thickness = sight_thickness(around.spacing, float(np.median(around.spacing)), settings.geometry)
        if is_paper:  # which renders a view more than once
            stride = stride_for_pixels(scene.views, settings.paper.image_pixels, journal)
            scene = replace(scene, views=tuple(thinned(view, stride) for view in scene.views))
    return Surface(scene, row_of_point, around, gaussians, near, thickness)


def with_needed_points(scene: Scene, journal: Journal) -> tuple[Scene, NDArray[np.int64] | None]:
    """The scene with one point per position or, where points are denser than pixels, per cell of two pixels; and for
    each of its points the row that stands for it; None if all stay."""
    scene, row_of_point = with_distinct_points(scene, journal)
    scene, cell = with_points_of_cells(scene, journal)
    if cell is None:
        return scene, row_of_point
    return scene, cell if row_of_point is None else cell[row_of_point]


def with_distinct_points(scene: Scene, journal: Journal) -> tuple[Scene, NDArray[np.int64] | None]:
    """The scene with one point per position, and for each of its points the row that stands for it; None if all differ.

    Of two points at the same position one would hide the other, which would then seem unseen. The row that stays has
    their mean color. Gaussians become points at their centers: their shapes are made to look right together, not to say
    where a surface is.
    """
    points = scene.points
    if points.are_gaussians:
        journal.leave_out(LeftOut.SHAPES)
        points = Points(points.xyz, points.origin, points.rgb)
        scene = replace(scene, points=points)
    first, row_of_point = distinct_positions(points.xyz)
    if len(first) == len(points):
        return scene, None
    journal.leave_out(LeftOut.COINCIDENT_POINTS, count=len(points) - len(first))
    distinct = points.take(first)
    if points.rgb is not None:
        sums = [np.bincount(row_of_point, channel) for channel in points.rgb.T]  # of whole numbers: exact in any order
        colors = np.rint(np.stack(sums, axis=1) / np.bincount(row_of_point)[:, None])
        distinct = replace(distinct, rgb=colors.astype(np.uint8))
    return replace(scene, points=distinct), row_of_point


def _in_morton_order(scene: Scene, row_of_point: NDArray[np.int64] | None) -> tuple[Scene, NDArray[np.int64]]:
    """The scene with its points in Morton order, and each point's new row. It saves a twelfth of a fit's time, and
    breaks ties by position."""
    order = morton_order(scene.points.xyz)
    row = np.empty(len(order), np.int64)
    row[order] = np.arange(len(order))
    return replace(scene, points=scene.points.take(order)), row if row_of_point is None else row[row_of_point]


def _gaussians(scene: Scene, around: Neighborhood, settings: FitSettings, journal: Journal) -> Gaussians:
    """Round Gaussians, whose size `held_out` may change later; in mode paper the file's own, if it has some."""
    if scene.points.are_gaussians:
        journal.leave_out(LeftOut.CHOICE_OF_SPLATS)
        return Gaussians.from_points(scene.points)
    if settings.mode == "paper":
        journal.leave_out(LeftOut.CHOICE_IN_PAPER_MODE)
        return isotropic(scene.points, around.spacing, settings.paper.scale, settings.paper.opacity)
    return isotropic(scene.points, around.spacing, settings.geometry.middle_scale, settings.geometry.opacity)


def sight_thickness(
    spacing: NDArray[np.float32], typical_spacing: float, settings: GeometrySettings
) -> NDArray[np.float32]:
    """(n,) how far in front of a point others must lie to hide it, scene units: the thickness that noise and overlap
    give a surface. It follows from the point's spacing, or the typical one if that is larger."""
    return (settings.sight_thickness * np.maximum(spacing, typical_spacing)).astype(np.float32)


def stride_for_pixels(views: Sequence[View], max_pixels: int, journal: Journal) -> int:
    """The least stride that leaves the largest image no more than ``max_pixels`` pixels."""
    largest = max(view.camera.width * view.camera.height for view in views)
    smallest = min(min(view.camera.width, view.camera.height) for view in views)  # a row and column of each stay
    stride = min(max(1, int(np.ceil(np.sqrt(largest / max_pixels)))), smallest)
    if stride > 1:
        journal.leave_out(LeftOut.PIXELS_IN_PAPER_MODE, share=1 - 1 / stride**2, most=max_pixels, stride=stride)
    return stride
