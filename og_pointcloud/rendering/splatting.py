"""Frozen geometry + camera -> how much of each pixel each Gaussian paints, exactly as 3DGS blends.

Rendering a frozen scene is linear: a pixel's value is ``sum_g W[p, g] value_g`` with the alpha-blending weights
``W[p, g] = T alpha`` of 3D Gaussian Splatting (Kerbl et al. 2023, Eq. 3; paper appendix "splatting"). This file
computes those weights, tile by tile. It knows nothing of colors, features or masks: a view of any value is a product
with them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from og_pointcloud.errors import SceneError
from og_pointcloud.kernels import get_num_threads, njit, prange
from og_pointcloud.rendering.lanes import WIDTH, any_of, broadcast, exp2, iota, load, minimum, select, store
from og_pointcloud.scene import Camera, Points

TILE = WIDTH
"""Pixels along a tile's side: 16 as in 3DGS, so that a row of a tile is one vector."""
GAUSSIANS_PER_BOX = 64
"""Consecutive Gaussians that share a bounding box and are culled together."""
BATCH = 128
"""Splats of a tile that are fetched together."""
ZERO, ONE = np.float32(0), np.float32(1)
LOW_PASS = 0.3
"""Added to the projected covariance, px^2: a splat is never smaller than about a pixel (3DGS)."""
ALPHA_MIN = 1.0 / 255.0
"""Contributions below this alpha are dropped (3DGS)."""
LOG2_ALPHA_MIN, LOG2_E = np.log2(ALPHA_MIN), np.log2(np.e)
ALPHA_MAX = 0.99
"""Alpha is clamped to this (3DGS)."""
TRANSMITTANCE_MIN = 1e-4
"""A pixel stops before the splat that would bring its transmittance below this (3DGS)."""
LEAST_LOG_ALPHA, LEAST_LIGHT = np.float32(LOG2_ALPHA_MIN), np.float32(0.99999 * TRANSMITTANCE_MIN)
"""Of a row of pixels. The light is lower by more than rounding: four splats of opacity 0.9 leave just 3DGS's limit."""
FRUSTUM_MARGIN = 0.3
"""Centers beyond the image by more than this share of the half field of view are clamped when the projection is
linearised (3DGS's 1.3 tan(fov/2), written for any principal point)."""
NEAR_SHARE = 0.02
"""The near plane as a share of the median depth of the scene; 3DGS fixes 0.2 units, which no unitless scene can."""


Binned = tuple[NDArray[Any], NDArray[np.int64], NDArray[np.int32], int]
"""(splats, starts, members, columns of tiles); members[starts[t] : starts[t + 1]] are rows of splats, nearest first."""


@dataclass(frozen=True)
class Gaussians:
    """Geometry ready for splatting. xyz (n, 3), scale (n, 3) linear, rotation (n, 4) unit wxyz, opacity (n,)."""

    xyz: NDArray[np.float32]
    scale: NDArray[np.float32]
    rotation: NDArray[np.float32]
    opacity: NDArray[np.float32]

    @classmethod
    def from_points(cls, points: Points) -> Gaussians:
        """The Gaussians of a 3DGS file; SceneError for a plain cloud, whose splats `geometry` chooses."""
        if points.scale is None or points.rotation is None or points.opacity is None:
            raise SceneError("the cloud has no scale, rotation and opacity; og.fit chooses them for a plain cloud")
        return cls(points.xyz, points.scale, points.rotation, points.opacity)

    def __len__(self) -> int:
        return len(self.xyz)

    @cached_property
    def boxes(self) -> NDArray[np.float32]:
        """(boxes, 7) of GAUSSIANS_PER_BOX each: least x, y, z and greatest x, y, z of the centers, and longest axis."""
        return _boxes(self.xyz, self.scale)

    def take(self, rows: NDArray[np.integer] | None) -> Gaussians:
        """The Gaussians of these rows, in their order; None: all."""
        if rows is None:
            return self
        return Gaussians(self.xyz[rows], self.scale[rows], self.rotation[rows], self.opacity[rows])


def render(
    gaussians: Gaussians, values: NDArray[np.float32], camera: Camera, near: float
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Values (n, c) of the Gaussians as one view shows them: (H, W, c) float32, and (H, W) float32, how much of each
    pixel is covered. Uncovered pixels are 0: this is ``W @ values`` without storing ``W``."""
    row = np.arange(camera.width * camera.height, dtype=np.int32).reshape(camera.height, camera.width)
    with_coverage = np.concatenate([values, np.ones((len(values), 1), np.float32)], axis=1)
    image = _paint(*_entries(gaussians, camera, row, near), with_coverage, row.size).reshape(*row.shape, -1)
    return image[..., :-1], image[..., -1]


@njit(cache=True, parallel=True, nogil=True)
def _paint(rows, cols, weights, first, counts, values, pixels):  # noqa: ANN001, ANN202
    """Add up the values of every tile's entries by pixel; no pixel belongs to two tiles."""
    image = np.zeros((pixels, values.shape[1]), np.float32)
    for tile in prange(len(counts)):
        for e in range(first[tile], first[tile] + counts[tile]):
            for c in range(values.shape[1]):
                image[rows[e], c] += weights[e] * values[cols[e], c]
    return image


def view_weights(
    gaussians: Gaussians, camera: Camera, near: float, wanted: NDArray[np.bool_] | None = None
) -> csr_array:
    """W of one view: (pixels, n) sparse float32, row by row of the image, a pixel's nearest Gaussian first.

    wanted: (H, W), H and W the camera's: the pixels that have a row; None: all. Splats are blended by (float32 depth,
    index), so that equal depths have one order.
    """
    wanted = np.ones((camera.height, camera.width), np.bool_) if wanted is None else wanted
    number = np.cumsum(wanted, dtype=np.int32)
    row = np.where(wanted, number.reshape(wanted.shape) - 1, np.int32(-1))
    entries = _by_row(*_entries(gaussians, camera, row, near), number[-1])
    return csr_array(entries, shape=(number[-1], len(gaussians)))


def working_memory(n: int, camera: Camera) -> int:
    """About how many bytes a view of n Gaussians takes while it is drawn or traced (sightings.py)."""
    return 250 * n + 60 * camera.width * camera.height


def _entries(gaussians: Gaussians, camera: Camera, row: NDArray[np.int32], near: float) -> tuple[NDArray[Any], ...]:
    """The entries of W, tile by tile: (rows, cols, weights, first, counts), where tile t has those from first[t] to
    first[t] + counts[t]. row: (H, W) of each pixel, -1 for those that are left out."""
    binned = binned_splats(gaussians, camera, near)
    first = np.concatenate([[0], np.cumsum(_entry_bounds(binned, row))])
    rows, cols, weights, counts = _composite(binned, row, first, get_num_threads())
    return rows, cols, weights, first[:-1], counts


def binned_splats(
    gaussians: Gaussians, camera: Camera, near: float, thickness: NDArray[np.float32] | None = None
) -> Binned:
    """The splats of an image by tile. thickness: (n,) how far in front of each its surface begins; None: not needed."""
    thickness = np.zeros(len(gaussians), np.float32) if thickness is None else thickness
    shapes = gaussians.xyz, gaussians.scale, gaussians.rotation, gaussians.opacity, thickness
    intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
    seen_by = camera.world_to_camera, intrinsics, (camera.width, camera.height), float(near)
    rows = np.flatnonzero(_in_frustum(gaussians.xyz, gaussians.scale, gaussians.boxes, _frustum_planes(seen_by)))
    splats = _records(len(rows))
    order = ascending(_project(rows, shapes, seen_by, splats))
    # In order of depth in memory too: a tile's splats are then read from front to back.
    splats = _in_order(splats, order, _records(len(order)))
    columns = -(-camera.width // TILE)
    tiles = columns * -(-camera.height // TILE)
    starts, members = _bin(splats, columns, tiles, get_num_threads())
    return splats, starts, members, columns


def _records(count: int) -> NDArray[Any]:
    """Splats with undefined values, each within one cache line."""
    room = np.empty((count + 1) * SPLAT.itemsize, np.uint8)
    ahead = -room.ctypes.data % SPLAT.itemsize
    return room[ahead : ahead + count * SPLAT.itemsize].view(SPLAT)


CULLED = np.uint32(0xFFFFFFFF)
"""The key of a splat that is not drawn: above those of all depths."""
SPLAT = np.dtype(
    [
        ("u", np.float64),  # center, px
        ("v", np.float64),
        ("shear", np.float64),  # px that a row's middle moves to the left per row down
        ("across", np.float32),  # log2 of the density along a row is -(across * distance to the row's middle)^2
        ("down", np.float32),  # log2 of the density at the rows' middles is -down * (distance to the center's row)^2
        ("peak", np.float32),  # log2 of the opacity
        ("depth", np.float32),
        ("surface", np.float32),  # depth of the nearest surface that it can belong to
        ("x0", np.int32),  # the pixels that it may show in, inclusive
        ("x1", np.int32),
        ("y0", np.int32),
        ("y1", np.int32),
        ("gaussian", np.int32),
    ],
    align=True,
)
"""A projected Gaussian, in one cache line. Split into rows, a quadratic form has no differences of large numbers:
float32 suffices for any needle."""


@njit(cache=True, nogil=True, error_model="numpy")
def depth_and_slopes(x, y, z, pose):  # noqa: ANN001, ANN201
    """Depth of a point, and the slopes x / z and y / z of the ray to it."""
    depth = pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z + pose[2, 3]
    across = (pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z + pose[0, 3]) / depth
    return depth, across, (pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z + pose[1, 3]) / depth


@njit(cache=True, nogil=True, error_model="numpy")
def clamped_slopes(tx, ty, intrinsics, size):  # noqa: ANN001, ANN201
    """The slopes at which the projection is linearised: those of the ray, at most FRUSTUM_MARGIN outside the image."""
    fx, fy, cx, cy = intrinsics
    margin_x, margin_y = FRUSTUM_MARGIN * 0.5 * size[0] / fx, FRUSTUM_MARGIN * 0.5 * size[1] / fy
    return (
        min(max(tx, -cx / fx - margin_x), (size[0] - cx) / fx + margin_x),
        min(max(ty, -cy / fy - margin_y), (size[1] - cy) / fy + margin_y),
    )


@njit(cache=True, nogil=True)
def _boxes(xyz, scale):  # noqa: ANN001, ANN202
    boxes = np.empty((-(-len(xyz) // GAUSSIANS_PER_BOX), 7), np.float32)
    for run in range(len(boxes)):
        boxes[run, :3], boxes[run, 3:6], boxes[run, 6] = np.inf, -np.inf, 0
        for g in range(run * GAUSSIANS_PER_BOX, min((run + 1) * GAUSSIANS_PER_BOX, len(xyz))):
            for axis in range(3):
                boxes[run, axis] = min(boxes[run, axis], xyz[g, axis])
                boxes[run, 3 + axis] = max(boxes[run, 3 + axis], xyz[g, axis])
                boxes[run, 6] = max(boxes[run, 6], scale[g, axis])
    return boxes


@njit(cache=True, nogil=True, error_model="numpy")
def _frustum_planes(seen_by):  # noqa: ANN001, ANN202
    """(5, 5): the near plane and the four borders of an image. Where ``a x + b y + c z + d + e * longest axis`` of a
    row (a, b, c, d, e) is not above 0, a circle that encloses the splat's ellipse lies beyond it."""
    pose, (fx, fy, cx, cy), size, near = seen_by
    low_x, low_y = clamped_slopes(-np.inf, -np.inf, (fx, fy, cx, cy), size)
    high_x, high_y = clamped_slopes(np.inf, np.inf, (fx, fy, cx, cy), size)
    # Standard deviations from the center to where an opaque splat's alpha is the least; a tenth more for poses and
    # quaternions that are not quite of length one. Times depth, the radius is own * longest axis + blur * depth.
    reach = 1.1 * np.sqrt(-2 * np.log(ALPHA_MIN))
    own_x = reach * fx * np.sqrt(1 + max(abs(low_x), abs(high_x)) ** 2)
    own_y = reach * fy * np.sqrt(1 + max(abs(low_y), abs(high_y)) ** 2)
    blur = reach * np.sqrt(LOW_PASS) + 1
    borders = np.zeros((5, 5))
    borders[0, :4] = pose[2]
    borders[0, 3] -= 0.999999 * near  # a margin for rounding: `_project` decides exactly
    borders[1, :4], borders[1, 4] = fx * pose[0] + (cx + blur) * pose[2], own_x
    borders[2, :4], borders[2, 4] = -fx * pose[0] + (size[0] - cx + blur) * pose[2], own_x
    borders[3, :4], borders[3, 4] = fy * pose[1] + (cy + blur) * pose[2], own_y
    borders[4, :4], borders[4, 4] = -fy * pose[1] + (size[1] - cy + blur) * pose[2], own_y
    return borders


@njit(cache=True, parallel=True, nogil=True, error_model="numpy")
def _in_frustum(xyz, scale, boxes, borders):  # noqa: ANN001, ANN202
    """(n,) bool: False for splats beyond one of an image's borders. Most of a cloud then costs one product per box and
    border, and no projection."""
    may = np.zeros(len(xyz), np.bool_)
    for run in prange(len(boxes)):
        within = True
        for k in range(len(borders)):
            a, b, c = borders[k, 0], borders[k, 1], borders[k, 2]
            innermost = max(a * boxes[run, 0], a * boxes[run, 3]) + max(b * boxes[run, 1], b * boxes[run, 4])
            innermost += max(c * boxes[run, 2], c * boxes[run, 5]) + borders[k, 3] + borders[k, 4] * boxes[run, 6]
            within &= innermost > 0
        for g in range(run * GAUSSIANS_PER_BOX, min((run + 1) * GAUSSIANS_PER_BOX, len(xyz)) if within else 0):
            longest = max(scale[g, 0], scale[g, 1], scale[g, 2])
            within = True
            for k in range(len(borders)):
                inside = borders[k, 0] * xyz[g, 0] + borders[k, 1] * xyz[g, 1] + borders[k, 2] * xyz[g, 2]
                within &= inside + borders[k, 3] + borders[k, 4] * longest > 0
            may[g] = within
    return may


@njit(cache=True, parallel=True, nogil=True, error_model="numpy")
def _project(rows, shapes, seen_by, splats):  # noqa: ANN001, ANN202
    """EWA projection in float64 of the Gaussians ``rows``, ascending: writes their splats (rows,); returns keys (rows,)
    uint32: the bits of the float32 depth, which sort as depths do since these are positive; CULLED for those without a
    pixel."""
    keys = np.full(len(rows), CULLED)
    (xyz, scale, rotation, opacity, thickness), (pose, intrinsics, size, near) = shapes, seen_by
    fx, fy, cx, cy = intrinsics
    for i in prange(len(rows)):
        g = rows[i]
        depth, tx, ty = depth_and_slopes(np.float64(xyz[g, 0]), np.float64(xyz[g, 1]), np.float64(xyz[g, 2]), pose)
        if not depth > near or not opacity[g] > ALPHA_MIN:
            continue
        jx, jy = clamped_slopes(tx, ty, intrinsics, size)
        sxx, sxy, syy, det = _covariance(scale, rotation, g, pose, fx / depth, fy / depth, jx, jy)
        u, v = fx * tx + cx, fy * ty + cy
        # The ellipse on which alpha falls to its least; its box holds every pixel that can contribute.
        peak = np.log2(np.float64(opacity[g]))
        reach = 2.0 / LOG2_E * (peak - LOG2_ALPHA_MIN)
        rx, ry = np.sqrt(reach * sxx), np.sqrt(reach * syy)
        x0, x1 = max(np.ceil(u - rx - 0.5), 0.0), min(np.floor(u + rx - 0.5), size[0] - 1.0)
        y0, y1 = max(np.ceil(v - ry - 0.5), 0.0), min(np.floor(v + ry - 0.5), size[1] - 1.0)
        if not (x0 <= x1 and y0 <= y1 and det < np.inf):
            continue
        s = splats[i]
        s.u, s.v, s.shear = u, v, -sxy / syy
        s.across, s.down = np.sqrt(0.5 * LOG2_E * syy / det), 0.5 * LOG2_E / syy
        s.peak, s.depth, s.surface = peak, depth, depth - thickness[g]
        s.x0, s.x1, s.y0, s.y1, s.gaussian = int(x0), int(x1), int(y0), int(y1), g
        keys[i] = np.float32(depth).view(np.uint32)
    return keys


@njit(cache=True, nogil=True)
def ascending(keys):  # noqa: ANN001, ANN201
    """Rows of uint32 keys in ascending order, stable, without CULLED: a radix sort by 11 bits at a time, in a quarter
    of the time of a sort by comparison."""
    order = np.flatnonzero(keys != CULLED).astype(np.int32)
    for shift in (0, 11, 22):
        place = np.zeros(2049, np.int64)
        for i in order:
            place[(keys[i] >> shift & 2047) + 1] += 1
        place, before = np.cumsum(place), order
        order = np.empty_like(before)
        for i in before:
            digit = keys[i] >> shift & 2047
            order[place[digit]] = i
            place[digit] += 1
    return order


@njit(cache=True, parallel=True, nogil=True)
def _in_order(splats, order, ordered):  # noqa: ANN001, ANN202
    for i in prange(len(order)):
        ordered[i] = splats[order[i]]
    return ordered


@njit(cache=True, nogil=True, error_model="numpy")
def _covariance(scale, rotation, g, pose, px, py, jx, jy):  # noqa: ANN001, ANN202
    """(xx, xy, yy, determinant) of a splat's covariance, px^2, linearised at slopes (jx, jy).

    The projected axes are the columns of J R_camera R_gaussian S, a 2x3 matrix V; the covariance is V V' + c I.
    """
    if scale[g, 0] == scale[g, 1] == scale[g, 2]:  # round, as those of a plain cloud are: no rotation changes it
        lx, ly = px * np.float64(scale[g, 0]), py * np.float64(scale[g, 0])
        sxx, sxy, syy = lx * lx * (1 + jx * jx), lx * ly * jx * jy, ly * ly * (1 + jy * jy)
        det = lx * lx * ly * ly * (1 + jx * jx + jy * jy) + LOW_PASS * (sxx + syy) + LOW_PASS * LOW_PASS
        return sxx + LOW_PASS, sxy, syy + LOW_PASS, det
    qw, qx = np.float64(rotation[g, 0]), np.float64(rotation[g, 1])
    qy, qz = np.float64(rotation[g, 2]), np.float64(rotation[g, 3])
    axis = (1 - 2 * (qy * qy + qz * qz), 2 * (qx * qy + qw * qz), 2 * (qx * qz - qw * qy))
    vx0, vy0 = _projected_axis(axis, np.float64(scale[g, 0]), pose, px, py, jx, jy)
    axis = (2 * (qx * qy - qw * qz), 1 - 2 * (qx * qx + qz * qz), 2 * (qy * qz + qw * qx))
    vx1, vy1 = _projected_axis(axis, np.float64(scale[g, 1]), pose, px, py, jx, jy)
    axis = (2 * (qx * qz + qw * qy), 2 * (qy * qz - qw * qx), 1 - 2 * (qx * qx + qy * qy))
    vx2, vy2 = _projected_axis(axis, np.float64(scale[g, 2]), pose, px, py, jx, jy)
    sxx = vx0 * vx0 + vx1 * vx1 + vx2 * vx2
    syy = vy0 * vy0 + vy1 * vy1 + vy2 * vy2
    sxy = vx0 * vy0 + vx1 * vy1 + vx2 * vy2
    # det(V V' + c I) as a sum of positive terms (Cauchy-Binet): no cancellation for needles.
    m01, m02, m12 = vx0 * vy1 - vx1 * vy0, vx0 * vy2 - vx2 * vy0, vx1 * vy2 - vx2 * vy1
    det = m01 * m01 + m02 * m02 + m12 * m12 + LOW_PASS * (sxx + syy) + LOW_PASS * LOW_PASS
    return sxx + LOW_PASS, sxy, syy + LOW_PASS, det


@njit(cache=True, error_model="numpy")
def _projected_axis(axis, length, pose, px, py, jx, jy):  # noqa: ANN001, ANN202
    """A Gaussian's axis (unit, world) times its length, in pixels of the image, linearised at (jx, jy)."""
    ex = length * (pose[0, 0] * axis[0] + pose[0, 1] * axis[1] + pose[0, 2] * axis[2])
    ey = length * (pose[1, 0] * axis[0] + pose[1, 1] * axis[1] + pose[1, 2] * axis[2])
    ez = length * (pose[2, 0] * axis[0] + pose[2, 1] * axis[1] + pose[2, 2] * axis[2])
    return px * (ex - jx * ez), py * (ey - jy * ez)


@njit(cache=True, parallel=True, nogil=True, error_model="numpy")
def _bin(splats, columns, tiles, bands):  # noqa: ANN001, ANN202
    """Members of every tile, of splats in order of depth: tile t holds members[starts[t]:starts[t + 1]]."""
    tile_rows = tiles // columns
    # The tile ranges side by side: every band reads all of them, twice.
    ranges = np.empty((len(splats), 4), np.int32)
    for i in prange(len(splats)):
        s = splats[i]
        ranges[i, 0], ranges[i, 1] = s.x0 // TILE, s.x1 // TILE + 1
        ranges[i, 2], ranges[i, 3] = s.y0 // TILE, s.y1 // TILE + 1
    # First pass: count the splats of each tile. Each thread has its own band of tile rows, so none writes to another's.
    counts = np.zeros(tiles + 1, np.int64)
    for band in prange(bands):
        low, high = band * tile_rows // bands, (band + 1) * tile_rows // bands
        for i in range(len(splats)):
            for row in range(max(ranges[i, 2], low), min(ranges[i, 3], high)):
                begin, end = _tiles_of_row(splats, i, row, ranges[i, 0], ranges[i, 1])
                for column in range(begin, end):
                    counts[row * columns + column + 1] += 1
    # Second pass: the splats themselves, in order of depth as they come.
    starts = np.cumsum(counts)
    members = np.empty(starts[-1], np.int32)
    fill = starts[:-1].copy()
    for band in prange(bands):
        low, high = band * tile_rows // bands, (band + 1) * tile_rows // bands
        for i in range(len(splats)):
            for row in range(max(ranges[i, 2], low), min(ranges[i, 3], high)):
                begin, end = _tiles_of_row(splats, i, row, ranges[i, 0], ranges[i, 1])
                for column in range(begin, end):
                    tile = row * columns + column
                    members[fill[tile]] = i
                    fill[tile] += 1
    return starts, members


@njit(cache=True, nogil=True, error_model="numpy")
def _tiles_of_row(splats, place, row, begin, end):  # noqa: ANN001, ANN202
    """The columns of tiles, of those that its box touches, that a splat's ellipse touches in a row of tiles."""
    if end - begin <= 2:  # the box will do
        return begin, end
    s = splats[place]
    # Along dy, the ellipse's right end lies at u - shear dy + sqrt(room - down dy^2) / across: farthest out at `far`,
    # within the row of tiles where it comes nearest to that; its left end is the mirror image.
    room, across, down = np.float64(s.peak) - LOG2_ALPHA_MIN, np.float64(s.across), np.float64(s.down)
    slant = s.shear * across
    far = -slant * np.sqrt(room / down / (down + slant * slant))
    low = max(row * TILE + 0.5 - s.v, -np.sqrt(room / down))
    high = min(row * TILE + TILE - 0.5 - s.v, np.sqrt(room / down))
    dy = min(max(far, low), high)
    right = s.u - s.shear * dy + np.sqrt(max(room - down * dy * dy, 0.0)) / across
    dy = min(max(-far, low), high)
    left = s.u - s.shear * dy - np.sqrt(max(room - down * dy * dy, 0.0)) / across
    if not (left > -1e9 and right < 1e9):  # also where they overflowed
        return begin, end
    # A hundredth of a pixel for what rounding may do; pixel centers lie at halves.
    return max(begin, int(left - 0.51) // TILE), min(end, int(max(right - 0.49, -1.0)) // TILE + 1)


@njit(cache=True, nogil=True)
def _clip_box(s, left, top):  # noqa: ANN001, ANN202
    """The pixels of splat s within a tile: x0, x1, y0, y1 counted from the tile's corner, with exclusive ends."""
    return max(s.x0 - left, 0), min(s.x1 + 1 - left, TILE), max(s.y0 - top, 0), min(s.y1 + 1 - top, TILE)


@njit(cache=True, parallel=True, nogil=True)
def _entry_bounds(binned, row):  # noqa: ANN001, ANN202
    """An upper bound of the entries that each tile will write."""
    splats, starts, members, columns = binned
    bounds = np.zeros(len(starts) - 1, np.int64)
    for tile in prange(len(bounds)):
        left, top = tile % columns * TILE, tile // columns * TILE
        pixels = np.count_nonzero(row[top : top + TILE, left : left + TILE] >= 0)
        for m in range(starts[tile], starts[tile + 1] if pixels else starts[tile]):
            x0, x1, y0, y1 = _clip_box(splats[members[m]], left, top)
            bounds[tile] += min(pixels, (x1 - x0) * (y1 - y0))
    return bounds


@njit(cache=True, parallel=True, nogil=True, error_model="numpy")
def _composite(binned, row, first, workers):  # noqa: ANN001, ANN202
    """Blend every tile front to back; entries of tile t start at first[t]."""
    splats, starts, members, columns = binned
    tiles = len(starts) - 1
    rows = np.empty(first[-1], np.int32)
    cols = np.empty(first[-1], np.int32)
    weights = np.empty(first[-1], np.float32)
    counts = np.zeros(tiles, np.int64)
    # Each worker takes every workers-th tile: neighboring tiles cost alike, so the shares are even.
    for worker in prange(workers):
        light, shown, batch = tile_buffer(), tile_buffer(), np.empty(BATCH, SPLAT)
        for tile in range(worker, tiles, workers):
            left, top = tile % columns * TILE, tile // columns * TILE
            pixels = row[top : top + TILE, left : left + TILE]
            _begin_tile(pixels, light)
            entry = first[tile]
            for begin in range(starts[tile], starts[tile + 1], BATCH):
                if not has_light(light, LEAST_LIGHT):
                    break
                count = min(BATCH, starts[tile + 1] - begin)
                for k in range(count):  # scattered in memory: fetched together, they do not wait for each other
                    batch[k] = splats[members[begin + k]]
                for k in range(count):
                    _blend(batch[k], left, top, light, shown)
                    x0, x1, y0, y1 = _clip_box(batch[k], left, top)
                    for y in range(y0, y1):
                        for x in range(x0, x1):
                            if shown[y * TILE + x] > 0:
                                rows[entry], cols[entry] = pixels[y, x], batch[k].gaussian
                                weights[entry] = shown[y * TILE + x]
                                entry += 1
            counts[tile] = entry - first[tile]
    return rows, cols, weights, counts


@njit(cache=True, nogil=True)
def tile_buffer():  # noqa: ANN201
    """(TILE * TILE,) float32, a number per pixel of a tile, aligned to cache lines."""
    room = np.empty(TILE * TILE + 16, np.float32)
    ahead = (64 - room.ctypes.data % 64) % 64 // 4
    return room[ahead : ahead + TILE * TILE]


@njit(cache=True, nogil=True)
def _begin_tile(pixels, light):  # noqa: ANN001, ANN202
    """Set light to 1 in pixels that have a row, and to 0 in others and outside the image."""
    light[:] = np.float32(0)
    for y in range(pixels.shape[0]):
        for x in range(pixels.shape[1]):
            if pixels[y, x] >= 0:
                light[y * TILE + x] = np.float32(1)


@njit(cache=True, nogil=True, error_model="numpy")
def _alpha_of_row(s, left, row):  # noqa: ANN001, ANN202
    """Alpha of a splat in a tile's row of pixels, clamped at both ends as in 3DGS; 0 where it does not reach."""
    least = broadcast(LEAST_LOG_ALPHA)
    # log2 of alpha along the row: a parabola about the row's middle, which lies a shear off the center.
    dy = row + 0.5 - s.v
    distance = (iota() - broadcast(np.float32(s.u - s.shear * dy - left - 0.5))) * broadcast(s.across)
    log_alpha = broadcast(np.float32(s.peak - s.down * dy * dy)) - distance * distance
    covers = log_alpha >= least
    alpha = minimum(exp2(select(covers, log_alpha, least)), broadcast(np.float32(ALPHA_MAX)))
    return select(covers, alpha, broadcast(ZERO))


@njit(cache=True, nogil=True, error_model="numpy")
def _blend(s, left, top, light, shown):  # noqa: ANN001, ANN202
    """Draw a splat into a tile, a row of pixels at a time. light: transmittance of each pixel, 0 where it is finished.
    shown: set to the splat's weights in the rows of its box."""
    none, full = broadcast(ZERO), broadcast(ONE)
    for y in range(max(s.y0 - top, 0), min(s.y1 + 1 - top, TILE)):
        alpha = _alpha_of_row(s, left, top + y)
        # Weight = transmittance before the splat times alpha, except in pixels that this splat would finish.
        before = load(light, y * TILE)
        after = before * (full - alpha)
        goes_on = after >= broadcast(LEAST_LIGHT)  # also where it is not covered and not finished
        store(shown, y * TILE, select(goes_on, before * alpha, none))
        store(light, y * TILE, select(goes_on, after, none))


@njit(cache=True, nogil=True, error_model="numpy")
def attenuate(s, left, top, light):  # noqa: ANN001, ANN201
    """Take from each pixel's light what a splat absorbs: `_blend` without the weights."""
    full = broadcast(ONE)
    for y in range(max(s.y0 - top, 0), min(s.y1 + 1 - top, TILE)):
        store(light, y * TILE, load(light, y * TILE) * (full - _alpha_of_row(s, left, top + y)))


@njit(cache=True, nogil=True)
def has_light(light, least):  # noqa: ANN001, ANN201
    """Whether any pixel of a tile still has at least this much light."""
    brightest = broadcast(ZERO)
    for y in range(TILE):
        row = load(light, y * TILE)
        brightest = select(row > brightest, row, brightest)
    return any_of(brightest >= broadcast(least))


@njit(cache=True, nogil=True)
def _by_row(rows, cols, weights, first, counts, row_count):  # noqa: ANN001, ANN202
    """Tiles' entries as CSR (data, indices, indptr), by a counting sort: a pixel's entries stay in their order."""
    start = np.zeros(row_count + 1, np.int32)
    for tile in range(len(first)):
        for e in range(first[tile], first[tile] + counts[tile]):
            start[rows[e] + 1] += 1
    start = np.cumsum(start).astype(np.int32)
    place = start[:-1].copy()
    sorted_cols, sorted_weights = np.empty(start[-1], np.int32), np.empty(start[-1], np.float32)
    for tile in range(len(first)):
        for e in range(first[tile], first[tile] + counts[tile]):
            p = place[rows[e]]
            sorted_cols[p], sorted_weights[p] = cols[e], weights[e]
            place[rows[e]] = p + 1
    return sorted_weights, sorted_cols, start
