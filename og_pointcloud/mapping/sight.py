"""What one view says of a point: it is still there, it is hidden, or the view sees through its position.

A view measures surfaces by its depth image or, where it has none, by the cloud of its visit, drawn as small discs in
the plane of the surface. A point is

    AGREES    if a surface is measured where it lies
    HIDDEN    if a surface is measured in front of it
    THROUGH   if every surface measured around its pixel lies behind it
    NOTHING   if nothing is measured there, or only surfaces seen at too flat an angle to tell

Distances are perpendicular to the surface. Along a slanted ray, an object 3 cm high on a table can lie 10 cm in front
of the table, but so can the near part of the table itself; only the perpendicular distance tells the two apart.
THROUGH alone is evidence of absence: a point that no view looks at stays.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.formats.capture import depth_files, read_poses
from og_pointcloud.formats.images import require_cv2
from og_pointcloud.formats.poses import in_local_frame
from og_pointcloud.kernels import njit, prange
from og_pointcloud.mapping.voxels import in_camera, turned
from og_pointcloud.rendering.geometry import Neighborhood, depths
from og_pointcloud.scene import Camera

NOTHING, AGREES, HIDDEN, THROUGH = 0, 1, 2, 3
"""States of a point."""

PLANE_POINTS = 12
"""Nearest points that a surface's plane is fitted to."""
NEARER_HALF_SHARE = 0.5
"""The plane is fitted to the nearer half alone if its residual is below this share of that of all points: the farther
half then lies on something else."""
DISC_RADIUS_SPACINGS = 2.0
"""Disc radius, in spacings: on randomly strewn points, one place in three hundred is then left uncovered."""
MAX_SHIFT_DEVIATIONS = 2.5
"""A point is moved by at most this many standard deviations of the noise."""
PLANE_ERROR = 1.5
"""Error of a plane fitted to k points, in units of the error of their mean, noise / sqrt(k)."""
DISC_RADIUS_PX = 2.5
"""Radius of a typical disc in drawn images, pixels: a finer image adds no information."""
MAX_DISC_RADIUS_PX = 24
"""Largest radius that a disc is drawn with, pixels, even right in front of the camera."""
MIN_COSINE = 0.15
"""Below this cosine between ray and normal (81 degrees), a surface says nothing about points far from it."""
PLANES_PER_BATCH = 1 << 16
"""Points whose planes are fitted in one batch: 30 MB."""
NEAR_SHARE = 0.02
"""Near plane, as a share of a view's median depth."""


@dataclass(frozen=True)
class MeasuredView:
    """Surfaces that one view measures. camera: of this image, with the pose from the frame of the points to be tested.
    depth: (h, w) float32, along the optical axis, 0 where nothing is measured. normal: (h, w, 3) float32 unit vectors
    in the camera's frame, towards it. noise: standard deviation of the surface, perpendicular to it."""

    camera: Camera
    depth: NDArray[np.float32]
    normal: NDArray[np.float32]
    noise: float
    _tables: dict[float, tuple[Any, ...]] = field(default_factory=dict, repr=False, compare=False)

    @property
    def pixel(self) -> float:
        """Length that a pixel spans at the median depth; requires a view that measures something."""
        return float(np.median(self.depth[self.depth > 0]) / np.sqrt(self.camera.fx * self.camera.fy))

    def tables(self, tolerance: float) -> tuple[Any, ...]:
        """Lookup tables of `_state_of`. tolerance: without the view's own noise, which is added here."""
        if tolerance not in self._tables:
            # The errors of the point and of the surface (three standard deviations) are independent.
            within, lens = float(np.hypot(tolerance, 3 * self.noise)), np.array(self.camera.intrinsics)
            planes, far = _planes_of(self.depth, self.normal, lens, within)
            # The maximum over 3 x 3 pixels: a point behind it lies on none of the surfaces that it is compared with.
            beyond = require_cv2().dilate(far, np.ones((3, 3), np.uint8))
            self._tables[tolerance] = within, self.camera.world_to_camera, lens, planes, beyond
        return self._tables[tolerance]


class DiscSurface:
    """A cloud as a surface: each point a disc in the plane of its neighbors.

    xyz: (n, 3) float32, each moved onto the plane of its neighbors, but no farther than noise explains. spacing:
    typical distance between neighbors. scatter: standard deviation of the points off their planes before they were
    moved. noise: standard deviation of the planes themselves.
    """

    def __init__(self, xyz: NDArray[np.float32], around: Neighborhood) -> None:
        self.spacing = float(np.median(around.spacing))
        self.normal, height, off = _planes(xyz, around.index[:, :PLANE_POINTS])
        noise = self.scatter = float(np.median(off))
        # A plane through many readings is more exact than each of them. A point farther off than noise explains is part
        # of the shape and keeps the rest of its height.
        shift = np.clip(height, -MAX_SHIFT_DEVIATIONS * noise, MAX_SHIFT_DEVIATIONS * noise)
        self.xyz = (xyz - shift[:, None] * self.normal).astype(np.float32)
        self.noise = noise * min(1.0, PLANE_ERROR / np.sqrt(1 + PLANE_POINTS))  # the point itself and its neighbors
        self._radius = (DISC_RADIUS_SPACINGS * np.maximum(around.spacing, self.spacing)).astype(np.float32)

    def seen_from(self, camera: Camera) -> MeasuredView:
        """What a view of the surface would measure, at the points' own resolution. camera: pose from their frame."""
        depth = depths(self.xyz, camera)
        in_image = depth[camera.shows(camera.project(self.xyz)[0])]
        typical = float(np.median(in_image)) if len(in_image) else 1.0
        # Discs are drawn into a smaller image where the photograph has more pixels than the cloud has points for.
        radius_px = DISC_RADIUS_SPACINGS * self.spacing * np.sqrt(camera.fx * camera.fy) / max(typical, 1e-12)
        share = min(1.0, DISC_RADIUS_PX / max(radius_px, 1e-12))
        size = max(8, round(camera.width * share)), max(8, round(camera.height * share))
        camera = camera.resized(*size) if share < 1 else camera
        discs, size = (self.xyz, self.normal, self._radius), (camera.height, camera.width)
        depth, normal = _draw_discs(
            discs, camera.world_to_camera, np.array(camera.intrinsics), size, NEAR_SHARE * typical
        )
        return MeasuredView(camera, depth, normal, self.noise)


def view_of_depth(depth: NDArray[np.float32], camera: Camera) -> MeasuredView:
    """Surfaces that a depth image measures. depth: (h, w) float32, 0 unmeasured. A sparse image (a projected lidar
    scan, say) is downsampled until most pixels hold a reading, the nearest of those that fall into each."""
    measured = depth > 0
    # Density where anything is measured, by right-hand neighbors: sky and black surfaces do not make an image sparse.
    share = float(measured[:, 1:][measured[:, :-1]].mean()) if measured[:, :-1].any() else 1.0
    # Blocks of step x step pixels hold two readings on average.
    step = int(np.ceil(np.sqrt(2 / max(share, 1e-3)))) if share < 0.5 else 1
    if step > 1:
        height, width = -(-depth.shape[0] // step), -(-depth.shape[1] // step)
        padded = np.zeros((height * step, width * step), np.float32)
        padded[: depth.shape[0], : depth.shape[1]] = depth
        nearest = np.where(padded > 0, padded, np.inf).reshape(height, step, width, step).min(axis=(1, 3))
        lens = camera.fx / step, camera.fy / step, camera.cx / step, camera.cy / step
        camera = Camera(width, height, *lens, camera.world_to_camera)
        depth = np.where(np.isfinite(nearest), nearest, 0).astype(np.float32)
    normal, second = _normals(depth, np.array(camera.intrinsics))
    second = second[np.isfinite(second)]
    # For readings with independent noise s, before - 2 here + after has the variance (1 + 4 + 1) s^2. 1.4826 times the
    # median of its magnitude is its standard deviation, robust against object edges. This is the noise along the axis:
    # perpendicular to a slanted surface there is less.
    noise = 1.4826 * float(np.median(second)) / np.sqrt(6.0) if len(second) else 0.0
    return MeasuredView(camera, depth, normal, noise)


def depth_views(capture: str | Path, origin: NDArray[np.float64]) -> Iterator[MeasuredView] | None:
    """What the depth images of a capture measured, read lazily one by one; None where it has none. Cameras are in the
    local frame of that origin (world = local + origin)."""
    files = depth_files(Path(capture), read_poses(Path(capture)))
    images = (file.read() for file in files.values())
    return (view_of_depth(image.depth, in_local_frame(image.camera, origin)) for image in images) if files else None


def states_of_points(xyz: NDArray[np.float32], tolerance: float, view: MeasuredView) -> NDArray[np.int8]:
    """(n,) int8: NOTHING, AGREES, HIDDEN or THROUGH. tolerance: without the view's noise, in the unit of xyz (n, 3)."""
    return _states(xyz, view.tables(tolerance))


def _planes(
    xyz: NDArray[np.float32], neighbors: NDArray[np.int32]
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """The plane fitted to each point and its neighbors (n, k): (n, 3) unit normals, (n,) the point's height above the
    plane, and (n,) the standard deviation of all these points off it."""
    normal, height, off = (np.empty(shape, np.float32) for shape in ((len(xyz), 3), len(xyz), len(xyz)))
    for start in range(0, len(xyz), PLANES_PER_BATCH):
        part = np.arange(start, min(start + PLANES_PER_BATCH, len(xyz)))
        for count in (neighbors.shape[1], neighbors.shape[1] // 2):
            about = np.concatenate([xyz[part, None], xyz[neighbors[part, :count]]], axis=1).astype(np.float64)
            about -= about.mean(axis=1, keepdims=True)
            # The normal is the scatter matrix's eigenvector of the smallest eigenvalue, the first: they are ascending.
            # A plane has three parameters: count + 1 points leave count - 2 degrees of freedom.
            values, vectors = np.linalg.eigh(np.swapaxes(about, 1, 2) @ about / max(count - 2, 1))
            deviation = np.sqrt(np.maximum(values[:, 0], 0))
            if count < neighbors.shape[1]:
                # Near an edge the farther neighbors reach another surface; the nearer half fits much better there.
                better = deviation < NEARER_HALF_SHARE * off[part]
                part, vectors, about, deviation = part[better], vectors[better], about[better], deviation[better]
            normal[part], off[part] = vectors[..., 0], deviation
            height[part] = np.einsum("na,na->n", about[:, 0], vectors[..., 0])
    return normal, height, off


@njit(cache=True, nogil=True)
def _draw_discs(discs, pose, lens, size, near):  # noqa: ANN001, ANN202
    """(h, w) depth of the nearest disc in each pixel, 0 none, and (h, w, 3) its normal, towards the camera.

    discs: (n, 3) centers, (n, 3) unit normals and (n,) radii. pose: (4, 4), from their frame to the camera's.
    """
    (xyz, normal, radius), (fx, fy, cx, cy), (height, width) = discs, lens, size
    depth = np.zeros((height, width), np.float32)
    facing = np.zeros((height, width, 3), np.float32)
    for i in range(len(xyz)):
        x, y, z = in_camera(pose, xyz[i])
        if z <= near:
            continue
        u, v = fx * x / z + cx, fy * y / z + cy
        # In the image a disc is at most about as wide as if it faced the camera.
        reach = min(max(fx, fy) * radius[i] / z, MAX_DISC_RADIUS_PX)
        if u < -reach or v < -reach or u > width + reach or v > height + reach:
            continue
        # A fitted plane has no front: its normal is flipped towards the camera, against the rays.
        nx, ny, nz = turned(pose, normal[i])
        along = nx * x + ny * y + nz * z
        if along > 0:
            nx, ny, nz, along = -nx, -ny, -nz, -along
        for row in range(max(int(v - reach), 0), min(int(v + reach) + 1, height)):
            for column in range(max(int(u - reach), 0), min(int(u + reach) + 1, width)):
                # The ray z' (dx, dy, 1) meets the disc's plane n . x = along at the depth z' = along / slope.
                dx, dy = (column + 0.5 - cx) / fx, (row + 0.5 - cy) / fy
                slope = nx * dx + ny * dy + nz
                meets = along / slope if slope < -1e-6 else z
                if (meets * dx - x) ** 2 + (meets * dy - y) ** 2 + (meets - z) ** 2 > radius[i] ** 2:
                    # Outside the disc. The pixel of the point itself is drawn anyway, however thin the disc.
                    if column != int(u) or row != int(v):
                        continue
                    meets = z
                if depth[row, column] == 0 or meets < depth[row, column]:
                    depth[row, column] = meets
                    facing[row, column] = nx, ny, nz
    return depth, facing


@njit(cache=True, parallel=True, nogil=True, error_model="numpy")
def _normals(depth, lens):  # noqa: ANN001, ANN202
    """(h, w, 3) unit normals of a depth image, towards the camera; and for every fourth pixel along each axis the
    magnitude of the second difference of depths along its row, NaN where one of the three is missing."""
    fx, fy, cx, cy = lens
    height, width = depth.shape
    # The ray through the middle of pixel (column, row) is (x[column], y[row], 1).
    x, y = (np.arange(width) + 0.5 - cx) / fx, (np.arange(height) + 0.5 - cy) / fy
    normal = np.zeros((height, width, 3), np.float32)
    second = np.full((height // 4 + 1, width // 4 + 1), np.nan)
    for row in prange(height):
        for column in range(width):
            z = depth[row, column]
            if z <= 0:
                continue
            # The slope of depth is taken on the side that differs less: the other side may lie beyond an edge.
            before = depth[row, column - 1] if column > 0 else np.float32(0)
            after = depth[row, column + 1] if column < width - 1 else np.float32(0)
            above = depth[row - 1, column] if row > 0 else np.float32(0)
            below = depth[row + 1, column] if row < height - 1 else np.float32(0)
            right, down = _step(z, before, after), _step(z, above, below)
            # The surface is z ray, its tangents d(z ray)/du and d(z ray)/dv. (a, b, c) is perpendicular to both, and
            # its dot product with the ray is -1: it faces the camera.
            a, b = right * fx / z, down * fy / z
            c = -1 - a * x[column] - b * y[row]
            unit = 1 / np.sqrt(a * a + b * b + c * c)
            normal[row, column] = a * unit, b * unit, c * unit
            if row % 4 == 0 and column % 4 == 0 and before > 0 and after > 0:
                second[row // 4, column // 4] = abs(before + after - 2 * z)
    return normal, second


@njit(cache=True, nogil=True)
def _step(here, before, after):  # noqa: ANN001, ANN202
    """Change of depth per pixel towards the measured neighbor that differs less; 0 where neither is measured."""
    if before <= 0 and after <= 0:
        return 0.0
    if before <= 0 or (after > 0 and abs(after - here) < abs(here - before)):
        return after - here
    return here - before


@njit(cache=True, parallel=True, nogil=True, error_model="numpy")
def _planes_of(depth, normal, lens, tolerance):  # noqa: ANN001, ANN202
    """(h, w, 5): normal, offset (normal . x of the plane) and depth of each pixel, adjacent as they are read together;
    and (h, w) the depth behind which no point lies on the pixel's surface, 0 where nothing is measured."""
    fx, fy, cx, cy = lens
    height, width = depth.shape
    x, y = (np.arange(width) + 0.5 - cx) / fx, (np.arange(height) + 0.5 - cy) / fy
    planes, far = np.empty((height, width, 5), np.float32), np.zeros(depth.shape)
    # A point in a neighboring pixel lies up to a pixel and a half off this one's center along each axis: n . ray
    # differs between the two by no more than this.
    turn = 1.5 * np.sqrt(1 / fx**2 + 1 / fy**2)
    for row in prange(height):
        for column in range(width):
            z, n = depth[row, column], normal[row, column]
            slope = n[0] * x[column] + n[1] * y[row] + n[2]
            planes[row, column, :3], planes[row, column, 3], planes[row, column, 4] = n, z * slope, z
            if z > 0:
                # `_state_of` agrees with a point at depth z' only if |z' slope' - z slope| <= tolerance, and, at a
                # slant below MIN_COSINE, only if |z' - z| <= tolerance too. Each is solved for the largest z'.
                far[row, column] = max(z + tolerance, (tolerance + z * abs(slope)) / max(abs(slope) - turn, MIN_COSINE))
    return planes, far


@njit(cache=True, nogil=True, error_model="numpy")
def _state_of(p, tables):  # noqa: ANN001, ANN202
    """The state of a point, by its distance from the surfaces in the 3 x 3 pixels around its own."""
    tolerance, pose, lens, planes, beyond = tables
    x, y, z = in_camera(pose, p)
    if z <= 0:
        return NOTHING
    u, v = lens[0] * x / z + lens[2], lens[1] * y / z + lens[3]
    height, width = beyond.shape
    if not (0 <= u < width and 0 <= v < height):
        return NOTHING
    column, row = int(u), int(v)
    # Most hidden points lie far behind all nine surfaces: one reading settles them. 0: none of the nine is measured.
    if z > beyond[row, column]:
        return HIDDEN if beyond[row, column] > 0 else NOTHING
    length = np.sqrt(x * x + y * y + z * z)
    behind, before, unsure = 0, 0, 0
    for k in range(9):  # its own pixel first: it mostly settles the matter
        r, c = row - 1 + (k + 4) % 9 // 3, column - 1 + (k + 4) % 3
        if not (0 <= r < height and 0 <= c < width) or planes[r, c, 4] <= 0:
            continue
        # Distance of the point in front of the pixel's plane, perpendicular to it, and in front of its reading, in
        # depth. Both are positive where the surface lies behind the point.
        along = planes[r, c, 0] * x + planes[r, c, 1] * y + planes[r, c, 2] * z
        across, deeper = along - planes[r, c, 3], planes[r, c, 4] - z
        on_ray = abs(deeper) * length / z
        slanted = abs(along) < MIN_COSINE * length
        # A plane seen edge-on comes close to points all along the ray: only its reading counts.
        if abs(across) <= tolerance and (on_ray <= tolerance or not slanted):
            return AGREES
        if slanted and on_ray > tolerance:
            unsure += deeper > 0
            before += deeper < 0
        elif across < 0:
            before += 1
        else:
            behind += 1
    # One surface in front is enough to hide. Absence requires more: a few readings behind, and none in doubt.
    if before > 0:
        return HIDDEN
    return THROUGH if behind >= 3 and unsure == 0 else NOTHING


@njit(cache=True, parallel=True, nogil=True, error_model="numpy")
def _states(xyz, tables):  # noqa: ANN001, ANN202
    states = np.empty(len(xyz), np.int8)
    for i in prange(len(xyz)):
        states[i] = _state_of((xyz[i, 0], xyz[i, 1], xyz[i, 2]), tables)
    return states
