"""One picture drawn off-screen, in a process of its own: ``python -m og_pointcloud_open3d.render JOB.npz OUT.png``.

Open3D ends the whole process where a driver is missing, and where a second renderer follows a first one.
"""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

WHITE = [1.0, 1.0, 1.0, 1.0]
SHIFTS_PX = ((0, 0), (5, 3), (11, 9))
"""Splats are drawn in tiles of 16 pixels, of which software drivers leave one in some hundreds white. So splats are
drawn three times with other tiles under them, and the darkest of the three pixels counts."""


def main(job_file: str, picture_file: str) -> None:
    """job_file: arrays positions (n, 3) float32, camera (4,) fx fy cx cy, size (2,) width height, world_to_camera
    (4, 4); colors (n, 3) float32 and point_size for points, or scale, rot, opacity, f_dc as
    Open3D has them for splats."""
    os.environ.setdefault("EGL_PLATFORM", "surfaceless")
    open3d: Any = importlib.import_module("open3d")
    with np.load(job_file, allow_pickle=False) as file:
        job = dict(file)
    width, height = map(int, job["size"])
    are_splats = "f_dc" in job
    shifts = SHIFTS_PX if are_splats else ((0, 0),)
    margin = np.max(shifts, axis=0)
    renderer = open3d.visualization.rendering.OffscreenRenderer(width + int(margin[0]), height + int(margin[1]))
    _fill(open3d, renderer.scene, job)
    frames = []
    for right, down in shifts:
        _aim(renderer, job, right, down, margin)
        image = np.asarray(renderer.render_to_image())
        frames.append(image[down : down + height, right : right + width])
    picture = np.ascontiguousarray(np.min(frames, axis=0))
    if not open3d.io.write_image(picture_file, open3d.geometry.Image(picture)):
        sys.exit("the picture could not be written")


def _fill(open3d: Any, scene: Any, job: Mapping[str, NDArray]) -> None:
    """The geometry on white; without post-processing, so that colours stay what they are."""
    material = open3d.visualization.rendering.MaterialRecord()
    cloud = open3d.t.geometry.PointCloud()
    for name in {"positions", "colors", "scale", "rot", "opacity", "f_dc"} & set(job):
        cloud.point[name] = open3d.core.Tensor(np.ascontiguousarray(job[name]))
    if "f_dc" in job:
        material.shader = "gaussianSplat"
        material.gaussian_splat_sh_degree = 0
    else:
        material.shader = "defaultUnlit"
        material.point_size = float(job["point_size"])
    scene.set_background(WHITE)
    scene.add_geometry("cloud", cloud, material)
    scene.view.set_post_processing(False)


def _aim(renderer: Any, job: Mapping[str, NDArray], right: int, down: int, margin: NDArray[np.integer]) -> None:
    """The camera, its picture moved by some pixels within the larger one that is drawn."""
    fx, fy, cx, cy = job["camera"]
    width, height = map(int, job["size"] + margin)
    intrinsics = np.array([[fx, 0, cx + right], [0, fy, cy + down], [0, 0, 1]])
    renderer.setup_camera(intrinsics, job["world_to_camera"].astype(np.float64), width, height)


if __name__ == "__main__":
    main(*sys.argv[1:])
