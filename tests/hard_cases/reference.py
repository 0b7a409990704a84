"""Splatting from its definition (Kerbl et al. 2023; Zwicker et al. 2001), slow, in the widest floats there are.

No tiles, boxes or recurrences, and no determinant: with the projected axes H of a Gaussian, a 2x5 matrix that also
holds the low-pass filter, the squared Mahalanobis distance is |y|^2 of ``L y = d``, ``H H' = L L'`` taken by
Gram-Schmidt on the rows of H, which squares nothing. A needle of 1e6:1 keeps its digits.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.fitting.mask_table import Gaussians
from og_pointcloud.scene import Camera

__all__ = ["blended", "mask_sums", "pixel_weights", "rotation_matrices"]

Wide = np.longdouble
ALPHA_MIN, ALPHA_MAX, TRANSMITTANCE_MIN, LOW_PASS, MARGIN = 1 / 255, 0.99, 1e-4, 0.3, 0.3
"""3DGS's constants; MARGIN is how far outside the image, in half images, the projection is linearised at most."""


def pixel_weights(
    gaussians: Gaussians, camera: Camera, near: float, window: tuple[int, int, int, int] | None = None
) -> NDArray[np.float64]:
    """(h, w, n) float64: the weight of every Gaussian in every pixel of the window (left, top, w, h), or of the image.

    Gaussians deeper than ``near`` are blended by (float32 depth, index).
    """
    pose = camera.world_to_camera.astype(Wide)
    x, y, depth = (pose[:3, :3] @ gaussians.xyz.astype(Wide).T) + pose[:3, 3:]
    front = np.flatnonzero(depth > near)
    order = front[np.lexsort((front, depth[front].astype(np.float32)))]
    left, top, width, height = window or (0, 0, camera.width, camera.height)
    column = (np.arange(width) + left + Wide(0.5))[None, :]
    row = (np.arange(height) + top + Wide(0.5))[:, None]

    def alpha(g: int) -> NDArray[np.float64]:
        tx, ty = x[g] / depth[g], y[g] / depth[g]
        first, second = _projected_axes(gaussians, g, camera, pose, tx, ty, depth[g])
        length = np.sqrt(first @ first)
        along = first @ second / length
        rest = second - along * first / length
        dx, dy = column - (camera.fx * tx + camera.cx), row - (camera.fy * ty + camera.cy)
        across = (dy - along * dx / length) / np.sqrt(rest @ rest)
        density = np.exp(-(np.square(dx / length) + np.square(across)) / 2)
        return np.minimum(ALPHA_MAX, gaussians.opacity[g].astype(Wide) * density).astype(np.float64)

    return blended(order, alpha, (height, width, len(gaussians)))


def mask_sums(weights: NDArray[np.floating], ids: NDArray[np.integer], count: int) -> NDArray[np.float64]:
    """(count + 1, n) float64: (h, w, n) weights added up over the pixels of every id, the last row over id -1."""
    sums = np.zeros((count + 1, weights.shape[2]))
    np.add.at(sums, ids.ravel(), weights.reshape(-1, weights.shape[2]))  # id -1 is the last row
    return sums


def blended(
    order: Iterable[int], alpha: Callable[[int], NDArray[Any]], shape: tuple[int, int, int], dtype: type = float
) -> NDArray[Any]:
    """(h, w, n) weights ``T alpha``, front to back in the order given; alpha(g) is the (h, w) opacity of g."""
    weights, transmittance = np.zeros(shape, dtype), np.ones(shape[:2], dtype)
    stopped = np.zeros(shape[:2], bool)
    for g in order:
        opacity = alpha(g)
        drawn = ~stopped & (opacity >= ALPHA_MIN)
        rest = transmittance * (1 - opacity)
        stopped |= drawn & (rest < TRANSMITTANCE_MIN)
        drawn &= ~stopped
        weights[drawn, g] = (transmittance * opacity)[drawn]
        transmittance[drawn] = rest[drawn]
    return weights


def rotation_matrices(quaternion: NDArray[np.floating]) -> NDArray[np.floating]:
    """(n, 3, 3) of unit quaternions (n, 4) wxyz, in their own precision."""
    w, x, y, z = quaternion.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows, quaternion.dtype), -1, 0)


def _projected_axes(
    gaussians: Gaussians, g: int, camera: Camera, pose: NDArray[Wide], tx: Wide, ty: Wide, depth: Wide
) -> tuple[NDArray[Wide], NDArray[Wide]]:
    """Rows of H, in pixels: the Gaussian's three axes through the linearised projection, and the low-pass filter's."""
    out_x, out_y = MARGIN * 0.5 * camera.width / camera.fx, MARGIN * 0.5 * camera.height / camera.fy
    jx = np.clip(tx, -camera.cx / camera.fx - out_x, (camera.width - camera.cx) / camera.fx + out_x)
    jy = np.clip(ty, -camera.cy / camera.fy - out_y, (camera.height - camera.cy) / camera.fy + out_y)
    rotation = rotation_matrices(gaussians.rotation[g : g + 1].astype(Wide))[0]
    axes = pose[:3, :3] @ rotation * gaussians.scale[g].astype(Wide)
    filter_size = np.sqrt(Wide(LOW_PASS))
    first = camera.fx / depth * (axes[0] - jx * axes[2])
    second = camera.fy / depth * (axes[1] - jy * axes[2])
    return np.append(first, [filter_size, 0]), np.append(second, [0, filter_size])
