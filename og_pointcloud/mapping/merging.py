"""A later visit folded into a map: what left is taken out, what came is added, what moved keeps its id.

Points of the map that are seen through are removed, and all points of what left, but for those that are still measured:
the floor below it. Points of the visit are added where the map has none. What was not looked at stays as it was.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from og_pointcloud.ask.labelled_scene import SceneLike, as_scene
from og_pointcloud.cloud import BACKGROUND, UNOBSERVED, FeatureSpace, InstanceTable, LabelledCloud
from og_pointcloud.fitting.fit import fit
from og_pointcloud.mapping.changes import FEWEST_POINTS, MOST, Changes, Comparison, Moved, Visit, compare_visits
from og_pointcloud.mapping.likeness import recognized, typical_cosine
from og_pointcloud.mapping.map_record import MapRecord, Retired, VisitEntry
from og_pointcloud.mapping.sight import MeasuredView
from og_pointcloud.scene import Scene
from og_pointcloud.settings import FitSettings

__all__ = ["Updated", "merge", "update"]

SAME_PLACE = 1.0
"""Spacings within which a point of the visit adds nothing to the map."""
SAME_SURFACE = 1.5
"""Spacings within which two visits' points are of one surface."""
MOST_CAMERAS = 2000
"""Cameras that a map remembers; older ones are thinned evenly."""


@dataclass(frozen=True)
class Updated:
    """cloud: the map after the visit. changes: gone and unseen by their ids of before, new and moved by those of the
    new map; ids that both have mean the same thing."""

    cloud: LabelledCloud
    changes: Changes


def update(
    before: SceneLike,
    capture: Scene,
    *,
    depth: Iterable[MeasuredView] | None = None,
    settings: FitSettings | None = None,
    progress: bool = True,
) -> Updated:
    """Fold a later capture of the same place, or of a part of it, into a map.

    capture: in the map's world frame, with points of its own. depth: what its views measured, in the map's local frame
    (`sight.view_of_depth`); None: as its points show it. FeatureSpaceError for masks of another encoder, SceneError for
    a capture that does not lie where the map does; the map is never changed.

    >>> print(og.update(wall, scene, progress=False).changes)  # of `fit`'s example
    0 gone, 0 new, 0 moved, 0 not seen again
    """
    cloud = as_scene(before).cloud
    cloud.space.require(FeatureSpace(capture.feature_space, capture.feature_width), "masks of the capture")
    visit = fit(capture, settings, progress=progress)
    earlier, later = Visit(cloud), Visit.in_frame_of(cloud, visit, depth)
    return merge(earlier, later, compare_visits(earlier, later), capture.name)


def merge(earlier: Visit, later: Visit, found: Comparison, name: str, stamp: float | None = None) -> Updated:
    """The map after a visit. stamp: of the visit; None: one more than the last one's."""
    a, b = earlier.cloud, later.cloud
    record = MapRecord.of(a)
    stamp = record.visits[-1].stamp + 1 if stamp is None else stamp
    changes = _known_again(found.changes, earlier, later, found, record)
    stays, shared = _staying(earlier, later, changes, found)
    ids_of_later, fresh = _ids(earlier, later, stays, changes, found.pieces)
    numbered = replace(changes, new=tuple(sorted({int(ids_of_later[k]) for k in changes.new})))

    adds: NDArray[np.bool_] = np.ones(len(b), bool)
    if stays.any():
        adds = (
            np.asarray(cKDTree(earlier.cloud.xyz[stays]).query(later.cloud.xyz, workers=-1)[0]) > SAME_PLACE * a.spacing
        )
    states = np.append(ids_of_later, [UNOBSERVED, BACKGROUND])  # -2 and -1 index the last two
    ids = np.concatenate([_relabelled(earlier, later, shared, states)[stays], states[b.instance_ids[adds]]])
    table = _table(a.instances, b.instances, ids_of_later, ids, len(a.instances) + fresh)
    _note(record, earlier, later, numbered, found, ids_of_later, VisitEntry(name, stamp, len(b.cameras)))
    merged = replace(
        a,
        xyz=np.concatenate([a.xyz[stays], later.cloud.xyz[adds]]),
        instance_ids=ids.astype(np.int32),
        instances=table,
        rgb=_both(a.rgb, b.rgb, stays, adds),
        certainty=_both(a.certainty, b.certainty, stays, adds),
        provenance=record.added_to(a.provenance),
        cameras=(*a.cameras, *later.cloud.cameras)[-MOST_CAMERAS:],
    )
    return Updated(merged, numbered)


def _staying(
    earlier: Visit, later: Visit, changes: Changes, found: Comparison
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """(n,) bool each of the map's points: those that stay, and those of them that have lost what they were part of."""
    left = np.zeros(len(earlier.cloud.instances) + 2, bool)  # rows -2 and -1: unobserved and background
    left[[*changes.gone, *found.gone_pieces, *(moved.id for moved in changes.moved)]] = True
    of_left = left[earlier.cloud.instance_ids]
    still = found.of_earlier.still
    return ~found.of_earlier.through & (~of_left | still), of_left & still


def _ids(
    earlier: Visit, later: Visit, stays: NDArray[np.bool_], changes: Changes, pieces: dict[int, int]
) -> tuple[NDArray[np.int64], int]:
    """(later instances,) their ids in the map, and how many of these are fresh.

    What moved has its old id, what came a fresh one, what was there the id that most of its surface has; what the map
    did not know a fresh one too.
    """
    a, b = earlier.cloud, later.cloud
    known = np.full(len(b.instances), -1, np.int64)
    came = {**{moved.now: moved.id for moved in changes.moved}}
    distance, nearest = cKDTree(earlier.cloud.xyz).query(later.cloud.xyz, workers=-1)
    on_map = (distance <= SAME_SURFACE * a.spacing) & stays[nearest] & (a.instance_ids[nearest] != UNOBSERVED)
    owners = a.instance_ids[nearest]
    fresh = len(a.instances)
    for k in range(len(b.instances)):
        thing = pieces.get(k)
        if thing is not None and thing in came:
            known[k] = came[thing]
            continue
        rows = later.points_of(k)
        votes = np.bincount(owners[rows[on_map[rows]]] + 1, minlength=1)  # place 0: background
        best = int(votes.argmax()) - 1
        if thing is None and votes[best + 1] >= FEWEST_POINTS and best >= 0 and votes[best + 1] > MOST * votes.sum():
            known[k] = best
            continue
        known[k] = fresh
        if thing is not None:
            came[thing] = fresh
        fresh += 1
    return known, fresh - len(a.instances)


def _relabelled(
    earlier: Visit, later: Visit, shared: NDArray[np.bool_], states: NDArray[np.int64]
) -> NDArray[np.int64]:
    """(n,) ids of the map's points: what lost its instance, or had never been seen, is what the visit says of it."""
    ids = earlier.cloud.instance_ids.astype(np.int64)
    asked = np.flatnonzero(shared | (ids == UNOBSERVED))
    distance, nearest = cKDTree(later.cloud.xyz).query(earlier.cloud.xyz[asked], workers=-1)
    near = distance <= SAME_SURFACE * earlier.cloud.spacing
    ids[asked] = np.where(
        near, states[later.cloud.instance_ids[nearest]], np.where(shared[asked], BACKGROUND, ids[asked])
    )
    return ids


def _both(
    first: NDArray[np.uint8] | None, second: NDArray[np.uint8] | None, stays: NDArray[np.bool_], adds: NDArray[np.bool_]
) -> NDArray[np.uint8] | None:
    """A column of both clouds' points; None where one of them does not know it."""
    return None if first is None or second is None else np.concatenate([first[stays], second[adds]])


def _table(
    a: InstanceTable, b: InstanceTable, ids_of_later: NDArray[np.int64], ids: NDArray[np.int64], count: int
) -> InstanceTable:
    """The rows of both: evidence of one id adds up, and its descriptors count by their masks."""

    def summed(name: str) -> NDArray[np.float64]:
        column = np.zeros(count)
        column[: len(a)] = getattr(a, name)
        np.add.at(column, ids_of_later, getattr(b, name))
        return column

    masks = summed("masks")
    agreement = np.zeros(count)
    agreement[: len(a)] = a.agreement * a.masks
    np.add.at(agreement, ids_of_later, b.agreement * b.masks)
    rows, owners = _descriptors(a, b, ids_of_later, count)
    part_of = np.full(count, -1, np.int32)
    part_of[: len(a)] = a.part_of
    return InstanceTable(
        descriptors=rows,
        descriptor_instance=owners,
        points=np.bincount(ids[ids >= 0], minlength=count).astype(np.int32),
        views=summed("views").astype(np.int32),
        masks=masks.astype(np.int32),
        agreement=(agreement / np.maximum(masks, 1)).astype(np.float32),
        visible_area=summed("visible_area").astype(np.float32),
        coarse=np.concatenate([a.coarse, np.full(count - len(a), -1, np.int32)]),
        part_of=part_of,
    )


def _descriptors(
    a: InstanceTable, b: InstanceTable, ids_of_later: NDArray[np.int64], count: int
) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Rows of one id with one descriptor in each visit become their mean; others stay as the map, or the visit, has."""
    width = max(a.descriptors.shape[1], b.descriptors.shape[1])
    own = [a.descriptors[a.descriptor_instance == k].astype(np.float64) for k in range(len(a))]
    own += [np.zeros((0, width))] * (count - len(a))
    weight = np.concatenate([a.masks, np.zeros(count - len(a), np.int64)]).astype(np.float64)
    for k, target in enumerate(ids_of_later):
        rows = b.descriptors[b.descriptor_instance == k].astype(np.float64)
        if len(own[target]) == 0:
            own[target] = rows
        elif len(own[target]) == len(rows) == 1:
            mean = weight[target] * own[target] + b.masks[k] * rows
            own[target] = mean / max(float(np.linalg.norm(mean)), 1e-12)
        weight[target] += b.masks[k]
    owners = np.repeat(np.arange(count, dtype=np.int32), [len(rows) for rows in own])
    return np.concatenate([np.zeros((0, width)), *own]).astype(np.float32), owners


def _known_again(changes: Changes, earlier: Visit, later: Visit, found: Comparison, record: MapRecord) -> Changes:
    """The changes, with new things that look like a retired one as moved, from where that was last."""
    back: dict[int, Moved] = {}
    typical = typical_cosine(later.cloud.instances)
    retired = {k: entry.look(earlier.cloud.instances, k) for k, entry in record.gone.items()}
    for moved in changes.moved:
        retired.pop(moved.id, None)
    for k in changes.new:
        rows = later.points_of(k)
        rows = rows[found.of_later.through[rows]]
        if (old := recognized(later.look(k, rows), retired, typical)) is not None:
            del retired[old]
            back[k] = Moved(old, np.array(record.gone[old].place), later.cloud.xyz_world[rows].mean(axis=0), k)
    return replace(changes, new=tuple(k for k in changes.new if k not in back), moved=(*changes.moved, *back.values()))


def _retired(visit: Visit, instance: int) -> Retired:
    """How an instance looks that leaves the map."""
    rows = visit.points_of(instance)
    look, place = visit.look(instance, rows), visit.cloud.xyz_world[rows].mean(axis=0)
    return Retired(tuple(place.tolist()), look.length, None if look.color is None else tuple(look.color.tolist()))


def _note(
    record: MapRecord, earlier: Visit, later: Visit, changes: Changes, found: Comparison,
    ids_of_later: NDArray[np.int64], entry: VisitEntry,
) -> None:  # fmt: skip
    """Write into the record what the visit saw: an instance that was not looked at keeps its time."""
    record.visits.append(entry)
    looked_at = earlier.count(found.of_earlier.still) >= FEWEST_POINTS
    seen = {*np.flatnonzero(looked_at & ~np.isin(np.arange(len(looked_at)), changes.unseen)).tolist()}
    for k in seen | set(ids_of_later.tolist()):
        record.last_seen[int(k)] = entry.stamp
    for moved in changes.moved:
        record.moved_from[moved.id] = tuple(moved.before.tolist())
        record.gone.pop(moved.id, None)
    pieces = (k for k, thing in found.gone_pieces.items() if k != thing)
    for k in {*changes.gone, *pieces}:
        record.gone[k] = _retired(earlier, k)
