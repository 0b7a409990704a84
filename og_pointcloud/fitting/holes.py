"""What a mask shows through holes between the points of its own object.

A table top of few points lets the floor through, all over, and seen at a slant it reaches as deep as the floor begins:
no gap in depth parts the two over the mask as a whole. Around each point it does.
"""

from __future__ import annotations

import numpy as np

from og_pointcloud.kernels import njit

WINDOW = 24
"""Points looked at around one, about: as many as adjoin."""
STRAIGHT_EDGE = 2 / np.pi
"""Length of the mean direction to points that are spread evenly over one side of a straight line."""


@njit(cache=True, nogil=True)
def seen_through_holes(xy, depth, weight, area, gap, front_share):  # noqa: ANN001, ANN201
    """(n,) bool, the points of one mask that lie behind others of it which surround them in the image.

    xy: (n, 2) float64, places in the image at depth 1; area: of the mask, there. depth, weight: (n,), depths ascending.
    gap: a step in depth wider than this parts the points about a place, if it is no less than that place is wide: so
    deep is a slanted surface. The nearest part with front_share of their weight is the surface there. What lies behind
    its rim is not surrounded: rims of masks, and what a depth sensor puts there, are uncertain, and other rules judge
    of them.
    """
    n = len(depth)
    hidden = np.zeros(n, np.bool_)
    if n == 0 or depth[-1] - depth[0] <= gap:
        return hidden
    # Three by three cells are the window that the points of the middle one are looked at in.
    low, span = np.array([xy[:, 0].min(), xy[:, 1].min()]), np.array([np.ptp(xy[:, 0]), np.ptp(xy[:, 1])])
    cell = np.sqrt(max(area * WINDOW / 9, span[0] * span[1] / 4) / n)
    cell = max(cell, span.sum() / (4 * n), 1e-12)
    columns, rows = int(span[0] / cell) + 1, int(span[1] / cell) + 1
    start, members = _by_cell(xy, low, cell, columns, rows)
    window = np.empty(n, np.int64)
    for middle in range(columns * rows):
        if start[middle] == start[middle + 1]:
            continue
        deepest = depth[members[start[middle + 1] - 1]]  # members of a cell ascend
        if deepest - depth[0] <= gap:
            continue
        row = middle // columns
        column = middle - row * columns
        around = max(row - 1, 0), min(row + 2, rows), max(column - 1, 0), min(column + 2, columns)
        near = depth[_nearest(around, start, members, columns, n)]
        step = max(gap, 3 * cell * near)
        # What is hidden lies a step behind the nearest point or more: in most cells nothing does.
        if not deepest - near > step:
            continue
        about = _about(around, start, members, columns, window)
        begin, end = _front(depth, weight, about, step, front_share)
        for point in members[start[middle] : start[middle + 1]]:
            if end < len(about) and point >= about[end]:
                hidden[point] = _surrounded(xy, point, about[begin:end])
    return hidden


@njit(cache=True, nogil=True)
def _by_cell(xy, low, cell, columns, rows):  # noqa: ANN001, ANN202
    """(start, members): the points by the cell of a grid that they lie in, row by row; of a cell, as they come."""
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
    """The first of n points in these cells: (first row, end of rows, first column, end of columns)."""
    nearest = n
    for row in range(around[0], around[1]):
        for cell in range(row * columns + around[2], row * columns + around[3]):
            if start[cell] < start[cell + 1]:
                nearest = min(nearest, members[start[cell]])
    return nearest


@njit(cache=True, nogil=True)
def _about(around, start, members, columns, window):  # noqa: ANN001, ANN202
    """The points of these cells, ascending, written to ``window``."""
    count = 0
    for row in range(around[0], around[1]):
        for k in range(start[row * columns + around[2]], start[row * columns + around[3]]):
            window[count] = members[k]
            count += 1
    about = window[:count]
    if count > 4 * WINDOW:
        about.sort()
    for k in range(1, count):  # by insertion: few points, in runs that ascend already
        point, place = about[k], k
        while place > 0 and about[place - 1] > point:
            about[place] = about[place - 1]
            place -= 1
        about[place] = point
    return about


@njit(cache=True, nogil=True)
def _front(depth, weight, points, gap, front_share):  # noqa: ANN001, ANN202
    """(begin, end) of the nearest run of points, in ascending order of depth, parted by gaps, with this share of all
    their weight; (0, n) where there is none."""
    least, mass, begin = 0.0, 0.0, 0
    for point in points:
        least += front_share * weight[point]
    for k in range(len(points)):
        if k and depth[points[k]] - depth[points[k - 1]] > gap:
            if mass >= least:
                return begin, k
            begin, mass = k, 0.0
        mass += weight[points[k]]
    return 0, len(points)


@njit(cache=True, nogil=True)
def _surrounded(xy, point, others):  # noqa: ANN001, ANN202
    """Whether the others lie about a point in the image, not all to one side of it: by the mean direction to them."""
    x, y, count = 0.0, 0.0, 0
    for other in others:
        across, down = xy[other, 0] - xy[point, 0], xy[other, 1] - xy[point, 1]
        length = np.sqrt(across**2 + down**2)
        if length > 0:
            x, y, count = x + across / length, y + down / length, count + 1
    return np.sqrt(x**2 + y**2) < STRAIGHT_EDGE * count
