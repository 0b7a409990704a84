"""The cells of one brick, from the cloud's points about it: which answer each has, and which points settle the others.

Points are gathered once for the brick, once more for each octant of it, and then compared cell by cell. Every test is
of a box against points: a point that is farther than another everywhere in the box cannot be the nearest there.
"""

from __future__ import annotations

import numpy as np

from og_pointcloud.errors import MissingExtraError

try:
    from numba import njit, prange
except ImportError as error:
    raise MissingExtraError("numba", "fit") from error

__all__ = ["BLOCK", "BRICK", "LIST_ALONE", "NO_LIST", "PARTS", "TOO_FAR_CODE", "answer_bricks", "mark_bricks"]

BLOCK = 4
"""Bricks along the edge of a block."""
BRICK = 4
"""Cells along the edge of a brick."""
PARTS = 4
"""Parts along the edge of a cell that is split."""
TOO_FAR_CODE = 0
"""Answer code of a query with no cloud point within reach."""
LIST_ALONE = -1
"""Value of the first cell of a brick whose list settles all of it."""
NO_LIST = -1
"""Length of a list that is none."""
SUBDIVISION = 2
"""A long list is put together anew from those of so many boxes along the cell's edge, which are shorter."""
OCTANTS = 2
BITS = 64
"""Lists of a brick that cells may share."""
BYTE = 256
"""Values of cells that a byte holds; lists of parts are not made where the number of a list would leave it."""

# Helpers are called by kernels alone: without wrappers of their own they compile sooner.
_helper = njit(no_cpython_wrapper=True, no_cfunc_wrapper=True)  # pyright: ignore[reportCallIssue]

# Throughout: ``lattice`` is (low (3,), cell_size, rounding), the length by which every box is inflated on all sides;
# ``limits`` is (reach, surface distance, codes); ``near`` is (x, y, z, answer, number), the points about one brick.


@njit(cache=True)
def mark_bricks(lower, upper, top, slots):  # noqa: ANN001, ANN201
    """Mark what points touch: from brick ``lower`` to brick ``upper``, (n, 3) int32 each, of the grid.

    top: of blocks. slots: (rows, 64) bool, the bricks of the block whose top is that row; without any rows, the top of
    each block that is touched becomes 0.
    """
    for point in range(len(lower)):
        for i in range(lower[point, 0], upper[point, 0] + 1):
            for j in range(lower[point, 1], upper[point, 1] + 1):
                for k in range(lower[point, 2], upper[point, 2] + 1):
                    if len(slots) == 0:
                        top[i // BLOCK, j // BLOCK, k // BLOCK] = 0
                    else:
                        row = top[i // BLOCK, j // BLOCK, k // BLOCK]
                        slots[row, (i % BLOCK * BLOCK + j % BLOCK) * BLOCK + k % BLOCK] = True


@njit(cache=True, parallel=True)
def answer_bricks(bricks, lattice, limits, points, top, wanted, values, lengths, lists, first_part, parts):  # noqa: ANN001, ANN201
    """Fill, for each of the bricks (m, 3):

    values (m, 64): a certain answer; that at the centre + codes where open; or 2 codes + the number of its list.
        LIST_ALONE first: list 0 settles the whole brick.
    lengths (m, most): of the lists, NO_LIST after the last. lists (m, most, longest): their candidates, ascending.
    first_part (m, most): of lists, -1, or for a cell that is split the number of its row in parts.
    parts (m, 64, 64): answers of the parts, or ``codes`` + how many lists after the cell's is the one that settles it.

    points: (x, y, z, answer, index, start): sorted by slot, ``start[slot]`` its first. wanted: (short, lists, split,
    alone): the length up to which lists are shared, whether there are lists, parts, and a list alone also where the
    brick holds points.
    """
    for row in prange(len(bricks)):
        _answer_brick(
            bricks[row], lattice, limits, points, top, wanted,
            values[row], lengths[row], lists[row], first_part[row], parts[row],
        )  # fmt: skip


@_helper
def _answer_brick(brick, lattice, limits, points, top, wanted, values, lengths, lists, first_part, parts):  # noqa: ANN001, ANN202
    low, size, rounding = lattice
    short, with_lists, with_parts, alone = wanted
    corner = (low[0] + brick[0] * BRICK * size, low[1] + brick[1] * BRICK * size, low[2] + brick[2] * BRICK * size)
    near, holds = _points_about(brick, corner, size, rounding, limits[0], points, top)
    lengths[:], first_part[:] = NO_LIST, -1
    if len(near[0]) <= short and with_lists and (alone or not holds.any()):
        values[:] = TOO_FAR_CODE
        if len(near[0]) > 0:
            values[0], lengths[0] = LIST_ALONE, len(near[0])
            for row in range(len(near[0])):
                lists[0, row] = row
            _sort_as_points(near[4], lists[0, : len(near[0])])
        return
    number_of_list = np.zeros(len(near[0]), np.uint64)  # bit k of a point: it is in list k, which may be shared
    whole, whole_length = np.empty(short, np.int32), 0  # of the list that settles the whole brick; -1: none does
    if not with_lists or (holds.any() and not alone):
        whole_length = -1
    squared, rows = np.empty(len(near[0])), np.empty(len(near[0]), np.int32)
    made, split, left = 0, 0, BRICK**3
    edge, half = BRICK // OCTANTS * size, size / 2 + rounding
    for octant in range(OCTANTS**3):
        rivals = _rivals_in_box(_middle(corner, octant, OCTANTS, edge), edge / 2 + rounding, limits[0], near)
        some = _chosen(near, rivals)
        alike = _alike(some)
        for cell in _cells_of_octant(octant):
            left -= 1
            if len(rivals) == 0:
                values[cell] = TOO_FAR_CODE
                continue
            center = _middle(corner, cell, BRICK, size)
            code, certain, count = _answer_box(center, half, limits, some, alike, whole_length >= 0, squared, rows)
            values[cell] = code if certain else code + limits[2]
            if whole_length >= 0:
                whole_length = _join(whole, whole_length, rows[:count], rivals)
            if not certain and with_lists:
                most = min(len(lengths), max(BRICK**3, BYTE - 2 * limits[2])) - left
                number, made, split = _give_list(
                    center, size, rounding, limits, some, rows[:count], short, holds[cell], with_parts,
                    made, split, most, number_of_list, lengths, lists, first_part, parts,
                )  # fmt: skip
                if number >= 0:
                    values[cell] = 2 * limits[2] + number
    if whole_length > 0:
        values[0], lengths[0], made = LIST_ALONE, whole_length, 1
        lengths[1:], first_part[0] = NO_LIST, -1
        lists[0, :whole_length] = whole[:whole_length]
    for number in range(made):
        _sort_as_points(near[4], lists[number, : lengths[number]])


@_helper
def _give_list(  # noqa: ANN202
    center, size, rounding, limits, near, rows, short, holds, with_parts,  # noqa: ANN001
    made, split, most, number_of_list, lengths, lists, first_part, parts,  # noqa: ANN001
):  # fmt: skip
    """Find the list of an open cell, or make it: its number, or -1, and how many lists and split cells there are now.

    rows: of the points that are nearest somewhere in the cell. most: lists that may be made, but for those of parts.
    """
    splits = holds and with_parts
    found = rows
    if splits or len(rows) > short:
        per_edge = PARTS if splits else SUBDIVISION  # what is not split needs no values, only the shorter list
        found = _settle_boxes(center, size, rounding, per_edge, splits, limits, near, rows, parts[split])
    if len(found) > lists.shape[1]:
        if not with_parts:
            return -1, made, split
        room = most - made
        more = _list_parts(center, size, rounding, limits, near, rows, lists[made:], lengths[made:], room, parts[split])
        if more == 0:
            return -1, made, split
        first_part[made] = split
        return made, made + more, split + 1
    number = made if splits else _list_to_share(found, near[4], number_of_list, lengths[:made], short)
    lengths[number] = _join(lists[number], max(lengths[number], 0), found, near[4])
    if splits:
        first_part[number] = split
        split += 1
    elif number < BITS:
        for row in found:
            number_of_list[near[4][row]] |= np.uint64(1) << np.uint64(number)
    return number, max(made, number + 1), split


@_helper
def _points_about(brick, corner, size, rounding, reach, points, top):  # noqa: ANN001, ANN202
    """The points within reach of the brick, and (64,) bool, which of its cells hold points."""
    x, y, z, answer, index, start = points
    half = BRICK * size / 2 + rounding
    center = (corner[0] + BRICK * size / 2, corner[1] + BRICK * size / 2, corner[2] + BRICK * size / 2)
    chosen, count = np.empty(256, np.int32), 0
    holds = np.zeros(BRICK**3, np.bool_)
    for neighbour in range(27):
        i, j, k = brick[0] + neighbour // 9 - 1, brick[1] + neighbour // 3 % 3 - 1, brick[2] + neighbour % 3 - 1
        row = top[i // BLOCK, j // BLOCK, k // BLOCK]  # no brick of the outermost layer is asked: all indices are right
        if row < 0:
            continue
        slot = row * BLOCK**3 + (i % BLOCK * BLOCK + j % BLOCK) * BLOCK + k % BLOCK
        for point in range(start[slot], start[slot + 1]):
            if _gap_squared(x[point] - center[0], y[point] - center[1], z[point] - center[2], half) <= _grown(reach):
                if count == len(chosen):
                    longer = np.empty(2 * count, np.int32)
                    longer[:count] = chosen
                    chosen = longer
                chosen[count] = point
                count += 1
            if neighbour == 13:
                cell_x = min(max(int((x[point] - corner[0]) / size), 0), BRICK - 1)
                cell_y = min(max(int((y[point] - corner[1]) / size), 0), BRICK - 1)
                cell_z = min(max(int((z[point] - corner[2]) / size), 0), BRICK - 1)
                holds[(cell_x * BRICK + cell_y) * BRICK + cell_z] = True
    chosen = chosen[:count]
    near = _chosen((x, y, z, answer, index), chosen)
    for row in range(count):
        chosen[row] = index[chosen[row]]
    return near, holds


@_helper
def _rivals_in_box(center, half, reach, near):  # noqa: ANN001, ANN202
    """Rows of the points within reach of the box, but for those farther everywhere than that nearest to its centre."""
    squared, rows, count = np.empty(len(near[0])), np.empty(len(near[0]), np.int32), 0
    best = _nearest(center, near, squared)
    if best < 0:
        return rows
    nearest = _seen_from(center, near, best)
    for row in range(len(squared)):
        rival = _seen_from(center, near, row)
        rows[count] = row
        count += _gap_squared(rival[0], rival[1], rival[2], half) <= _grown(reach) and not _loses(
            rival, squared[row], nearest, squared[best], half
        )
    return rows[:count]


@_helper
def _chosen(near, rows):  # noqa: ANN001, ANN202
    """Those points of ``near``, each with its row there instead of its number in the cloud."""
    x, y, z = np.empty(len(rows)), np.empty(len(rows)), np.empty(len(rows))
    answer = np.empty(len(rows), np.int32)
    for place, row in enumerate(rows):
        x[place], y[place], z[place], answer[place] = near[0][row], near[1][row], near[2][row], near[3][row]
    return x, y, z, answer, rows


@_helper
def _alike(near):  # noqa: ANN001, ANN202
    """Whether all points have the same answer."""
    alike = True
    for answer in near[3]:
        alike = alike and answer == near[3][0]
    return alike


@_helper
def _nearest(center, near, squared):  # noqa: ANN001, ANN202
    """Fill the squared distances of all points; the row of the nearest, -1 if there is none."""
    for row in range(len(near[0])):
        dx, dy, dz = near[0][row] - center[0], near[1][row] - center[1], near[2][row] - center[2]
        squared[row] = dx * dx + dy * dy + dz * dz
    best, best_squared = -1, np.inf
    for row in range(len(near[0])):
        if squared[row] < best_squared:
            best, best_squared = row, squared[row]
    return best


@_helper
def _cells_of_octant(octant):  # noqa: ANN001, ANN202
    """(8,) numbers of its cells in the brick."""
    edge = BRICK // OCTANTS
    cells = np.empty(edge**3, np.int64)
    for part in range(edge**3):
        x = octant // OCTANTS**2 * edge + part // edge**2
        y = octant // OCTANTS % OCTANTS * edge + part // edge % edge
        cells[part] = (x * BRICK + y) * BRICK + octant % OCTANTS * edge + part % edge
    return cells


@_helper
def _middle(corner, number, per_edge, size):  # noqa: ANN001, ANN202
    """Centre of the part with that number, of per_edge^3 of that size in C order."""
    return (
        corner[0] + (number // per_edge**2 + 0.5) * size,
        corner[1] + (number // per_edge % per_edge + 0.5) * size,
        corner[2] + (number % per_edge + 0.5) * size,
    )


@_helper
def _answer_box(center, half, limits, near, alike, always, squared, rows):  # noqa: ANN001, ANN202
    """(code at the centre, whether it is the whole box's, count): so many rows are nearest somewhere in the box.

    near: the points that may be; alike: all have one answer. rows: filled, rightly only for boxes that are not certain,
        or if ``always`` asked for.
    squared: scratch; both as long as near, or longer.
    """
    reach = limits[0]
    best = _nearest(center, near, squared)
    if best < 0 or squared[best] > (reach + np.sqrt(3.0) * half) ** 2:
        return TOO_FAR_CODE, True, 0
    nearest, best_squared = _seen_from(center, near, best), squared[best]
    within = _all_within_reach(nearest, half, reach)
    if within and alike and not always:
        return _code(near[3][best], best_squared, limits), True, 0
    limit = (np.sqrt(best_squared) + 2 * np.sqrt(3.0) * half) ** 2  # farther points always lose
    count, one_answer = 0, True
    for row in range(len(near[0])):
        if squared[row] <= limit:
            rival = _seen_from(center, near, row)
            if _loses(rival, squared[row], nearest, best_squared, half):
                continue
            if _gap_squared(rival[0], rival[1], rival[2], half) <= _grown(reach):
                rows[count] = row
                count += 1
                one_answer = one_answer and near[3][row] == near[3][best]
    if count == 0:
        return TOO_FAR_CODE, True, 0
    if not (within and one_answer) or always:
        count = _winners(center, half, near, squared, rows, count)
        one_answer = True
        for row in rows[:count]:
            one_answer = one_answer and near[3][row] == near[3][best]
    return _code(near[3][best], best_squared, limits), within and one_answer, count


@_helper
def _winners(center, half, near, squared, rows, count):  # noqa: ANN001, ANN202
    """Keep the rows that do not lose to another; how many. (What loses to a loser, loses to the other's winner too.)"""
    row = 0
    while row < count:
        rival, rival_squared, lost = _seen_from(center, near, rows[row]), squared[rows[row]], False
        for other in rows[:count]:
            if squared[other] < rival_squared and not lost:
                lost = _loses(rival, rival_squared, _seen_from(center, near, other), squared[other], half)
        if lost:
            count -= 1
            rows[row] = rows[count]
        else:
            row += 1
    return count


@_helper
def _settle_boxes(center, size, rounding, per_edge, only_open, limits, near, rows, values):  # noqa: ANN001, ANN202
    """Look at a cell in per_edge^3 boxes: those of its rows that are nearest somewhere in one.

    values: filled with the boxes' certain answers, or codes. only_open: what certain boxes need is left out.
    """
    edge = size / per_edge
    corner = (center[0] - size / 2, center[1] - size / 2, center[2] - size / 2)
    some, needed = _chosen(near, rows), np.zeros(len(rows), np.bool_)
    alike = _alike(some)
    squared, wins = np.empty(len(rows)), np.empty(len(rows), np.int32)
    for box in range(per_edge**3):
        middle = _middle(corner, box, per_edge, edge)
        code, certain, count = _answer_box(
            middle, edge / 2 + rounding, limits, some, alike, not only_open, squared, wins
        )
        values[box] = code if certain else limits[2]
        if not (certain and only_open):
            for row in wins[:count]:
                needed[row] = True
    kept = np.empty(len(rows), np.int32)
    count = 0
    for place in range(len(rows)):
        kept[count] = rows[place]
        count += needed[place]
    return kept[:count]


@_helper
def _list_parts(center, size, rounding, limits, near, rows, lists, lengths, room, values):  # noqa: ANN001, ANN202
    """Give each open part of a cell a list: for cells of so many candidates that one list does not hold them.

    values: filled with the parts' certain answers, or codes + the number of a list. Returns how many lists were made;
    0 where there is no room for them, or even a part has too many candidates.
    """
    edge = size / PARTS
    corner = (center[0] - size / 2, center[1] - size / 2, center[2] - size / 2)
    some = _chosen(near, rows)
    alike, squared, wins = _alike(some), np.empty(len(rows)), np.empty(len(rows), np.int32)
    made = 0
    for box in range(PARTS**3):
        middle = _middle(corner, box, PARTS, edge)
        code, certain, count = _answer_box(middle, edge / 2 + rounding, limits, some, alike, False, squared, wins)
        values[box] = code if certain else limits[2] + made
        if certain:
            continue
        if made >= room or count > lists.shape[1]:
            lengths[: made + 1] = NO_LIST
            return 0
        lengths[made] = count
        for place in range(count):
            lists[made, place] = near[4][some[4][wins[place]]]
        made += 1
    return made


@_helper
def _list_to_share(rows, names, number_of_list, lengths, short):  # noqa: ANN001, ANN202
    """Number of the list that grows least by these rows, and not beyond ``short``; the next number if there is none.

    A list that may not be shared has no bit in ``number_of_list``, so that it would grow by all rows, as an empty one.
    """
    chosen, least = len(lengths), short + 1
    for number in range(min(len(lengths), BITS)):
        growth = len(rows)
        for row in rows:
            growth -= np.int64((number_of_list[names[row]] >> np.uint64(number)) & np.uint64(1))
        if growth < least and growth < len(rows) and lengths[number] + growth <= max(short, lengths[number]):
            chosen, least = number, growth
    return chosen


@_helper
def _sort_as_points(index, rows):  # noqa: ANN001, ANN202
    """Replace the rows, a handful, by the points' numbers in the cloud, ascending."""
    for place in range(len(rows)):
        point = index[rows[place]]
        before = place
        while before > 0 and rows[before - 1] > point:
            rows[before] = rows[before - 1]
            before -= 1
        rows[before] = point


@_helper
def _join(members, length, more, names):  # noqa: ANN001, ANN202
    """Add the names of more rows, where new, to the members; the new length, or -1 where there is no room."""
    for place in more:
        row = names[place]
        known = False
        for member in members[:length]:
            known = known or member == row
        if not known:
            if length == len(members):
                return -1
            members[length] = row
            length += 1
    return length


@_helper
def _seen_from(center, near, row):  # noqa: ANN001, ANN202
    return near[0][row] - center[0], near[1][row] - center[1], near[2][row] - center[2]


@_helper
def _code(answer, squared, limits):  # noqa: ANN001, ANN202
    """Code of an answer at that distance: too far, near, or on the surface."""
    reach, surface, codes = limits
    if squared > reach * reach:
        return TOO_FAR_CODE
    return answer if squared <= surface * surface else answer + codes // 2


@_helper
def _grown(reach):  # noqa: ANN001, ANN202
    """The squared reach, and a little more for rounding."""
    return reach * reach * (1 + 1e-9)


@_helper
def _gap_squared(dx, dy, dz, half):  # noqa: ANN001, ANN202
    """Squared distance of a point, seen from a box's centre, to the box."""
    gap_x, gap_y, gap_z = max(abs(dx) - half, 0.0), max(abs(dy) - half, 0.0), max(abs(dz) - half, 0.0)
    return gap_x * gap_x + gap_y * gap_y + gap_z * gap_z


@_helper
def _all_within_reach(nearest, half, reach):  # noqa: ANN001, ANN202
    """Whether that point, seen from the centre, is within reach of every place in the box."""
    far_x, far_y, far_z = abs(nearest[0]) + half, abs(nearest[1]) + half, abs(nearest[2]) + half
    return far_x * far_x + far_y * far_y + far_z * far_z <= reach * reach * (1 - 1e-9)


@_helper
def _loses(p, p_squared, q, q_squared, half):  # noqa: ANN001, ANN202
    """Whether a point p is farther than a point q everywhere in the box.

    |u - p|^2 - |u - q|^2 is linear in u, so the box's worst corner decides: |p|^2 - |q|^2 - 2 half |p - q|_1 > 0, seen
    from the centre. A tie does not lose.
    """
    spread = abs(p[0] - q[0]) + abs(p[1] - q[1]) + abs(p[2] - q[2])
    return p_squared - q_squared - 2 * half * spread > 1e-9 * half * half
