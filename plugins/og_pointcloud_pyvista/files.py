"""``pv.read("scene.ogpc")`` and ``mesh.save("part.ogpc")``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyvista as pv

import og_pointcloud as og
from og_pointcloud.ask.hosts import SCENE_FIELD, carried_scene
from og_pointcloud.ask.labelled_scene import as_scene
from og_pointcloud.cloud import UNOBSERVED
from og_pointcloud.errors import OgPointcloudError
from og_pointcloud_pyvista.datasets import INSTANCE, set_strings

__all__ = ["RGB", "read_ogpc", "write_ogpc"]

RGB = "RGB"
"""Point array of the scene's own colours, as PyVista's reader of .ply names it."""


def read_ogpc(path: str) -> pv.PolyData:
    """The points of a scene, world coordinates, float64, with og_instance, and RGB where it has colours.

    The dataset remembers its file, so that ``mesh.og.segment(["chair"])`` needs no scene. BundleError for any other
    file, also where PyVista would say that it cannot read it.
    """
    scene = as_scene(path)
    mesh = pv.PolyData(scene.xyz) if len(scene.xyz) else pv.PolyData()
    if len(scene.xyz):
        if scene.cloud.rgb is not None:
            mesh.point_data[RGB] = scene.cloud.rgb
        mesh.point_data[INSTANCE] = scene.instance_ids
        mesh.set_active_scalars(INSTANCE, preference="point")
    set_strings(mesh, SCENE_FIELD, [str(Path(path).resolve())])
    return mesh


def write_ogpc(mesh: Any, path: str) -> None:
    """A scene of a dataset's points, such as a crop of one: the instances, words and bank are those of its scene.

    Needs og_instance and the scene that it refers to; OgPointcloudError says what is missing. Points too far from that
    scene become unobserved. Written whole or not at all; needs the extra 'fit'.
    """
    source = carried_scene(mesh)
    if INSTANCE not in mesh.point_data or source is None:
        lacking = f"point array '{INSTANCE}'" if INSTANCE not in mesh.point_data else f"field '{SCENE_FIELD}'"
        raise OgPointcloudError(
            f"a {type(mesh).__name__} of {mesh.n_points:,} points without {lacking} is no scene; expected one that was "
            "read from a .ogpc file or segmented with one: mesh = mesh.og.segment(scene='S.ogpc'). To keep the points "
            "alone, save them as .ply or .vtp"
        )
    if Path(path).resolve() == source.resolve():
        raise OgPointcloudError(f"'{path}' is the scene that this dataset refers to; expected another name")
    cloud = og.load(source).cloud
    ids = np.asarray(mesh.point_data[INSTANCE], np.int32)
    table = cloud.instances
    if ids.size and (ids.max() >= len(table) or ids.min() < og.TOO_FAR):
        raise OgPointcloudError(
            f"'{INSTANCE}' spans {ids.min()}..{ids.max()}, but {source} has {len(table)} instances: segment it again"
        )
    points = np.bincount(ids[ids >= 0], minlength=len(table)).astype(np.int32)
    rgb = mesh.point_data.get(RGB)
    part = replace(
        cloud,
        xyz=(np.asarray(mesh.points, np.float64) - cloud.origin).astype(np.float32),
        instance_ids=np.maximum(ids, UNOBSERVED),
        instances=replace(table, points=points),
        rgb=None if rgb is None else np.asarray(rgb, np.uint8)[:, :3],
        certainty=None,
        provenance=cloud.provenance | {"points_of": str(source)},
    )
    og.write_bundle(part, path)
