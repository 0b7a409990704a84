"""Boxes around points, axis-aligned and oriented, and which points are strays that no box should include. numpy only.

The least upright box has one side flush with the points' outline seen from above (rotating calipers: Toussaint, 1983).
A free box starts at the principal axes; the same step is then taken about whichever of its axes gains most, repeatedly.

Every result depends on the set of points alone, not on their order or on how often one is repeated. Work is done in
float64 around the points' middle, so map coordinates of 1e6 cost no more than their own rounding.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from og_pointcloud.errors import SceneError
from og_pointcloud.formats.poses import quaternion_of, upright_axes
from og_pointcloud.scene import DoubleArray, numbers_of

LARGEST = 1e100
"""Volumes of boxes at larger coordinates would be no numbers."""
DIRECTIONS = 180
"""Directions around a circle along which the extreme points are taken as the corners of an outline."""
PRODUCTS_AT_ONCE = 1 << 20
"""Products of directions and points worked out side by side, which bounds the memory."""
THIN = 1e-6
"""Thickness, as a share of the diagonal, added to every side while volumes are compared: of two flat boxes, 0 x 2 x 3
is then smaller than 0 x 4 x 5."""
ROUNDING = 16 * float(np.finfo(np.float64).eps)
"""Share of a box's coordinates and size by which rounding may put the points that it was made from outside it."""
GAIN = 1e-9
"""A turned box counts as better only when it is smaller by more than this share."""
TURNS = 6
"""Turns of a free box at most."""

LINK = 2.0
"""Edge in spacings of the voxels that connect an instance's points."""
MAIN_PART = 0.05
"""Share of the points that a connected part needs to be no stray."""
MOST = 0.9
"""Share of the points that the main parts must hold; below it the points are taken to be sparse, and linked farther."""
WIDEST = 1 << 19
"""Most voxels on either side of the origin: a coordinate then fits the 21 bits that `_connected` gives it."""


@dataclass(frozen=True, eq=False)
class Box:
    """center: (3,) float64. size: (3,) float64, full lengths along the rows of axes. axes: (3, 3) float64, unit rows,
    right-handed. In the frame and unit of the points it was made from.

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
        """Product of the three lengths; 0 for flat things."""
        return float(np.prod(self.size))

    @cached_property
    def corners(self) -> DoubleArray:
        """(8, 3) float64; bit k of a corner's number says on which side of axis k it lies."""
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
        """(4,) unit quaternion, w >= 0, that turns the world's axes into the box's."""
        return quaternion_of(self.axes.T)

    def contains(self, points: ArrayLike, margin: float = 0.0) -> NDArray[np.bool_]:
        """(n,) bool, whether each of (n, 3) points lies inside, or outside by no more than margin along every axis; up
        to rounding, so that the points of a face are inside. SceneError for another shape."""
        from_center = _rows(points) - self.center
        slack = ROUNDING * (np.abs(self.center).max() + self.size.max())
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

    Its volume is within a few percent of the least there is as a rule; up to half more around a few scattered points.
    Of flat points, a small area; of points on a line, the line. up: (3,) direction that one axis has to have, where it
    is known: the box then stands upright, is the least one that does, and this axis is its third.
    SceneError for no points, for NaN or infinity, and for an up of length 0.

    A square that stands on its corner, by its four corners:

    >>> import og_pointcloud as og
    >>> og.oriented_box([[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]], up=(0, 0, 1)).size.round(3)
    array([1.414, 1.414, 0.   ])
    """
    return oriented_boxes([points], up)[0]


def oriented_boxes(clouds: Sequence[ArrayLike], up: ArrayLike | None = None) -> list[Box]:
    """`oriented_box` of each of many sets of points, in their order; those of few points are worked out together."""
    direction = None if up is None else unit_up(up)
    sets = [_distinct(_checked(points))[0] for points in clouds]
    boxes: list[Box | None] = [None] * len(sets)
    waiting = sorted(range(len(sets)), key=lambda k: len(sets[k]))  # alike in size, so that little is padded
    lengths = np.array([len(sets[k]) for k in waiting])
    while waiting:
        # As many as fit, all as long as the last of them; three turns of each are tried at once.
        products = 3 * DIRECTIONS * lengths * np.arange(1, len(waiting) + 1)
        count = max(1, int(np.searchsorted(products, PRODUCTS_AT_ONCE, side="right")))
        together, waiting, lengths = waiting[:count], waiting[count:], lengths[count:]
        for k, box in zip(together, _boxes_around([sets[k] for k in together], direction), strict=True):
            boxes[k] = box
    return [box for box in boxes if box is not None]


def _boxes_around(sets: Sequence[DoubleArray], up: DoubleArray | None) -> Iterator[Box]:
    """The box around each of some sets of distinct points (n, 3), n as alike as may be. up: of length 1, or None."""
    middles = [xyz.min(axis=0) + np.ptp(xyz, axis=0) / 2 for xyz in sets]
    centered = [xyz - middle for xyz, middle in zip(sets, middles, strict=True)]
    # A repeated point changes no extent: all sets become as long as the longest.
    rows = np.arange(max(map(len, sets)))
    padded = np.stack([local[np.minimum(rows, len(local) - 1)] for local in centered])
    if up is None:
        all_axes = _least_volume(padded, np.stack([_principal_axes(local) for local in centered]))
    else:
        all_axes = _turned_about(padded, np.broadcast_to(upright_axes(up), (len(sets), 3, 3)))
    for local, middle, axes in zip(centered, middles, all_axes, strict=True):
        along = local @ axes.T
        low, high = along.min(axis=0), along.max(axis=0)
        if up is None:
            order = np.argsort(-(high - low), kind="stable")
            axes, low, high = axes[order], low[order], high[order]
        axes = _right_handed(axes, keep_third=up is not None)
        # A reversed axis keeps the length along it, but not where it begins.
        center = (local @ axes.T).min(axis=0) + (high - low) / 2
        yield Box(middle + center @ axes, high - low, axes)


def main_part(points: ArrayLike, spacing: float) -> NDArray[np.bool_]:
    """(n,) bool, the points (n, 3) of an object that are not strays; at least nine tenths of them.

    Points are linked through neighboring voxels, and a connected part counts where it holds a twentieth of the points.
    If such parts hold less than nine tenths, points lie wider apart than thought, and voxels twice as large are tried.
    What floats alone is thus left out, and so is a speck of another object; fewer than 20 points all count.

    spacing: typical distance between neighboring points.
    """
    xyz = _checked(points)
    distinct, which = _distinct(xyz)
    # Among so few points a single one is already MAIN_PART of them.
    if MAIN_PART * len(distinct) <= 1:
        return np.ones(len(xyz), bool)
    local = distinct - distinct.mean(axis=0)
    # Voxels lie along the principal axes, so that a turned object loses the same points.
    local = local @ _principal_axes(local).T
    extent = float(np.ptp(local, axis=0).max())
    edge = LINK * spacing
    # Voxels as large as the whole all touch: nothing is a stray then.
    while edge < extent:
        part = _connected(np.floor(local / max(edge, extent / WIDEST)).astype(np.int64))
        held = np.bincount(part)
        main = (held > MAIN_PART * len(local))[part]
        if main.mean() >= MOST:
            return main[which]
        edge *= 2
    return np.ones(len(xyz), bool)


def _checked(points: ArrayLike) -> DoubleArray:
    xyz = _rows(points, fewest=1)
    if not (np.abs(xyz) <= LARGEST).all():  # NaN is not
        raise SceneError(
            f"points hold NaN, infinity or more than {LARGEST:g}; expected finite coordinates: leave those points out"
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
    # By the largest part first: its square neither underflows nor overflows.
    direction = direction / np.abs(direction).max()
    return direction / np.linalg.norm(direction)


def _distinct(xyz: DoubleArray) -> tuple[DoubleArray, NDArray[np.int64]]:
    """Each place once, sorted, so that sums do not depend on the order given; and (n,) which place each point has."""
    order = np.lexsort(xyz.T)
    rows = xyz[order]
    new = np.append(True, (rows[1:] != rows[:-1]).any(axis=1))
    which = np.empty(len(xyz), np.int64)
    which[order] = np.cumsum(new) - 1
    return rows[new], which


def _principal_axes(local: DoubleArray) -> DoubleArray:
    """(3, 3) orthonormal rows, the widest direction first; signs by the third moment, so that they turn with points."""
    centered = local - local.mean(axis=0)
    # eigh sorts by rising eigenvalue and leaves each sign to chance.
    axes = np.asarray(np.linalg.eigh(centered.T @ centered)[1], np.float64).T[::-1]
    skew = ((centered @ axes.T) ** 3).sum(axis=0)
    return np.where(skew < 0, -1.0, 1.0)[:, None] * axes


def _right_handed(axes: DoubleArray, keep_third: bool) -> DoubleArray:
    """First and third axis, unless that is kept, with their largest component positive; the second is their product."""
    signs = np.sign(axes[np.arange(3), np.abs(axes).argmax(axis=1)])
    first, third = signs[0] * axes[0], axes[2] * (1 if keep_third else signs[2])
    return np.asarray([first, np.cross(third, first), third], np.float64)


# The oriented box -------------------------------------------------------------------------------------------------


def _least_volume(local: DoubleArray, axes: DoubleArray) -> DoubleArray:
    """(k, 3, 3) axes, as rows, of a small box around each of k sets of points (k, n, 3) near the origin. axes: (k, 3,
    3), those to begin with."""
    axes, thickness = axes.copy(), THIN * np.linalg.norm(np.ptp(local, axis=1), axis=1)

    def volumes(sets: NDArray[np.intp], axes: DoubleArray) -> DoubleArray:
        along = axes @ local[sets].swapaxes(1, 2)
        return (along.max(axis=2) - along.min(axis=2) + thickness[sets, None]).prod(axis=1)

    going = np.arange(len(local))
    least = volumes(going, axes)
    for _ in range(TURNS):
        each = np.repeat(going, 3)
        turned = _turned_about(local[each], axes[going][:, _EACH_THIRD].reshape(-1, 3, 3))
        of_turned = volumes(each, turned).reshape(-1, 3)
        best = of_turned.argmin(axis=1) + 3 * np.arange(len(going))
        # A box that is no smaller is not worth an odd orientation.
        smaller = of_turned.ravel()[best] < (1 - GAIN) * least[going]
        going, best = going[smaller], best[smaller]
        axes[going], least[going] = turned[best], of_turned.ravel()[best]
        if not len(going):
            break
    return axes


def _turned_about(local: DoubleArray, axes: DoubleArray) -> DoubleArray:
    """(k, 3, 3) axes, each three turned about their third one so that their rectangle around their set of points, of
    (k, n, 3), has the least area."""
    flat = axes[:, :2] @ local.swapaxes(1, 2)  # (k, 2, n)
    # The farthest points along directions in order are corners of the convex hull in order.
    # They lie half a step off the axes: of a side that is flush already rounding alone would say which end is farthest.
    at_once = max(1, PRODUCTS_AT_ONCE // flat[:, 0].size)
    parts = (_AROUND[start : start + at_once] for start in range(0, DIRECTIONS, at_once))
    farthest = np.concatenate([(part @ flat).argmax(axis=2) for part in parts], axis=1)
    corners = np.take_along_axis(flat, farthest[:, None], axis=2)
    sides = np.roll(corners, -1, axis=2) - corners
    lengths = np.hypot(sides[:, 0], sides[:, 1])
    # Sides without length, of directions with one farthest point, go behind the others.
    order = np.argsort(lengths == 0, axis=1, kind="stable")[:, : max(1, int((lengths > 0).sum(axis=1).max()))]
    corners, sides = (np.take_along_axis(of, order[:, None], axis=2) for of in (corners, sides))
    lengths = np.take_along_axis(lengths, order, axis=1)
    # The least rectangle is flush with a side of the hull (Toussaint): one candidate a side.
    along = sides / np.where(lengths > 0, lengths, 1)[:, None]
    across = np.stack([-along[:, 1], along[:, 0]], axis=1)
    thickness = THIN * np.linalg.norm(np.ptp(corners, axis=2), axis=1)[:, None]
    extents = (direction.swapaxes(1, 2) @ corners for direction in (along, across))
    first, second = (extent.max(axis=2) - extent.min(axis=2) + thickness for extent in extents)
    best = np.arange(len(axes)), slice(None), np.where(lengths > 0, first * second, np.inf).argmin(axis=1)
    turned = np.stack([along[best], across[best]], axis=1) @ axes[:, :2]
    some = lengths[:, :1, None] > 0  # points at one place have no side
    return np.concatenate([np.where(some, turned, axes[:, :2]), axes[:, 2:]], axis=1)


# Strays -----------------------------------------------------------------------------------------------------------


def _connected(voxel: NDArray[np.int64]) -> NDArray[np.int64]:
    """(n,) number of the connected part that each voxel (n, 3) belongs to; touching at a corner connects."""
    # One number a voxel, 21 bits a coordinate: coordinates lie within +-WIDEST, and 1 << 20 makes them positive.
    keys, which = np.unique((voxel + (1 << 20)) @ np.array([1 << 42, 1 << 21, 1]), return_inverse=True)
    part = np.arange(len(keys))  # a forest: each voxel points at one of its part, a root at itself
    wanted = keys + _HALF_OF_26
    place = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
    there = keys[place] == wanted
    first, second = np.nonzero(there)[1], place[there]
    while True:
        a, b = part[first], part[second]
        apart = a != b
        if not apart.any():
            return np.unique(part, return_inverse=True)[1].ravel()[which.ravel()]
        # Union-find on all pairs at once: each larger root is hung below a smaller one, then all move up to their root.
        np.minimum.at(part, np.maximum(a, b)[apart], np.minimum(a, b)[apart])
        while (part != part[part]).any():
            part = part[part]


_ANGLES = (np.arange(DIRECTIONS) + 0.5) * 2 * np.pi / DIRECTIONS
_AROUND = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=1)
"""(DIRECTIONS, 2) unit vectors."""
_EACH_THIRD = [[-shift, 1 - shift, 2 - shift] for shift in range(3)]
"""Three axes in turn, each once the third."""
_HALF_OF_26 = np.array(
    [(x << 42) + (y << 21) + z for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if (x, y, z) > (0, 0, 0)]
)[:, None]
"""(13, 1) key differences of neighboring voxels, one of each opposite pair."""
