"""Noisy points -> positions nearer to their surface, at which they are drawn.

A point that noise has moved in front of its surface hides what lies beside it; one that noise has moved behind seems
hidden itself. So points are drawn nearer to the plane of their neighbors. Only the drawing uses these positions:
points, neighbors and distances stay as they are.

How much nearer is decided point by point. Noise scatters the nearest few neighbors off their plane as far as it
scatters all neighbors off theirs. A surface that bends, ends, or has another beside it departs from a plane the more,
the farther it is followed. With s(k) the variance of k neighbors off the plane that fits them best,

    share = NOISE_BIAS s(NOISE_NEIGHBORS) / s(all)

of the way to the plane of all neighbors is due to noise, at most all of it. Farther neighbors have less weight and the
last has none (as in moving least squares; Levin, 2004), so it does not matter which of several equally far is the last.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.kernels import njit, prange
from og_pointcloud.rendering.geometry import Neighborhood

NOISE_NEIGHBORS = 7
"""Neighbors whose plane shows the noise alone."""
NOISE_BIAS = 1.3
"""A plane fitted to few points follows their noise: their variance off it is smaller than off the surface."""

MIN_NORMAL = 1e-6
"""Length of the cross products of a covariance's rows, relative to its spread, below which it has no normal."""


def smoothed(xyz: NDArray[np.float32], around: Neighborhood) -> NDArray[np.float32]:
    """(n, 3) float32 positions nearer to the surface. xyz: (n, 3) float32, scene units. Points that have no more than
    NOISE_NEIGHBORS neighbors, or whose neighbors lie on a line, stay.

    >>> from og_pointcloud.rendering.geometry import neighborhood
    >>> from og_pointcloud.settings import GeometrySettings
    >>> random = np.random.default_rng(0)
    >>> wall = random.uniform(0, 20, (400, 3)).astype(np.float32)
    >>> wall[:, 2] = random.normal(0, 0.5, 400)
    >>> bool(smoothed(wall, neighborhood(wall, GeometrySettings()))[:, 2].std() < 0.7 * wall[:, 2].std())
    True
    """
    if around.index.shape[1] <= NOISE_NEIGHBORS:
        return xyz
    return _smoothed(np.ascontiguousarray(xyz), around.index)


@njit(cache=True, parallel=True)
def _smoothed(xyz, index):  # noqa: ANN001, ANN202
    moved = xyz.copy()
    for g in prange(len(xyz)):
        noise = _plane(xyz, g, index, NOISE_NEIGHBORS)[0]
        variance, height, nx, ny, nz = _plane(xyz, g, index, index.shape[1])
        if variance > 0:
            step = min(1.0, NOISE_BIAS * noise / variance) * height
            moved[g, 0] = xyz[g, 0] - step * nx
            moved[g, 1] = xyz[g, 1] - step * ny
            moved[g, 2] = xyz[g, 2] - step * nz
    return moved


@njit(cache=True)
def _plane(xyz, g, index, count):  # noqa: ANN001, ANN202
    """The plane of a point and ``count`` neighbors: their variance off it, the point's height over it, and its unit
    normal. 0 and 0 where no plane fits better than others."""
    px, py, pz = np.float64(xyz[g, 0]), np.float64(xyz[g, 1]), np.float64(xyz[g, 2])
    last = index[g, count - 1]
    reach = (xyz[last, 0] - px) ** 2 + (xyz[last, 1] - py) ** 2 + (xyz[last, 2] - pz) ** 2
    # Moments about the point itself, which has weight 1. The last neighbor has weight 0.
    total, mx, my, mz = 1.0, 0.0, 0.0, 0.0
    xx, yy, zz, xy, xz, yz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(count - 1):
        other = index[g, k]
        x, y, z = xyz[other, 0] - px, xyz[other, 1] - py, xyz[other, 2] - pz
        weight = 1 - (x * x + y * y + z * z) / reach if reach > 0 else 0.0
        total += weight
        mx, my, mz = mx + weight * x, my + weight * y, mz + weight * z
        xx, yy, zz = xx + weight * x * x, yy + weight * y * y, zz + weight * z * z
        xy, xz, yz = xy + weight * x * y, xz + weight * x * z, yz + weight * y * z
    mx, my, mz = mx / total, my / total, mz / total
    xx, yy, zz = xx / total - mx * mx, yy / total - my * my, zz / total - mz * mz
    xy, xz, yz = xy / total - mx * my, xz / total - mx * mz, yz / total - my * mz
    variance, nx, ny, nz = _smallest_eigenpair(xx, yy, zz, xy, xz, yz)
    return variance, -(mx * nx + my * ny + mz * nz), nx, ny, nz


@njit(cache=True)
def _smallest_eigenpair(xx, yy, zz, xy, xz, yz):  # noqa: ANN001, ANN202
    """The smallest eigenvalue of a covariance, in closed form (Smith, 1961), and its unit eigenvector; zeros where
    another eigenvalue is as small."""
    middle = (xx + yy + zz) / 3
    a, b, c = xx - middle, yy - middle, zz - middle
    spread = np.sqrt((a * a + b * b + c * c + 2 * (xy * xy + xz * xz + yz * yz)) / 6)
    if not spread > 0:
        return 0.0, 0.0, 0.0, 0.0
    a, b, c, d, e, f = a / spread, b / spread, c / spread, xy / spread, xz / spread, yz / spread
    half = (a * (b * c - f * f) - d * (d * c - f * e) + e * (d * f - b * e)) / 2
    least = 2 * np.cos(np.arccos(min(max(half, -1.0), 1.0)) / 3 + 2 * np.pi / 3)
    # The eigenvector is orthogonal to all rows of what is left: the longest of their cross products.
    a, b, c = a - least, b - least, c - least
    longest, nx, ny, nz = 0.0, 0.0, 0.0, 0.0
    for x, y, z in (
        (d * f - e * b, e * d - a * f, a * b - d * d),
        (d * c - e * f, e * e - a * c, a * f - d * e),
        (b * c - f * f, f * e - d * c, d * f - b * e),
    ):
        length = np.sqrt(x * x + y * y + z * z)
        if length > longest:
            longest, nx, ny, nz = length, x, y, z
    if longest < MIN_NORMAL:
        return 0.0, 0.0, 0.0, 0.0
    return max(middle + spread * least, 0.0), nx / longest, ny / longest, nz / longest
