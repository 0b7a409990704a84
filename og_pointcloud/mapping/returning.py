"""What left on an earlier visit and comes back: a new thing that looks like a retired one of the map is that one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from og_pointcloud.mapping.changes import Changes, Comparison, Moved, Visit
from og_pointcloud.mapping.likeness import ALIKE, Look, likeness, look_of, typical_cosine
from og_pointcloud.mapping.map_record import MapRecord, Retired

__all__ = ["known_again", "retire"]


def retire(visit: Visit, instance: int) -> Retired:
    """How an instance looks that leaves the map."""
    rows = visit.points_of(instance)
    look = visit.look(instance, rows)
    place = visit.cloud.xyz_world[rows].mean(axis=0)
    return Retired(tuple(place.tolist()), look.length, None if look.color is None else tuple(look.color.tolist()))


def known_again(changes: Changes, earlier: Visit, later: Visit, found: Comparison, record: MapRecord) -> Changes:
    """The changes, with new things that look like a retired one as moved, from where that was last."""
    back: dict[int, Moved] = {}
    typical = typical_cosine(later.cloud.instances)
    taken = {moved.id for moved in changes.moved}
    for k in changes.new:
        rows = later.points_of(k)
        rows = rows[found.of_later.through[rows]]
        look = later.look(k, rows)
        alike = {old: likeness(_look(earlier, old, entry), look, typical) for old, entry in record.gone.items()}
        best = max((old for old in alike if old not in taken), key=lambda old: (alike[old], -old), default=None)
        if best is not None and alike[best] > ALIKE:
            place = later.cloud.xyz_world[rows].mean(axis=0)
            back[k] = Moved(best, np.array(record.gone[best].place), place, k)
            taken.add(best)
    return replace(changes, new=tuple(k for k in changes.new if k not in back), moved=(*changes.moved, *back.values()))


def _look(visit: Visit, instance: int, entry: Retired) -> Look:
    color = None if entry.color is None else np.array(entry.color)
    kept = look_of(visit.cloud.instances, instance, np.zeros((1, 3), np.float32), None)
    return replace(kept, color=color, length=entry.length)
