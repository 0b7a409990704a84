"""Frozen geometry + camera + id map -> how much each Gaussian shows in each id's pixels, exactly as 3DGS blends.

Rendering a frozen scene is linear: a pixel's value is ``sum_g W[p, g] value_g`` with the alpha-blending weights
``W[p, g] = T alpha`` of 3D Gaussian Splatting (Kerbl et al. 2023, Eq. 3; paper appendix "splatting"). This file adds
those weights up over the pixels of each mask, tile by tile while compositing; ``W`` itself is never stored:

    A[i, g] = sum over pixels p of mask i of W[p, g]

It knows nothing of colours or features: what a view shows of any value is a product with these sparse rows. A map
that gives every pixel its own id makes ``A`` the weights ``W`` themselves (see `pixel_weights`).

Blending also shows what a mask does not mean: the floor between the splats of a table top. Given how thick surfaces
are, exposure counts little what shows *through* one: a splat farther than that behind the one at which a pixel became
more covered than not. It is a depth test with the accuracy of a surface, not of a point, and takes no second pass.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from numba import njit, prange
from numpy.typing import NDArray
from scipy.sparse import csr_array

from og_pointcloud.errors import SceneError
from og_pointcloud.scene import Camera, Points

# OpenMP first: numba else tries TBB, and warns where it finds an old one. A user's own choice is kept.
# Threads that wait sleep: spinning ones double the time of a fit wherever another program has a core.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")
if "NUMBA_THREADING_LAYER_PRIORITY" not in os.environ:
    numba.config.THREADING_LAYER_PRIORITY = ["omp", "tbb", "workqueue"]  # pyright: ignore

__all__ = [
    "Gaussians",
    "ViewWeights",
    "pixel_weights",
    "render",
    "view_weights",
    "working_memory",
]

TILE = 16
"""Pixels along a tile's side, as in 3DGS."""
LOW_PASS = 0.3
"""Added to the projected covariance, px^2: a splat is never smaller than about a pixel (3DGS)."""
ALPHA_MIN = 1.0 / 255.0
"""Contributions below are dropped (3DGS)."""
LARGEST_REACH = 2 * np.log(1 / ALPHA_MIN)
"""Squared Mahalanobis distance at which alpha falls to ALPHA_MIN, at opacity 1."""
ALPHA_MAX = 0.99
"""Alpha is cut here (3DGS)."""
TRANSMITTANCE_MIN = 1e-4
"""A pixel stops before the splat that would bring its transmittance below (3DGS)."""
FRUSTUM_MARGIN = 0.3
"""Centres beyond the image by more than this share of the half field of view are clamped when the projection is
linearised (3DGS's 1.3 tan(fov/2), written for any principal point)."""
NEAR_SHARE = 0.02
"""The near plane as a share of the median depth of the scene; 3DGS fixes 0.2 units, which no unitless scene can."""


@dataclass(frozen=True)
class Gaussians:
    """Geometry ready for splatting. xyz (n, 3), scale (n, 3) linear, rotation (n, 4) unit wxyz, opacity (n,)."""

    xyz: NDArray[np.float32]
    scale: NDArray[np.float32]
    rotation: NDArray[np.float32]
    opacity: NDArray[np.float32]

    @classmethod
    def from_points(cls, points: Points) -> Gaussians:
        """The Gaussians of a 3DGS file; SceneError for a plain cloud, whose splats `geometry` has to choose."""
        if points.scale is None or points.rotation is None or points.opacity is None:
            raise SceneError("the cloud has no scale, rotation and opacity; choose them with geometry.choose_gaussians")
        return cls(points.xyz, points.scale, points.rotation, points.opacity)

    def __len__(self) -> int:
        return len(self.xyz)


def pixel_weights(gaussians: Gaussians, camera: Camera, near: float) -> csr_array:
    """The blending weights ``W`` of one view themselves: (H W, n) sparse float32, pixels row by row."""
    pixels = camera.width * camera.height
    ids = np.arange(pixels, dtype=np.int32).reshape(camera.height, camera.width)
    return view_weights(gaussians, camera, ids, pixels, near).rows[:-1]


def render(
    gaussians: Gaussians, values: NDArray[np.float32], camera: Camera, near: float
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Values (n, c) of the Gaussians as one view shows them: (H, W, c) float32, and (H, W) float32, how much of each
    pixel is covered. Uncovered pixels are 0: this is ``W @ values`` without ``W`` in between."""
    pixels = camera.width * camera.height
    ids = np.arange(pixels, dtype=np.int32).reshape(camera.height, camera.width)
    (rows, cols, weights, first, counts), _ = _entries(gaussians, camera, ids, pixels, near, None)
    with_coverage = np.concatenate([values, np.ones((len(values), 1), np.float32)], axis=1)
    image = _paint(rows, cols, weights, first, counts, with_coverage, pixels).reshape(camera.height, camera.width, -1)
    return image[..., :-1], image[..., -1]


@njit(cache=True, parallel=True, nogil=True)
def _paint(rows, cols, weights, first, counts, values, pixels):  # noqa: ANN001, ANN202
    """Add up the values of every tile's entries by pixel; no pixel belongs to two tiles."""
    image = np.zeros((pixels, values.shape[1]), np.float32)
    for tile in prange(len(counts)):
        for e in range(first[tile], first[tile] + counts[tile]):
            for c in range(values.shape[1] if rows[e] < pixels else 0):
                image[rows[e], c] += weights[e] * values[cols[e], c]
    return image


@dataclass(frozen=True)
class ViewWeights:
    """What one view shows. rows: (id_count + 1, n) sparse float32 without duplicates, the last row what shows in pixels
    with id -1; they sum to at most the id's area in pixels. area: (n,) float64, the pixels each splat would weigh with
    nothing in front of it, 0 where it is outside the image. through: (1, n) sparse float32, the part of a splat's
    weight that shows through a surface."""

    rows: csr_array
    area: NDArray[np.float64]
    through: csr_array


def view_weights(
    gaussians: Gaussians,
    camera: Camera,
    ids: NDArray[np.int32],
    id_count: int,
    near: float,
    thickness: NDArray[np.float32] | None = None,
) -> ViewWeights:
    """Blending weight of every Gaussian summed over the pixels of every id of one view.

    ids: (H, W) int32 in -1..id_count-1, H and W the camera's. thickness: see `visibility.mask_table`.
    Splats are blended by (float32 depth, index), so that equal depths have one order.
    """
    (rows, cols, weights, first, counts), area = _entries(gaussians, camera, ids, id_count, near, thickness)
    data, indices, indptr = _merge(rows, cols, weights, first, counts, id_count + 2, len(gaussians))
    border, n = indptr[-2], len(gaussians)
    return ViewWeights(
        csr_array((data[:border], indices[:border], indptr[:-1]), shape=(id_count + 1, n)),
        area,
        csr_array((data[border:], indices[border:], indptr[-2:] - border), shape=(1, n)),
    )


def working_memory(n: int, camera: Camera) -> int:
    """About how many bytes `view_weights` holds at once for n Gaussians and that image."""
    return 250 * n + 60 * camera.width * camera.height


def _entries(
    gaussians: Gaussians,
    camera: Camera,
    ids: NDArray[np.int32],
    id_count: int,
    near: float,
    thickness: NDArray[np.float32] | None,
) -> tuple[tuple[NDArray[Any], ...], NDArray[np.float64]]:
    """What `view_weights` adds up, tile by tile: (rows, cols, weights, first, counts), tile t's entries being
    first[t] : first[t] + counts[t]; and the area of each splat."""
    splats, keys = _project(
        gaussians.xyz,
        gaussians.scale,
        gaussians.rotation,
        gaussians.opacity,
        np.full(len(gaussians), np.inf, np.float32) if thickness is None else thickness,
        camera.world_to_camera,
        np.array([camera.fx, camera.fy, camera.cx, camera.cy]),
        camera.width,
        camera.height,
        near,
    )
    keys = np.sort(keys[keys != _CULLED])
    order = (keys & np.uint64(0xFFFFFFFF)).astype(np.int32)
    columns = -(-camera.width // TILE)
    tiles = columns * -(-camera.height // TILE)
    starts, members = _bin(splats, order, columns, tiles, numba.get_num_threads())
    masks = np.where(ids < 0, id_count, ids).astype(np.int32)
    bounds = _entry_bounds(splats, starts, members, masks, id_count, columns)
    first = np.concatenate([[0], np.cumsum(bounds)])
    rows, cols, weights, counts = _composite(
        splats, starts, members, masks, id_count, columns, first, numba.get_num_threads()
    )
    area = np.zeros(len(gaussians))
    area[order] = splats[order, _AREA]
    return (rows, cols, weights, first[:-1], counts), area


_CULLED = np.uint64(0xFFFFFFFFFFFFFFFF)
# Columns of the splat record: centre (px), conic (inverse covariance xx, xy, yy), opacity, pixel box (inclusive), the
# largest squared Mahalanobis distance that still contributes, weight in pixels if nothing were in front, exp(-xx),
# exp(-yy), exp(-xy), 1 where no corner of the box is so far out that recurrences from it would underflow, depth, and
# the depth of the nearest surface that it can belong to.
_U, _V, _XX, _XY, _YY, _SIGMA, _X0, _X1, _Y0, _Y1, _LIMIT, _AREA, _STEP_X, _STEP_Y, _STEP_XY, _GENTLE, *_ = range(19)
_DEPTH, _SURFACE, _SIZE = 16, 17, 18


@njit(cache=True, parallel=True, nogil=True, error_model="numpy")
def _project(xyz, scale, rotation, opacity, thickness, pose, intrinsics, width, height, near):  # noqa: ANN001, ANN202
    """EWA projection of every Gaussian in float64: splat records (n, _SIZE) and depth keys (n,) uint64.

    A key is the float32 depth's bits above the index: sorting keys sorts by depth, ties by index.
    """
    n = len(xyz)
    splats = np.empty((n, _SIZE))
    depth = np.empty(n, np.float32)
    keys = np.empty(n, np.uint64)
    fx, fy, cx, cy = intrinsics
    half_x, half_y = 0.5 * width / fx, 0.5 * height / fy
    x_low, x_high = -cx / fx - FRUSTUM_MARGIN * half_x, (width - cx) / fx + FRUSTUM_MARGIN * half_x
    y_low, y_high = -cy / fy - FRUSTUM_MARGIN * half_y, (height - cy) / fy + FRUSTUM_MARGIN * half_y
    for g in prange(n):
        keys[g] = _CULLED
        x, y, z = np.float64(xyz[g, 0]), np.float64(xyz[g, 1]), np.float64(xyz[g, 2])
        cz = pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z + pose[2, 3]
        sigma = np.float64(opacity[g])
        if not cz > near or not sigma > ALPHA_MIN:
            continue
        tx = (pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z + pose[0, 3]) / cz
        ty = (pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z + pose[1, 3]) / cz
        u, v = fx * tx + cx, fy * ty + cy
        jx, jy = min(max(tx, x_low), x_high), min(max(ty, y_low), y_high)
        # Most of a scene lies outside a view: turned away before its ellipse is known, by the largest it could be.
        largest = np.float64(max(scale[g, 0], scale[g, 1], scale[g, 2])) / cz
        room_x = np.sqrt(LARGEST_REACH * (fx * fx * largest * largest * (1 + jx * jx) + LOW_PASS)) + 1.0
        room_y = np.sqrt(LARGEST_REACH * (fy * fy * largest * largest * (1 + jy * jy) + LOW_PASS)) + 1.0
        if u < -room_x or u > width + room_x or v < -room_y or v > height + room_y:
            continue
        # The projected axes: columns of J R_camera R_gaussian S, a 2x3 matrix whose V V' is the covariance.
        qw, qx = np.float64(rotation[g, 0]), np.float64(rotation[g, 1])
        qy, qz = np.float64(rotation[g, 2]), np.float64(rotation[g, 3])
        axis = (1 - 2 * (qy * qy + qz * qz), 2 * (qx * qy + qw * qz), 2 * (qx * qz - qw * qy))
        vx0, vy0 = _projected_axis(axis, np.float64(scale[g, 0]), pose, fx / cz, fy / cz, jx, jy)
        axis = (2 * (qx * qy - qw * qz), 1 - 2 * (qx * qx + qz * qz), 2 * (qy * qz + qw * qx))
        vx1, vy1 = _projected_axis(axis, np.float64(scale[g, 1]), pose, fx / cz, fy / cz, jx, jy)
        axis = (2 * (qx * qz + qw * qy), 2 * (qy * qz - qw * qx), 1 - 2 * (qx * qx + qy * qy))
        vx2, vy2 = _projected_axis(axis, np.float64(scale[g, 2]), pose, fx / cz, fy / cz, jx, jy)
        sxx = vx0 * vx0 + vx1 * vx1 + vx2 * vx2
        syy = vy0 * vy0 + vy1 * vy1 + vy2 * vy2
        sxy = vx0 * vy0 + vx1 * vy1 + vx2 * vy2
        # det(V V' + c I) as a sum of positive terms (Cauchy-Binet): no cancellation for needles.
        m01, m02, m12 = vx0 * vy1 - vx1 * vy0, vx0 * vy2 - vx2 * vy0, vx1 * vy2 - vx2 * vy1
        det = m01 * m01 + m02 * m02 + m12 * m12 + LOW_PASS * (sxx + syy) + LOW_PASS * LOW_PASS
        sxx += LOW_PASS
        syy += LOW_PASS
        # The ellipse on which alpha falls to ALPHA_MIN; its box holds every pixel that can contribute.
        reach = 2.0 * np.log(sigma / ALPHA_MIN)
        rx, ry = np.sqrt(reach * sxx), np.sqrt(reach * syy)
        x0, x1 = max(np.ceil(u - rx - 0.5), 0.0), min(np.floor(u + rx - 0.5), width - 1.0)
        y0, y1 = max(np.ceil(v - ry - 0.5), 0.0), min(np.floor(v + ry - 0.5), height - 1.0)
        if not (x0 <= x1 and y0 <= y1 and det < np.inf):
            continue
        s = splats[g]
        s[_U], s[_V], s[_XX], s[_XY], s[_YY], s[_SIGMA] = u, v, syy / det, -sxy / det, sxx / det, sigma
        s[_X0], s[_X1], s[_Y0], s[_Y1], s[_LIMIT] = x0, x1, y0, y1, reach
        s[_STEP_X], s[_STEP_Y], s[_STEP_XY] = np.exp(-syy / det), np.exp(-sxx / det), np.exp(sxy / det)
        # The density at a corner is exp(-reach / (1 - |correlation|)) of the peak.
        s[_GENTLE] = 1.0 if reach < 300 * (1 - abs(sxy) / np.sqrt(sxx * syy)) else 0.0
        # The integral of alpha over that ellipse.
        s[_AREA] = 2 * np.pi * np.sqrt(det) * (sigma - ALPHA_MIN)
        s[_DEPTH], s[_SURFACE] = cz, cz - thickness[g]
        depth[g] = cz
        keys[g] = (np.uint64(depth.view(np.uint32)[g]) << np.uint64(32)) | np.uint64(g)
    return splats, keys


@njit(cache=True, error_model="numpy")
def _projected_axis(axis, length, pose, px, py, jx, jy):  # noqa: ANN001, ANN202
    """An axis of a Gaussian (unit, world) of that length in pixels of the image, linearised at (jx, jy)."""
    ex = length * (pose[0, 0] * axis[0] + pose[0, 1] * axis[1] + pose[0, 2] * axis[2])
    ey = length * (pose[1, 0] * axis[0] + pose[1, 1] * axis[1] + pose[1, 2] * axis[2])
    ez = length * (pose[2, 0] * axis[0] + pose[2, 1] * axis[1] + pose[2, 2] * axis[2])
    return px * (ex - jx * ez), py * (ey - jy * ez)


@njit(cache=True, parallel=True, nogil=True)
def _bin(splats, order, columns, tiles, bands):  # noqa: ANN001, ANN202
    """Depth-ordered members of every tile: tile t holds members[starts[t]:starts[t + 1]]."""
    tile_rows = tiles // columns
    # The tile ranges side by side: every band reads all of them, twice.
    ranges = np.empty((len(order), 4), np.int16)
    for i in prange(len(order)):
        s = splats[order[i]]
        ranges[i, 0], ranges[i, 1] = int(s[_X0]) // TILE, int(s[_X1]) // TILE + 1
        ranges[i, 2], ranges[i, 3] = int(s[_Y0]) // TILE, int(s[_Y1]) // TILE + 1
    counts = np.zeros(tiles + 1, np.int64)
    for band in prange(bands):
        low, high = band * tile_rows // bands, (band + 1) * tile_rows // bands
        for i in range(len(order)):
            for row in range(max(ranges[i, 2], low), min(ranges[i, 3], high)):
                for column in range(ranges[i, 0], ranges[i, 1]):
                    counts[row * columns + column + 1] += 1
    starts = np.cumsum(counts)
    members = np.empty(starts[-1], np.int32)
    fill = starts[:-1].copy()
    for band in prange(bands):
        low, high = band * tile_rows // bands, (band + 1) * tile_rows // bands
        for i in range(len(order)):
            for row in range(max(ranges[i, 2], low), min(ranges[i, 3], high)):
                for column in range(ranges[i, 0], ranges[i, 1]):
                    tile = row * columns + column
                    members[fill[tile]] = order[i]
                    fill[tile] += 1
    return starts, members


@njit(cache=True, inline="always")
def _clip_box(s, tile, columns):  # noqa: ANN001, ANN202
    """The pixels of splat s within a tile: x0, x1, y0, y1 with exclusive ends."""
    left, top = tile % columns * TILE, tile // columns * TILE
    return (
        max(int(s[_X0]), left),
        min(int(s[_X1]) + 1, left + TILE),
        max(int(s[_Y0]), top),
        min(int(s[_Y1]) + 1, top + TILE),
    )


@njit(cache=True, parallel=True, nogil=True)
def _entry_bounds(splats, starts, members, masks, id_count, columns):  # noqa: ANN001, ANN202
    """An upper bound of the (mask, Gaussian) entries each tile will write."""
    tiles = len(starts) - 1
    height, width = masks.shape
    bounds = np.zeros(tiles, np.int64)
    for tile in prange(tiles):
        left, top = tile % columns * TILE, tile // columns * TILE
        distinct, last = 0, -1
        for y in range(top, min(top + TILE, height)):
            for x in range(left, min(left + TILE, width)):
                # Runs of equal ids along rows: at least the number of distinct ids, without a set.
                if masks[y, x] != last:
                    distinct, last = distinct + 1, masks[y, x]
        if distinct <= 4:
            # Looking at every splat would save little memory here.
            bounds[tile] = (distinct + 1) * (starts[tile + 1] - starts[tile])
            continue
        total = 0
        for m in range(starts[tile], starts[tile + 1]):
            x0, x1, y0, y1 = _clip_box(splats[members[m]], tile, columns)
            total += min(distinct, id_count + 1, (x1 - x0) * (y1 - y0)) + 1
        bounds[tile] = total
    return bounds


@njit(cache=True, parallel=True, nogil=True, error_model="numpy")
def _composite(splats, starts, members, masks, id_count, columns, first, workers):  # noqa: ANN001, ANN202
    """Blend every tile front to back and add each splat's weights up by mask; entries of tile t start at first[t].

    Row id_count holds pixels without a mask, row id_count + 1 what shows through surfaces (counted in its mask too)."""
    tiles = len(starts) - 1
    height, width = masks.shape
    rows = np.empty(first[-1], np.int32)
    cols = np.empty(first[-1], np.int32)
    weights = np.empty(first[-1], np.float32)
    counts = np.zeros(tiles, np.int64)
    sums = np.zeros((workers, id_count + 1))
    # Each worker takes every workers-th tile (neighbouring tiles cost alike, so the shares are even) and adds up in a
    # scratch row of its own.
    for worker in prange(workers):
        total = sums[worker]
        touched = np.empty(TILE * TILE, np.int32)
        for tile in range(worker, tiles, workers):
            left, top = tile % columns * TILE, tile // columns * TILE
            transmittance = np.ones((TILE, TILE))
            surface = np.full((TILE, TILE), np.inf)
            open_pixels = (min(top + TILE, height) - top) * (min(left + TILE, width) - left)
            entry = first[tile]
            for m in range(starts[tile], starts[tile + 1]):
                if open_pixels == 0:
                    break
                g = members[m]
                s = splats[g]
                u, v, xx, xy, yy, sigma = s[_U], s[_V], s[_XX], s[_XY], s[_YY], s[_SIGMA]
                x0, x1, y0, y1 = _clip_box(s, tile, columns)
                touches, through = 0, 0.0
                # exp of a quadratic by recurrence, along rows (`density`, `ratio`) and down the box's left edge
                # (`edge`, `edge_ratio`, `first_ratio`): g(x + 1) = g(x) ratio(x), ratio(x + 1) = ratio(x) exp(-xx).
                gentle = s[_GENTLE] > 0.0
                dx, dy = x0 + 0.5 - u, y0 + 0.5 - v
                edge = sigma * np.exp(-0.5 * (xx * dx * dx + yy * dy * dy) - xy * dx * dy) if gentle else 0.0
                edge_ratio = np.exp(-yy * (dy + 0.5) - xy * dx) if gentle else 0.0
                first_ratio = np.exp(-xx * (dx + 0.5) - xy * dy) if gentle else 0.0
                for y in range(y0, y1):
                    if gentle:
                        begin, end, density, ratio = x0, x1, edge, first_ratio
                        edge *= edge_ratio
                        edge_ratio *= s[_STEP_Y]
                        first_ratio *= s[_STEP_XY]
                    else:
                        # A corner of the box would underflow: start each row on its chord of the ellipse instead.
                        dy = y + 0.5 - v
                        chord = xy * dy * xy * dy - xx * (yy * dy * dy - s[_LIMIT])
                        if chord < 0.0:
                            continue
                        half, middle = np.sqrt(chord) / xx + 1e-6, u - xy * dy / xx - 0.5
                        begin = max(x0, int(np.ceil(max(middle - half, -1.0))))
                        end = min(x1, int(min(middle + half, 1e9)) + 1)
                        if begin >= end:
                            continue
                        dx = begin + 0.5 - u
                        density = sigma * np.exp(-0.5 * (xx * dx * dx + yy * dy * dy) - xy * dx * dy)
                        ratio = np.exp(-xx * (dx + 0.5) - xy * dy)
                    for x in range(begin, end):
                        alpha = min(ALPHA_MAX, density)
                        density *= ratio
                        ratio *= s[_STEP_X]
                        if alpha < ALPHA_MIN:
                            continue
                        t = transmittance[y - top, x - left]
                        if t == 0.0:
                            continue
                        rest = t * (1.0 - alpha)
                        if rest < TRANSMITTANCE_MIN:
                            transmittance[y - top, x - left] = 0.0  # marks a finished pixel
                            open_pixels -= 1
                            continue
                        if t >= 0.5 and rest < 0.5:
                            surface[y - top, x - left] = s[_DEPTH]
                        transmittance[y - top, x - left] = rest
                        if s[_SURFACE] > surface[y - top, x - left]:
                            through += t * alpha
                        mask = masks[y, x]
                        if total[mask] == 0.0:
                            touched[touches] = mask
                            touches += 1
                        total[mask] += t * alpha
                for k in range(touches):
                    mask = touched[k]
                    rows[entry], cols[entry], weights[entry] = mask, g, total[mask]
                    total[mask] = 0.0
                    entry += 1
                if through > 0.0:
                    rows[entry], cols[entry], weights[entry] = id_count + 1, g, through
                    entry += 1
            counts[tile] = entry - first[tile]
    return rows, cols, weights, counts


@njit(cache=True, nogil=True)
def _merge(rows, cols, weights, first, counts, row_count, n):  # noqa: ANN001, ANN202
    """Tiles' entries as CSR (data, indices, indptr), one entry per (mask, Gaussian)."""
    start = np.zeros(row_count + 1, np.int64)
    for tile in range(len(first)):
        for e in range(first[tile], first[tile] + counts[tile]):
            start[rows[e] + 1] += 1
    start = np.cumsum(start)
    place = start[:-1].copy()
    sorted_cols = np.empty(start[-1], np.int32)
    sorted_weights = np.empty(start[-1], np.float32)
    for tile in range(len(first)):
        for e in range(first[tile], first[tile] + counts[tile]):
            p = place[rows[e]]
            sorted_cols[p], sorted_weights[p] = cols[e], weights[e]
            place[rows[e]] = p + 1
    # A Gaussian over a tile border has an entry from each tile: fold them together, row by row.
    where = np.full(n, -1, np.int64)
    indptr = np.zeros(row_count + 1, np.int32)
    out = 0
    for row in range(row_count):
        begin = out
        for p in range(start[row], start[row + 1]):
            g = sorted_cols[p]
            if where[g] >= begin:
                sorted_weights[where[g]] += sorted_weights[p]
            else:
                where[g] = out
                sorted_cols[out], sorted_weights[out] = g, sorted_weights[p]
                out += 1
        indptr[row + 1] = out
    return sorted_weights[:out].copy(), sorted_cols[:out].copy(), indptr
