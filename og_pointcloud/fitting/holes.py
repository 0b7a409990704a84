"""What a mask shows through holes between the points of its own object.

A table top of few points shows the floor through it everywhere, and at a slant its far edge lies as deep as the nearest
floor: over the mask as a whole no depth gap separates the two. Around each point there is one.
"""

from __future__ import annotations

import numpy as np

from og_pointcloud.kernels import njit

WINDOW_POINTS = 24
"""Approximate number of points in the window around a point: as many as `GeometrySettings.neighbors`."""
HALF_PLANE_MEAN_DIRECTION = 2 / np.pi
"""Length of the mean of unit directions that are spread evenly over a half plane, as seen from a straight edge."""


@njit(cache=True, nogil=True)
def seen_through_holes(xy, depth, weight, area, gap, front_share):  # noqa: ANN001, ANN201
    """(n,) bool, the points of one mask that lie behind others of it which surround them in the image.

    xy: (n, 2) float64, places in an image at depth 1; area: of the mask, there. depth, weight: (n,), depths ascending.
    gap: points of a window are separated where depth steps by more than this and by more than the window's width; a
    slanted surface goes as deep as it is wide. The nearest part with front_share of their weight is the surface there.
    What lies behind the surface's rim is not surrounded: rims of masks, and what a depth sensor puts there, are
    uncertain, and judged by other rules.
    """
    n = len(depth)
    hidden = np.zeros(n, np.bool_)
    if n == 0 or depth[-1] - depth[0] <= gap:
        return hidden
    # The window of a cell is three by three cells, which hold WINDOW_POINTS points if these lie evenly over the mask. A
    # mask much smaller than its bounding box gets at most about four cells a point.
    low, span = np.array([xy[:, 0].min(), xy[:, 1].min()]), np.array([np.ptp(xy[:, 0]), np.ptp(xy[:, 1])])
    cell = np.sqrt(max(area * WINDOW_POINTS / 9, span[0] * span[1] / 4) / n)
    cell = max(cell, span.sum() / (4 * n), 1e-12)
    columns, rows = int(span[0] / cell) + 1, int(span[1] / cell) + 1
    start, members = _by_cell(xy, low, cell, columns, rows)
    window = np.empty(n, np.int64)
    for middle in range(columns * rows):
        if start[middle] == start[middle + 1]:
            continue
        # If nothing in the cell lies a gap behind the mask's nearest point, its window does not matter.
        deepest = depth[members[start[middle + 1] - 1]]  # members of a cell ascend
        if deepest - depth[0] <= gap:
            continue
        row = middle // columns
        column = middle - row * columns
        around = max(row - 1, 0), min(row + 2, rows), max(column - 1, 0), min(column + 2, columns)
        nearest_depth = depth[_nearest(around, start, members, columns, n)]
        # The window's width in scene units, at that depth.
        step = max(gap, 3 * cell * nearest_depth)
        # What is hidden lies at least a step behind the nearest point: in most cells nothing does.
        if not deepest - nearest_depth > step:
            continue
        around_cell = _points_of_cells(around, start, members, columns, window)
        begin, end = _front(depth, weight, around_cell, step, front_share)
        # Points are numbered by depth: one from around_cell[end] on lies behind the surface.
        for point in members[start[middle] : start[middle + 1]]:
            if end < len(around_cell) and point >= around_cell[end]:
                hidden[point] = _surrounded(xy, point, around_cell[begin:end])
    return hidden


@njit(cache=True, nogil=True)
def _by_cell(xy, low, cell, columns, rows):  # noqa: ANN001, ANN202
    """(start, members): members[start[c] : start[c + 1]] are the points of cell c, ascending; cells go row by row."""
    # A counting sort: how many points each cell has, hence where each begins, then every point in its cell's turn.
    place = np.empty(len(xy), np.int64)
    start = np.zeros(columns * rows + 1, np.int64)
    for i in range(len(xy)):
        place[i] = int((xy[i, 1] - low[1]) / cell) * columns + int((xy[i, 0] - low[0]) / cell)
        start[place[i] + 1] += 1
    start = np.cumsum(start)
    end, members = start[:-1].copy(), np.empty(len(xy), np.int64)
    for i in range(len(xy)):
        members[end[place[i]]] = i
        end[place[i]] += 1
    return start, members


@njit(cache=True, nogil=True)
def _nearest(around, start, members, columns, n):  # noqa: ANN001, ANN202
    """The lowest number of the points in these cells, n if none. around: first and end of rows, of columns."""
    nearest = n
    for row in range(around[0], around[1]):
        for cell in range(row * columns + around[2], row * columns + around[3]):
            if start[cell] < start[cell + 1]:
                nearest = min(nearest, members[start[cell]])
    return nearest


@njit(cache=True, nogil=True)
def _points_of_cells(around, start, members, columns, window):  # noqa: ANN001, ANN202
    """The points of these cells, ascending, written to ``window``."""
    count = 0
    for row in range(around[0], around[1]):
        # Cells side by side in a row are one stretch of the members.
        for k in range(start[row * columns + around[2]], start[row * columns + around[3]]):
            window[count] = members[k]
            count += 1
    points = window[:count]
    if count > 4 * WINDOW_POINTS:  # insertion takes the square of their number
        points.sort()
    for k in range(1, count):  # by insertion: few points, in runs that ascend already
        point, place = points[k], k
        while place > 0 and points[place - 1] > point:
            points[place] = points[place - 1]
            place -= 1
        points[place] = point
    return points


@njit(cache=True, nogil=True)
def _front(depth, weight, points, gap, front_share):  # noqa: ANN001, ANN202
    """(begin, end) of the first run of points, ascending in depth and parted by gaps, that has this share of all their
    weight; (0, n) where none before the last has."""
    least, mass, begin = 0.0, 0.0, 0
    for point in points:
        least += front_share * weight[point]
    for k in range(len(points)):
        if k and depth[points[k]] - depth[points[k - 1]] > gap:
            if mass >= least:
                return begin, k
            # A small run in front is no surface: begin again behind it.
            begin, mass = k, 0.0
        mass += weight[points[k]]
    return 0, len(points)


@njit(cache=True, nogil=True)
def _surrounded(xy, point, others):  # noqa: ANN001, ANN202
    """Whether the others lie all around a point in the image, not to one side of it, by the mean direction to them."""
    x, y, count = 0.0, 0.0, 0
    for other in others:
        across, down = xy[other, 0] - xy[point, 0], xy[other, 1] - xy[point, 1]
        length = np.sqrt(across**2 + down**2)
        if length > 0:
            x, y, count = x + across / length, y + down / length, count + 1
    return np.sqrt(x**2 + y**2) < HALF_PLANE_MEAN_DIRECTION * count
