"""Noisy points -> the places on their surface where views are asked for them.

A point that noise has taken before its surface hides what lies beside it, one that noise has taken behind seems hidden
itself. So views are asked at places nearer to the plane of each point's neighbors; the points themselves stay where
they are, and so do their neighbors.

How much nearer is decided point by point. Noise scatters the nearest neighbors off their plane as far as all of them
off theirs. A surface that bends, ends, or has another beside it departs from a plane the more, the farther it is
followed. With the variances s of neighbors off the planes that fit them best,

    share = OF_FEW s(NEAREST) / s(all)        of the way to the plane of all, at most all of it

is what noise explains. Neighbors count the less, the farther they are, the last one nothing (as in moving least
squares; Levin, 2004): which of several as far away is the last does not matter.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.kernels import njit, prange
from og_pointcloud.rendering.geometry import Neighborhood

NEAREST = 7
"""Neighbors to which the smaller plane is fitted."""
OF_FEW = 1.3
"""A plane through few points follows their noise: they scatter less off it than off the surface."""

ON_A_LINE = 1e-6
"""Length of the cross products of a covariance's rows, in units of its spread, below which it has no normal."""


def on_surface(xyz: NDArray[np.float32], around: Neighborhood) -> NDArray[np.float32]:
    """(n, 3) float32 where views are asked for each point. xyz: (n, 3). Where a point has no more than NEAREST
    neighbors, or these lie on a line, it stays.

    >>> from og_pointcloud.rendering.geometry import neighborhood
    >>> from og_pointcloud.settings import GeometrySettings
    >>> random = np.random.default_rng(0)
    >>> wall = random.uniform(0, 20, (400, 3)).astype(np.float32)
    >>> wall[:, 2] = random.normal(0, 0.5, 400)
    >>> moved = on_surface(wall, neighborhood(wall, GeometrySettings()))
    >>> bool(moved[:, 2].std() < 0.7 * wall[:, 2].std())
    True
    """
    if around.index.shape[1] <= NEAREST:
        return xyz
    return _moved(np.ascontiguousarray(xyz), around.index)


@njit(cache=True, parallel=True)
def _moved(xyz, index):  # noqa: ANN001, ANN202
    moved = xyz.copy()
    for g in prange(len(xyz)):
        few = _fit(xyz, g, index, NEAREST)[0]
        all_, height, nx, ny, nz = _fit(xyz, g, index, index.shape[1])
        if all_ > 0:
            step = min(1.0, OF_FEW * few / all_) * height
            moved[g, 0] = xyz[g, 0] - step * nx
            moved[g, 1] = xyz[g, 1] - step * ny
            moved[g, 2] = xyz[g, 2] - step * nz
    return moved


@njit(cache=True)
def _fit(xyz, g, index, count):  # noqa: ANN001, ANN202
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
    variance, nx, ny, nz = _flattest(xx, yy, zz, xy, xz, yz)
    return variance, -(mx * nx + my * ny + mz * nz), nx, ny, nz


@njit(cache=True)
def _flattest(xx, yy, zz, xy, xz, yz):  # noqa: ANN001, ANN202
    """The smallest eigenvalue of a covariance, in closed form (Smith, 1961), and its unit eigenvector; zeros where
    others are as small."""
    middle = (xx + yy + zz) / 3
    a, b, c = xx - middle, yy - middle, zz - middle
    spread = np.sqrt((a * a + b * b + c * c + 2 * (xy * xy + xz * xz + yz * yz)) / 6)
    if not spread > 0:
        return 0.0, 0.0, 0.0, 0.0
    a, b, c, d, e, f = a / spread, b / spread, c / spread, xy / spread, xz / spread, yz / spread
    half = (a * (b * c - f * f) - d * (d * c - f * e) + e * (d * f - b * e)) / 2
    least = 2 * np.cos(np.arccos(min(max(half, -1.0), 1.0)) / 3 + 2 * np.pi / 3)
    # Its eigenvector is at right angles to all rows of what is left: of their cross products the longest.
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
    if longest < ON_A_LINE:
        return 0.0, 0.0, 0.0, 0.0
    return max(middle + spread * least, 0.0), nx / longest, ny / longest, nz / longest
