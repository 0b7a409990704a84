"""Open-vocabulary labels for Open3D, 0.19 or later.

import og_pointcloud_open3d as og3

cloud = og3.read("kitchen.ply")                              # refuses what Open3D reads as an empty cloud
painted, result = og3.segment(cloud, ["chair", "desk"], "kitchen.ogpc")
painted.point["og_label"], painted.point["og_instance"]     # (N, 1) of a tensor cloud; a legacy one is painted
og3.draw(cloud, ["chair", "desk"], "kitchen.ogpc")           # a window: a group a class, queries typed into it
og3.draw_png("labels.png", painted)                          # a picture, without any window
og3.highlight_png("mug.png", "kitchen_3dgs.ply", "mug", "kitchen.ogpc")     # a 3DGS file, with what a word finds
"""

from __future__ import annotations

from og_pointcloud_open3d.convert import Segmented, read, segment, to_open3d
from og_pointcloud_open3d.offscreen import draw_png, highlight_png, look_at
from og_pointcloud_open3d.window import draw

__all__ = ["Segmented", "draw", "draw_png", "highlight_png", "look_at", "read", "segment", "to_open3d"]
