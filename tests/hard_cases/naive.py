"""What a plain float32 implementation computes: formulas as printed, single precision throughout, nothing rearranged.

These are what the library is compared with, to see where the printed form breaks; nothing else uses them.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.scene import Camera

__all__ = [
    "cosines", "eq1", "eq2_gradient", "mean_direction", "nearest", "nearest_center", "pixel_weights",
    "unit",
]  # fmt: skip

Single = np.float32
ALPHA_MIN, ALPHA_MAX, TRANSMITTANCE_MIN, LOW_PASS = 1 / 255, 0.99, 1e-4, 0.3


def pixel_weights(
    xyz: NDArray[np.floating], scale: NDArray[np.floating], rotation: NDArray[np.floating],
    opacity: NDArray[np.floating], camera: Camera, near: float,
) -> NDArray[np.floating]:  # fmt: skip
    """(H, W, n): J W Sigma W' J' + 0.3 I, its plain determinant and inverse, sorted by float32 depth.

    J is taken at most 1.3 tan(fov / 2) from the axis, as in 3DGS.
    """
    pose = camera.world_to_camera.astype(Single)
    fx, fy, cx, cy = np.array([camera.fx, camera.fy, camera.cx, camera.cy], Single)
    x, y, z = pose[:3, :3] @ xyz.astype(Single).T + pose[:3, 3:]
    u, v = fx * x / z + cx, fy * y / z + cy
    limit_x, limit_y = Single(1.3) * camera.width / (2 * fx), Single(1.3) * camera.height / (2 * fy)
    jx, jy = np.clip(x / z, -limit_x, limit_x) * z, np.clip(y / z, -limit_y, limit_y) * z
    zero = np.zeros_like(z)
    jacobian = np.moveaxis(np.array([[fx / z, zero, -fx * jx / (z * z)], [zero, fy / z, -fy * jy / (z * z)]]), -1, 0)
    axes = _rotation_matrices(rotation.astype(Single)) * scale.astype(Single)[:, None, :]
    world = axes @ np.swapaxes(axes, 1, 2)
    half = jacobian @ pose[:3, :3]
    covariance = half @ world @ np.swapaxes(half, 1, 2) + Single(LOW_PASS) * np.eye(2, dtype=Single)
    a, b, c = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    determinant = a * c - b * b
    column = (np.arange(camera.width, dtype=Single) + Single(0.5))[None, :]
    row = (np.arange(camera.height, dtype=Single) + Single(0.5))[:, None]

    def alpha(g: int) -> NDArray[np.floating]:
        dx, dy = column - u[g], row - v[g]
        power = -(c[g] * dx * dx - 2 * b[g] * dx * dy + a[g] * dy * dy) / (2 * determinant[g])
        return np.minimum(Single(ALPHA_MAX), opacity[g].astype(Single) * np.exp(power))

    front = np.flatnonzero(z > Single(near))
    order = front[np.argsort(z[front])]
    return _blended(order, alpha, (camera.height, camera.width, len(xyz)))


def _blended(
    order: NDArray[np.intp], alpha: Callable[[int], NDArray[np.floating]], shape: tuple[int, int, int]
) -> NDArray[np.floating]:
    """(h, w, n) weights ``T alpha``, front to back in the order given; alpha(g) is the (h, w) opacity of g."""
    weights, transmittance = np.zeros(shape, Single), np.ones(shape[:2], Single)
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


def _rotation_matrices(quaternion: NDArray[np.floating]) -> NDArray[np.floating]:
    """(n, 3, 3) of unit quaternions (n, 4) wxyz, in their own precision."""
    w, x, y, z = quaternion.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows, quaternion.dtype), -1, 0)


def unit(rows: NDArray[np.floating]) -> NDArray[np.floating]:
    """Rows over the square root of their sum of squares."""
    rows = rows.astype(Single)
    return rows / np.sqrt((rows * rows).sum(axis=1, keepdims=True))


def cosines(a: NDArray[np.floating], b: NDArray[np.floating], dtype: type = Single) -> NDArray[np.floating]:
    """(len(a), len(b)): products over lengths."""
    a, b = a.astype(dtype), b.astype(dtype)
    squares_a, squares_b = (a * a).sum(axis=1, dtype=dtype), (b * b).sum(axis=1, dtype=dtype)
    return (a @ b.T) / np.sqrt(squares_a[:, None] * squares_b[None, :])


def mean_direction(rows: NDArray[np.floating]) -> NDArray[np.floating]:
    """The mean of unit rows, of length 1."""
    return unit(unit(rows).mean(axis=0, keepdims=True, dtype=Single))[0]


def nearest(points: NDArray[np.floating], queries: NDArray[np.floating]) -> NDArray[np.int64]:
    """Index of the nearest point to each query, in world coordinates."""
    points, queries = points.astype(Single), queries.astype(Single)
    return np.array([((points - query) ** 2).sum(axis=1).argmin() for query in queries])


def nearest_center(values: NDArray[np.floating], centers: NDArray[np.floating]) -> NDArray[np.int64]:
    """k-means' assignment by |x|^2 - 2 x c + |c|^2."""
    x, c = values.astype(Single), centers.astype(Single)
    return ((x * x).sum(axis=1)[:, None] - 2 * x @ c.T + (c * c).sum(axis=1)).argmin(axis=1)


def eq1(weights: NDArray[np.floating], features: NDArray[np.floating]) -> np.floating:
    """Eq. 1 as a quadratic form: the sum of c |f|^2 less N |mean|^2, over the sum of N."""
    weights, features = weights.astype(Single), features.astype(Single)
    size = weights.sum(axis=1)
    means = weights @ features / size[:, None]
    squares = (weights.sum(axis=0)[:, None] * features * features).sum()
    return (squares - (size[:, None] * means * means).sum()) / size.sum()


def eq2_gradient(means: NDArray[np.floating]) -> NDArray[np.floating]:
    """Of the mean of 1 / d^2 over the pairs of (m, width) means, by the means."""
    means = means.astype(Single)
    apart = means[:, None] - means[None]
    square = (apart * apart).sum(axis=2)
    np.fill_diagonal(square, np.inf)
    pairs = Single(len(means) * (len(means) - 1))
    return (-4 * apart / (square * square)[..., None]).sum(axis=1) / pairs
