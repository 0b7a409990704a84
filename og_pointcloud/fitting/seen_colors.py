"""Colors of points and of the pixels that they lie in -> the probability that each view sees each point.

Rays slip between points: a view then says of the ground below a car what its masks say of the car. But the pixel has
the car's color, the point the ground's. How much a color difference says (light, lens, noise, how well cloud and
photographs fit) varies by scene. So it is counted there, over all views: how often is a difference that large at points
that a view sees by geometry, and how often at points in the image that are hidden? With

    r    how many times likelier the difference is at seen points than at hidden ones
    p    the prior: SEEN_PRIOR times the exposure

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
    """For each point that a view shows, the rounded distance of its color from its pixel's, or NO_DIFFERENCE; and how
    often each distance occurs in the image, (2, 443): at shown points, weighted by exposure, and at hidden ones.

    columns: (k,) rows of the points that the view shows, ascending. exposure: (k,) theirs, in (0, 1].
    """
    image = view.image_rgb()
    if image is None or points.rgb is None:
        return np.full(len(columns), NO_DIFFERENCE, np.uint16), np.zeros((2, COLOR_DIFFERENCE_BINS))
    camera = view.camera
    return _compared(
        points.xyz, np.ascontiguousarray(points.rgb), np.ascontiguousarray(image), np.array(camera.intrinsics),
        camera.world_to_camera, near, columns, exposure,
    )  # fmt: skip


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
def _compared(xyz, rgb, image, intrinsics, pose, near, columns, exposure):  # noqa: ANN001, ANN202
    fx, fy, cx, cy = intrinsics
    height, width = image.shape[:2]
    difference, counts = np.full(len(columns), NO_DIFFERENCE, np.uint16), np.zeros((2, COLOR_DIFFERENCE_BINS))
    next_shown = 0
    for g in range(len(xyz)):
        is_shown = next_shown < len(columns) and columns[next_shown] == g
        next_shown += is_shown
        depth, x, y = depth_and_slopes(xyz[g, 0], xyz[g, 1], xyz[g, 2], pose)
        u, v = fx * x + cx, fy * y + cy
        if not (depth > near and 0 <= u < width and 0 <= v < height):
            continue
        pixel = image[int(v), int(u)]
        if pixel.max() == 0:  # black: the photograph shows nothing there, as beyond a lens's rim
            continue
        distance = color_difference(rgb[g], pixel)
        if not is_shown:
            counts[1, distance] += 1
            continue
        difference[next_shown - 1] = distance
        # In steps of 1/256 sums in float64 are exact: the order of points does not matter.
        counts[0, distance] += np.rint(256 * np.float64(exposure[next_shown - 1])) / 256
    return difference, counts


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
