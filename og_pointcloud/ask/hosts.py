"""Point clouds of other libraries -> an array of points, without importing any of them.

A cloud is recognized by the module of its type: whoever holds such an object has already imported its library. No row
is dropped, not even one with NaN: row i of the result is row i of the cloud.
"""

from __future__ import annotations

import importlib
import os
import re
from hashlib import blake2b
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.errors import MissingExtraError, OgPointcloudError, SceneError
from og_pointcloud.formats.atomic import StrPath
from og_pointcloud.scene import Points, dense_tensor

SCENE_FIELD = "og_pointcloud_scene"
"""Field of a PyVista dataset that names the .ogpc file its labels came from."""
NAMES_FIELD = "og_names"
"""Field of hosts and files that can store text: the names that ``og_label`` indexes."""


def world_points(pcd: Any) -> NDArray[np.float64]:
    """(N, 3) float64 world coordinates of a cloud; rows may be NaN.

    pcd: an array of shape (N, 3); a torch tensor of that shape, on any device; the Points of `read_points`; an
    Open3D point cloud or mesh, legacy or tensor; a PyVista dataset; a trimesh cloud or mesh; laspy's LasData; a
    PointCloud2 message; or the path of a geometry file that `read_points` reads. A mesh's points are its vertices.
    SceneError for anything else; MissingExtraError where reading needs a library that is not installed.
    """
    if isinstance(pcd, (str, os.PathLike)):
        from og_pointcloud.formats.points import read_places

        return read_places(pcd)
    if isinstance(pcd, Points):
        return pcd.xyz_world
    kind = type(pcd).__name__
    if kind.endswith("PointCloud2"):  # rclpy's type, and rosbags' sensor_msgs__msg__PointCloud2
        return _checked(import_plugin("og_pointcloud_ros", "ros").from_pointcloud2(pcd), kind)
    host = _host(pcd)
    if host is None:
        return _checked(pcd, kind)
    values = _READERS[host](pcd)
    if values is None:
        raise SceneError(f"a {kind} of {host} has no points to query: pass its points as (N, 3)")
    return _checked(values, kind)


_NAMED: dict[str, Path] = {}
"""The .ogpc files that this process's datasets came from, by `scene_name`."""


def scene_name(path: StrPath) -> str:
    """How a dataset names the .ogpc file that its labels came from: the file's name, and a hash that distinguishes it
    from others of that name. Not its path, since datasets are saved and passed on."""
    path = Path(path).resolve()
    name = f"{path.name}#{blake2b(os.fsencode(path), digest_size=4).hexdigest()}"
    _NAMED[name] = path
    return name


def carried_scene(pcd: Any) -> Path | None:
    """The .ogpc file that a cloud says its labels came from, None if it says none: the file that this process named so,
    else a file of that name in the working folder. A dataset may be untrusted, so it can name no other place.

    OgPointcloudError if there is no such file.
    """
    if _host(pcd) != "pyvista" or SCENE_FIELD not in pcd.field_data:
        return None
    names = np.asarray(pcd.field_data[SCENE_FIELD]).ravel()
    if not len(names):
        return None
    named = str(names[0])
    if path := _NAMED.get(named):
        return path
    beside = Path(re.split(r"[/\\]", named.partition("#")[0])[-1])
    if beside.suffix == ".ogpc" and beside.is_file():
        return beside
    raise OgPointcloudError(
        f"the dataset records that its labels came from '{named:.200}', which was not opened here and is not in this "
        "folder; expected scene=og.load('S.ogpc'), or its path"
    )


def import_plugin(module: str, extra: str) -> Any:
    """One of our plugins, og_pointcloud_*; MissingExtraError names the extra if its host library is not installed."""
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        raise MissingExtraError(error.name or module, extra) from None


def _host(pcd: Any) -> str | None:
    """Library of a cloud's type or of a base class; None for arrays of any kind."""
    if isinstance(pcd, np.ndarray):  # PyVista and trimesh subclass it: mesh.points, mesh.vertices
        return None
    for kind in type(pcd).__mro__:
        root = kind.__module__.partition(".")[0]
        if root in _READERS:
            return root
    return None


def _of_open3d(cloud: Any) -> Any:
    if type(cloud).__name__ == "Vector3dVector":  # cloud.points
        return cloud
    if type(cloud).__name__ == "Tensor":  # cloud.point.positions
        return cloud.cpu().numpy()
    for name in ("points", "vertices"):  # legacy
        if hasattr(cloud, name):
            return getattr(cloud, name)
    for name in ("point", "vertex"):  # tensor
        if hasattr(cloud, name):
            tensors = getattr(cloud, name)
            return tensors["positions"].cpu().numpy() if "positions" in tensors else np.zeros((0, 3))
    return None


_READERS = {
    "open3d": _of_open3d,
    "pyvista": lambda dataset: getattr(dataset, "points", None),
    "trimesh": lambda geometry: getattr(geometry, "vertices", None),
    "laspy": lambda las: getattr(las, "xyz", None),
    "torch": dense_tensor,
}
"""Root module of a cloud's type -> function that returns its points, or None if it has none."""


def _checked(values: Any, kind: str) -> NDArray[np.float64]:
    if isinstance(values, np.ma.MaskedArray) and values.dtype.kind in "fiu":
        values = np.ma.filled(values.astype(np.float64), np.nan)  # masked points have no coordinates
    try:
        points = np.asarray(values)
    except Exception as error:  # arrays of GPU libraries raise types of their own
        raise SceneError(f"a {kind} is not an array of points ({error}); expected shape (N, 3)") from None
    if points.ndim != 2 or points.shape[1] != 3 or points.dtype.kind not in "fiu":
        raise SceneError(
            f"points are a {kind} of {points.dtype} {points.shape}; expected numbers of shape (N, 3), x y z in the "
            "scene's world coordinates: select or transpose the columns"
        )
    return points.astype(np.float64)
