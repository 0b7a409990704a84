"""What one view says of a point: it is still there, it is hidden, or the view sees through its place.

A view measures surfaces by its depth image or, where it has none, by the cloud of its visit, drawn as small discs in
the plane of the surface. A point is

    AGREES    if a surface is measured where it lies
    HIDDEN    if a surface is measured in front of it
    THROUGH   if every surface measured around its pixel lies behind it
    NOTHING   if nothing is measured there, or only surfaces seen at too flat an angle to tell

Distances are taken at right angles to the surface. Along a slanted ray, an object 3 cm high on a table can lie 10 cm
in front of the table, but so can the near part of the table itself; only the perpendicular distance parts the two.
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
from og_pointcloud.rendering.geometry import Neighborhood, depths, neighborhood
from og_pointcloud.scene import Camera
from og_pointcloud.settings import GeometrySettings

NOTHING, AGREES, HIDDEN, THROUGH = 0, 1, 2, 3
"""States of a point."""

PLANE_POINTS = 12
"""Nearest points to which the plane of a surface is fitted."""
SAME_SHEET = 0.5
"""The nearer half of them alone gives the plane where it scatters less than this share as much off its own plane as
all do off theirs: the farther half then lies on something else."""
DISC_SPACINGS = 2.0
"""Radius of a disc, in spacings: on randomly strewn points, one place in three hundred is then left open."""
MOST_SHIFT = 2.5
"""Standard deviations of the noise by which a point is moved at most."""
SMOOTHED = 1.5
"""A plane fitted to k points has this many times the error of their mean, which is their noise over the root of k."""
PIXELS_PER_DISC = 2.5
"""Radius of a typical disc in the images that are drawn, pixels: a finer image says nothing more."""
WIDEST_DISC = 24
"""Pixels; a disc right in front of the camera is drawn no larger."""
SLANT = 0.15
"""Cosine between ray and normal (81 degrees) below which a surface says nothing of points far from it."""
AT_ONCE = 1 << 16
"""Points whose planes are fitted at once: 30 MB."""
NEAR_SHARE = 0.02
"""Whatever is nearer than this share of a view's median depth is not drawn."""


@dataclass(frozen=True)
class MeasuredView:
    """Surfaces that one view measures. camera: of this image, its pose from the frame of the points to be asked about.
    depth: (h, w) float32, along the optical axis, 0 where nothing is measured. normal: (h, w, 3) float32, of length 1,
    in the camera's frame, towards it. noise: standard deviation of the surface, at right angles to it."""

    camera: Camera
    depth: NDArray[np.float32]
    normal: NDArray[np.float32]
    noise: float
    _asked: dict[float, tuple[Any, ...]] = field(default_factory=dict, repr=False, compare=False)

    @property
    def pixel(self) -> float:
        """Length that a pixel spans at the median depth; only for a view that measures something."""
        return float(np.median(self.depth[self.depth > 0]) / np.sqrt(self.camera.fx * self.camera.fy))

    def asked(self, tolerance: float) -> tuple[Any, ...]:
        """What `_state_of` reads of a view. tolerance: without the view's own noise, which is added here."""
        if tolerance not in self._asked:
            # The point's error and that of the surface, three standard deviations of it, are independent.
            within, lens = float(np.hypot(tolerance, 3 * self.noise)), np.array(self.camera.intrinsics)
            planes, own = _planes_of(self.depth, self.normal, lens, within)
            # A maximum over the 3 x 3 pixels: behind it, none of the surfaces that a point is held against holds it.
            beyond = require_cv2().dilate(own, np.ones((3, 3), np.uint8))
            self._asked[tolerance] = within, self.camera.world_to_camera, lens, planes, beyond
        return self._asked[tolerance]


class DiscSurface:
    """A cloud as a surface: each point a disc in the plane of its neighbors.

    xyz: (n, 3) float32, each moved onto the plane of its neighbors, but no farther than noise explains. spacing:
    typical distance of neighbors. scatter: standard deviation of the points off their planes, before they were moved;
    noise: of the planes themselves.
    """

    def __init__(self, xyz: NDArray[np.float32], around: Neighborhood | None = None) -> None:
        around = neighborhood(xyz, GeometrySettings()) if around is None else around
        self.spacing = float(np.median(around.spacing))
        self.normal, height, off = _planes(xyz, around.index[:, :PLANE_POINTS])
        noise = self.scatter = float(np.median(off))
        # A plane through many readings is more exact than each of them; a point farther off than noise explains is
        # part of the shape, and keeps the rest of its height.
        shift = np.clip(height, -MOST_SHIFT * noise, MOST_SHIFT * noise)
        self.xyz = (xyz - shift[:, None] * self.normal).astype(np.float32)
        self.noise = noise * min(1.0, SMOOTHED / np.sqrt(1 + PLANE_POINTS))  # the point itself and its neighbors
        self._radius = (DISC_SPACINGS * np.maximum(around.spacing, self.spacing)).astype(np.float32)

    def seen_from(self, camera: Camera) -> MeasuredView:
        """What a view of the surface would measure, at the points' own resolution. camera: from their frame."""
        depth = depths(self.xyz, camera)
        in_image = depth[camera.shows(camera.project(self.xyz)[0])]
        typical = float(np.median(in_image)) if len(in_image) else 1.0
        # Discs are drawn into a smaller image where the photograph has more pixels than the cloud has points for.
        radius_px = DISC_SPACINGS * self.spacing * np.sqrt(camera.fx * camera.fy) / max(typical, 1e-12)
        share = min(1.0, PIXELS_PER_DISC / max(radius_px, 1e-12))
        size = max(8, round(camera.width * share)), max(8, round(camera.height * share))
        camera = camera.resized(*size) if share < 1 else camera
        discs, size = (self.xyz, self.normal, self._radius), (camera.height, camera.width)
        depth, normal = _draw_discs(
            discs, camera.world_to_camera, np.array(camera.intrinsics), size, NEAR_SHARE * typical
        )
        return MeasuredView(camera, depth, normal, self.noise)


def view_of_depth(depth: NDArray[np.float32], camera: Camera) -> MeasuredView:
    """What a depth image measures. depth: (h, w) float32, 0 unmeasured. A sparse one (a projected lidar scan, say) is
    shrunk until most of its pixels hold a reading, the nearest of those that fall into each."""
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
    # before - 2 here + after of readings with independent noise s has the variance (1 + 4 + 1) s^2; the median of its
    # size times 1.4826 is its standard deviation, whatever edges of objects add to a few of them. This is the noise
    # along the axis: at right angles to a slanted surface there is less.
    noise = 1.4826 * float(np.median(second)) / np.sqrt(6.0) if len(second) else 0.0
    return MeasuredView(camera, depth, normal, noise)


def depth_views(capture: str | Path, origin: NDArray[np.float64]) -> Iterator[MeasuredView] | None:
    """What the depth images of a capture measured, read one by one as they are asked for; None where it has none.
    Cameras are in the local frame of that origin (world = local + origin)."""
    files = depth_files(Path(capture), read_poses(Path(capture)))
    images = (file.read() for file in files.values())
    return (view_of_depth(image.depth, in_local_frame(image.camera, origin)) for image in images) if files else None


def states_of_points(xyz: NDArray[np.float32], tolerance: float, view: MeasuredView) -> NDArray[np.int8]:
    """(n,) int8: NOTHING, AGREES, HIDDEN or THROUGH. tolerance: without the view's noise, in the unit of xyz (n, 3)."""
    return _states(xyz, view.asked(tolerance))


def _planes(
    xyz: NDArray[np.float32], neighbors: NDArray[np.int32]
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """The plane fitted to each point and its neighbors (n, k): (n, 3) unit normals, (n,) the point's height over the
    plane, and (n,) the standard deviation of all of them off it."""
    normal, height, off = (np.empty(shape, np.float32) for shape in ((len(xyz), 3), len(xyz), len(xyz)))
    for start in range(0, len(xyz), AT_ONCE):
        part = np.arange(start, min(start + AT_ONCE, len(xyz)))
        for count in (neighbors.shape[1], neighbors.shape[1] // 2):
            about = np.concatenate([xyz[part, None], xyz[neighbors[part, :count]]], axis=1).astype(np.float64)
            about -= about.mean(axis=1, keepdims=True)
            # Of the scatter matrix, the eigenvector of the smallest eigenvalue (the first: ascending) is the normal.
            # A plane has three parameters: count + 1 points leave count - 2 degrees of freedom.
            values, vectors = np.linalg.eigh(np.swapaxes(about, 1, 2) @ about / max(count - 2, 1))
            deviation = np.sqrt(np.maximum(values[:, 0], 0))
            if count < neighbors.shape[1]:
                # Near an edge the farther neighbors reach another surface; the nearer half fits much better there.
                better = deviation < SAME_SHEET * off[part]
                part, vectors, about, deviation = part[better], vectors[better], about[better], deviation[better]
            normal[part], off[part] = vectors[..., 0], deviation
            height[part] = np.einsum("na,na->n", about[:, 0], vectors[..., 0])
    return normal, height, off


@njit(cache=True, nogil=True)
def _draw_discs(discs, pose, lens, size, near):  # noqa: ANN001, ANN202
    """(h, w) depth of the nearest disc in each pixel, 0 none, and (h, w, 3) its normal, towards the camera.

    discs: (n, 3) centers, (n, 3) unit normals and (n,) radii, in the frame that pose (4, 4) leads from.
    """
    (xyz, normal, radius), (fx, fy, cx, cy), (height, width) = discs, lens, size
    depth = np.zeros((height, width), np.float32)
    facing = np.zeros((height, width, 3), np.float32)
    for i in range(len(xyz)):
        x, y, z = in_camera(pose, xyz[i])
        if z <= near:
            continue
        u, v = fx * x / z + cx, fy * y / z + cy
        # In the image a disc is about as wide as if it faced the camera, or narrower.
        reach = min(max(fx, fy) * radius[i] / z, WIDEST_DISC)
        if u < -reach or v < -reach or u > width + reach or v > height + reach:
            continue
        # A fitted plane has no front: its normal is turned to the camera, so that it points against the rays.
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
                    # Outside of the disc. The pixel of the point itself is drawn all the same, however thin the disc.
                    if column != int(u) or row != int(v):
                        continue
                    meets = z
                if depth[row, column] == 0 or meets < depth[row, column]:
                    depth[row, column] = meets
                    facing[row, column] = nx, ny, nz
    return depth, facing


@njit(cache=True, parallel=True, nogil=True, error_model="numpy")
def _normals(depth, lens):  # noqa: ANN001, ANN202
    """(h, w, 3) unit normals of a depth image, towards the camera; and of every fourth pixel along each axis the size
    of the second difference of depths along its row, NaN where one of the three is missing."""
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
            # Depth's slope is taken on the side that differs less: the other side may lie beyond an edge.
            before = depth[row, column - 1] if column > 0 else np.float32(0)
            after = depth[row, column + 1] if column < width - 1 else np.float32(0)
            above = depth[row - 1, column] if row > 0 else np.float32(0)
            below = depth[row + 1, column] if row < height - 1 else np.float32(0)
            right, down = _step(z, before, after), _step(z, above, below)
            # The surface is z ray, its tangents d(z ray)/du and d(z ray)/dv. (a, b, c) is at right angles to both, and
            # its product with the ray is -1: it faces the camera.
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
    """(h, w, 5): normal, offset (normal . x of the plane) and depth of each pixel, side by side as they are read
    together; and (h, w) the depth behind which the pixel's surface holds no point, 0 where nothing is measured."""
    fx, fy, cx, cy = lens
    height, width = depth.shape
    x, y = (np.arange(width) + 0.5 - cx) / fx, (np.arange(height) + 0.5 - cy) / fy
    planes, own = np.empty((height, width, 5), np.float32), np.zeros(depth.shape)
    # A point in a neighboring pixel lies up to a pixel and a half off this one's middle along each axis: n . ray
    # differs between the two by no more than this.
    turn = 1.5 * np.sqrt(1 / fx**2 + 1 / fy**2)
    for row in prange(height):
        for column in range(width):
            z, n = depth[row, column], normal[row, column]
            slope = n[0] * x[column] + n[1] * y[row] + n[2]
            planes[row, column, :3], planes[row, column, 3], planes[row, column, 4] = n, z * slope, z
            if z > 0:
                # `_state_of` agrees with a point at depth z' only if |z' slope' - z slope| <= tolerance, and, at a
                # slant below SLANT, only if |z' - z| <= tolerance too. Each is solved for the largest z'.
                own[row, column] = max(z + tolerance, (tolerance + z * abs(slope)) / max(abs(slope) - turn, SLANT))
    return planes, own


@njit(cache=True, nogil=True, error_model="numpy")
def _state_of(p, asked):  # noqa: ANN001, ANN202
    """The state of a point, by its distance from the surfaces in the 3 x 3 pixels around its own."""
    tolerance, pose, lens, planes, beyond = asked
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
        # How far the point lies before the pixel's plane, at right angles to it, and before its reading in depth. Both
        # are positive where the surface lies behind the point.
        along = planes[r, c, 0] * x + planes[r, c, 1] * y + planes[r, c, 2] * z
        across, deeper = along - planes[r, c, 3], planes[r, c, 4] - z
        on_ray = abs(deeper) * length / z
        slanted = abs(along) < SLANT * length
        # A plane that is seen along its own extent comes close to points all along the ray: only its reading counts.
        if abs(across) <= tolerance and (on_ray <= tolerance or not slanted):
            return AGREES
        if slanted and on_ray > tolerance:
            unsure += deeper > 0
            before += deeper < 0
        elif across < 0:
            before += 1
        else:
            behind += 1
    # One surface in front is enough to hide. Absence asks for more: a few readings behind, and none in doubt.
    if before > 0:
        return HIDDEN
    return THROUGH if behind >= 3 and unsure == 0 else NOTHING


@njit(cache=True, parallel=True, nogil=True, error_model="numpy")
def _states(xyz, asked):  # noqa: ANN001, ANN202
    states = np.empty(len(xyz), np.int8)
    for i in prange(len(xyz)):
        states[i] = _state_of((xyz[i, 0], xyz[i, 1], xyz[i, 2]), asked)
    return states
