"""Depth images -> a cloud, for captures without one: measurements of all views, averaged in voxels and cross-checked.

First pass: pixels that lie on a surface (without flying pixels, which lie between two) are averaged in voxels. Second
pass: every view votes on every voxel's point: it measured that surface, looked through it, or could not see it. A point
stays if more views confirm than refute it, and if two confirm it where three or more could have. It then moves to the
confirming views' mean surface: along each view's ray by the difference of the depths, one step towards the surface of a
signed distance volume. So a noisy surface becomes one layer, not one per voxel that the noise spans; points that then
share a voxel are averaged once more.

The voxel size follows from the images: two pixels wide at the median depth, but not finer than the noise between views.

A check (`doubtful_depth`) finds mistakes before hours are spent on a fit: where views overlap, a depth image of one
predicts what the other measures; in the wrong unit the prediction is wrong, unless the camera only turned.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.errors import SceneError
from og_pointcloud.formats.depth import DepthFrame, DepthImage
from og_pointcloud.formats.images import require_cv2
from og_pointcloud.kernels import njit, prange
from og_pointcloud.scene import Camera, DoubleArray, Points, evenly

SURVEYED_VIEWS = 16
"""Views, spread evenly, that are compared with each other before the fusion."""
PIXELS_PER_VIEW = 1000
"""Sampled pixels of a surveyed view, looked up in the others."""
SAME_SURFACE_SHARE = 0.05
"""Depths that differ by less than this share may belong to one surface: noise is measured on these."""
AGREEING_SHARE = 0.02
"""Depths that differ by less than this share agree."""

PIXELS_PER_VOXEL, NOISE_PER_VOXEL = 2.0, 1.0
"""Edge of a voxel: the larger of this many pixel widths and this many standard deviations of the noise."""
MAX_SLOPE = 5.7
"""Change of a surface's depth, in pixel widths per pixel: tan 80, for a surface seen 80 degrees off its normal."""
LINE_READINGS, MAX_BEND_SHARE = 5, 0.25
"""This many readings in a row, more than sensors put between two surfaces, belong to one surface if the steps of
their inverse depths differ by at most this share of the largest."""
VOXEL_TOLERANCE, NOISE_TOLERANCE = 1.5, 3.0
"""Largest distance of a point from a measured depth of its surface, in voxels and in deviations of the noise."""
JUDGING_ROUNDS = 2
"""Rounds in which all views vote on the points and move them."""
MIN_ENDED_SHARE, MIN_ENDED_VIEWS = 0.02, 3
"""A depth that is the largest of all, and exactly that of this share of the readings in this many views, is where a
simulator cuts off its camera's range; an edge seen alike from all sides has one row of the pixels."""
VOXELS_ACROSS = 1 << 21
"""Voxels along each axis, so that a voxel's three indices fit one 64-bit key."""

CHECKED_VIEWS = 12
"""Views, spread evenly, that the unit check reads."""
UNIT_FACTORS = (1e-3, 1e-2, 0.1, 0.2, 0.25, 4.0, 5.0, 10.0, 100.0, 1e3)
"""Factors between units in use: meters, centimeters, millimeters, 1/4000 and 1/5000 m against 1/1000 m."""
MIN_AGREEING_SHARE, MIN_SAME_SURFACE_SHARE = 0.2, 0.35
"""If smaller shares of the depths agree, and are close enough for one surface, the images are not depths of one place.
Correct depths agree in about half of the places; the rest is hidden in one of the views."""
MIN_UNIT_GAIN = 0.3
"""Another unit is suggested if it increases the share of agreeing depths by more than this."""


@dataclass(frozen=True)
class Survey:
    """Measured on some frames, used for all. depth: median measured depth. footprint: median width of a pixel on the
    surface. noise: standard deviation of one view's depths of a surface, 0 where no two views overlap. range_end: the
    depth that stands for "this or farther", infinite without one."""

    depth: float
    footprint: float
    noise: float
    range_end: float = np.inf

    @property
    def voxel(self) -> float:
        """Edge of the fusion's voxels."""
        return max(PIXELS_PER_VOXEL * self.footprint, NOISE_PER_VOXEL * self.noise)

    @property
    def tolerance(self) -> float:
        """Distance along the ray, at the median depth, up to which a measured depth belongs to a point's surface."""
        return max(VOXEL_TOLERANCE * self.voxel, NOISE_TOLERANCE * self.noise)


@dataclass(frozen=True)
class FusedCloud:
    """points: with colors if every frame has them. frames: number given. refused: number of voxels that other views
    looked through or that only one saw. empty: names of frames in which nothing was measured."""

    points: Points
    survey: Survey
    frames: int
    refused: int
    empty: tuple[str, ...]


def fuse(frames: Sequence[DepthFrame]) -> FusedCloud:
    """Fuse posed depth images; each is read several times, so that memory holds one at a time.

    Raises SceneError where no frame measures anything, or a file cannot be read.
    """
    found = survey(frames)
    # The origin lies among the cameras, so that voxel indices, counted from it, fit their key.
    origin = np.median([frame.depth.camera.center for frame in frames], axis=0)
    voxels = _Voxels(found.voxel)
    empty = []
    for frame in frames:
        image = frame.depth.read()
        if not image.depth.any():
            empty.append(frame.name)
        kept = _fusible(image, found)
        colors = frame.colors(image.camera)[kept] if frame.colors else np.zeros((int(kept.sum()), 3), np.uint8)
        voxels.add(to_world(image, kept) - origin, colors, f"view '{frame.name}'")
    refused = 0
    for _ in range(JUDGING_ROUNDS):
        xyz, rgb = voxels.means()
        stays, moved = _judge(xyz, origin, frames, found)
        if not stays.any():
            raise SceneError(
                f"none of the {len(xyz)} points that {len(frames)} depth images measured is confirmed by their views: "
                "check the poses and the depth unit"
            )
        refused += int((~stays).sum())
        # Points have moved: those that share a voxel now become one.
        voxels = _Voxels(found.voxel)
        voxels.add(moved[stays], rgb[stays], "the fused cloud")
    xyz, rgb = voxels.means()
    colored = all(frame.colors for frame in frames)
    points = Points.from_world(xyz + origin, rgb=np.rint(rgb).astype(np.uint8) if colored else None)
    return FusedCloud(points, found, len(frames), refused, tuple(empty))


def survey(frames: Sequence[DepthFrame]) -> Survey:
    """Depth, pixel width and noise, from evenly spread frames (from all, if those are empty)."""
    images, end = _within_range(_measured(evenly(frames, SURVEYED_VIEWS)) or _measured(frames)[:SURVEYED_VIEWS])
    if not images:
        raise SceneError(
            f"none of the {len(frames)} depth images has a measured pixel (e.g. {frames[0].depth.path}); expected "
            "depths above 0: check that they are depth images, or add a cloud"
        )
    depths = [image.depth[image.depth > 0] for image in images]
    widths = [depth / np.float32(np.sqrt(i.camera.fx * i.camera.fy)) for depth, i in zip(depths, images, strict=True)]
    typical = float(np.median(np.concatenate(depths)))
    off = np.abs(_differences(images))
    comparable = off[off < SAME_SURFACE_SHARE]
    # 1.4826: from the median of absolute values to a standard deviation. The difference of two views has the noise of
    # both, sqrt(2) times that of one; it is relative, so it is scaled by the typical depth.
    noise = 1.4826 / np.sqrt(2) * float(np.median(comparable)) * typical if len(comparable) else 0.0
    return Survey(typical, float(np.median(np.concatenate(widths))), float(noise), end)


def _measured(frames: Sequence[DepthFrame]) -> list[DepthImage]:
    return [image for frame in frames if (image := frame.depth.read()).depth.any()]


def _range_end(images: Sequence[DepthImage]) -> float:
    """The depth at which the camera's range was cut off, infinite if it was not."""
    end = max((float(image.depth.max()) for image in images), default=np.inf)
    shares = [np.count_nonzero(image.depth == end) / np.count_nonzero(image.depth) for image in images]
    # A view that measured nothing else tells nothing: constant images are no depths, and are reported as such.
    ended = [i for i, share in zip(images, shares, strict=True) if MIN_ENDED_SHARE <= share <= 1 - MIN_ENDED_SHARE]
    if len(ended) < MIN_ENDED_VIEWS:
        return np.inf
    # There may be such surfaces: one plane for all views, as a floor seen from one height, or the walls of a square
    # room around a camera that only turned.
    axes = np.array([image.camera.world_to_camera[2, :3] for image in ended])
    centers = np.array([image.camera.center for image in ended]) - ended[0].camera.center
    along = (axes * centers).sum(axis=1)
    have_moved = np.ptp(centers, axis=0).max() >= AGREEING_SHARE * end
    is_plane = np.ptp(axes, axis=0).max() < AGREEING_SHARE and np.ptp(along) < AGREEING_SHARE * end
    return end if have_moved and not is_plane else np.inf


def _within_range(images: Sequence[DepthImage]) -> tuple[list[DepthImage], float]:
    """The images, unmeasured where their camera's range ends, and that depth."""
    end = _range_end(images)
    return [replace(image, depth=np.where(image.depth < end, image.depth, np.float32(0))) for image in images], end


def _fusible(image: DepthImage, found: Survey) -> NDArray[np.bool_]:
    """(H, W) bool: readings on a surface, within the camera's range."""
    return on_surface(image, found.noise) & (image.depth < found.range_end)


def on_surface(image: DepthImage, noise: float, step: int = 1, *, slanted: bool = False) -> NDArray[np.bool_]:
    """(H, W) bool: of every ``step``-th reading along each axis, those on one surface with a neighbor in their row and
    in their column. slanted: readings on a surface seen at a flatter angle count too, if they are among LINE_READINGS
    on a line. A map uses these, as it knows what its frames measured; in a fused cloud such points would hide each
    other from a fit."""
    steepest = MAX_SLOPE / image.camera.fx, MAX_SLOPE / image.camera.fy
    return _on_surface(image.depth, step, steepest, NOISE_TOLERANCE * noise, slanted)


@njit(cache=True, nogil=True, error_model="numpy")
def _on_surface(depth, step, steepest, slack, slanted):  # noqa: ANN001, ANN202
    """See `on_surface`. steepest: relative change of depth per pixel along rows and columns; slack: added to it."""
    height, width = depth.shape
    chosen, none = np.zeros(depth.shape, np.bool_), np.float32(0)
    for row in range(step // 2, height, step):
        for column in range(step // 2, width, step):
            z = depth[row, column]
            if z <= 0:
                continue
            # A flying pixel lies between two surfaces: near neither neighbor along the axis across their edge. An image
            # of one column or row has no such neighbors.
            left = depth[row, column - 1] if column > 0 else none
            right = depth[row, column + 1] if column < width - 1 else none
            across = width == 1 or _near(z, left, steepest[0], slack) or _near(z, right, steepest[0], slack)
            if not (across or (slanted and _on_a_line(depth[row], column))):
                continue
            above = depth[row - 1, column] if row > 0 else none
            below = depth[row + 1, column] if row < height - 1 else none
            down = height == 1 or _near(z, above, steepest[1], slack) or _near(z, below, steepest[1], slack)
            chosen[row, column] = down or (slanted and _on_a_line(depth[:, column], row))
    return chosen


@njit(cache=True, nogil=True, error_model="numpy")
def _near(z, other, steepest, slack):  # noqa: ANN001, ANN202
    """Whether two adjacent depths, 0 unmeasured, belong to one surface."""
    return other > 0 and abs(other - z) <= min(other, z) * steepest + slack


@njit(cache=True, nogil=True, error_model="numpy")
def _on_a_line(line, k):  # noqa: ANN001, ANN202
    """Whether reading k of a row or column is among LINE_READINGS on a line. Inverse depths of a plane are linear in
    the image; those of readings between two surfaces lie anywhere."""
    for first in range(max(k - LINE_READINGS + 1, 0), min(k, len(line) - LINE_READINGS) + 1):
        low, high = np.inf, -np.inf
        for j in range(first, first + LINE_READINGS - 1):
            if line[j] <= 0 or line[j + 1] <= 0:
                break
            change = 1 / line[j + 1] - 1 / line[j]
            low, high = min(low, change), max(high, change)
        else:
            # All steps have one sign (else the bound is below 0), and are about equal.
            if high - low <= MAX_BEND_SHARE * max(low, -high):
                return True
    return False


def to_world(image: DepthImage, chosen: NDArray[np.bool_], factor: float = 1.0) -> DoubleArray:
    """(n, 3) float64 world coordinates of the chosen pixels, row by row, their depths times ``factor``."""
    camera = image.camera
    rows, columns = np.nonzero(chosen)
    z = image.depth[chosen] * np.float64(factor)  # along the axis; pixel centers at +0.5
    x, y = (columns + 0.5 - camera.cx) / camera.fx * z, (rows + 0.5 - camera.cy) / camera.fy * z
    rotation, center = camera.world_to_camera[:3, :3], camera.center
    return np.column_stack(
        [rotation[0, axis] * x + rotation[1, axis] * y + rotation[2, axis] * z + center[axis] for axis in range(3)]
    )


def _differences(images: Sequence[DepthImage], factor: float = 1.0) -> DoubleArray:
    """Relative differences between depths of some pixels and the depths that other images measured at the same places,
    all depths multiplied by ``factor``."""
    found = [np.zeros(0)]
    for index, image in enumerate(images):
        # About PIXELS_PER_VIEW measured pixels, evenly spread, each looked up in all other images.
        sampled = np.zeros(image.depth.shape, bool)
        rows = np.flatnonzero(image.depth)
        sampled.reshape(-1)[rows[:: 1 + len(rows) // PIXELS_PER_VIEW]] = True
        xyz = to_world(image, sampled, factor)
        for other in [*images[:index], *images[index + 1 :]]:
            pixel, depth = _seen(xyz, other.camera)
            measured = other.depth.reshape(-1)[pixel].astype(np.float64) * factor
            found.append(((measured - depth) / depth)[measured > 0])
    return np.concatenate(found)


def _seen(xyz: DoubleArray, camera: Camera) -> tuple[NDArray[np.intp], DoubleArray]:
    """Flat pixel indices and depths of the world points that fall into the image."""
    uv_px, depth = camera.project(xyz)
    inside = camera.shows(uv_px)
    column, row = uv_px[inside].astype(np.intp).T
    return row * camera.width + column, depth[inside]


def _judge(
    xyz: DoubleArray, origin: DoubleArray, frames: Sequence[DepthFrame], found: Survey
) -> tuple[NDArray[np.bool_], DoubleArray]:
    """(n,) bool, which points the views confirm, and (n, 3) their new positions. xyz: relative to the origin."""
    cv2 = require_cv2()
    votes, shift = np.zeros((len(xyz), 3), np.int32), np.zeros((len(xyz), 4))
    for frame in frames:
        image = frame.depth.read()
        camera = image.camera
        surface = np.where(_fusible(image, found), image.depth, np.float32(0))
        # A view looks through a point only if all pixels around it do: a thin thing half a pixel off is still there.
        nearest = np.asarray(cv2.erode(image.depth, np.ones((3, 3), np.uint8)), np.float32)
        seen_from = camera.world_to_camera[:3, :3], camera.center - origin, camera.intrinsics
        depths, limits = (image.depth, surface, nearest), (found.tolerance, found.depth)
        _add_votes(xyz, seen_from, depths, limits, votes, shift)
    confirmed, refuted, could_see = votes.T
    stays = (confirmed > refuted) & (confirmed >= np.where(could_see >= 3, 2, 1))
    return stays, xyz + shift[:, :3] / np.maximum(shift[:, 3:], np.finfo(np.float64).tiny)  # weight 0: shift 0


@njit(cache=True, parallel=True)
def _add_votes(xyz, seen_from, depths, limits, votes, shift):  # noqa: ANN001, ANN202
    """One view's votes on all points: confirmed, refuted, could see; and the weighted shift to its measured surface.

    seen_from: rotation to the camera, its center, and fx, fy, cx, cy. depths: (H, W) as measured; the same without
    flying pixels; the smallest of 3x3 pixels, 0 if one of them is unmeasured. limits: the tolerance, and the typical
    depth at which it holds.
    """
    rotation, center, (fx, fy, cx, cy) = seen_from
    (depth, surface, nearest), (tolerance, typical) = depths, limits
    height, width = depth.shape
    for i in prange(len(xyz)):
        x, y, z = xyz[i, 0] - center[0], xyz[i, 1] - center[1], xyz[i, 2] - center[2]
        along = rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z
        if along <= 0.0:
            continue
        column = np.floor((rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z) / along * fx + cx)
        row = np.floor((rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z) / along * fy + cy)
        if not (0 <= column < width and 0 <= row < height):
            continue
        v, u = int(row), int(column)
        # Noise and the width of pixels grow with depth.
        allowed = tolerance * max(1.0, along / typical)
        # The view could see the point if it measured nothing in front; it refutes it if all pixels around are behind.
        votes[i, 2] += depth[v, u] >= along - allowed
        votes[i, 1] += nearest[v, u] > along + allowed
        difference = surface[v, u] - along
        if surface[v, u] > 0 and abs(difference) <= allowed:
            votes[i, 0] += 1
            # (x, y, z) / along is the ray to depth 1, so that the point moves to the measured depth. Nearer views
            # measure better: weights are the inverse square of the depth.
            weight = 1.0 / (along * along)
            shift[i, 0] += weight * difference * x / along
            shift[i, 1] += weight * difference * y / along
            shift[i, 2] += weight * difference * z / along
            shift[i, 3] += weight


class _Voxels:
    """Mean position and color by voxel. _merged: the keys, ascending, and for each the sums of x, y, z, r, g, b and the
    number of points; _waiting: points not yet merged."""

    def __init__(self, edge: float) -> None:
        self._edge = edge
        self._merged = np.zeros(0, np.int64), np.zeros((0, 7))
        self._waiting: list[tuple[NDArray[np.int64], DoubleArray]] = []

    def add(self, xyz: DoubleArray, rgb: NDArray[Any], source: str) -> None:
        """xyz: (n, 3), within VOXELS_ACROSS / 2 voxels of 0. rgb: (n, 3). source: of the points, for the error."""
        farthest = float(np.abs(xyz).max(initial=0.0))
        if farthest >= (VOXELS_ACROSS // 2 - 1) * self._edge:
            raise SceneError(
                f"{source} has points {farthest:.3g} from the middle of the cameras, in voxels of {self._edge:.3g}; "
                f"expected fewer than {VOXELS_ACROSS // 2} voxels: check its pose and the depth unit"
            )
        # Indices from 0, 21 bits each, as one number.
        x, y, z = (np.floor(xyz / self._edge).astype(np.int64) + VOXELS_ACROSS // 2).T
        keys = (x * VOXELS_ACROSS + y) * VOXELS_ACROSS + z
        self._waiting.append((keys, np.column_stack([xyz, rgb, np.ones(len(xyz))])))
        # Merge only when as many points wait as are merged: a voxel is then sorted a few times, not once per frame.
        if sum(len(keys) for keys, _ in self._waiting) > len(self._merged[0]):
            self._merge()

    def means(self) -> tuple[DoubleArray, DoubleArray]:
        """(n, 3) positions and (n, 3) colors, in the order of the voxels."""
        self._merge()
        sums = self._merged[1]
        means = sums[:, :6] / sums[:, 6:]
        return means[:, :3], means[:, 3:]

    def _merge(self) -> None:
        keys, sums = zip(self._merged, *self._waiting, strict=True)
        self._merged, self._waiting = _summed(np.concatenate(keys), np.concatenate(sums)), []


def _summed(keys: NDArray[np.int64], rows: DoubleArray) -> tuple[NDArray[np.int64], DoubleArray]:
    """The keys that occur, ascending, and the sum of the rows of each, added in order."""
    unique, index = np.unique(keys, return_inverse=True)
    sums = [np.bincount(index, column, len(unique)) for column in rows.T]
    return unique, np.column_stack(sums).astype(np.float64, copy=False)


def doubtful_depth(frames: Sequence[DepthFrame]) -> str | None:
    """A warning, with the cure, where views agree clearly better with all depths in another unit, or agree in no unit;
    else None."""
    # Poses keep their unit, so that depths only agree in the right one.
    images, _ = _within_range(_measured(evenly(frames, CHECKED_VIEWS)))
    shares = {factor: np.nan_to_num(_agreement(images, factor)) for factor in (1.0, *UNIT_FACTORS)}
    best = max(UNIT_FACTORS, key=shares.__getitem__)
    if shares[best] <= shares[1.0] + MIN_UNIT_GAIN:
        return _disagreement(images, max(shares.values()))
    return (
        f"the views' depths agree in {shares[1.0]:.0%} of places, and in {shares[best]:.0%} if all depths are "
        f"multiplied by {best:g}: state the depth unit (og-pointcloud fuse --depth-unit, or integer_depth_scale in "
        "transforms.json)"
    )


def _disagreement(images: Sequence[DepthImage], share: float) -> str | None:
    """A warning where views overlap and agree in no unit. share: of depths that agree in the best unit."""
    roughly = _agreement(images, 1.0, SAME_SURFACE_SHARE)
    if share >= MIN_AGREEING_SHARE or not roughly < MIN_SAME_SURFACE_SHARE:  # also where no views overlap
        return None
    return (
        f"the views' depths agree in {share:.0%} of places, whatever the unit (correct depths agree in half of them): "
        "poses (axes, direction, order) or intrinsics are wrong, or the images contain something other than depths "
        "along the optical axis (lengths of rays, disparities, another frame's depths)"
    )


def _agreement(images: Sequence[DepthImage], factor: float, within: float = AGREEING_SHARE) -> float:
    """Share of depths that another view confirms if all are multiplied by ``factor``; NaN where no views overlap."""
    off = _differences(images, factor)
    return float((np.abs(off) < within).mean()) if len(off) else float("nan")
