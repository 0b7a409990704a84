"""How openly a view sees each point, and which of its masks the point lies in: along the point's own ray.

Blending (`splatting`) says how much of a pixel's light comes from each Gaussian. That is what an image is made of; for
the question "what is this point?" it is the wrong way round: Gaussians large enough to close a surface bleed over its
edges, smaller ones let the background through. Here the size of a point serves occlusion alone. Let, for point g,

    openness_g = product of (1 - alpha_h) at the pixel of g, over all h that lie more than ``thickness`` before g

with alpha_h as in 3DGS. The point's vote goes to the mask at its pixel, by its openness; half of it to those around the
pixel, since the edges of masks are uncertain by a pixel or two. Points within ``thickness`` of each other along a ray
never hide each other, so noisy surfaces of several layers are seen whole.
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
    CUTOFFS,
    SPLAT,
    TILE,
    Gaussians,
    ascending,
    binned_splats,
    dim,
    is_open,
    tile_buffer,
)
from og_pointcloud.scene import NOT_SEEN, Camera

LEAST_OPEN = 0.02
"""A point that less light reaches is hidden: what so few rays say is as often about an edge as about the point."""
EDGE_PX = 1.5
"""Edges of masks are uncertain by so many pixels: RING_SHARE of a vote goes to a ring so far around the pixel."""
RING_SHARE = 0.5
RING = [(EDGE_PX * np.cos(angle), EDGE_PX * np.sin(angle)) for angle in np.arange(8) * np.pi / 4]
SAMPLES = np.array([(0.0, 0.0, 1 - RING_SHARE), *((x, y, RING_SHARE / len(RING)) for x, y in RING)])
"""Right and down of a point, in pixels, and the share of its vote there."""
REACH_PX = int(np.ceil(EDGE_PX))
"""A sample lies in a pixel at most this far from the point's own."""
BLOCK = 8
"""Pixels along the side of a block. Amid one mask a point's vote is taken as a whole, elsewhere sample by sample."""


@dataclass(frozen=True)
class Sightings:
    """What one view shows of n points. rows: (masks + 1, n) sparse float32, openness by mask, last row outside of all
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
    asked: NDArray[np.bool_] | None = None,
) -> Sightings:
    """The masks that each point lies in, by how openly the view sees it.

    ids: (H, W) int32 in -1..mask_count-1, or NOT_SEEN, H and W the camera's; a view says nothing of points whose pixel
        is NOT_SEEN. near, thickness (n,): scene units.
    asked: (n,) bool, points that are looked at (all of them hide others); None: all.
    """
    return sightings_of(*openness(gaussians, camera, near, thickness, asked), ids, mask_count)


def sightings_of(
    open_: NDArray[np.float32], u: NDArray[np.float32], v: NDArray[np.float32], ids: NDArray[np.int32], mask_count: int
) -> Sightings:
    """The masks that each point lies in, by what `openness` answers, or by a depth image that says which points it
    measured: 1 for these, 0 for the others."""
    starts, columns, votes, seen = _votes(open_, u, v, ids, mask_count, SAMPLES)
    return Sightings(
        csr_array((votes, columns, starts), shape=(mask_count + 1, len(open_))),
        csr_array((open_[seen], seen, [0, len(seen)]), shape=(1, len(open_))),
    )


def openness(
    gaussians: Gaussians,
    camera: Camera,
    near: float,
    thickness: NDArray[np.float32],
    asked: NDArray[np.bool_] | None = None,
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """(n,) float32 each: openness, 0 where a point is hidden, outside the image or not asked; and where it is seen, in
    pixels (u, v). Light is followed through the centers of pixels."""
    binned = binned_splats(gaussians, camera, near, thickness, CUTOFFS)
    n = len(gaussians)
    asked = np.ones(n, np.bool_) if asked is None else asked
    open_, u, v = (np.zeros(n, np.float32) for _ in range(3))
    size = np.array([camera.width, camera.height])
    log2_least = np.float32(np.log2(CUTOFFS.alpha_min))
    _see(binned, size, asked, log2_least, get_num_threads(), (open_, u, v))
    return open_, u, v


@njit(cache=True, parallel=True, nogil=True, error_model="numpy")
def _see(binned, size, asked, log2_least, workers, seen):  # noqa: ANN001, ANN202
    """Writes what is seen, tile by tile: a center lies in one tile, whose members are all that can hide it.

    Light falls through the splats of a tile from front to back. A point is asked when all that lies before its surface
    has been drawn: so points are taken by the depth of their surface, splats by their own.
    """
    (splats, starts, members, columns), (open_, u, v) = binned, seen
    tiles = len(starts) - 1
    first, points = _centers(splats, size, columns, tiles, asked)
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
                    if drawn == fetched:  # they lie all over memory: fetched at once, they do not wait for each other
                        if not is_open(light, np.float32(LEAST_OPEN)):
                            end = drawn  # all that is still to be asked is hidden
                            break
                        fetched = min(drawn + BATCH, end)
                        for k in range(drawn, fetched):
                            batch[k % BATCH] = splats[members[k]]
                    if not batch[drawn % BATCH]["depth"] < surface[q]:
                        break
                    dim(batch[drawn % BATCH], left, top, log2_least, light)
                    drawn += 1
                s = splats[of_tile[q]]
                reaches = light[(int(s.v) - top) * TILE + int(s.u) - left]
                if reaches >= LEAST_OPEN:
                    open_[s.gaussian], u[s.gaussian], v[s.gaussian] = reaches, s.u, s.v


@njit(cache=True, nogil=True)
def _centers(splats, size, columns, tiles, asked):  # noqa: ANN001, ANN202
    """(first, rows): of splats whose points are asked, those with their center in tile t are rows[first[t] :
    first[t + 1]], by the depth of their surface."""
    # Positive floats sort as their bits do: depths are sorted by digits, all tiles at once.
    tile_of, keys = np.empty(len(splats), np.int32), np.full(len(splats), CULLED)
    first = np.zeros(tiles + 1, np.int64)
    for i in range(len(splats)):
        s = splats[i]
        if 0 <= s.u < size[0] and 0 <= s.v < size[1] and asked[s.gaussian]:
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
        # Rounded to float32, a place just inside the image may lie on its border.
        column, row = min(int(u[g]), width - 1), min(int(v[g]), height - 1)
        if ids[row, column] == NOT_SEEN:
            continue
        seen[points] = g
        points += 1
        # Amid a mask, or far from any, all samples say the same.
        if inside[row // BLOCK, column // BLOCK]:
            mask = ids[row, column] if ids[row, column] >= 0 else mask_count
            rows[end], columns[end], votes[end] = mask, g, _whole_vote(open_[g], samples)
            starts[mask + 1] += 1
            end += 1
            continue
        # Samples in the same mask add up to one entry. Beyond the image they are those of its border.
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
    """The shares of a vote added up: to the last bit what they add up to where they are looked at one by one."""
    vote = np.float32(0)
    for k in range(len(samples)):
        vote = np.float32(vote + open_ * samples[k, 2])
    return vote


@njit(cache=True, nogil=True)
def _within_masks(ids):  # noqa: ANN001, ANN202
    """(blocks, blocks) bool: the blocks of pixels about which there is one mask, or none, as far as any sample of a
    point in them."""
    height, width = ids.shape
    # A block, widened by REACH_PX: all pixels that a sample of its points may lie in. -1 and NOT_SEEN are both no mask.
    one = np.ones((-(-height // BLOCK), -(-width // BLOCK)), np.bool_)
    for row in range(one.shape[0]):
        for column in range(one.shape[1]):
            top, left = max(row * BLOCK - REACH_PX, 0), max(column * BLOCK - REACH_PX, 0)
            mask = max(ids[top, left], -1)
            for y in range(top, min((row + 1) * BLOCK + REACH_PX, height)):
                same = True
                for x in range(left, min((column + 1) * BLOCK + REACH_PX, width)):
                    same &= max(ids[y, x], -1) == mask
                if not same:
                    one[row, column] = False
                    break
    return one
