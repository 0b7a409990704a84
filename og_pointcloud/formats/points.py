"""Read geometry files of any known format, recognized by content, as Points; write labelled PLY for other tools."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.errors import SceneError
from og_pointcloud.formats.atomic import StrPath
from og_pointcloud.formats.e57 import looks_like_e57, read_e57
from og_pointcloud.formats.gaussian_ply import Splats, gaussians_from_ply, holds_gaussians
from og_pointcloud.formats.las import looks_like_las, read_las
from og_pointcloud.formats.pcd import looks_like_pcd, read_pcd
from og_pointcloud.formats.ply import HEADER_LIMIT, looks_like_ply, plain_rows, read_ply, write_ply
from og_pointcloud.formats.sog import looks_like_sog, read_sog
from og_pointcloud.formats.splat import SUFFIX as SPLAT_SUFFIX
from og_pointcloud.formats.splat import read_splat
from og_pointcloud.formats.spz import looks_like_spz, read_spz
from og_pointcloud.formats.tables import colors, naming, positions
from og_pointcloud.formats.text_cloud import looks_like_text_cloud, read_text_cloud
from og_pointcloud.scene import Points


def read_points(path: StrPath) -> Points:
    """Read a plain cloud (PLY, PCD, LAS, LAZ, COPC, E57, text) or Gaussians (PLY, SuperSplat's PLY, SPZ, SOG, .splat),
    whatever the name; only .splat is recognized by it.

    World coordinates are read as float64; their median becomes the origin. Colors are uint8 RGB, None where the
    file has none. Points and Gaussians that hold NaN or infinity, as depth cameras and failing trainers write them, are
    left out with a warning.
    SceneError, beginning with the path, for a file that cannot be read or has no points. LAS and LAZ need the extra
    'las', E57 'e57', SPZ version 4 'spz', SOG 'fit'.

    >>> import pathlib, tempfile
    >>> path = og.segment(cloud).save(pathlib.Path(tempfile.mkdtemp()) / "two.ply")  # of `LabelledCloud`'s example
    >>> og.read_points(path).xyz_world[2].round(3)
    array([1., 0., 1.])
    """
    path = Path(path)
    with naming(path):
        found = _read(path)
        if isinstance(found, Points):
            return found
        if isinstance(found, Splats):
            _warn(path, found.others, "left out")
            return found.points
        xyz = positions(found)
        placed, others = _placed(xyz)
        _warn(path, others, "left out")
        return Points.from_world(xyz[placed], rgb=colors(found[placed]))


def read_places(path: StrPath) -> NDArray[np.float64]:
    """(n, 3) float64 world coordinates of every row of a geometry file, to be labelled: rows with NaN or infinity are
    kept, with a warning that they stay unknown. A PLY or PCD may have no rows, as an array may."""
    path = Path(path)
    with naming(path):
        found = _read(path)
        if isinstance(found, Points):
            return found.xyz_world
        if isinstance(found, Splats):
            _warn(path, found.others, "unknown")
            xyz = np.full((len(found.finite), 3), np.nan)
            xyz[found.finite] = found.points.xyz_world
            return xyz
        xyz = positions(found)
        if len(xyz):
            _warn(path, _placed(xyz)[1], "unknown")
        return xyz


def _placed(xyz: NDArray[np.float64]) -> tuple[NDArray[np.bool_], str]:
    """(n,) bool, whether each point's coordinates are finite, and how many are not, "" if none. SceneError if all."""
    placed = np.logical_and.reduce(np.isfinite(xyz), axis=1)
    if not placed.any():
        rest = f", and {len(xyz)} that contain NaN or infinity" if len(xyz) else ""
        raise SceneError(f"the cloud has 0 points{rest}; expected at least one: check the geometry file")
    if placed.all():
        return placed, ""
    missing, first = int((~placed).sum()), int(np.argmin(placed))
    return placed, f"{missing} of {len(xyz)} points contain NaN or infinity (the first is row {first})"


def _warn(path: Path, others: str, then: str) -> None:
    """Warn of rows that are not finite, if there are any. others: says which. then: what becomes of them."""
    if others:
        warnings.warn(f"{path}: {others}: {then}", stacklevel=3)


def _read(path: Path) -> Points | Splats | NDArray[np.void]:
    """A file's points; for a plain cloud in PLY, PCD, E57 or text, its rows as they are; for Gaussians, also which rows
    are not finite."""
    if path.exists() and not (path.is_file() or path.is_dir()):  # such a file cannot be read twice
        raise SceneError("it is a pipe or a device; expected a file: write the cloud to one first")
    with path.open("rb") as file:
        head = file.read(4096)  # PCD headers may begin with comments
    for recognizes, read in READERS:
        if recognizes(head):
            return read(path)
    if path.suffix.lower() == SPLAT_SUFFIX:
        return read_splat(path)
    start = f"it starts with {head[:16]!r}" if head else "it is empty"
    raise SceneError(
        f"not a geometry file that can be read ({start}); expected a PLY (plain cloud, 3D Gaussians, or SuperSplat "
        "compressed), PCD (ascii, binary, binary_compressed), LAS, LAZ, COPC, E57, SPZ, SOG or .splat file, or text "
        "with numbers x y z in each line (1.5, not 1,5): convert it first"
    )


def _read_ply(path: Path) -> Splats | NDArray[np.void]:
    elements = read_ply(path)
    if holds_gaussians(elements):
        return gaussians_from_ply(elements)
    if "vertex" not in elements:
        raise SceneError(
            "no element 'vertex' before the first one with lists (faces); the file has "
            f"{', '.join(elements) or 'none':.200}: write the vertices first"
        )
    return elements["vertex"]


READERS: tuple[tuple[Callable[[bytes], bool], Callable[[Path], Points | Splats | NDArray[np.void]]], ...] = (
    (looks_like_ply, _read_ply),
    (looks_like_pcd, read_pcd),
    (looks_like_las, read_las),
    (looks_like_e57, read_e57),
    (looks_like_spz, read_spz),
    (looks_like_sog, read_sog),
    (looks_like_text_cloud, read_text_cloud),
)
"""Pairs of functions, one that recognizes a format by a file's first 4096 bytes and one that reads it. To add a format,
add a pair."""


def write_labelled_ply(
    path: StrPath,
    xyz_world: NDArray[np.floating],
    rgb: NDArray[np.uint8],
    attributes: Mapping[str, NDArray],
    names: Sequence[str] = (),
) -> None:
    """Write a cloud with its labels: x y z, red green blue (uchar), and the unchanged attributes; whole or not at all.

    xyz_world: (n, 3); written as float, or as double where float would move a point by more than 1e-6 of the cloud's
    extent. rgb: (n, 3) uint8. attributes: name -> (n,): og_label, og_instance (int32), og_score (float32), og_reason
    (uint8). names: those that og_label indexes; written as JSON in a comment "og_names" if they fit into a header.
    """
    comment = f"og_names {json.dumps(list(names))}"
    fits = names and len(comment) < HEADER_LIMIT // 2
    write_ply(path, {"vertex": plain_rows(xyz_world, np.asarray(rgb, np.uint8), attributes)}, [comment] if fits else [])
