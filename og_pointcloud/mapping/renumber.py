"""Instance ids that stay: what the batch rule numbers by size gets the ids that the map has given already."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.cloud import InstanceTable, LabelledCloud

__all__ = ["matched_ids", "with_ids"]


def matched_ids(
    ids: NDArray[np.int32], count: int, known: NDArray[np.int32], known_count: int, first: int = 0
) -> tuple[NDArray[np.int64], int]:
    """(count,) the id that each instance gets, and how many ids there are then: that of the known object with which it
    shares most points, each given once; then fresh ones from known_count on.

    ids, known: (n,) instance and known object of each point, below 0 none. Instances below ``first`` keep their ids.
    """
    wanted = np.arange(count, dtype=np.int64)
    both = (ids >= first) & (known >= 0)
    pairs, shared = np.unique(ids[both].astype(np.int64) * known_count + known[both], return_counts=True)
    given, taken = set(), set(range(first))
    for pair in pairs[np.lexsort((pairs, -shared))].tolist():
        instance, owner = divmod(pair, known_count)
        if instance not in given and owner not in taken:
            wanted[instance] = owner
            given.add(instance)
            taken.add(owner)
    fresh = max(known_count, first)
    for instance in range(first, count):
        if instance not in given:
            wanted[instance], fresh = fresh, fresh + 1
    return wanted, fresh


def with_ids(cloud: LabelledCloud, wanted: NDArray[np.int64], count: int) -> LabelledCloud:
    """The cloud with instance k called wanted[k], in a table of ``count`` rows; rows without an instance are empty."""
    table = cloud.instances
    number = np.append(wanted, [-2, -1])  # states -2 and -1 index the last two
    order = np.argsort(wanted[table.descriptor_instance], kind="stable")

    def moved(name: str, empty: float) -> NDArray:
        column = np.full(count, empty, getattr(table, name).dtype)
        column[wanted] = getattr(table, name)
        return column

    part_of = np.full(count, -1, np.int32)
    part_of[wanted] = np.where(table.part_of >= 0, wanted[table.part_of], -1)
    renamed = InstanceTable(
        descriptors=table.descriptors[order],
        descriptor_instance=wanted[table.descriptor_instance][order].astype(np.int32),
        points=moved("points", 0),
        views=moved("views", 0),
        masks=moved("masks", 0),
        agreement=moved("agreement", 0),
        visible_area=moved("visible_area", 0),
        coarse=moved("coarse", -1),
        part_of=part_of,
        reliability=moved("reliability", np.nan),
    )
    return replace(cloud, instance_ids=number[cloud.instance_ids].astype(np.int32), instances=renamed)
