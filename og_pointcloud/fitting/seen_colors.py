"""Colors of points and of the pixels that they lie in -> the probability that each view sees each point.

Rays slip between points: a view then says of the ground below a car what its masks say of the car. But the pixel has
the car's color, the point the ground's. How much a color difference says (light, lens, noise, how well cloud and
photographs fit) varies by scene. So it is counted there, over all views: how often is a difference that large at points
that a view sees by geometry, and how often at points in the image that are hidden? Cameras adjust exposure and white
balance from one photograph to the next, which says nothing about points: pixels are compared without the factor by
which each channel of their photograph is brighter than the points that it shows. With

    r    how many times likelier the difference is at seen points than at hidden ones
    p    the prior: SEEN_PRIOR times the point's exposure, its openness to the view

the posterior that the view sees the point is p r / (p r + 1 - p), and becomes its exposure. How masks overlap is
measured by geometry alone, on many points each: what is removed from the exposure is kept for it (`MaskTable.doubted`).
Without photographs, or without colors of points, nothing changes.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from og_pointcloud.errors import SceneError
from og_pointcloud.fitting.colors import COLOR_DIFFERENCE_BINS, color_difference, likelihood_ratios
from og_pointcloud.fitting.mask_table import MaskTable
from og_pointcloud.fitting.memory import scratch_like
from og_pointcloud.journal import Journal, with_bar
from og_pointcloud.kernels import get_num_threads, njit
from og_pointcloud.rendering.splatting import depth_and_slopes
from og_pointcloud.scene import Points, View

SEEN_PRIOR = 0.5
"""Probability, before colors, that a view sees a point that is open by geometry: half of what seems open may be
hidden."""
GAIN_STEP, MAX_GAIN_STEPS = 0.005, 300
"""Gains are found in steps of half a percent, between 1/4.5 and 4.5."""
GAIN_PRIOR = 30 * 128.0
"""Pseudo-weight of a gain of 1, as of 30 points of middle brightness: of a few points, hidden ones may be many. 0 and
ten times as much label scenes within 0.0005 mIoU of it."""
NO_DIFFERENCE = COLOR_DIFFERENCE_BINS
"""Stands for a missing difference: the view has no photograph, or the point is not in it."""

Doubles = NDArray[np.float64]


def doubted_by_color(
    table: MaskTable, points: Points, views: Sequence[View], near: float, journal: Journal | None = None
) -> MaskTable:
    """The table with exposures weighted by color evidence. It replaces the given one, whose exposure is overwritten.
    points, views: what it was made from. near: depth of the near plane, scene units. journal: of the fit; gets a
    warning about photographs that cannot be read."""
    if points.rgb is None or all(view.image is None for view in views):
        return table
    journal = journal or Journal(progress=False)
    start, columns, exposure = table.exposure.indptr, table.exposure.indices, table.exposure.data
    difference = scratch_like(exposure, np.uint16)

    def compare(row: int) -> tuple[Doubles, str]:
        entries = slice(start[row], start[row + 1])
        view, fault = with_photograph(views[row])
        difference[entries], counts = differences(points, view, near, columns[entries], exposure[entries])
        return counts, fault

    with ThreadPoolExecutor(get_num_threads()) as pool:
        compared = with_bar(pool.map(compare, range(len(views))), "colors", len(views), journal.progress)
        counts, faults = zip(*compared, strict=True)
    warn_of_faults(faults, journal)
    return with_color_evidence(table, difference, sight_ratios(np.sum(counts, axis=0)))


def differences(
    points: Points, view: View, near: float, columns: NDArray[np.int32], exposure: NDArray[np.float32]
) -> tuple[NDArray[np.uint16], Doubles]:
    """For each point that a view shows, the rounded distance of its color from its pixel's (without the photograph's
    gains), or NO_DIFFERENCE; and how often each distance occurs in the image, (2, 443): at shown points, weighted by
    exposure, and at hidden ones.

    columns: (k,) rows of the points that the view shows, ascending. exposure: (k,) theirs, in (0, 1].
    """
    image = view.image_rgb()
    if image is None or points.rgb is None:
        return np.full(len(columns), NO_DIFFERENCE, np.uint16), np.zeros((2, COLOR_DIFFERENCE_BINS))
    camera, rgb, image = view.camera, np.ascontiguousarray(points.rgb), np.ascontiguousarray(image)
    pixels = _pixels(points.xyz, image, np.array(camera.intrinsics), camera.world_to_camera, near)
    gains = _gains(rgb, image, pixels, columns, exposure)
    evened = np.minimum(np.arange(256) / gains[:, None], 255)
    return _compared(rgb, image, evened, pixels, columns, exposure)


def with_photograph(view: View) -> tuple[View, str]:
    """The view with its photograph read, or without it if that fails; and what is wrong with it, else ""."""
    try:
        return replace(view, image=view.image_rgb()), ""
    except SceneError as error:
        return replace(view, image=None), str(error)


def warn_of_faults(faults: Sequence[str], journal: Journal) -> None:
    """faults: of each view, from `with_photograph`. The checks of a capture read some photographs only."""
    if found := [fault for fault in faults if fault]:
        journal.warnings.append(f"photographs of {len(found)} of {len(faults)} views cannot be read: {found[0]}")


@njit(cache=True, nogil=True, error_model="numpy")
def _pixels(xyz, image, intrinsics, pose, near):  # noqa: ANN001, ANN202
    """(n, 2) int32: row and column of each point's pixel; -1 where the image shows nothing of it."""
    fx, fy, cx, cy = intrinsics
    height, width = image.shape[:2]
    pixels = np.full((len(xyz), 2), -1, np.int32)
    for g in range(len(xyz)):
        depth, x, y = depth_and_slopes(xyz[g, 0], xyz[g, 1], xyz[g, 2], pose)
        u, v = fx * x + cx, fy * y + cy
        # Black: the photograph shows nothing there, as beyond a lens's rim.
        if depth > near and 0 <= u < width and 0 <= v < height and image[int(v), int(u)].max() > 0:
            pixels[g] = int(v), int(u)
    return pixels


@njit(cache=True, nogil=True, error_model="numpy")
def _gains(rgb, image, pixels, columns, exposure):  # noqa: ANN001, ANN202
    """(3,) of each channel the gain with the least sum of |pixel - gain point|, weighted by exposure: the median of
    pixel / point, weighted by exposure and brightness. Hidden points among those shown hardly move it."""
    weight = np.zeros((3, 2 * MAX_GAIN_STEPS + 1))
    weight[:, MAX_GAIN_STEPS] = GAIN_PRIOR
    for e, g in enumerate(columns):
        v, u = pixels[g]
        for channel in range(3 if v >= 0 else 0):
            point, pixel = np.float64(rgb[g, channel]), np.float64(image[v, u, channel])
            if point > 0:
                step = np.rint(np.log(max(pixel, 0.5) / point) / GAIN_STEP)
                place = MAX_GAIN_STEPS + int(min(max(step, -MAX_GAIN_STEPS), MAX_GAIN_STEPS))
                weight[channel, place] += _in_256ths(exposure[e]) * point
    gains = np.empty(3)
    for channel in range(3):
        total = np.cumsum(weight[channel])
        gains[channel] = np.exp(GAIN_STEP * (np.searchsorted(total, total[-1] / 2) - MAX_GAIN_STEPS))
    return gains


@njit(cache=True, nogil=True, error_model="numpy")
def _compared(rgb, image, evened, pixels, columns, exposure):  # noqa: ANN001, ANN202
    """`differences`. evened: (3, 256) the levels of each channel without its gain."""
    difference, counts = np.full(len(columns), NO_DIFFERENCE, np.uint16), np.zeros((2, COLOR_DIFFERENCE_BINS))
    next_shown, color = 0, np.empty(3)
    for g in range(len(rgb)):
        is_shown = next_shown < len(columns) and columns[next_shown] == g
        next_shown += is_shown
        v, u = pixels[g]
        if v < 0:
            continue
        for channel in range(3):
            color[channel] = evened[channel, image[v, u, channel]]
        distance = color_difference(rgb[g], color)
        if not is_shown:
            counts[1, distance] += 1
            continue
        difference[next_shown - 1] = distance
        counts[0, distance] += _in_256ths(exposure[next_shown - 1])
    return difference, counts


@njit(cache=True)
def _in_256ths(exposure):  # noqa: ANN001, ANN202
    """In steps of 1/256 sums in float64 are exact: the order of points does not matter."""
    return np.rint(256 * np.float64(exposure)) / 256


def sight_ratios(counts: Doubles) -> NDArray[np.float32]:
    """(443 + 1,) how many times likelier each difference is at points that a view sees than at hidden ones; 1 for
    NO_DIFFERENCE. counts: of `differences`, summed over all views."""
    return np.append(likelihood_ratios(*counts), np.float32(1))


def with_color_evidence(table: MaskTable, difference: NDArray[np.uint16], ratios: NDArray[np.float32]) -> MaskTable:
    """The table with each exposure replaced by its posterior given the color; the rest is doubted. In place.

    difference: of each entry of the exposure. ratios: from `sight_ratios`.
    """
    if (ratios == 1).all():
        return table
    exposure, holes = table.exposure, table.doubted
    if holes is None:
        holes = csr_array(exposure.shape, dtype=np.float32)
    removed = scratch_like(exposure.data, np.float32)
    _apply_color_evidence(
        *((matrix.indptr, matrix.indices, matrix.data) for matrix in (exposure, holes)), difference, ratios, removed
    )
    # The same rows and columns, which are not copied.
    return replace(table, doubted=csr_array((removed, exposure.indices, exposure.indptr), shape=exposure.shape))


@njit(cache=True)
def _apply_color_evidence(exposure, holes, difference, ratios, removed):  # noqa: ANN001, ANN202
    """Writes to ``removed`` all that holes and colors take from each exposure; below 0 where colors raise it. Columns
    ascend in each row, and what came through holes is still exposed a little."""
    (start, column, exposed), (hole_start, hole_column, through) = exposure, holes
    for row in range(len(start) - 1):
        hole = hole_start[row]
        for e in range(start[row], start[row + 1]):
            p, r = SEEN_PRIOR * np.float64(exposed[e]), np.float64(ratios[difference[e]])
            seen = np.float32(p * r / (p * r + 1 - p))
            removed[e], exposed[e] = exposed[e] - seen, seen
            while hole < hole_start[row + 1] and hole_column[hole] < column[e]:
                hole += 1
            if hole < hole_start[row + 1] and hole_column[hole] == column[e]:
                removed[e] += through[hole]
