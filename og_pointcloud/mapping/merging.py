"""A later visit merged into a map: what left is removed, what came is added, what moved keeps its id.

Points of the map that are seen through are removed, and so are all points of what left, except those that are still
measured, such as the floor below it. Points of the visit are added where the map has none. What was not looked at stays
as it was.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from og_pointcloud.ask.labelled_scene import SceneLike, as_scene
from og_pointcloud.bundle.vocabulary import SceneWords, all_words, scene_words
from og_pointcloud.cloud import BACKGROUND, UNKNOWN_SPACE, UNOBSERVED, FeatureSpace, InstanceTable, LabelledCloud
from og_pointcloud.errors import SceneError
from og_pointcloud.fitting.fit import fit
from og_pointcloud.formats.capture import read_capture
from og_pointcloud.formats.colors import UNKNOWN_COLOR
from og_pointcloud.mapping.changes import SAME_SURFACE_SPACINGS, Changes, Comparison, compare_visits
from og_pointcloud.mapping.map_record import MapRecord, VisitEntry
from og_pointcloud.mapping.presence import MAJORITY, MIN_POINTS, Visit
from og_pointcloud.mapping.sight import MeasuredView, depth_views
from og_pointcloud.rendering.geometry import nearest_in
from og_pointcloud.scene import Scene
from og_pointcloud.settings import FitSettings

SAME_POINT_SPACINGS = 1.0
"""A point of the visit within this many spacings of a map point adds nothing to the map."""
MAX_CAMERAS = 2000
"""Number of cameras that a map remembers, the latest ones."""


@dataclass(frozen=True)
class Updated:
    """cloud: the map after the visit. changes: gone and unseen by ids of the map before it, new and moved by ids of the
    map after it; an id that occurs in both maps means the same thing in both."""

    cloud: LabelledCloud
    changes: Changes


def update(
    before: SceneLike,
    capture: Scene | str | Path,
    *,
    depth: Iterable[MeasuredView] | None = None,
    gaussians: str | Path | None = None,
    settings: FitSettings | None = None,
    progress: bool = True,
) -> Updated:
    """Merge a later capture of the same place, or of a part of it, into a map.

    capture: a folder, or a scene, in the map's world frame, with points of its own. depth: what its views measured, in
    the map's local frame (`sight.depth_views`); None: the folder's depth images, if there are any, else its points take
    the place of depth. gaussians: geometry to use instead of the folder's own. The map gets the folder's words too, and
    its word bank if it has none. FeatureSpaceError for masks of another encoder, SceneError for a capture that does not
    lie where the map does. The given map is not changed: the new one is a copy.

    >>> print(og.update(wall, scene, progress=False).changes)  # of `fit`'s example
    0 gone, 0 new, 0 moved, 0 not seen again
    """
    cloud = as_scene(before).cloud
    folder = capture if isinstance(capture, (str, Path)) else None
    if folder is not None:
        depth = depth_views(folder, cloud.origin) if depth is None else depth
        capture = read_capture(folder, gaussians=gaussians)
    if not isinstance(capture, Scene):
        raise SceneError(f"capture is a {type(capture).__name__}; expected a folder, or a Scene that was read from one")
    space = FeatureSpace(capture.feature_space, capture.feature_width)
    cloud.space.require(space, "masks of the capture")
    words = scene_words(space, capture=folder) if folder is not None else SceneWords()
    visit = words.added_to(fit(capture, settings, progress=progress))
    earlier, later = Visit(cloud), Visit.in_frame_of(cloud, visit, depth)
    return merge(earlier, later, compare_visits(earlier, later, progress=progress), capture.name)


def merge(
    earlier: Visit, later: Visit, found: Comparison, name: str, stamp: float | None = None,
    given: tuple[NDArray[np.int64], int] | None = None,
) -> Updated:  # fmt: skip
    """The map after a visit. stamp: of the visit; None: one more than the last one's. given: (later instances,) ids
    beyond the map's that they have already, below that none, and the next id after all that were given."""
    a, b = earlier.cloud, later.cloud
    stays, orphaned = _staying(earlier, found)
    given = (np.full(len(b.instances), -1), len(a.instances)) if given is None else given
    ids_of_later = _ids_of_later(earlier, later, stays, found, given)
    # Only those points of the visit are added that lie where the map has none (left): visits do not densify the map.
    adds = nearest_in(cKDTree(a.xyz[stays]), b.xyz)[0] > SAME_POINT_SPACINGS * a.spacing
    states = np.append(ids_of_later, [UNOBSERVED, BACKGROUND])  # -2 and -1 index the last two
    ids = np.concatenate([_relabelled(a, b, orphaned, states)[stays], states[b.instance_ids[adds]]]).astype(np.int32)
    changes = replace(found.changes, new=tuple(sorted({int(ids_of_later[k]) for k in found.changes.new})))
    record = MapRecord.of(a)
    stamp = record.visits[-1].stamp + 1 if stamp is None else stamp
    _record_visit(record, earlier, found, ids_of_later, VisitEntry(name, stamp, len(b.cameras)))

    def both(first: NDArray[Any] | None, second: NDArray[Any] | None) -> NDArray[Any] | None:
        return None if first is None or second is None else np.concatenate([first[stays], second[adds]])

    words = [cloud.vocabulary for cloud in (a, b) if cloud.vocabulary]
    colors = [np.full((len(cloud), 3), UNKNOWN_COLOR, np.uint8) if cloud.rgb is None else cloud.rgb for cloud in (a, b)]
    merged = replace(
        a,
        xyz=np.concatenate([a.xyz[stays], b.xyz[adds]]),
        instance_ids=ids,
        instances=joined(a.instances, b.instances, ids_of_later, ids),
        feature_space=b.feature_space if a.feature_space == UNKNOWN_SPACE else a.feature_space,
        rgb=None if a.rgb is None and b.rgb is None else both(*colors),
        certainty=both(a.certainty, b.certainty),
        vocabulary=all_words(*words) if len(words) == 2 else next(iter(words), None),
        word_bank=a.word_bank or b.word_bank,
        provenance=record.added_to(a.provenance),
        cameras=(*a.cameras, *b.cameras)[-MAX_CAMERAS:],
    )
    return Updated(merged, changes)


def _staying(earlier: Visit, found: Comparison) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """(n,) bool each over the map's points: those that stay; and those that stay although their instance left."""
    ids, still, through = earlier.cloud.instance_ids, found.evidence.still, found.evidence.through
    left, unseen = np.zeros((2, len(earlier.cloud.instances) + 2), bool)  # rows -2 and -1: unobserved and background
    left[[*found.changes.gone, *found.gone_pieces]] = True
    unseen[list(found.changes.unseen)] = True
    # If it is unknown whether an instance left, it keeps even the points that were seen through, unless these are a few
    # strays.
    unseen[:-2] &= earlier.count(through) >= MIN_POINTS
    return (~through | unseen[ids]) & (~left[ids] | still), left[ids] & still


def _ids_of_later(
    earlier: Visit, later: Visit, stays: NDArray[np.bool_], found: Comparison, given: tuple[NDArray[np.int64], int]
) -> NDArray[np.int64]:
    """(later instances,) their ids in the map: the old id for what moved or is back, a fresh one for what came, the id
    of most of its surface for what was there already, and a fresh one too for what the map did not know. given: as for
    `merge`; such an id counts as a fresh one."""
    count, (own, fresh) = len(earlier.cloud.instances), given
    on_map = (found.nearest >= 0) & stays[found.nearest]
    owners = earlier.cloud.instance_ids[found.nearest]
    on_none = np.where(owners == BACKGROUND, count, owners)  # gets its own column
    shared = later.overlap(np.where(on_map, on_none, UNOBSERVED), count + 1)
    best, most = (np.asarray(of).ravel() for of in (shared.argmax(axis=1), shared.max(axis=1).toarray()))
    was_there = (best < count) & (most >= MIN_POINTS) & (most > MAJORITY * shared.sum(axis=1))
    map_ids = np.where(was_there, best, -1)
    came = {moved.now: moved.id for moved in found.changes.moved} | found.back
    for k in range(len(map_ids)):
        # All pieces of a thing that came share one id: the one it had, if any, else the first piece's fresh one.
        thing = found.pieces.get(k)
        if thing is not None:
            map_ids[k] = came.get(thing, -1)
        if map_ids[k] < 0 and own[k] >= count:
            map_ids[k] = own[k]
        elif map_ids[k] < 0:
            map_ids[k], fresh = fresh, fresh + 1
        if thing is not None:
            came[thing] = int(map_ids[k])
    return map_ids


def _relabelled(
    a: LabelledCloud, b: LabelledCloud, orphaned: NDArray[np.bool_], states: NDArray[np.int64]
) -> NDArray[np.int64]:
    """(n,) ids of the map's points. Points that lost their instance, or were never seen, take the id of the visit's
    nearest point on the same surface."""
    ids = np.where(orphaned, BACKGROUND, a.instance_ids).astype(np.int64)
    unowned = np.flatnonzero(orphaned | (ids == UNOBSERVED))
    distance, nearest = nearest_in(cKDTree(b.xyz), a.xyz[unowned])
    on_surface = distance <= SAME_SURFACE_SPACINGS * a.spacing
    ids[unowned[on_surface]] = states[b.instance_ids[nearest[on_surface]]]
    return ids


def joined(
    a: InstanceTable, b: InstanceTable, ids_of_b: NDArray[np.integer], ids: NDArray[np.integer], count: int = 0
) -> InstanceTable:
    """Both tables as one: counts under one id add up, means are weighted by the number of masks.

    ids_of_b: (len(b),) new id of each instance of b; those of a keep theirs. ids: (n,) of all points. count: rows that
    the table has at least; those without an instance are empty.
    """
    count = max(len(a), count, int(ids_of_b.max(initial=-1)) + 1)
    owner = np.concatenate([np.arange(len(a)), ids_of_b])

    def total(one: NDArray[Any], other: NDArray[Any]) -> NDArray[np.float64]:
        return np.asarray(np.bincount(owner, np.concatenate([one, other]), count), np.float64)

    masks, none = total(a.masks, b.masks), np.full(count - len(a), -1, np.int32)
    rows, owners = _descriptors(a, b, ids_of_b, count)
    of_a, of_b = (table.masks * np.isfinite(table.reliability) for table in (a, b))
    known = total(of_a, of_b)
    reliability = total(of_a * np.nan_to_num(a.reliability), of_b * np.nan_to_num(b.reliability))
    coarse, part_of = np.concatenate([a.coarse, none]), np.concatenate([a.part_of, none])
    for k in np.flatnonzero(ids_of_b >= len(a)):  # those of a keep theirs
        new, above = ids_of_b[k], np.append(ids_of_b, -1)[b.part_of[k]]
        coarse[new] = -1 if b.coarse[k] < 0 else b.coarse[k] + a.coarse.max(initial=-1) + 1  # clusters of b alone
        # Several instances of b may be one now, which must not be a part of itself.
        lineage = [above]
        while lineage[-1] >= 0:
            lineage.append(part_of[lineage[-1]])
        if above >= 0 and new not in lineage:
            part_of[new] = above
    return InstanceTable(
        descriptors=rows,
        descriptor_instance=owners,
        points=np.bincount(ids[ids >= 0], minlength=count).astype(np.int32),
        views=total(a.views, b.views).astype(np.int32),
        masks=masks.astype(np.int32),
        agreement=(total(a.agreement * a.masks, b.agreement * b.masks) / np.maximum(masks, 1)).astype(np.float32),
        visible_area=total(a.visible_area, b.visible_area).astype(np.float32),
        coarse=coarse,
        part_of=part_of,
        reliability=np.where(known > 0, reliability / np.maximum(known, 1), np.nan).astype(np.float32),
    )


def _descriptors(
    a: InstanceTable, b: InstanceTable, ids_of_b: NDArray[np.integer], count: int
) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Descriptors of each id, and the id of each. One descriptor in the map and one in the visit become their mean,
    weighted by masks. If either has several, it is unknown which of them belong together: the map's stay, or the
    visit's where the map has none."""
    nothing = np.zeros((0, max(a.descriptors.shape[1], b.descriptors.shape[1])))
    of_id, weight = [nothing] * count, np.zeros(count)
    for table, ids in ((a, np.arange(len(a))), (b, ids_of_b)):
        for k, target in enumerate(ids.tolist()):
            rows = table.descriptors[table.descriptor_instance == k].astype(np.float64)
            if len(of_id[target]) == 0:
                of_id[target] = rows
            elif len(of_id[target]) == len(rows) == 1:
                mean = weight[target] * of_id[target] + table.masks[k] * rows
                of_id[target] = mean / max(float(np.linalg.norm(mean)), 1e-12)
            weight[target] += table.masks[k]
    owners = np.repeat(np.arange(count, dtype=np.int32), [len(rows) for rows in of_id])
    return np.concatenate([nothing, *(rows for rows in of_id if len(rows))]).astype(np.float32), owners


def _record_visit(
    record: MapRecord, earlier: Visit, found: Comparison, ids_of_later: NDArray[np.int64], entry: VisitEntry
) -> None:
    """Record what the visit saw. An instance that it did not look at, or that has left, keeps the time when it was last
    seen."""
    record.visits.append(entry)
    # Smaller pieces of what moved become rows without points too: the thing keeps the id of its largest piece.
    left = {*found.changes.gone, *(piece for piece, thing in found.gone_pieces.items() if piece != thing)}
    seen = earlier.count(found.evidence.still) >= MIN_POINTS
    seen[[*found.changes.unseen, *left]] = False  # of what left, some points lie on what stands there still
    for k in {*np.flatnonzero(seen).tolist(), *ids_of_later.tolist()}:
        record.last_seen[k] = entry.stamp
    for moved in found.changes.moved:
        record.moved_from[moved.id] = tuple(moved.before.tolist())
    for k in found.back.values():
        del record.gone[k]
    for k in left:
        record.gone[k] = earlier.look(k, earlier.rows[k])
