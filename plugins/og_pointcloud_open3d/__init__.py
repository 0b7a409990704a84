"""Open-vocabulary labels for Open3D, 0.19 or later.

import og_pointcloud_open3d as og3

cloud = og3.read("kitchen.ply")                              # refuses what Open3D reads as an empty cloud
painted, result = og3.segment(cloud, ["chair", "desk"], "kitchen.ogpc")
painted.point["og_label"], painted.point["og_instance"]     # (N, 1) of a tensor cloud; a legacy one is painted
open3d.visualization.draw(painted)
"""

from __future__ import annotations

from og_pointcloud_open3d.convert import Segmented, read, segment, to_open3d

__all__ = ["Segmented", "read", "segment", "to_open3d"]
