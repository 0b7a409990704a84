"""``pv.read("scene.ogpc")``."""

from __future__ import annotations

import pyvista as pv

from og_pointcloud.ask.hosts import SCENE_FIELD, scene_name
from og_pointcloud.ask.labelled_scene import as_scene
from og_pointcloud_pyvista.datasets import INSTANCE, set_strings

RGB = "RGB"
"""Point array of the scene's own colors, named as by PyVista's .ply reader."""


def read_ogpc(path: str) -> pv.PolyData:
    """The points of a scene, world coordinates, float64, with og_instance, and RGB if it has colors.

    The dataset records its file, so that ``mesh.og.segment(["chair"])`` needs no scene. BundleError for any other file,
    instead of PyVista's error that it cannot be read.
    """
    scene = as_scene(path)
    # All copied: VTK writes into the arrays it is given, read-only or not, and the scene is cached.
    mesh = pv.PolyData(scene.xyz.copy()) if len(scene.xyz) else pv.PolyData()
    if len(scene.xyz):
        if scene.cloud.rgb is not None:
            mesh.point_data.set_array(scene.cloud.rgb, RGB, deep_copy=True)
        mesh.point_data.set_array(scene.instance_ids, INSTANCE, deep_copy=True)
        mesh.set_active_scalars(INSTANCE, preference="point")
    set_strings(mesh, SCENE_FIELD, [scene_name(path)])
    return mesh
