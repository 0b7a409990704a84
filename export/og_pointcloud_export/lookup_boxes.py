"""The kernel that builds the lookup grid: finds the nearest point's answer in each of a box's 4^3 children.

Each test compares a child, a cube, with points in coordinates relative to its center. A point p is farther than a point
q everywhere in the cube if |u - p|^2 > |u - q|^2 for all u in it. The difference is linear in u, so its minimum lies at
a corner:

    |p|^2 - |q|^2 - 2 half |p - q|_1 > 0        (|.|_1: the sum of absolute coordinates)

A point that loses to another in this way, or is out of reach of the cube, is nearest nowhere in it. If all remaining
points have one answer, and the cube lies within reach of one of them, the child is certain. If not, they are the
candidates among which a query in the child finds its nearest point; or the child is split into 4^3 children of its own.

Cubes are inflated by ``rounding``, the most that float32 can move a query's cell, so that a query always lies inside
the child in which it is looked up.
"""

from __future__ import annotations

import numpy as np

from og_pointcloud.kernels import njit, prange

EDGE = 4
"""Children along the edge of a split box."""
CHILDREN = EDGE**3
MAX_SHARED_LIST_LENGTH = 8
"""Children share lists up to this length; the graph always compares so many candidates, so sharing costs no time."""
MAX_LIST_LENGTH = 64
"""Largest number of a child's candidates; with more, where points almost coincide, it is left to the exact search."""
TOO_FAR_CODE = 0
"""Answer code of a query with no cloud point within reach."""
NO_CHILD, SPLIT = -1, CHILDREN
"""In place of a list's index: the child has no list, as its answer is certain or left open; or it is split further."""
MAX_COMPARED_CANDIDATES = 4 * MAX_LIST_LENGTH
"""With more candidates than this, a child is split without comparing all pairs."""

# Helpers are called only by kernels: without wrappers of their own they compile faster.
_helper = njit(no_cpython_wrapper=True, no_cfunc_wrapper=True)  # pyright: ignore[reportCallIssue]

# numba takes no dataclasses; these tuples are the records of this file:
#   level   (size of a child, rounding, longest list of a child that could be split, whether it is the last: no splits)
#   limits  (reach, distance from the cloud up to which a query is on its surface, number of answer codes)
#   points  (low (3,), brick edge, block_row, start, x, y, z, answer, number): the cloud sorted by brick, as
#           ``lookup_grid`` makes it
#   near    (x, y, z, answer, number): the points within reach of a box, coordinates float64; ``rows`` are places in it


@njit(cache=True, parallel=True)
def answer_children(corners, level, limits, points, filled):  # noqa: ANN001, ANN201
    """Answer the children of each box; corners (m, 3): its low corner. Fills these four, in C order of the children:

    answers (m, 64): code of the answer, if certain; else that at the child's center, plus the number of codes.
    child (m, 64): number of the list that settles the child, or NO_CHILD, or SPLIT.
    lengths (m, 64), lists (m, 64, MAX_LIST_LENGTH): the box's lists, of points' numbers, ascending; length 0: no list.
    """
    for box in prange(len(corners)):
        _answer_box(box, corners[box], level, limits, points, filled)


@_helper
def _answer_box(box, corner, level, limits, points, filled):  # noqa: ANN001, ANN202
    answers, child, lengths, lists = filled[0][box], filled[1][box], filled[2][box], filled[3][box]
    size, rounding, longest, last = level
    near, holds = _points_about(corner, size, rounding, limits[0], points)
    squared, rows = np.empty(len(near[0])), np.empty(len(near[0]), np.int32)  # scratch of each child
    lists_of = np.zeros(len(near[0]), np.uint64)  # bit k of a point: it is in list k
    lengths[:], list_count = 0, 0
    for number in range(CHILDREN):
        center = (
            corner[0] + (number // EDGE**2 + 0.5) * size,
            corner[1] + (number // EDGE % EDGE + 0.5) * size,
            corner[2] + (number % EDGE + 0.5) * size,
        )
        code, certain, count = _answer_child(center, size / 2 + rounding, last, limits, near, squared, rows)
        answers[number] = code if certain else code + limits[2]
        child[number] = NO_CHILD
        if certain:
            continue
        # Queries come where points are: there the smaller children of a split answer most of them without a list.
        if not last and (holds[number] or count > longest):
            child[number] = SPLIT
        elif count <= MAX_LIST_LENGTH:  # else left open
            # Candidates that are not in the shared list yet are added; lists hold the cloud's numbers of points.
            chosen = _list_to_share(rows[:count], lists_of, lengths[:list_count])
            for row in rows[:count]:
                bit = np.uint64(1) << np.uint64(chosen)
                if lists_of[row] & bit == 0:
                    lists_of[row] |= bit
                    lists[chosen, lengths[chosen]] = near[4][row]
                    lengths[chosen] += 1
            list_count = max(list_count, chosen + 1)
            child[number] = chosen
    for number in range(list_count):
        lists[number, : lengths[number]].sort()


@_helper
def _points_about(corner, size, rounding, reach, points):  # noqa: ANN001, ANN202
    """The points within reach of the box, and (64,) bool, which of its children hold points."""
    low, edge, block_row, start, x, y, z, answer, number = points
    half = EDGE * size / 2 + rounding  # of the whole box, inflated as its children are
    middle = (corner[0] + EDGE * size / 2, corner[1] + EDGE * size / 2, corner[2] + EDGE * size / 2)
    first, last = np.empty(3, np.int64), np.empty(3, np.int64)  # bricks along each axis that are within reach
    for axis in range(3):
        bricks = EDGE * block_row.shape[axis]
        first[axis] = max(int(np.floor((middle[axis] - half - reach - low[axis]) / edge)), 0)
        last[axis] = min(int(np.floor((middle[axis] + half + reach - low[axis]) / edge)), bricks - 1)
    chosen, count = np.empty(256, np.int32), 0
    holds = np.zeros(CHILDREN, np.bool_)
    for i in range(first[0], last[0] + 1):
        for j in range(first[1], last[1] + 1):
            for k in range(first[2], last[2] + 1):
                row = block_row[i // EDGE, j // EDGE, k // EDGE]
                if row < 0:  # the block holds no point and is near none
                    continue
                slot = row * CHILDREN + (i % EDGE * EDGE + j % EDGE) * EDGE + k % EDGE
                for point in range(start[slot], start[slot + 1]):
                    gap = _gap_squared((x[point] - middle[0], y[point] - middle[1], z[point] - middle[2]), half)
                    if gap > _grown(reach):
                        continue
                    if count == len(chosen):  # full: twice the room
                        chosen = np.append(chosen, np.empty(count, np.int32))
                    chosen[count] = point
                    count += 1
                    if gap == 0:  # inside the inflated box: the child it lies in, the nearest where it is just outside
                        child_x = min(max(int((x[point] - corner[0]) / size), 0), EDGE - 1)
                        child_y = min(max(int((y[point] - corner[1]) / size), 0), EDGE - 1)
                        child_z = min(max(int((z[point] - corner[2]) / size), 0), EDGE - 1)
                        holds[(child_x * EDGE + child_y) * EDGE + child_z] = True
    chosen = chosen[:count]
    return (x[chosen], y[chosen], z[chosen], answer[chosen], number[chosen]), holds


@_helper
def _answer_child(center, half, last, limits, near, squared, rows):  # noqa: ANN001, ANN202
    """(code of the answer at the center, whether it is all the child's, count of candidates, the first of ``rows``)."""
    reach = limits[0]
    # The point nearest to the center. None within reach of the cube's circumscribed sphere: too far.
    best, best_squared = -1, np.inf
    for row in range(len(squared)):
        seen = _seen_from(center, near, row)
        squared[row] = seen[0] * seen[0] + seen[1] * seen[1] + seen[2] * seen[2]
        if squared[row] < best_squared:
            best, best_squared = row, squared[row]
    diagonal = np.sqrt(3.0) * half
    if best < 0 or best_squared > (reach + diagonal) ** 2:
        return TOO_FAR_CODE, True, 0
    # Candidates: what does not lose to that point, and is within reach of the cube.
    nearest = _seen_from(center, near, best)
    # By the triangle inequality points beyond this always lose; the test by corners would say so at greater cost.
    limit = (np.sqrt(best_squared) + 2 * diagonal) ** 2
    count = 0
    for row in range(len(squared)):
        if squared[row] <= limit:
            rival = _seen_from(center, near, row)
            loses = _loses(rival, squared[row], nearest, best_squared, half)
            if not loses and _gap_squared(rival, half) <= _grown(reach):
                rows[count] = row
                count += 1
    if count == 0:
        return TOO_FAR_CODE, True, 0
    # Certain if all candidates have one answer and the whole cube is within reach of one point.
    code = _code(near[3][best], best_squared, limits)
    within = _all_within_reach(nearest, half, reach)
    if within and _alike(near[3], rows[:count]):
        return code, True, count
    if count > MAX_COMPARED_CANDIDATES and not last:
        return code, False, count
    # Fewer candidates, each compared with each; they may then agree.
    count = _winners(center, half, near, squared, rows, count)
    return code, within and _alike(near[3], rows[:count]), count


@_helper
def _winners(center, half, near, squared, rows, count):  # noqa: ANN001, ANN202
    """Move the rows that lose to no other to the front, and count them. Losers may be dropped at once: what loses to
    one also loses to the point that it loses to."""
    row = 0
    while row < count:
        rival, rival_squared, lost = _seen_from(center, near, rows[row]), squared[rows[row]], False
        for other in rows[:count]:
            if squared[other] < rival_squared and _loses(
                rival, rival_squared, _seen_from(center, near, other), squared[other], half
            ):
                lost = True
                break
        if lost:  # the last row takes its place, and is looked at next
            count -= 1
            rows[row] = rows[count]
        else:
            row += 1
    return count


@_helper
def _list_to_share(rows, lists_of, lengths):  # noqa: ANN001, ANN202
    """Index of the list that grows least by these rows, up to MAX_SHARED_LIST_LENGTH; else of a new list."""
    chosen, least = len(lengths), len(rows)
    for number in range(len(lengths)):
        growth = len(rows)
        for row in rows:
            growth -= np.int64((lists_of[row] >> np.uint64(number)) & np.uint64(1))
        if growth < least and (growth == 0 or lengths[number] + growth <= MAX_SHARED_LIST_LENGTH):
            chosen, least = number, growth
    return chosen


@_helper
def _alike(answers, rows):  # noqa: ANN001, ANN202
    """Whether these points have one answer."""
    for row in rows:  # noqa: SIM110
        if answers[row] != answers[rows[0]]:
            return False
    return True


@_helper
def _seen_from(center, near, row):  # noqa: ANN001, ANN202
    return near[0][row] - center[0], near[1][row] - center[1], near[2][row] - center[2]


@_helper
def _code(answer, squared, limits):  # noqa: ANN001, ANN202
    """Code of an answer at that squared distance: too far, near, or on the surface (`CODE_OFFSET` in lookup_grid)."""
    reach, surface, codes = limits
    if squared > reach * reach:
        return TOO_FAR_CODE
    return answer if squared <= surface * surface else answer + codes // 2


@_helper
def _grown(reach):  # noqa: ANN001, ANN202
    """The squared reach, and a little more: rounding must not lose a point at exactly that distance."""
    return reach * reach * (1 + 1e-9)


@_helper
def _gap_squared(seen, half):  # noqa: ANN001, ANN202
    """Squared distance of a point, seen from a cube's center, to the cube."""
    gap_x, gap_y, gap_z = max(abs(seen[0]) - half, 0.0), max(abs(seen[1]) - half, 0.0), max(abs(seen[2]) - half, 0.0)
    return gap_x * gap_x + gap_y * gap_y + gap_z * gap_z


@_helper
def _all_within_reach(seen, half, reach):  # noqa: ANN001, ANN202
    """Whether a point, seen from a cube's center, is within reach of all of the cube."""
    far_x, far_y, far_z = abs(seen[0]) + half, abs(seen[1]) + half, abs(seen[2]) + half
    return far_x * far_x + far_y * far_y + far_z * far_z <= reach * reach * (1 - 1e-9)


@_helper
def _loses(p, p_squared, q, q_squared, half):  # noqa: ANN001, ANN202
    """Whether p is farther than q everywhere in the cube, by the formula above. A tie does not lose."""
    spread = abs(p[0] - q[0]) + abs(p[1] - q[1]) + abs(p[2] - q[2])
    return p_squared - q_squared - 2 * half * spread > 1e-9 * half * half
