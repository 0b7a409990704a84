"""Overlapping proposals -> one id map at a level: small, medium or large.

Of proposals that nearly coincide, the one with the best score is kept. A mask that lies inside another is its child, so
masks form a forest. A level is a cut through the forest: a mask is used instead of its parts if its value, area times
score, is at least the best total value of its parts, times the level's `PARTS_WEIGHT`. A smaller weight cuts higher or
equally high everywhere, so a small mask lies in a medium one, which lies in a large one. Where masks of one level still
overlap, the one with the better score takes the pixels.

Everything is computed on atoms, the sets of pixels covered by the same masks: exact, and independent of the image's
size after one pass.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.masking.contracts import Proposals
from og_pointcloud.scene import DoubleArray, IntArray

PARTS_WEIGHT = {"small": 1.6, "medium": 1.0, "large": 0.6}
"""Level -> weight of the value of a mask's parts against its own: a higher weight favors parts, a lower wholes."""
SAME_IOU = 0.8
"""Two masks with a larger IoU are the same mask."""
INSIDE_SHARE = 0.9
"""A mask with more than this share of its area in a larger one is its child."""
VISIBLE_SHARE = 0.3
"""A mask is dropped if better ones leave less than this share of it visible."""


def masks_of_level(proposals: Proposals, level: str) -> tuple[IntArray, NDArray[np.intp]]:
    """(H, W) int32: -1 outside every mask of this level of `PARTS_WEIGHT`, else 0..K-1 by descending score; and (K,)
    the proposal of each id."""
    atom_of_pixel, member, area_px = _atoms(proposals.masks)
    order = np.lexsort((member @ area_px, -proposals.scores.astype(np.float64)))  # better first, then smaller
    member, scores = member[order], proposals.scores[order].astype(np.float64)
    # (M, M) pixels shared by each pair of masks; on the diagonal, areas.
    shared_px = (member * area_px) @ member.T.astype(np.float64)
    kept = _distinct(shared_px)
    member, scores, shared_px = member[kept], scores[kept], shared_px[np.ix_(kept, kept)]
    used = _cut(np.diag(shared_px), scores, _parents(shared_px), PARTS_WEIGHT[level])
    # Ids 0..K-1 of the masks that own an atom, best first, in the order of the masks.
    shown, ids = np.unique(_owners(member, area_px, used), return_inverse=True)
    ids = ids - (shown[:1] < 0).sum()  # -1, if present, is the first owner
    return ids.astype(np.int32)[atom_of_pixel], order[kept][shown[shown >= 0]]


def _atoms(masks: NDArray[np.bool_]) -> tuple[NDArray[np.intp], NDArray[np.bool_], DoubleArray]:
    """(H, W) the atom of each pixel; (M, atoms) which masks cover each atom; (atoms,) its area in pixels."""
    # Each mask gets a random number, a set of masks their sum: two sets collide about once in 2^63 draws.
    rng = np.random.default_rng(0)
    signature = np.zeros(masks.shape[1:], np.uint64)
    for mask in masks:
        signature[mask] += rng.integers(1 << 63, dtype=np.uint64)
    _, first, atom_of_pixel, area_px = np.unique(signature, return_index=True, return_inverse=True, return_counts=True)
    member = masks.reshape(len(masks), signature.size)[:, first]
    return atom_of_pixel.reshape(masks.shape[1:]), member, area_px.astype(np.float64)


def _distinct(shared_px: DoubleArray) -> NDArray[np.intp]:
    """Rows of the masks, best first, without empty ones and those that nearly coincide with an earlier one."""
    area_px = np.diag(shared_px)
    kept: list[int] = []
    for mask in np.flatnonzero(area_px > 0).tolist():
        shared = shared_px[mask, kept]
        if not (shared > SAME_IOU * (area_px[mask] + area_px[kept] - shared)).any():
            kept.append(mask)
    return np.array(kept, np.intp)


def _parents(shared_px: DoubleArray) -> NDArray[np.intp]:
    """(M,) the smallest larger mask that contains each, -1 for none."""
    area_px = np.diag(shared_px)
    parent = np.full(len(area_px), -1)
    for mask, area in enumerate(area_px):
        containers = np.flatnonzero((shared_px[mask] > INSIDE_SHARE * area) & (area_px > area))
        if len(containers):
            parent[mask] = containers[np.argmin(area_px[containers])]
    return parent


def _cut(area_px: DoubleArray, scores: DoubleArray, parent: NDArray[np.intp], parts_weight: float) -> NDArray[np.intp]:
    """The masks of one level, best first: none lies inside another in the forest. A whole wins a tie with its parts."""
    # parts: best total value of a mask's children. Children come first, as they are smaller.
    value, parts = area_px * scores, np.zeros(len(parent))
    used = np.zeros(len(parent), bool)
    upwards = np.argsort(area_px, kind="stable")  # a parent is larger
    for mask in upwards:
        used[mask] = value[mask] >= parts_weight * parts[mask]
        if parent[mask] >= 0:
            parts[parent[mask]] += max(value[mask], parts_weight * parts[mask])
    # From the roots down: nothing inside a used mask is used.
    covered = np.zeros(len(parent) + 1, bool)  # the last entry serves roots, whose parent is -1
    for mask in upwards[::-1]:
        used[mask] &= not covered[parent[mask]]
        covered[mask] = used[mask] or covered[parent[mask]]
    return np.flatnonzero(used)


def _owners(member: NDArray[np.bool_], area_px: DoubleArray, used: NDArray[np.intp]) -> NDArray[np.intp]:
    """(atoms,) the best of the used masks over each atom, -1 for none. Masks are numbered best first; one that better
    ones mostly hide owns nothing."""
    owner = np.full(member.shape[1], -1)
    for mask in used:
        free = member[mask] & (owner < 0)
        if area_px[free].sum() >= VISIBLE_SHARE * (member[mask] @ area_px):
            owner[free] = mask
    return owner
