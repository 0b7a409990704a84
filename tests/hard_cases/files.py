"""Files that are cut short, lie about themselves, or come from elsewhere."""

from __future__ import annotations

import json
import tempfile
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from hard_cases.case import Answer, agrees, refuses
from hard_cases.inputs import labelled_cloud, write_two_balls
from og_pointcloud.bundle.read import read_bundle
from og_pointcloud.errors import BundleError, SceneError
from og_pointcloud.formats.capture import read_capture
from og_pointcloud.formats.points import read_points


@agrees(0, "offset of the world, scene units", (0, 1e4, 1e8))
def bundle_round_trip(distance: float) -> Answer:
    """A labelled cloud at map coordinates, written and read: the same world coordinates and ids, bit by bit."""
    cloud = labelled_cloud(origin=(distance, -distance, 1 / 3))
    with tempfile.TemporaryDirectory() as folder:
        read = read_bundle(_write(folder)(cloud)).cloud
    return Answer(
        np.c_[read.xyz_world.view(np.int64), read.instance_ids],
        np.c_[cloud.xyz_world.view(np.int64), cloud.instance_ids],
    )


@refuses(BundleError, "not a .ogpc file, or damaged", "expected a zip", "copy it again")
def bundle_cut_short() -> object:
    """A .ogpc of which the last third is missing."""
    return _read_changed(lambda path: path.write_bytes(path.read_bytes()[: path.stat().st_size * 2 // 3]))


@refuses(BundleError, "not a .ogpc file, or damaged", "expected a zip", "copy it again")
def bundle_of_nothing() -> object:
    """A .ogpc of no byte."""
    return _read_changed(lambda path: path.write_bytes(b""))


@refuses(BundleError, "schema_version is 99", "newer than the", "pip install --upgrade og-pointcloud")
def bundle_of_tomorrow() -> object:
    """A .ogpc of a later version."""

    def change(path: Path) -> None:
        with zipfile.ZipFile(path) as archive:
            members = {name: archive.read(name) for name in archive.namelist()}
        members["manifest.json"] = json.dumps({**json.loads(members["manifest.json"]), "schema_version": 99}).encode()
        with zipfile.ZipFile(path, "w") as archive:
            for name, data in members.items():
                archive.writestr(name, data)

    return _read_changed(change)


@refuses(SceneError, "the file has 3 rows", "expected 1000000000000 rows", "copy or write it again")
def cloud_that_claims_too_much() -> object:
    """A PLY header of a trillion points before a few bytes."""
    header = "ply\nformat binary_little_endian 1.0\nelement vertex 1000000000000\n"
    header += "".join(f"property float {axis}\n" for axis in "xyz") + "end_header\n"
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "cloud.ply"
        path.write_bytes(header.encode() + bytes(36))
        return read_points(path)


@refuses(SceneError, "lacks view0.png", "expected one per image", "write an all-zero mask")
def capture_without_a_mask_image() -> object:
    """A capture folder that lacks one of its mask images."""
    with tempfile.TemporaryDirectory() as folder:
        write_two_balls(Path(folder))
        (Path(folder) / "masks" / "view0.png").unlink()
        return read_capture(folder)


def _write(folder: str) -> Callable[..., Path]:
    from og_pointcloud_export import write_bundle

    return lambda cloud: write_bundle(cloud, Path(folder) / "scene.ogpc")


def _read_changed(change: Callable[[Path], object]) -> object:
    with tempfile.TemporaryDirectory() as folder:
        path = _write(folder)(labelled_cloud())
        change(path)
        return read_bundle(path)
