"""What a map kept -> instances, by the rule of `fit` in mode grouping: the same masks, witnesses and votes of views."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.cloud import InstanceTable
from og_pointcloud.fitting.grouping import group_masks
from og_pointcloud.fitting.labellers import instances_of_groups, renumbered
from og_pointcloud.fitting.mask_table import MaskTable
from og_pointcloud.fitting.membership import assign_points, without_see_through
from og_pointcloud.fitting.view_votes import view_votes
from og_pointcloud.rendering.geometry import Neighbourhood, isotropic, sample_of_points
from og_pointcloud.scene import Camera, Points
from og_pointcloud.settings import FitSettings

__all__ = ["label"]


def label(
    xyz: NDArray[np.float32], around: Neighbourhood, table: MaskTable, cameras: list[Camera], settings: FitSettings
) -> tuple[NDArray[np.int32], InstanceTable, NDArray[np.float32]]:
    """(instance ids (n,), table of instances, certainty (n,)) of points (n, 3), as `fit` would find them."""
    drawn = isotropic(
        Points(xyz, np.zeros(3)), around.spacing, settings.geometry.start_scale, settings.geometry.opacity
    )
    depth_rows = np.stack([camera.world_to_camera[2] for camera in cameras])
    focal = np.sqrt([camera.fx * camera.fy for camera in cameras])
    table, _ = without_see_through(table, drawn, depth_rows, focal, settings.membership)
    votes = view_votes(table)
    groups = group_masks(table, votes, settings.grouping, sample_of_points(xyz, settings.grouping.graph_points))
    membership = assign_points(table, votes, groups, around, settings.membership)
    used, ids, mask_instance = renumbered(membership.instance_ids, groups.group)
    instances = instances_of_groups(table, mask_instance, ids, len(used), settings.association)
    return ids, instances, membership.certainty
