"""What a view says of points at some place: still there, hidden, or seen through.

A view measures surfaces: by its depth image, or, where it has none, by the cloud of its visit, drawn as small discs in
the surface's plane. A point is

    AGREES    if a surface is measured where it lies
    HIDDEN    if the surface lies in front of it
    THROUGH   if all surfaces measured around its pixel lie behind it
    NOTHING   if nothing is measured there, or so much at a slant that it says nothing

Distances count at right angles to the surface: along a ray, a thing of 3 cm on a table lies 10 cm before it, and so
does a table's edge before the table, at a slant. Absence is told by THROUGH alone; what no view looks at stays.
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
from og_pointcloud.mapping.voxels import in_camera, lens_of, turned
from og_pointcloud.rendering.geometry import Neighbourhood, neighbourhood
from og_pointcloud.scene import Camera
from og_pointcloud.settings import GeometrySettings

NOTHING, AGREES, HIDDEN, THROUGH = 0, 1, 2, 3
"""States of a point."""

PLANE_POINTS = 12
"""Nearest points by which the plane of a surface is told."""
SAME_SHEET = 0.5
"""Half of these tell the plane if they lie less than this share as far off theirs: the others are of something else."""
DISC_SPACINGS = 2.0
"""Radius of a disc: of randomly strewn points, one place in three hundred is then left open."""
MOST_SHIFT = 2.5
"""Deviations of the noise by which a point is moved at most."""
SMOOTHED = 1.5
"""The height of a plane through k points is this many times as exact as their noise over the root of k."""
PIXELS_PER_DISC = 2.5
"""Radius of a typical disc in the images that are drawn: finer ones say nothing more."""
WIDEST_DISC = 24
"""Pixels; a disc just before the camera is drawn no larger."""
SLANT = 0.15
"""Cosine between ray and normal below which a surface says nothing of points far from it."""
AT_ONCE = 1 << 16
"""Points whose planes are told at once: 30 MB."""
NEAR_SHARE = 0.02
"""What is nearer than this share of a view's median depth is not drawn."""


@dataclass(frozen=True)
class MeasuredView:
    """Surfaces that one view measures. camera: of this image, from the frame of the points that it will be asked about.
    depth: (h, w) float32, along the optical axis, 0 where nothing is measured. normal: (h, w, 3) float32, of length 1,
    in the camera's frame, towards it. noise: standard deviation of the surface, at right angles to it."""

    camera: Camera
    depth: NDArray[np.float32]
    normal: NDArray[np.float32]
    noise: float
    _asked: dict[float, tuple[Any, ...]] = field(default_factory=dict, repr=False, compare=False)

    @property
    def pixel(self) -> float:
        """Length that a pixel spans at the median depth; of a view that measures something."""
        return float(np.median(self.depth[self.depth > 0]) / np.sqrt(self.camera.fx * self.camera.fy))

    def asked(self, tolerance: float) -> tuple[Any, ...]:
        """What `_state_of` asks a view for. tolerance: beside the view's noise."""
        if tolerance not in self._asked:
            within, lens = float(np.hypot(tolerance, 3 * self.noise)), lens_of(self.camera)
            planes, own = _planes_of(self.depth, self.normal, lens, within)
            beyond = require_cv2().dilate(own, np.ones((3, 3), np.uint8))
            self._asked[tolerance] = within, self.camera.world_to_camera, lens, planes, beyond
        return self._asked[tolerance]


class DiscSurface:
    """A cloud as a surface: each point a disc in the plane of its neighbours.

    xyz: (n, 3) float32, each moved onto the plane of its neighbours as far as noise goes. spacing: typical distance of
    neighbours. scatter: standard deviation of the points off their planes, before that; noise: of the
    planes.
    """

    def __init__(self, xyz: NDArray[np.float32], around: Neighbourhood | None = None) -> None:
        around = neighbourhood(xyz, GeometrySettings()) if around is None else around
        self.spacing = float(np.median(around.spacing))
        self.normal, height, off = _planes(xyz, around.index[:, :PLANE_POINTS])
        noise = self.scatter = float(np.median(off))
        # Onto the planes, as far as noise goes: a mean of many readings is more exact than each of them.
        shift = np.clip(height, -MOST_SHIFT * noise, MOST_SHIFT * noise)
        self.xyz = (xyz - shift[:, None] * self.normal).astype(np.float32)
        self.noise = noise * min(1.0, SMOOTHED / np.sqrt(1 + PLANE_POINTS))
        self._radius = (DISC_SPACINGS * np.maximum(around.spacing, self.spacing)).astype(np.float32)

    def seen_from(self, camera: Camera) -> MeasuredView:
        """What a view of the surface would measure, at the points' own resolution. camera: from their frame."""
        depth = self.xyz @ camera.world_to_camera[2, :3] + camera.world_to_camera[2, 3]
        in_image = depth[camera.shows(camera.project(self.xyz)[0])]
        typical = float(np.median(in_image)) if len(in_image) else 1.0
        radius_px = DISC_SPACINGS * self.spacing * np.sqrt(camera.fx * camera.fy) / max(typical, 1e-12)
        share = min(1.0, PIXELS_PER_DISC / max(radius_px, 1e-12))
        size = max(8, round(camera.width * share)), max(8, round(camera.height * share))
        camera = camera.resized(*size) if share < 1 else camera
        discs, size = (self.xyz, self.normal, self._radius), (camera.height, camera.width)
        depth, normal = _draw_discs(discs, camera.world_to_camera, lens_of(camera), size, NEAR_SHARE * typical)
        return MeasuredView(camera, depth, normal, self.noise)


def view_of_depth(depth: NDArray[np.float32], camera: Camera) -> MeasuredView:
    """What a depth image measures. depth: (h, w) float32, 0 unmeasured. A sparse one is taken at the resolution at
    which most pixels hold a reading: the nearest of those that fall into one."""
    measured = depth > 0
    # Of what is measured, how much has a measured neighbour: sky and black surfaces make no image sparse.
    share = float(measured[:, 1:][measured[:, :-1]].mean()) if measured[:, :-1].any() else 1.0
    step = int(np.ceil(np.sqrt(2 / max(share, 1e-3)))) if share < 0.5 else 1
    if step > 1:
        height, width = -(-depth.shape[0] // step), -(-depth.shape[1] // step)
        padded = np.zeros((height * step, width * step), np.float32)
        padded[: depth.shape[0], : depth.shape[1]] = depth
        far = np.where(padded > 0, padded, np.inf).reshape(height, step, width, step).min(axis=(1, 3))
        lens = camera.fx / step, camera.fy / step, camera.cx / step, camera.cy / step
        camera = Camera(width, height, *lens, camera.world_to_camera)
        depth = np.where(np.isfinite(far), far, 0).astype(np.float32)
    normal, second = _normals(depth, lens_of(camera))
    second = second[np.isfinite(second)]
    # A second difference of three readings of one noise has its deviation times the root of 6.
    noise = 1.4826 * float(np.median(second)) / np.sqrt(6.0) if len(second) else 0.0
    return MeasuredView(camera, depth, normal, noise)


def depth_views(capture: str | Path, origin: NDArray[np.float64]) -> Iterator[MeasuredView] | None:
    """What the depth images of a capture measured, read one by one, from cameras in the local frame of that origin
    (world = local + origin); None where it has none."""
    files = depth_files(Path(capture), read_poses(Path(capture)))
    images = (file.read() for file in files.values())
    return (view_of_depth(image.depth, in_local_frame(image.camera, origin)) for image in images) if files else None


def states_of_points(xyz: NDArray[np.float32], tolerance: float, view: MeasuredView) -> NDArray[np.int8]:
    """(n,) int8: NOTHING, AGREES, HIDDEN or THROUGH. tolerance: beside the view's noise, same unit as xyz (n, 3)."""
    return _states(xyz, view.asked(tolerance))


def _planes(
    xyz: NDArray[np.float32], neighbours: NDArray[np.int32]
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Of each point with its neighbours (n, k): (n, 3) unit normals, (n,) the point's height over the plane, and (n,)
    the standard deviation off it."""
    normal, height, off = (np.empty(shape, np.float32) for shape in ((len(xyz), 3), len(xyz), len(xyz)))
    for start in range(0, len(xyz), AT_ONCE):
        part = np.arange(start, min(start + AT_ONCE, len(xyz)))
        for count in (neighbours.shape[1], neighbours.shape[1] // 2):
            about = np.concatenate([xyz[part, None], xyz[neighbours[part, :count]]], axis=1).astype(np.float64)
            about -= about.mean(axis=1, keepdims=True)
            # Three of the points fit any plane.
            values, vectors = np.linalg.eigh(np.swapaxes(about, 1, 2) @ about / max(count - 2, 1))
            deviation = np.sqrt(np.maximum(values[:, 0], 0))
            if count < neighbours.shape[1]:
                # Fewer neighbours, where more reach a surface behind or beyond an edge.
                better = deviation < SAME_SHEET * off[part]
                part, vectors, about, deviation = part[better], vectors[better], about[better], deviation[better]
            normal[part], off[part] = vectors[..., 0], deviation
            height[part] = np.einsum("na,na->n", about[:, 0], vectors[..., 0])
    return normal, height, off


@njit(cache=True, nogil=True)
def _draw_discs(discs, pose, lens, size, near):  # noqa: ANN001, ANN202
    """(h, w) depth of the nearest disc in each pixel, 0 none, and (h, w, 3) its normal, towards the camera."""
    (xyz, normal, radius), (fx, fy, cx, cy), (height, width) = discs, lens, size
    depth = np.zeros((height, width), np.float32)
    facing = np.zeros((height, width, 3), np.float32)
    for i in range(len(xyz)):
        x, y, z = in_camera(pose, xyz[i])
        if z <= near:
            continue
        u, v = fx * x / z + cx, fy * y / z + cy
        reach = min(max(fx, fy) * radius[i] / z, WIDEST_DISC)
        if u < -reach or v < -reach or u > width + reach or v > height + reach:
            continue
        nx, ny, nz = turned(pose, normal[i])
        along = nx * x + ny * y + nz * z
        if along > 0:
            nx, ny, nz, along = -nx, -ny, -nz, -along
        # The pixels whose rays meet the disc's plane within its radius; at least the one that the point is in.
        for row in range(max(int(v - reach), 0), min(int(v + reach) + 1, height)):
            for column in range(max(int(u - reach), 0), min(int(u + reach) + 1, width)):
                dx, dy = (column + 0.5 - cx) / fx, (row + 0.5 - cy) / fy
                slope = nx * dx + ny * dy + nz
                meets = along / slope if slope < -1e-6 else z
                if (meets * dx - x) ** 2 + (meets * dy - y) ** 2 + (meets - z) ** 2 > radius[i] ** 2:
                    if column != int(u) or row != int(v):
                        continue
                    meets = z
                if depth[row, column] == 0 or meets < depth[row, column]:
                    depth[row, column] = meets
                    facing[row, column] = nx, ny, nz
    return depth, facing


@njit(cache=True, parallel=True, nogil=True, error_model="numpy")
def _normals(depth, lens):  # noqa: ANN001, ANN202
    """(h, w, 3) normals of a depth image, towards the camera; and of every fourth pixel along each axis the second
    difference of its depths, NaN where one is missing."""
    fx, fy, cx, cy = lens
    height, width = depth.shape
    x, y = (np.arange(width) + 0.5 - cx) / fx, (np.arange(height) + 0.5 - cy) / fy
    normal = np.zeros((height, width, 3), np.float32)
    second = np.full((height // 4 + 1, width // 4 + 1), np.nan)
    for row in prange(height):
        for column in range(width):
            z = depth[row, column]
            if z <= 0:
                continue
            # The steps to the neighbours whose depths differ less: the others may lie beyond an edge.
            before = depth[row, column - 1] if column > 0 else np.float32(0)
            after = depth[row, column + 1] if column < width - 1 else np.float32(0)
            above = depth[row - 1, column] if row > 0 else np.float32(0)
            below = depth[row + 1, column] if row < height - 1 else np.float32(0)
            right, down = _step(z, before, after), _step(z, above, below)
            # Two tangents are d(z ray)/du and d(z ray)/dv; this is their cross product, up to its length.
            a, b = right * fx / z, down * fy / z
            c = -1 - a * x[column] - b * y[row]
            unit = 1 / np.sqrt(a * a + b * b + c * c)
            normal[row, column] = a * unit, b * unit, c * unit
            if row % 4 == 0 and column % 4 == 0 and before > 0 and after > 0:
                second[row // 4, column // 4] = abs(before + after - 2 * z)
    return normal, second


@njit(cache=True, nogil=True)
def _step(here, before, after):  # noqa: ANN001, ANN202
    """Change of depth per pixel: to the neighbour that is measured and differs less, 0 where neither is."""
    if before <= 0 and after <= 0:
        return 0.0
    if before <= 0 or (after > 0 and abs(after - here) < abs(here - before)):
        return after - here
    return here - before


@njit(cache=True, parallel=True, nogil=True, error_model="numpy")
def _planes_of(depth, normal, lens, tolerance):  # noqa: ANN001, ANN202
    """(h, w, 5): normal, offset (normal . x of the plane) and depth of each pixel, together as they are read; and
    (h, w) the depth behind which its surface can hold no point, 0 where nothing is measured."""
    fx, fy, cx, cy = lens
    height, width = depth.shape
    x, y = (np.arange(width) + 0.5 - cx) / fx, (np.arange(height) + 0.5 - cy) / fy
    planes, own = np.empty((height, width, 5), np.float32), np.zeros(depth.shape)
    # Products of a normal and the rays to two points that are a pixel and a half apart differ by no more than this.
    turn = 1.5 * np.sqrt(1 / fx**2 + 1 / fy**2)
    for row in prange(height):
        for column in range(width):
            z, n = depth[row, column], normal[row, column]
            slope = n[0] * x[column] + n[1] * y[row] + n[2]
            planes[row, column, :3], planes[row, column, 3], planes[row, column, 4] = n, z * slope, z
            if z > 0:
                own[row, column] = max(z + tolerance, (tolerance + z * abs(slope)) / max(abs(slope) - turn, SLANT))
    return planes, own


@njit(cache=True, nogil=True, error_model="numpy")
def _state_of(p, asked):  # noqa: ANN001, ANN202
    """The state of a point, by its distance from the surfaces in the 3 x 3 pixels around its own."""
    tolerance, pose, lens, planes, beyond = asked  # beyond: the depth behind which none of the 3 x 3 holds a point
    x, y, z = in_camera(pose, p)
    if z <= 0:
        return NOTHING
    u, v = lens[0] * x / z + lens[2], lens[1] * y / z + lens[3]
    height, width = beyond.shape
    if not (0 <= u < width and 0 <= v < height):
        return NOTHING
    column, row = int(u), int(v)
    if z > beyond[row, column]:
        return HIDDEN if beyond[row, column] > 0 else NOTHING
    length = np.sqrt(x * x + y * y + z * z)
    behind, before, unsure = 0, 0, 0
    for k in range(9):  # its own pixel first: it mostly settles the matter
        r, c = row - 1 + (k + 4) % 9 // 3, column - 1 + (k + 4) % 3
        if not (0 <= r < height and 0 <= c < width) or planes[r, c, 4] <= 0:
            continue
        # How far the point lies before the pixel's plane; and before its surface, along the ray.
        along = planes[r, c, 0] * x + planes[r, c, 1] * y + planes[r, c, 2] * z
        across, deeper = along - planes[r, c, 3], planes[r, c, 4] - z
        on_ray = abs(deeper) * length / z
        slanted = abs(along) < SLANT * length
        if abs(across) <= tolerance and (on_ray <= tolerance or not slanted):
            return AGREES
        if slanted and on_ray > tolerance:
            unsure += deeper > 0
            before += deeper < 0
        elif across < 0:
            before += 1
        else:
            behind += 1
    if before > 0:
        return HIDDEN
    return THROUGH if behind >= 3 and unsure == 0 else NOTHING


@njit(cache=True, parallel=True, nogil=True, error_model="numpy")
def _states(xyz, asked):  # noqa: ANN001, ANN202
    states = np.empty(len(xyz), np.int8)
    for i in prange(len(xyz)):
        states[i] = _state_of((xyz[i, 0], xyz[i, 1], xyz[i, 2]), asked)
    return states
