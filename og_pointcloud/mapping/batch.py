"""What a map kept -> instances, by the rule of `fit` in mode grouping: the same masks, witnesses and votes of views."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.fitting.labellers import Labelling, grouping
from og_pointcloud.fitting.mask_table import MaskTable
from og_pointcloud.fitting.membership import without_see_through
from og_pointcloud.journal import Journal
from og_pointcloud.rendering.geometry import Neighbourhood, isotropic, near_plane
from og_pointcloud.rendering.surface import Surface, sight_thickness
from og_pointcloud.scene import Camera, Points, Scene, View
from og_pointcloud.settings import FitSettings

__all__ = ["label"]


def label(
    xyz: NDArray[np.float32], around: Neighbourhood, table: MaskTable, cameras: list[Camera], settings: FitSettings
) -> Labelling:
    """The labelling of points (n, 3) that `fit` would find in this table. cameras: of its views."""
    points, geometry = Points(xyz, np.zeros(3)), settings.geometry
    drawn = isotropic(points, around.spacing, geometry.start_scale, geometry.opacity)
    thickness = sight_thickness(around.spacing, float(np.median(around.spacing)), geometry)
    no_mask, no_feature = np.zeros((0, 0), np.int32), np.zeros((0, 1), np.float32)
    views = tuple(View(str(k), camera, no_mask, no_feature) for k, camera in enumerate(cameras))
    near = near_plane(xyz, views)
    surface = Surface(Scene(points, views, "map"), None, around, drawn, near, thickness, 1, by_sight=True)
    depth_rows = np.stack([camera.world_to_camera[2] for camera in cameras])
    focal = np.sqrt([camera.fx * camera.fy for camera in cameras])
    table, _ = without_see_through(table, drawn, depth_rows, focal, settings.membership)
    return grouping(table, surface, settings, Journal(progress=False))
