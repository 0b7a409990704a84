"""Splatting written straight from its definition (Kerbl et al. 2023; Zwicker et al. 2001), slow and in float64.

No tiles, no bounding boxes, no recurrences: every Gaussian is evaluated at every pixel. The projected covariance and
its inverse are taken in extended precision where the machine has it, so that the reference of a needle is exact.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from og_pointcloud.rendering.splatting import Gaussians
from og_pointcloud.scene import Camera

Wide = np.longdouble


def round_splats(xyz: ArrayLike, scale: ArrayLike, opacity: ArrayLike = 0.9) -> Gaussians:
    """Splats alike in all directions. xyz: (n, 3). scale, opacity: a number, or (n,)."""
    n = len(np.asarray(xyz))
    size, rotation = np.broadcast_to(np.reshape(scale, (-1, 1)), (n, 3)), np.tile(np.float32([1, 0, 0, 0]), (n, 1))
    opacities = np.broadcast_to(np.asarray(opacity, np.float32), n).copy()
    return Gaussians(np.asarray(xyz, np.float32), size.astype(np.float32), rotation, opacities)


def reference_pixel_weights(gaussians: Gaussians, camera: Camera, near: float) -> NDArray[np.float64]:
    """(H, W, n) float64: T alpha of every Gaussian in every pixel."""
    n = len(gaussians)
    weights = np.zeros((camera.height, camera.width, n))
    transmittance = np.ones((camera.height, camera.width))
    stopped = np.zeros((camera.height, camera.width), bool)
    for g in front_to_back(gaussians, camera, near):
        alpha = reference_alpha(gaussians, g, camera)
        drawn = ~stopped & (alpha >= 1 / 255)
        rest = transmittance * (1 - alpha)
        stopped |= drawn & (rest < 1e-4)
        drawn &= ~stopped
        weights[drawn, g] = (transmittance * alpha)[drawn]
        transmittance[drawn] = rest[drawn]
    return weights


def front_to_back(gaussians: Gaussians, camera: Camera, near: float) -> list[int]:
    """Gaussians beyond the near plane by (float32 depth, index)."""
    depths = [float(in_camera(gaussians, g, camera)[2]) for g in range(len(gaussians))]
    return sorted((g for g in range(len(gaussians)) if depths[g] > near), key=lambda g: (np.float32(depths[g]), g))


def rotation_matrix(quaternion: NDArray[np.floating]) -> NDArray[np.longdouble]:
    """(3, 3) rotation of a unit quaternion wxyz."""
    w, x, y, z = quaternion.astype(Wide)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def in_camera(gaussians: Gaussians, g: int, camera: Camera) -> NDArray[np.float64]:
    return camera.world_to_camera[:3, :3] @ gaussians.xyz[g].astype(np.float64) + camera.world_to_camera[:3, 3]


def reference_alpha(gaussians: Gaussians, g: int, camera: Camera) -> NDArray[np.float64]:
    """(H, W) float64: opacity times the projected Gaussian, cut at 0.99."""
    x, y, z = in_camera(gaussians, g, camera).astype(Wide)
    u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    covariance = projected_covariance(gaussians, g, camera)
    (xx, xy), (_, yy) = covariance
    det = xx * yy - xy * xy
    column, row = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    dx, dy = column - u, row - v
    squared_distance = (yy * dx * dx - 2 * xy * dx * dy + xx * dy * dy) / det
    return np.minimum(0.99, gaussians.opacity[g] * np.exp(-0.5 * squared_distance)).astype(np.float64)


def projected_covariance(gaussians: Gaussians, g: int, camera: Camera) -> NDArray[np.longdouble]:
    """(2, 2) covariance in px^2: J W Sigma W' J' + 0.3 I, with J the Jacobian of the projection at the center.

    J is taken at most 0.3 half fields of view outside the image, as in 3DGS (1.3 tan(fov/2)).
    """
    x, y, z = in_camera(gaussians, g, camera).astype(Wide)
    margin_x, margin_y = 0.3 * 0.5 * camera.width / camera.fx, 0.3 * 0.5 * camera.height / camera.fy
    x = z * np.clip(x / z, -camera.cx / camera.fx - margin_x, (camera.width - camera.cx) / camera.fx + margin_x)
    y = z * np.clip(y / z, -camera.cy / camera.fy - margin_y, (camera.height - camera.cy) / camera.fy + margin_y)
    jacobian = np.array([[camera.fx / z, 0, -camera.fx * x / z**2], [0, camera.fy / z, -camera.fy * y / z**2]], Wide)
    axes = rotation_matrix(gaussians.rotation[g]) @ np.diag(gaussians.scale[g].astype(Wide))
    half = jacobian @ camera.world_to_camera[:3, :3].astype(Wide) @ axes
    return half @ half.T + Wide(0.3) * np.eye(2, dtype=Wide)
