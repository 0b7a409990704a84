"""Files of places far from the origin, and folders that lack a file."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

from hard_cases.case import Answer, agrees, refuses
from hard_cases.inputs import labelled_cloud, write_two_balls
from og_pointcloud.bundle.read import read_bundle
from og_pointcloud.errors import SceneError
from og_pointcloud.formats.capture import read_capture


@agrees(0, "offset of the world, scene units", (0, 1e4, 1e8))
def bundle_round_trip(distance: float) -> Answer:
    """A labelled cloud at map coordinates, written and read: the same world coordinates and ids, bit by bit."""
    from og_pointcloud_export import write_bundle

    cloud = labelled_cloud(origin=(distance, -distance, 1 / 3))
    with tempfile.TemporaryDirectory() as folder:
        read = read_bundle(write_bundle(cloud, Path(folder) / "scene.ogpc")).cloud
    return Answer(
        np.c_[read.xyz_world.view(np.int64), read.instance_ids],
        np.c_[cloud.xyz_world.view(np.int64), cloud.instance_ids],
    )


@refuses(SceneError, "lacks view0.png", "expected one per image", "write an all-zero mask")
def capture_without_a_mask_image() -> object:
    """A capture folder that lacks one of its mask images."""
    with tempfile.TemporaryDirectory() as folder:
        write_two_balls(Path(folder))
        (Path(folder) / "masks" / "view0.png").unlink()
        return read_capture(folder)
