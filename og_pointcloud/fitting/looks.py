"""Groups of masks that show two things -> looks; each point of a group takes the look that most of its votes are for.

Masks of one extent are one group, whatever the encoder says of them (grouping.py): a couch that half of the views call
a suitcase stays whole, but its mean feature then fits neither. Where the masks of a group fall into two clearly
separate kinds, with enough masks of each, every point of the group takes the kind that more of its votes are for.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from og_pointcloud.fitting.association import directions, members_of, shown_of_instance
from og_pointcloud.fitting.grouping import cosines_within_views
from og_pointcloud.fitting.mask_table import MaskTable
from og_pointcloud.fitting.view_votes import ViewVotes

MIN_LOOK_MASKS = 4
"""A look has at least this many masks: fewer differ by chance, or are wrong."""


@dataclass(frozen=True)
class Looks:
    """look: (masks,) int32, the look of each mask, -1 none. group: (looks,) int32, the group of each look. A group's
    main look has the group's number; further looks are numbered after the last group."""

    look: NDArray[np.int32]
    group: NDArray[np.int32]


def looks_of_groups(table: MaskTable, group: NDArray[np.int32], ids: NDArray[np.int32], count: int) -> Looks:
    """The looks of ``count`` groups; nearly all groups have one.

    group: (masks,) int32, the group of each mask, -1 none. ids: (n,) int32, the group of each point, below 0 none.
    """
    shown = shown_of_instance(table, group, ids)
    features = directions(table.mask_features)
    described = features.any(axis=1)
    usable = (group >= 0) & (shown > 0) & described
    # The encoder's cosine of different things in this scene, so that no threshold depends on the encoder.
    cosines = cosines_within_views(features[described], table.mask_view[described])
    different_cosine = float(np.median(cosines)) if len(cosines) else 0.0
    look, owner = group.copy(), list(range(count))
    for index, members in enumerate(members_of(np.where(usable, group, -1), count)):
        # Kinds are split again as long as they hold two: three things take two splits.
        waiting = [members]
        kinds: list[NDArray[np.intp]] = []
        while waiting:
            masks = waiting.pop()
            second = _second_look(features[masks], shown[masks], different_cosine)
            if second is None:
                kinds.append(masks)
            else:
                waiting += [masks[second], masks[~second]]
        # The kind that shows most stays the group; the others get numbers of their own.
        kinds.sort(key=lambda masks: -shown[masks].sum())
        for masks in kinds[1:]:
            look[masks] = len(owner)
            owner.append(index)
    return Looks(look, np.array(owner, np.int32))


def by_look(votes: ViewVotes, ids: NDArray[np.int32], looks: Looks) -> NDArray[np.int32]:
    """(n,) int32: ids, with points of a group with several looks given the look that most of their votes are for, and
    the main look where votes are equal or there are none."""
    found = ids.copy()
    several = np.unique(looks.group[np.bincount(looks.group)[looks.group] > 1])
    for group in several.tolist():
        points = np.flatnonzero(ids == group)
        own_looks = np.flatnonzero(looks.group == group)  # ascending: the main look, with the group's number, is first
        shares = [
            np.asarray(csr_array(votes.in_mask[np.flatnonzero(looks.look == look)])[:, points].sum(axis=0)).ravel()
            for look in own_looks
        ]
        found[points] = own_looks[np.argmax(shares, axis=0)]
    return found


def _second_look(
    features: NDArray[np.float64], weight: NDArray[np.float64], different_cosine: float
) -> NDArray[np.bool_] | None:
    """(masks,) bool, masks of the second of two clearly separate kinds; None, as for most groups, where there is one.

    2-means on the sphere, started from the least alike pair. The kinds are separate if the cosine of masks of different
    kinds is nearer to that of different things (``different_cosine``) than to that of masks of one kind. All are
    medians over pairs, as single masks may be wrong; fewer than MIN_LOOK_MASKS wrong masks are outliers, not a look.
    """
    if len(features) < 2 * MIN_LOOK_MASKS:
        return None
    cosines = features @ features.T
    centers = features[list(np.unravel_index(cosines.argmin(), cosines.shape))]  # the pair that is least alike
    second = features @ centers[1] > features @ centers[0]
    for _ in range(len(features)):  # converges in a few rounds
        centers = directions(np.stack([weight[~second] @ features[~second], weight[second] @ features[second]]))
        before, second = second, features @ centers[1] > features @ centers[0]
        if (before == second).all():
            break
    if min(second.sum(), (~second).sum()) < MIN_LOOK_MASKS:
        return None
    # Halfway between one kind and different things; a third or two thirds of the way label scenes as well.
    same = second[:, None] == second
    within, across = np.median(cosines[same & ~np.eye(len(features), dtype=bool)]), np.median(cosines[~same])
    return second if across < (within + different_cosine) / 2 else None
