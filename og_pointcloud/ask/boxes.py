"""Bounding boxes of points, axis-aligned and oriented, and the stray points that no box should include. numpy only.

The smallest upright box has a side flush with the points' outline seen from above (rotating calipers: Toussaint, 1983).
A box without an up direction starts at the principal axes; the same step is then repeated about the axis that gains
most.

Results depend on the set of points alone, not on their order or on duplicates. Computed in float64 relative to the
points' middle, so map coordinates of 1e6 lose no more than their own rounding.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from og_pointcloud.errors import SceneError
from og_pointcloud.formats.poses import quaternion_of, upright_axes
from og_pointcloud.scene import DoubleArray, numbers_of

MAX_COORDINATE = 1e100
"""The volume of a box with larger coordinates would overflow."""
HULL_DIRECTIONS = 180
"""Directions around a circle; the extreme points along them are the corners of the outline."""
MAX_PRODUCTS = 1 << 20
"""Dot products of directions and points computed at once, which bounds the memory."""
MIN_THICKNESS_SHARE = 1e-6
"""Thickness, as a share of the diagonal, added to every side when volumes are compared, so that a flat box of
0 x 2 x 3 is smaller than one of 0 x 4 x 5."""
ROUNDING_SHARE = 16 * float(np.finfo(np.float64).eps)
"""Share of a box's coordinates and size by which rounding may push its own points outside."""
MIN_GAIN_SHARE = 1e-9
"""A rotated box is taken only when its volume is smaller by more than this share."""
MAX_TURNS = 6
"""Rotations of a box without an up direction."""

LINK_SPACINGS = 2.0
"""Edge, in point spacings, of the voxels that connect an instance's points."""
MIN_PART_SHARE = 0.05
"""A connected part with at most this share of the points is stray."""
MIN_MAIN_SHARE = 0.9
"""Share of the points that the main parts must hold; below it the cloud is taken to be sparse, and voxels double."""
MAX_VOXEL = 1 << 19
"""Largest absolute voxel coordinate: it then fits the 21 bits that `_connected` gives it."""


@dataclass(frozen=True, eq=False)
class Box:
    """A box in the frame and unit of its points. center: (3,) float64. size: (3,) float64, full lengths along the rows
    of axes. axes: (3, 3) float64, orthonormal rows, right-handed.

    >>> import og_pointcloud as og
    >>> box = og.axis_aligned_box([[0, 0, 0], [2, 1, 4]])
    >>> box.volume, box.contains([[1, 1, 1], [3, 0, 0]])
    (8.0, array([ True, False]))
    """

    center: DoubleArray
    size: DoubleArray
    axes: DoubleArray

    @property
    def volume(self) -> float:
        """Product of the three lengths; 0 for a flat box."""
        return float(np.prod(self.size))

    @cached_property
    def corners(self) -> DoubleArray:
        """(8, 3) float64; bit k of a corner's index tells its side along axis k."""
        sides = (np.arange(8)[:, None] >> np.arange(3) & 1) - 0.5
        return self.center + (sides * self.size) @ self.axes

    @property
    def low(self) -> DoubleArray:
        """(3,) smallest coordinates of the corners."""
        return self.corners.min(axis=0)

    @property
    def high(self) -> DoubleArray:
        """(3,) largest coordinates of the corners."""
        return self.corners.max(axis=0)

    @property
    def rotation_wxyz(self) -> DoubleArray:
        """(4,) unit quaternion, w >= 0, that rotates the world's axes onto the box's."""
        return quaternion_of(self.axes.T)

    def contains(self, points: ArrayLike, margin: float = 0.0) -> NDArray[np.bool_]:
        """(n,) bool, whether each of the points (n, 3) lies inside, or at most margin outside along every axis. Points
        on a face are inside, up to rounding. SceneError for another shape."""
        from_center = _rows(points) - self.center
        slack = ROUNDING_SHARE * (np.abs(self.center).max() + self.size.max())
        return (np.abs(from_center @ self.axes.T) <= self.size / 2 + (margin + slack)).all(axis=1)

    def to_dict(self) -> dict[str, Any]:
        """JSON-able: center, size, axes, rotation_wxyz, volume."""
        names = ("center", "size", "axes", "rotation_wxyz")
        return {**{name: getattr(self, name).tolist() for name in names}, "volume": self.volume}


def axis_aligned_box(points: ArrayLike) -> Box:
    """The smallest box along the coordinate axes that holds all points (n, 3), n >= 1. SceneError as `oriented_box`.

    >>> import og_pointcloud as og
    >>> og.axis_aligned_box([[0, 0, 0], [2, 1, 4]]).center
    array([1. , 0.5, 2. ])
    """
    xyz = _checked(points)
    low, high = xyz.min(axis=0), xyz.max(axis=0)
    return Box(low + (high - low) / 2, high - low, np.eye(3))


def oriented_box(points: ArrayLike, up: ArrayLike | None = None) -> Box:
    """A small box that holds all points (n, 3), n >= 1; axes by falling length.

    Its volume is usually within a few percent of the minimum; up to half more around a few scattered points. Around
    flat points its area is small; points on a line give the line. up: (3,) direction that the third axis must have, if
    known: the result is then the smallest upright box.
    SceneError for no points, for NaN or infinity, and for an up of length 0.

    A square standing on its corner, given by its four corners:

    >>> import og_pointcloud as og
    >>> og.oriented_box([[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]], up=(0, 0, 1)).size.round(3)
    array([1.414, 1.414, 0.   ])
    """
    xyz = _distinct(_checked(points))[0]
    middle = xyz.min(axis=0) + np.ptp(xyz, axis=0) / 2
    local = xyz - middle
    if up is None:
        axes = _least_volume(local, _principal_axes(local))
        axes = axes[np.argsort(-np.ptp(local @ axes.T, axis=0), kind="stable")]
    else:
        axes = _rotated_about_third(local, upright_axes(unit_up(up)))
    size = np.ptp(local @ axes.T, axis=0)
    axes = _right_handed(axes, keep_third=up is not None)
    # A reversed axis keeps the length along it, but not where it begins.
    center = (local @ axes.T).min(axis=0) + size / 2
    return Box(middle + center @ axes, size, axes)


def main_part(points: ArrayLike, spacing: float) -> NDArray[np.bool_]:
    """(n,) bool, the points (n, 3) of an object that are not strays; at least nine tenths of them.

    Points in touching voxels are connected, and a connected part is kept if it holds more than a twentieth of the
    points. If such parts hold less than nine tenths, the cloud is sparser than assumed, and the voxel edge doubles.
    This removes floaters and specks of other objects; of 20 points or fewer, all are kept.

    spacing: typical distance between neighboring points.
    """
    xyz = _checked(points)
    distinct, which = _distinct(xyz)
    # Among so few points a single one already has MIN_PART_SHARE.
    if MIN_PART_SHARE * len(distinct) <= 1:
        return np.ones(len(xyz), bool)
    local = distinct - distinct.mean(axis=0)
    # Voxels are aligned with the principal axes, so that a rotated object loses the same points.
    local = local @ _principal_axes(local).T
    extent = float(np.ptp(local, axis=0).max())
    edge = LINK_SPACINGS * spacing
    # Voxels as large as the object all touch: nothing is stray then.
    while edge < extent:
        part = _connected(np.floor(local / max(edge, extent / MAX_VOXEL)).astype(np.int64))
        part_points = np.bincount(part)
        main = (part_points > MIN_PART_SHARE * len(local))[part]
        if main.mean() >= MIN_MAIN_SHARE:
            return main[which]
        edge *= 2
    return np.ones(len(xyz), bool)


def _checked(points: ArrayLike) -> DoubleArray:
    xyz = _rows(points, fewest=1)
    if not (np.abs(xyz) <= MAX_COORDINATE).all():  # false for NaN
        raise SceneError(
            f"points contain NaN, infinity or values above {MAX_COORDINATE:g}; expected finite coordinates: leave "
            "those points out"
        )
    return xyz


def _rows(points: ArrayLike, fewest: int = 0) -> DoubleArray:
    given = numbers_of(points)
    if given.ndim != 2 or given.shape[1] != 3 or len(given) < fewest or given.dtype.kind not in "fiu":
        at_least = ", at least one point, for a box" * fewest
        raise SceneError(f"points are {given.dtype} of shape {given.shape}; expected numbers (n, 3){at_least}")
    return given.astype(np.float64)


def unit_up(up: ArrayLike) -> DoubleArray:
    """An upward direction (3,) at unit length. SceneError for anything but three finite numbers that are not all 0."""
    direction = numbers_of(up)
    is_vector = direction.shape == (3,) and direction.dtype.kind in "fiu"
    if not is_vector or not np.isfinite(direction).all() or not direction.any():
        raise SceneError(f"up is {up}; expected a direction of three numbers, not all 0, e.g. (0, 0, 1)")
    # Divided by the largest component first, so that no square underflows or overflows.
    direction = direction / np.abs(direction).max()
    return direction / np.linalg.norm(direction)


def _distinct(xyz: DoubleArray) -> tuple[DoubleArray, NDArray[np.int64]]:
    """Distinct points, sorted so that sums do not depend on the given order; and (n,) each point's index among them."""
    order = np.lexsort(xyz.T)
    rows = xyz[order]
    new = np.append(True, (rows[1:] != rows[:-1]).any(axis=1))
    which = np.empty(len(xyz), np.int64)
    which[order] = np.cumsum(new) - 1
    return rows[new], which


def _principal_axes(local: DoubleArray) -> DoubleArray:
    """(3, 3) orthonormal rows, widest direction first; signs by the third moment, so that they rotate with points."""
    centered = local - local.mean(axis=0)
    # eigh sorts by rising eigenvalue and leaves each sign arbitrary.
    axes = np.asarray(np.linalg.eigh(centered.T @ centered)[1], np.float64).T[::-1]
    skew = ((centered @ axes.T) ** 3).sum(axis=0)
    return np.where(skew < 0, -1.0, 1.0)[:, None] * axes


def _right_handed(axes: DoubleArray, keep_third: bool) -> DoubleArray:
    """The first axis, and the third unless it is kept, with a positive largest component; the second completes them."""
    signs = np.sign(axes[np.arange(3), np.abs(axes).argmax(axis=1)])
    first, third = signs[0] * axes[0], axes[2] * (1 if keep_third else signs[2])
    return np.asarray([first, np.cross(third, first), third], np.float64)


# The oriented box -------------------------------------------------------------------------------------------------


def _least_volume(local: DoubleArray, axes: DoubleArray) -> DoubleArray:
    """(3, 3) axes, as rows, of a small box around points (n, 3) near the origin. axes: (3, 3), the initial ones."""
    thickness = MIN_THICKNESS_SHARE * np.linalg.norm(np.ptp(local, axis=0))

    def volume(axes: DoubleArray) -> float:
        return float((np.ptp(axes @ local.T, axis=1) + thickness).prod())

    smallest = volume(axes)
    for _ in range(MAX_TURNS):
        rotated = [_rotated_about_third(local, axes[cycle]) for cycle in _AXIS_CYCLES]
        volumes = [volume(each) for each in rotated]
        # A box that is no smaller is not worth an odd orientation.
        if not min(volumes) < (1 - MIN_GAIN_SHARE) * smallest:
            break
        smallest = min(volumes)
        axes = rotated[volumes.index(smallest)]
    return axes


def _rotated_about_third(local: DoubleArray, axes: DoubleArray) -> DoubleArray:
    """(3, 3) axes, rotated about the third so that the rectangle of the first two around the points (n, 3) has the
    smallest area."""
    flat = axes[:2] @ local.T
    # The farthest points along successive directions are successive corners of the convex hull. Directions lie half a
    # step off the axes: at a side that is already flush, rounding alone would decide which end is farthest.
    at_once = max(1, MAX_PRODUCTS // len(local))
    parts = [_CIRCLE[start : start + at_once] for start in range(0, HULL_DIRECTIONS, at_once)]
    farthest = np.concatenate([(part @ flat).argmax(axis=1) for part in parts])
    corners = flat[:, farthest]
    sides = flat[:, np.roll(farthest, -1)] - corners
    lengths = np.hypot(*sides)
    # Between directions with the same farthest point there is no side; coincident points have none at all.
    is_side = lengths > 0
    if not is_side.any():
        return axes
    corners, along = corners[:, is_side], sides[:, is_side] / lengths[is_side]
    # The smallest rectangle is flush with a side of the hull (Toussaint): one candidate per side.
    across = along[::-1] * [[-1], [1]]
    thickness = MIN_THICKNESS_SHARE * np.linalg.norm(np.ptp(corners, axis=1))
    areas = (np.ptp(along.T @ corners, axis=1) + thickness) * (np.ptp(across.T @ corners, axis=1) + thickness)
    best = areas.argmin()
    return np.concatenate([np.array([along[:, best], across[:, best]]) @ axes[:2], axes[2:]])


# Strays -----------------------------------------------------------------------------------------------------------


def _connected(voxel: NDArray[np.int64]) -> NDArray[np.int64]:
    """(n,) index of the connected part of each voxel (n, 3); voxels that touch at a corner are connected."""
    # One key per voxel, 21 bits per coordinate: coordinates lie within +-MAX_VOXEL, and 1 << 20 makes them positive.
    keys, which = np.unique((voxel + (1 << 20)) @ np.array([1 << 42, 1 << 21, 1]), return_inverse=True)
    part = np.arange(len(keys))  # a forest: each voxel points at another of its part, a root at itself
    neighbor_keys = keys + _NEIGHBOR_KEYS
    index = np.minimum(np.searchsorted(keys, neighbor_keys), len(keys) - 1)
    exists = keys[index] == neighbor_keys
    first, second = np.nonzero(exists)[1], index[exists]
    while True:
        a, b = part[first], part[second]
        separate = a != b
        if not separate.any():
            return np.unique(part, return_inverse=True)[1].ravel()[which.ravel()]
        # Union-find on all pairs at once: each larger root is hung below a smaller one, then all move up to their root.
        np.minimum.at(part, np.maximum(a, b)[separate], np.minimum(a, b)[separate])
        while (part != part[part]).any():
            part = part[part]


_ANGLES = (np.arange(HULL_DIRECTIONS) + 0.5) * 2 * np.pi / HULL_DIRECTIONS
_CIRCLE = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=1)
"""(HULL_DIRECTIONS, 2) unit vectors."""
_AXIS_CYCLES = [[-shift, 1 - shift, 2 - shift] for shift in range(3)]
"""Cyclic permutations of three axes: each axis is once the third."""
_NEIGHBOR_KEYS = np.array(
    [(x << 42) + (y << 21) + z for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if (x, y, z) > (0, 0, 0)]
)[:, None]
"""(13, 1) key offsets of neighboring voxels, one of each opposite pair."""
