"""Geometry files -> Points, told apart by their content; and the labelled cloud that other tools open."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.errors import SceneError
from og_pointcloud.formats.e57 import E57_SIGNATURE, read_e57
from og_pointcloud.formats.gaussian_ply import gaussians_from_ply, holds_gaussians
from og_pointcloud.formats.las import SIGNATURE as LAS_SIGNATURE
from og_pointcloud.formats.las import read_las
from og_pointcloud.formats.pcd import looks_like_pcd, read_pcd
from og_pointcloud.formats.ply import HEADER_LIMIT, plain_rows, read_ply, write_ply
from og_pointcloud.formats.spz import looks_like_spz, read_spz
from og_pointcloud.formats.tables import colors, naming, positions
from og_pointcloud.scene import Points


def read_points(path: str | os.PathLike[str]) -> Points:
    """A plain cloud (PLY, PCD, LAS, LAZ, COPC, E57) or Gaussians (PLY, SuperSplat's, SPZ), whatever the file's name.

    World coordinates are read as float64; their median becomes the origin. Colors come as uint8 RGB, None where the
    file has none.
    SceneError, beginning with the path, for what cannot be read, has no points, or holds NaN. LAS and LAZ need the
    extra 'las', E57 'e57', the newest SPZ 'spz'.

    >>> import pathlib, tempfile
    >>> path = og.segment(cloud).save(pathlib.Path(tempfile.mkdtemp()) / "two.ply")  # of `LabelledCloud`'s example
    >>> og.read_points(path).xyz_world[2].round(3)
    array([1., 0., 1.])
    """
    path = Path(path)
    with naming(path):
        with path.open("rb") as file:
            head = file.read(4096)  # PCD headers may begin with comments
        if head.startswith((b"ply\n", b"ply\r", b"ply ")):
            elements = read_ply(path)
            if holds_gaussians(elements):
                return gaussians_from_ply(elements)
            if "vertex" not in elements:
                raise SceneError(
                    "no element 'vertex' before the first with lists (faces); the file has "
                    f"{', '.join(elements) or 'none':.200}: write the vertices first"
                )
            return _cloud(elements["vertex"])
        if looks_like_pcd(head):
            return _cloud(read_pcd(path))
        if head.startswith(LAS_SIGNATURE):
            return read_las(path)
        if head.startswith(E57_SIGNATURE):
            return read_e57(path)
        if looks_like_spz(head):
            return read_spz(path)
        start = f"it starts with {head[:16]!r}" if head else "it is empty"
        raise SceneError(
            f"not a geometry file that can be read ({start}); expected a PLY (plain cloud, 3D Gaussians, or SuperSplat "
            "compressed), a PCD (ascii, binary, binary_compressed), a LAS, LAZ or COPC, an E57 or an SPZ: convert it"
            " first"
        )


def write_labelled_ply(
    path: str | os.PathLike[str],
    xyz_world: NDArray[np.floating],
    rgb: NDArray[np.uint8],
    attributes: Mapping[str, NDArray],
    names: Sequence[str] = (),
) -> None:
    """Write a cloud with its labels: x y z, red green blue (uchar), and the attributes as they are; atomic.

    xyz_world: (n, 3); written as float, or as double where float would move a point by more than 1e-6 of the cloud's
    extent. rgb: (n, 3) uint8. attributes: name -> (n,): og_label, og_instance (int32), og_score (float32), og_reason
    (uint8). names: what og_label counts; a comment "og_names", JSON, unless they would not fit into a header.
    """
    comment = f"og_names {json.dumps(list(names))}"
    fits = names and len(comment) < HEADER_LIMIT // 2
    write_ply(path, {"vertex": plain_rows(xyz_world, np.asarray(rgb, np.uint8), attributes)}, [comment] if fits else [])


def _cloud(rows: NDArray[np.void]) -> Points:
    return Points.from_world(positions(rows), rgb=colors(rows))
