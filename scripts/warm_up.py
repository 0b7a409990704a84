"""Compiles the kernels into numba's cache, so that a new installation's first fit and first file do not wait for it."""

import tempfile
from pathlib import Path

import numpy as np
from og_pointcloud_export import write_bundle

from og_pointcloud.fitting.fit import fit
from og_pointcloud.scene import Camera, Points, Scene, View


def main() -> None:
    """Fit a few points seen by three cameras, and write the file."""
    rng = np.random.default_rng(0)
    points = Points.from_world(rng.uniform(-1, 1, (200, 3)), rgb=rng.integers(0, 256, (200, 3), np.uint8))
    views = []
    for index in range(3):
        pose = np.eye(4)
        pose[:3, 3] = -points.origin + [0.1 * index, 0, 4]
        masks = np.full((48, 64), -1, np.int32)
        masks[:, 32:] = 0
        image = np.zeros((48, 64, 3), np.uint8)
        views.append(View(str(index), Camera(64, 48, 60, 60, 32, 24, pose), masks, np.ones((1, 4), np.float32), image))
    cloud = fit(Scene(points, tuple(views), "none"), progress=False)
    with tempfile.TemporaryDirectory() as folder:
        write_bundle(cloud, Path(folder) / "warm_up.ogpc")


if __name__ == "__main__":
    main()
