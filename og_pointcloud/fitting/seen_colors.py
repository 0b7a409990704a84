"""Colors of points and of the pixels that they lie in -> how far a view's word on each point is believed.

Rays slip between points: a view then says of the ground below a car what its masks say of the car. But the pixel has
the car's color, the point the ground's. How much a difference of color says (light, lens, noise, how well cloud and
photographs fit) is another in every scene. So it is counted there, over all views: how often is it as large at points
that geometry lets a view see, and how often at points in the image that it hides? With

    r    how many times likelier the difference is at seen points than at hidden ones
    p    the chance before colors are asked: OPEN_IS_SEEN of the exposure

the chance that the view sees the point is p r / (p r + 1 - p), and its exposure becomes that. What masks have in common
is told by geometry alone, by many points each: what is taken from the exposure stays beside it (`MaskTable.doubted`).
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
from og_pointcloud.fitting.colors import DIFFERENCES, color_difference, likelihood_ratios
from og_pointcloud.fitting.mask_table import MaskTable
from og_pointcloud.fitting.memory import scratch_like
from og_pointcloud.journal import Journal, with_bar
from og_pointcloud.kernels import get_num_threads, njit
from og_pointcloud.rendering.splatting import depth_and_slopes
from og_pointcloud.scene import Points, View

OPEN_IS_SEEN = 0.5
"""Chance that a view sees a point that geometry calls open, before colors are asked: of what seems open, half may be
hidden."""
NO_COLOR = DIFFERENCES
"""In place of a difference, where there is none: the view has no photograph, or the point is not in it."""

Doubles = NDArray[np.float64]


def doubted_by_color(
    table: MaskTable, points: Points, views: Sequence[View], near: float, journal: Journal | None = None
) -> MaskTable:
    """The table with exposures that colors bear out. It takes the place of the given one, whose exposure is written
    over. points, views: what it was made from. near: depth of the near plane, scene units. journal: of the fit, is told
    of photographs that cannot be read."""
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
    return believed(table, difference, sight_ratios(np.sum(counts, axis=0)))


def differences(
    points: Points, view: View, near: float, columns: NDArray[np.int32], exposure: NDArray[np.float32]
) -> tuple[NDArray[np.uint16], Doubles]:
    """Of each point that a view shows, how far its color is from its pixel's, rounded, or NO_COLOR; and how often a
    point of the image differs so far, (2, DIFFERENCES): shown ones, by their exposure, and hidden ones.

    columns: (k,) rows of the points that the view shows, ascending. exposure: (k,) theirs, in (0, 1].
    """
    image = view.image_rgb()
    if image is None or points.rgb is None:
        return np.full(len(columns), NO_COLOR, np.uint16), np.zeros((2, DIFFERENCES))
    camera = view.camera
    return _compared(
        points.xyz, np.ascontiguousarray(points.rgb), np.ascontiguousarray(image), np.array(camera.intrinsics),
        camera.world_to_camera, near, columns, exposure,
    )  # fmt: skip


def with_photograph(view: View) -> tuple[View, str]:
    """The view with its photograph read, or without where it cannot be; then what is wrong with it, else ""."""
    try:
        return replace(view, image=view.image_rgb()), ""
    except SceneError as error:
        return replace(view, image=None), str(error)


def warn_of_faults(faults: Sequence[str], journal: Journal) -> None:
    """faults: of each view, as of `with_photograph`. The checks of a capture ask for some photographs only."""
    if found := [fault for fault in faults if fault]:
        journal.warnings.append(f"photographs of {len(found)} of {len(faults)} views cannot be read: {found[0]}")


@njit(cache=True, nogil=True, error_model="numpy")
def _compared(xyz, rgb, image, intrinsics, pose, near, columns, exposure):  # noqa: ANN001, ANN202
    fx, fy, cx, cy = intrinsics
    height, width = image.shape[:2]
    difference, counts = np.full(len(columns), NO_COLOR, np.uint16), np.zeros((2, DIFFERENCES))
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
        apart = color_difference(rgb[g], pixel)
        if not is_shown:
            counts[1, apart] += 1
            continue
        difference[next_shown - 1] = apart
        # In steps of 1/256 sums in float64 are exact: the order of points does not matter.
        counts[0, apart] += np.rint(256 * np.float64(exposure[next_shown - 1])) / 256
    return difference, counts


def sight_ratios(counts: Doubles) -> NDArray[np.float32]:
    """(DIFFERENCES + 1,) how many times likelier each difference is at points that a view sees than at hidden ones; 1
    for NO_COLOR. counts: as of `differences`, of all views."""
    return np.append(likelihood_ratios(*counts), np.float32(1))


def believed(table: MaskTable, difference: NDArray[np.uint16], ratios: NDArray[np.float32]) -> MaskTable:
    """The table with each exposure as far as colors bear it out; the rest is doubted. Exposures are written over.

    difference: of each entry of the exposure. ratios: as of `sight_ratios`.
    """
    if (ratios == 1).all():
        return table
    exposure, holes = table.exposure, table.doubted
    if holes is None:
        holes = csr_array(exposure.shape, dtype=np.float32)
    taken = scratch_like(exposure.data, np.float32)
    _believe(*((matrix.indptr, matrix.indices, matrix.data) for matrix in (exposure, holes)), difference, ratios, taken)
    # In the same rows and columns, which are not copied.
    return replace(table, doubted=csr_array((taken, exposure.indices, exposure.indptr), shape=exposure.shape))


@njit(cache=True)
def _believe(exposure, holes, difference, ratios, taken):  # noqa: ANN001, ANN202
    """Writes to ``taken`` what was, and is now, taken from each exposure; below 0 where colors speak for more than
    geometry does. Columns ascend in each row, and what came through holes is still exposed a little."""
    (start, column, exposed), (hole_start, hole_column, through) = exposure, holes
    for row in range(len(start) - 1):
        hole = hole_start[row]
        for e in range(start[row], start[row + 1]):
            p, r = OPEN_IS_SEEN * np.float64(exposed[e]), np.float64(ratios[difference[e]])
            seen = np.float32(p * r / (p * r + 1 - p))
            taken[e], exposed[e] = exposed[e] - seen, seen
            while hole < hole_start[row + 1] and hole_column[hole] < column[e]:
                hole += 1
            if hole < hole_start[row + 1] and hole_column[hole] == column[e]:
                taken[e] += through[hole]
