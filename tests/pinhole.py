"""Pinhole cameras of made scenes: where they look, and the rays of their pixels."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from og_pointcloud.formats.poses import rigid
from og_pointcloud.scene import Camera


def looking(eye: ArrayLike, forward: ArrayLike) -> NDArray[np.float64]:
    """World-to-camera (4, 4), OpenCV axes, of a level camera at ``eye`` that looks ``forward``; world z is up."""
    forward = np.asarray(forward, np.float64) / np.linalg.norm(forward)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return rigid(rotation, -rotation @ eye)


def rays(camera: Camera) -> NDArray[np.float64]:
    """(H, W, 3) directions in the world through pixel centers, of length 1 along the camera's axis."""
    row, column = np.mgrid[: camera.height, : camera.width] + 0.5
    x, y = (column - camera.cx) / camera.fx, (row - camera.cy) / camera.fy
    return np.stack([x, y, np.ones_like(x)], axis=-1) @ camera.world_to_camera[:3, :3]
