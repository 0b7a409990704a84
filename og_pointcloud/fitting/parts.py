"""Masks -> part-of relations of instances: what lies in another's masks as often as both are seen is a part of it.

A handle has masks of its own in some views, while most views show it within the mask of the mug. So, for instances
a and b, with A the mask table, over the views that see both and have a mask of b:

    held     views in which most of what shows of a lies in a mask of b
    a is a part of b where held / all of them is a majority, and some view shows a in a mask of its own

No mask is needed that no view has: a whole is always an instance too. Where masks never show the whole, or never the
part, nothing is said. Works alike for groups of masks and for the leaves of a codebook.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.fitting.learned.codebook import cluster_weights
from og_pointcloud.fitting.mask_table import MaskTable

__all__ = ["part_of"]

MOSTLY = 0.5
"""Of what a view shows of a part, more than this lies in one mask of the whole; of the views, more than this say so."""
SEEN_SHARE = 0.1
"""A view that shows less of an instance than this part of its typical view says nothing of it."""
FEWEST_VIEWS = 2
"""One view alone could be a mask that spilled over."""


def part_of(
    table: MaskTable, mask_instance: NDArray[np.int32], instance_ids: NDArray[np.int32], count: int
) -> NDArray[np.int32]:
    """(count,) int32: the instance that each is a part of, -1 none. No cycles: a whole has more points than its parts.

    mask_instance: (masks,) int32, the instance whose mask it is (`MaskGroups.group` or `Matching.mask_instance`), -1
    none. instance_ids: (n,) int32, below 0 none. Of several wholes the one that holds the part in most of the views is
    named, of equal ones the smallest: a handle is a part of the mug before it is one of the table.
    """
    whole = np.full(count, -1, np.int32)
    shown = cluster_weights(table.weights, instance_ids, count)
    seen = cluster_weights(table.outside, instance_ids, count)
    np.add.at(seen, table.mask_view, shown)
    sees = seen > SEEN_SHARE * _typical(seen)
    own_mask = np.zeros((count, len(seen)), bool)  # instance, view
    own_mask[mask_instance[mask_instance >= 0], table.mask_view[mask_instance >= 0]] = True

    within = (shown > MOSTLY * seen[table.mask_view]) & sees[table.mask_view]
    part_masks, parts = np.nonzero(within)
    owners = mask_instance[part_masks]
    apart = np.zeros(count, bool)
    apart[parts[owners == parts]] = True
    other = (owners >= 0) & (owners != parts)
    other &= sees[table.mask_view[part_masks], owners]
    held = np.zeros((count, count))
    np.add.at(held, (parts[other], owners[other]), 1)
    asked = sees.T.astype(np.float64) @ (own_mask.T & sees)

    size = np.bincount(instance_ids[instance_ids >= 0], minlength=count)
    share = held / np.maximum(asked, 1)
    candidate = (share > MOSTLY) & (held >= FEWEST_VIEWS) & apart[:, None] & (size[None] > size[:, None])
    for part in np.flatnonzero(candidate.any(axis=1)):
        wholes = np.flatnonzero(candidate[part])
        whole[part] = wholes[np.lexsort((wholes, size[wholes], -share[part, wholes]))[0]]
    return whole


def _typical(seen: NDArray[np.float64]) -> NDArray[np.float64]:
    """Per instance, the median over the views that show it at all."""
    shows = np.where(seen > 0, seen, np.nan)
    typical = np.zeros(seen.shape[1])
    known = (seen > 0).any(axis=0)
    typical[known] = np.nanmedian(shows[:, known], axis=0)
    return typical
