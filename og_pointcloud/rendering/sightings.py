"""How openly a view sees each point, and which of its masks the point lies in, along the point's own ray.

Blending (`splatting`) says how much of a pixel's light comes from each Gaussian. That makes an image; for the question
"what is this point?" it is the wrong way round: Gaussians large enough to close a surface bleed over its edges, smaller
ones let the background through. Here the size of a point serves occlusion alone. For point g, let

    openness_g = product of (1 - alpha_h) at the pixel of g, over all h more than ``thickness`` in front of g

with alpha_h as in 3DGS. The point votes with the weight of its openness, half for the mask at its pixel and half for
those around it, since the edges of masks are uncertain by a pixel or two. Points within ``thickness`` of each other
along a ray never hide each other, so all layers of a noisy surface are seen.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from og_pointcloud.kernels import get_num_threads, njit, prange
from og_pointcloud.rendering.splatting import (
    BATCH,
    CULLED,
    SPLAT,
    TILE,
    Gaussians,
    ascending,
    attenuate,
    binned_splats,
    has_light,
    tile_buffer,
)
from og_pointcloud.scene import NOT_SEEN, Camera

MIN_OPENNESS = 0.02
"""A point that less light reaches is hidden: what so few rays say is as often about an edge as about the point."""
EDGE_PX = 1.5
"""Edges of masks are uncertain by so many pixels: RING_SHARE of a vote goes to a ring so far around the pixel."""
RING_SHARE = 0.5
RING_PX = [(EDGE_PX * np.cos(angle), EDGE_PX * np.sin(angle)) for angle in np.arange(8) * np.pi / 4]
VOTE_SAMPLES = np.array([(0.0, 0.0, 1 - RING_SHARE), *((x, y, RING_SHARE / len(RING_PX)) for x, y in RING_PX)])
"""Right and down of a point, in pixels, and the share of its vote there."""
REACH_PX = int(np.ceil(EDGE_PX))
"""A sample lies in a pixel at most this far from the point's own."""
BLOCK_PX = 8
"""Side of a block of pixels. Inside one mask a point's vote is cast as a whole, elsewhere sample by sample."""


@dataclass(frozen=True)
class Sightings:
    """What one view shows of n points. rows: (masks + 1, n) sparse float32, openness by mask, the last row outside all
    masks. openness: (1, n) sparse float32, their sums, in (0, 1]."""

    rows: csr_array
    openness: csr_array


def sightings(
    gaussians: Gaussians,
    camera: Camera,
    ids: NDArray[np.int32],
    mask_count: int,
    near: float,
    thickness: NDArray[np.float32],
    selected: NDArray[np.bool_] | None = None,
) -> Sightings:
    """The masks that each point lies in, by how openly the view sees it.

    ids: (H, W) int32 in -1..mask_count-1, or NOT_SEEN, H and W the camera's; a view says nothing of points whose pixel
        is NOT_SEEN. near, thickness (n,): scene units.
    selected: (n,) bool, points that are looked up (all points hide others); None: all.
    """
    return sightings_of(*openness(gaussians, camera, near, thickness, selected), ids, mask_count)


def sightings_of(
    open_: NDArray[np.float32], u: NDArray[np.float32], v: NDArray[np.float32], ids: NDArray[np.int32], mask_count: int
) -> Sightings:
    """The masks that each point lies in, from the result of `openness`, or from a depth image: 1 for points that it
    measured, 0 for the others."""
    starts, columns, votes, seen = _votes(open_, u, v, ids, mask_count, VOTE_SAMPLES)
    return Sightings(
        csr_array((votes, columns, starts), shape=(mask_count + 1, len(open_))),
        csr_array((open_[seen], seen, [0, len(seen)]), shape=(1, len(open_))),
    )


def openness(
    gaussians: Gaussians,
    camera: Camera,
    near: float,
    thickness: NDArray[np.float32],
    selected: NDArray[np.bool_] | None = None,
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """(n,) float32 each: openness, 0 where a point is hidden, outside the image or not selected; and its place u, v in
    the image, pixels. Light is followed through the centers of pixels."""
    binned = binned_splats(gaussians, camera, near, thickness)
    n = len(gaussians)
    selected = np.ones(n, np.bool_) if selected is None else selected
    open_, u, v = (np.zeros(n, np.float32) for _ in range(3))
    size = np.array([camera.width, camera.height])
    _trace_openness(binned, size, selected, get_num_threads(), (open_, u, v))
    return open_, u, v


@njit(cache=True, parallel=True, nogil=True, error_model="numpy")
def _trace_openness(binned, size, selected, workers, seen):  # noqa: ANN001, ANN202
    """Writes openness and pixels, tile by tile: only the members of a center's tile can hide it.

    Light falls through the splats of a tile from front to back. A point is read off when all that lies before its
    surface has been drawn: so points are taken by the depth of their surface, splats by their own.
    """
    (splats, starts, members, columns), (open_, u, v) = binned, seen
    tiles = len(starts) - 1
    first, points = _centers(splats, size, columns, tiles, selected)
    # A worker takes every so-many-th tile. light: the transmittance of the tile's pixels so far, row by row.
    for worker in prange(workers):
        light, batch = tile_buffer(), np.empty(BATCH, SPLAT)
        for tile in range(worker, tiles, workers):
            left, top = tile % columns * TILE, tile // columns * TILE
            of_tile = points[first[tile] : first[tile + 1]]
            surface = np.empty(len(of_tile), np.float32)
            for k in range(len(of_tile)):
                surface[k] = splats[of_tile[k]].surface
            light[:] = np.float32(1)
            drawn, fetched, end = starts[tile], starts[tile], starts[tile + 1]
            for q in range(len(of_tile)):
                # Draw on until the next splat is no longer in front of this point's surface.
                while drawn < end:
                    if drawn == fetched:  # scattered in memory: fetched together, they do not wait for each other
                        if not has_light(light, np.float32(MIN_OPENNESS)):
                            end = drawn  # all remaining points are hidden
                            break
                        fetched = min(drawn + BATCH, end)
                        for k in range(drawn, fetched):
                            batch[k % BATCH] = splats[members[k]]
                    if not batch[drawn % BATCH]["depth"] < surface[q]:
                        break
                    attenuate(batch[drawn % BATCH], left, top, light)
                    drawn += 1
                s = splats[of_tile[q]]
                transmittance = light[(int(s.v) - top) * TILE + int(s.u) - left]
                if transmittance >= MIN_OPENNESS:
                    open_[s.gaussian], u[s.gaussian], v[s.gaussian] = transmittance, s.u, s.v


@njit(cache=True, nogil=True)
def _centers(splats, size, columns, tiles, selected):  # noqa: ANN001, ANN202
    """(first, rows): the splats of selected points with their center in tile t are rows[first[t] : first[t + 1]], by
    the depth of their surface."""
    # Positive floats sort as their bits do: depths are sorted by digits, all tiles at once.
    tile_of, keys = np.empty(len(splats), np.int32), np.full(len(splats), CULLED)
    first = np.zeros(tiles + 1, np.int64)
    for i in range(len(splats)):
        s = splats[i]
        if 0 <= s.u < size[0] and 0 <= s.v < size[1] and selected[s.gaussian]:
            tile_of[i] = int(s.v) // TILE * columns + int(s.u) // TILE
            keys[i] = np.float32(max(s.surface, 0)).view(np.uint32)  # nothing is drawn before a depth of 0
            first[tile_of[i] + 1] += 1
    first = np.cumsum(first)
    # Dealt out in order of depth, the points of each tile are in order of depth.
    fill, rows = first[:-1].copy(), np.empty(first[-1], np.int32)
    for i in ascending(keys):
        rows[fill[tile_of[i]]] = i
        fill[tile_of[i]] += 1
    return first, rows


@njit(cache=True, nogil=True)
def _votes(open_, u, v, ids, mask_count, samples):  # noqa: ANN001, ANN202
    """The openness of each point, shared among the masks at and around its pixel: (starts, columns, votes) of sparse
    rows (masks + 1, n); and the points that have a vote."""
    height, width = ids.shape
    inside = _within_masks(ids)
    # A point has at most one entry for each sample: room for all of them, as rows, columns and votes.
    most = np.count_nonzero(open_)
    seen = np.empty(most, np.int32)
    entries = np.empty((3, most * len(samples)), np.int32)
    rows, columns, votes = entries[0], entries[1], entries[2].view(np.float32)
    starts = np.zeros(mask_count + 2, np.int32)
    points, end = 0, 0
    for g in range(len(open_)):
        if open_[g] == 0:
            continue
        # A position just inside the image may be rounded onto its border in float32.
        column, row = min(int(u[g]), width - 1), min(int(v[g]), height - 1)
        if ids[row, column] == NOT_SEEN:
            continue
        seen[points] = g
        points += 1
        # Inside a mask, or far from any, all samples agree.
        if inside[row // BLOCK_PX, column // BLOCK_PX]:
            mask = ids[row, column] if ids[row, column] >= 0 else mask_count
            rows[end], columns[end], votes[end] = mask, g, _whole_vote(open_[g], samples)
            starts[mask + 1] += 1
            end += 1
            continue
        # Samples in the same mask add up to one entry. Those beyond the image are moved to its border.
        first = end
        for k in range(len(samples)):
            x = min(max(int(np.floor(u[g] + samples[k, 0])), 0), width - 1)
            y = min(max(int(np.floor(v[g] + samples[k, 1])), 0), height - 1)
            mask, entry = ids[y, x], first
            if mask < 0:
                mask = mask_count
            while entry < end and rows[entry] != mask:
                entry += 1
            if entry == end:
                rows[end], columns[end], votes[end] = mask, g, np.float32(0)
                starts[mask + 1] += 1
                end += 1
            votes[entry] += open_[g] * samples[k, 2]
    # A counting sort by row: points of a row stay in their order.
    starts = np.cumsum(starts).astype(np.int32)
    place = starts[:-1].copy()
    sorted_columns, sorted_votes = np.empty(end, np.int32), np.empty(end, np.float32)
    for e in range(end):
        sorted_columns[place[rows[e]]], sorted_votes[place[rows[e]]] = columns[e], votes[e]
        place[rows[e]] += 1
    return starts, sorted_columns, sorted_votes, seen[:points]


@njit(cache=True, nogil=True)
def _whole_vote(open_, samples):  # noqa: ANN001, ANN202
    """The sum of a vote's shares: bit for bit the same as where samples are added one by one."""
    vote = np.float32(0)
    for k in range(len(samples)):
        vote = np.float32(vote + open_ * samples[k, 2])
    return vote


@njit(cache=True, nogil=True)
def _within_masks(ids):  # noqa: ANN001, ANN202
    """(blocks, blocks) bool: blocks of pixels in which all samples of all points fall into one mask, or into none."""
    height, width = ids.shape
    # A block widened by REACH_PX holds all samples of its points. -1 and NOT_SEEN both mean no mask.
    one = np.ones((-(-height // BLOCK_PX), -(-width // BLOCK_PX)), np.bool_)
    for row in range(one.shape[0]):
        for column in range(one.shape[1]):
            top, left = max(row * BLOCK_PX - REACH_PX, 0), max(column * BLOCK_PX - REACH_PX, 0)
            mask = max(ids[top, left], -1)
            for y in range(top, min((row + 1) * BLOCK_PX + REACH_PX, height)):
                same = True
                for x in range(left, min((column + 1) * BLOCK_PX + REACH_PX, width)):
                    same &= max(ids[y, x], -1) == mask
                if not same:
                    one[row, column] = False
                    break
    return one
