"""Geometry files -> Points, told apart by their content; and the labelled cloud that other tools open."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.errors import SceneError
from og_pointcloud.formats.gaussian_ply import gaussians_from_ply, holds_gaussians
from og_pointcloud.formats.pcd import looks_like_pcd, read_pcd
from og_pointcloud.formats.ply import join_columns, read_ply, write_ply
from og_pointcloud.formats.tables import colors, naming, normals, positions, storable_positions
from og_pointcloud.scene import Points

__all__ = ["read_points", "write_labelled_ply"]


def read_points(path: str | os.PathLike[str]) -> Points:
    """A plain cloud (PLY, PCD) or Gaussians (3DGS PLY, SuperSplat compressed PLY), whatever the file is called.

    World coordinates are read as float64; their median becomes the origin. Colours come as uint8 RGB, normals as unit
    vectors, a zero row where the file has none for that point; either is None where the file has none at all.
    SceneError, beginning with the path, for what cannot be read, has no points, or holds NaN.
    """
    path = Path(path)
    with naming(path):
        with path.open("rb") as file:
            head = file.read(4096)
        if head.startswith((b"ply\n", b"ply\r", b"ply ")):
            elements = read_ply(path)
            if holds_gaussians(elements):
                return gaussians_from_ply(elements)
            if "vertex" not in elements:
                raise SceneError(
                    f"no element 'vertex' of plain properties; the file has {', '.join(elements) or 'none'}"
                )
            return _cloud(elements["vertex"])
        if looks_like_pcd(head):
            return _cloud(read_pcd(path))
        start = f"it starts with {head[:16]!r}" if head else "it is empty"
        raise SceneError(
            f"not a geometry file that can be read ({start}); expected a PLY (plain cloud, 3D Gaussians, or SuperSplat "
            "compressed) or a PCD (ascii, binary, binary_compressed): convert it first"
        )


def write_labelled_ply(
    path: str | os.PathLike[str],
    xyz_world: NDArray[np.floating],
    rgb: NDArray[np.uint8],
    instance: NDArray[np.integer],
    label: NDArray[np.integer],
    score: NDArray[np.floating],
) -> None:
    """Write a cloud with its labels: x y z, red green blue (uchar), instance and label (int), score (float); atomic.

    xyz_world: (n, 3); written as float, or as double where float would move a point by more than 1e-6 of the cloud's
    extent. rgb: (n, 3) uint8. instance, label: (n,), -1 and below for none. score: (n,).
    """
    n = len(xyz_world)
    shapes = {"rgb": (rgb, (n, 3)), "xyz_world": (xyz_world, (n, 3))}
    shapes |= {name: (values, (n,)) for name, values in (("instance", instance), ("label", label), ("score", score))}
    for name, (values, expected) in shapes.items():
        if values.shape != expected:
            raise SceneError(f"{path}: {name} has shape {values.shape}; expected {expected}")
    columns = dict(zip("xyz", storable_positions(xyz_world).T, strict=True))
    columns |= dict(zip(("red", "green", "blue"), np.asarray(rgb, np.uint8).T, strict=True))
    columns["instance"] = np.asarray(instance, np.int32)
    columns["label"] = np.asarray(label, np.int32)
    columns["score"] = np.asarray(score, np.float32)
    write_ply(path, {"vertex": join_columns(columns)})


def _cloud(rows: NDArray[np.void]) -> Points:
    return Points.from_world(positions(rows), rgb=colors(rows), normals=normals(rows))
