"""Open3D geometry in, labelled geometry of the same kind out."""

from __future__ import annotations

import importlib
import re
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

import og_pointcloud as og
from og_pointcloud.ask.hosts import world_points
from og_pointcloud.ask.labelled_scene import SceneLike
from og_pointcloud.ask.segmentation import Segmentation
from og_pointcloud.errors import MissingExtraError, OgPointcloudError, SceneError, first_line
from og_pointcloud.formats.atomic import StrPath
from og_pointcloud.text.words import Labels

MIN_VERSION = (0, 19)
DEBIAN_LIBRARIES = "libusb-1.0-0 libgl1 libegl1 libx11-6 libgomp1"


class Segmented(NamedTuple):
    """cloud: a painted copy of the input, of the same kind. result: the labels, row i for point i."""

    cloud: Any
    result: Segmentation


def read(path: StrPath) -> Any:
    """A file as Open3D's tensor cloud, Gaussians with their attributes.

    SceneError where Open3D would return an empty cloud and a warning (no file, no points, unreadable), and for a
    damaged PLY or PCD, for which it returns uninitialized memory.
    """
    host, path, cloud = open3d(), Path(path), None
    if not path.is_file():
        raise SceneError(f"{path}: no such file; expected a point cloud")
    if path.suffix.lower() in (".ply", ".pcd"):
        world_points(path)  # raises for damaged ones
    # The error below covers Open3D's warnings, and the exception that it raises for a .npz of other arrays.
    with host.utility.VerbosityContextManager(host.utility.VerbosityLevel.Error), suppress(RuntimeError):
        cloud = host.t.io.read_point_cloud(str(path))
    if cloud is None or cloud.is_empty():
        raise SceneError(
            f"{path}: Open3D reads no points from it; expected a point cloud that it knows (.ply, .pcd, .xyz, .pts): "
            "the file is damaged, empty, or not of the kind that its name says"
        )
    return cloud


def segment(
    pcd: Any, labels: Labels = None, scene: SceneLike | None = None, *, pose: ArrayLike | None = None, **options: Any
) -> Segmented:
    """Label a cloud, or a mesh by its vertices, and paint a copy of it.

    pcd: Open3D's PointCloud or TriangleMesh, legacy or tensor, on any device, in the scene's world coordinates. The
    result is of the same kind with all its attributes; its colors are the labels', gray where unknown. A tensor
    geometry also has og_label, og_instance (int32), og_score (float32) and og_reason (uint8), (N, 1) each, as Open3D's
    own filters require.
    Other arguments and errors: as for ``og_pointcloud.segment``; SceneError for an empty cloud too.
    """
    if len(world_points(pcd)) == 0:
        raise SceneError(
            "the cloud has 0 points; Open3D returns such a cloud for a file that it cannot read: read it with "
            "og_pointcloud_open3d.read, which says so"
        )
    result = og.segment(pcd, labels, scene, pose=pose, **options)
    return Segmented(_painted(pcd, result), result)


def to_open3d(result: Segmentation) -> Any:
    """A tensor cloud: positions float64, colors float32 in [0, 1], and og_label, og_instance, og_score, og_reason as
    (N, 1)."""
    host = open3d()
    cloud = host.t.geometry.PointCloud()
    cloud.point["positions"] = host.core.Tensor(np.ascontiguousarray(result.xyz))
    _set_attributes(cloud.point, result, cloud.device)
    return cloud


def _painted(pcd: Any, result: Segmentation) -> Any:
    """A copy of any of the four kinds with the result's colors, and with its attributes if the kind supports them."""
    host = open3d()
    colors = result.colors / 255
    if isinstance(pcd, host.geometry.PointCloud):
        copy = host.geometry.PointCloud(pcd)
        copy.colors = host.utility.Vector3dVector(colors)
    elif isinstance(pcd, host.geometry.TriangleMesh):
        copy = host.geometry.TriangleMesh(pcd)
        copy.vertex_colors = host.utility.Vector3dVector(colors)
    elif isinstance(pcd, host.t.geometry.PointCloud):
        copy = pcd.clone()
        _set_attributes(copy.point, result, copy.device)
    elif isinstance(pcd, host.t.geometry.TriangleMesh):
        copy = pcd.clone()
        _set_attributes(copy.vertex, result, copy.device)
    else:
        raise OgPointcloudError(
            f"a {type(pcd).__name__} of {type(pcd).__module__} cannot be painted; expected Open3D's PointCloud or "
            "TriangleMesh: for anything else, og_pointcloud.segment(pcd, ...).to_open3d()"
        )
    return copy


def _set_attributes(tensors: Any, result: Segmentation, device: Any) -> None:
    """tensors: the ``point`` or ``vertex`` of a tensor geometry."""
    core = open3d().core
    columns: dict[str, NDArray[Any]] = {"colors": (result.colors / 255).astype(np.float32)}
    # A one-dimensional attribute makes Open3D's own filters fail.
    columns |= {name: values[:, None] for name, values in result.attributes.items()}
    for name, values in columns.items():
        tensors[name] = core.Tensor(np.ascontiguousarray(values)).to(device)


def open3d() -> Any:
    """The module. MissingExtraError if Open3D is not installed, OgPointcloudError if it is too old or does not load."""
    try:
        module = importlib.import_module("open3d")
    except ModuleNotFoundError as error:
        raise MissingExtraError(error.name or "open3d", "open3d") from None
    except (ImportError, OSError) as error:
        raise OgPointcloudError(
            f"Open3D is installed but does not load ({first_line(error)}): install the system libraries it "
            f"needs, on Debian and Ubuntu: apt-get install {DEBIAN_LIBRARIES}"
        ) from None
    if tuple(map(int, re.findall(r"\d+", module.__version__)[:2])) < MIN_VERSION:
        oldest = "{}.{}".format(*MIN_VERSION)
        raise OgPointcloudError(
            f"Open3D is {module.__version__}; this plugin needs {oldest} or later: pip install 'open3d>={oldest}'"
        )
    return module
