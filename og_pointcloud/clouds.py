"""Point clouds of other libraries -> an array of points, without importing any of them.

A cloud is told by the module of its type: whoever has such an object has imported its library already.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.errors import SceneError

__all__ = ["SCENE_FIELD", "carried_scene", "world_points"]

SCENE_FIELD = "og_pointcloud_scene"
"""Field of a PyVista dataset that names the .ogpc file its labels came from."""


def world_points(pcd: Any) -> NDArray[np.float64]:
    """(N, 3) float64 world coordinates of a cloud; rows may be NaN.

    pcd: an array of shape (N, 3); an Open3D point cloud or mesh, legacy or tensor; a PyVista dataset; a trimesh cloud
    or mesh; or the path of a geometry file. A mesh's points are its vertices. SceneError for anything else.
    """
    if isinstance(pcd, (str, os.PathLike)):
        from og_pointcloud.formats.points import read_points

        return read_points(Path(pcd)).xyz_world
    host = _host(pcd)
    if host == "open3d" and hasattr(pcd, "points"):
        values = pcd.points
    elif host == "open3d" and (hasattr(pcd, "point") or hasattr(pcd, "vertex")):
        tensors = pcd.point if hasattr(pcd, "point") else pcd.vertex
        values = tensors["positions"].cpu().numpy() if "positions" in tensors else np.zeros((0, 3))
    elif host == "pyvista" and hasattr(pcd, "points"):
        values = pcd.points
    elif host in ("open3d", "trimesh") and hasattr(pcd, "vertices"):
        values = pcd.vertices
    elif host is None:
        values = pcd
    else:
        raise SceneError(f"a {type(pcd).__name__} of {host} has no points that can be asked: give its points as (N, 3)")
    return _checked(values, type(pcd).__name__)


def carried_scene(pcd: Any) -> Path | None:
    """The .ogpc file that a cloud says its labels came from, if it says so."""
    if _host(pcd) == "pyvista" and SCENE_FIELD in pcd.field_data:
        return Path(str(np.asarray(pcd.field_data[SCENE_FIELD]).ravel()[0]))
    return None


def _host(pcd: Any) -> str | None:
    """Library of a cloud's type or of one it is derived from."""
    for kind in type(pcd).__mro__:
        root = kind.__module__.partition(".")[0]
        if root in ("open3d", "pyvista", "trimesh"):
            return root
    return None


def _checked(values: Any, kind: str) -> NDArray[np.float64]:
    try:
        points = np.asarray(values)
    except ValueError as error:
        raise SceneError(f"a {kind} is no array of points ({error}); expected shape (N, 3)") from None
    if points.ndim != 2 or points.shape[1] != 3 or points.dtype.kind not in "fiu":
        raise SceneError(
            f"points are a {kind} of {points.dtype} {points.shape}; expected numbers of shape (N, 3), x y z in the "
            "scene's world coordinates: select or transpose the columns"
        )
    return points.astype(np.float64)
