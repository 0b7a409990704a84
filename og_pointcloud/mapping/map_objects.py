"""Objects of a growing map: tracks that get an id, leave with most of their points, and keep it when they come back."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.ask.boxes import Box, axis_aligned_box
from og_pointcloud.mapping.changes import Moved
from og_pointcloud.mapping.growing_map import GrowingMap
from og_pointcloud.mapping.likeness import MIN_LIKENESS, LikenessScale, Look
from og_pointcloud.mapping.presence import MAJORITY, MIN_LOST_SHARE, MIN_POINTS
from og_pointcloud.mapping.tracks import NO_TRACK


@dataclass(frozen=True)
class MapObject:
    """An object as currently known. place: (3,) median of its points, world coordinates. box: around them, aligned with
    the world's axes. state: "present"; "moved": present, but not where it was at first; "unseen": part of an earlier
    map, where no frame has looked since; "gone": place and box are its last ones. since: the stamp since which most of
    its points have been seen there, -inf for an earlier map's, inf for what left. last_seen: the stamp of the last
    frame that showed it."""

    id: int
    state: str
    place: NDArray[np.float64]
    box: Box
    points: int
    views: int
    since: float
    last_seen: float
    descriptor: NDArray[np.float64] | None = field(repr=False)


def objects_of(map_: GrowingMap) -> list[MapObject]:
    """By ascending id: objects that at least two frames have shown, and those that left."""
    objects = []
    for id_, k in sorted(map_.tracks.by_id().items()):
        track, rows = map_.tracks.tracks[k], map_.rows_of(k)
        if track.left:
            place, bounds, state = track.left.place, track.left.bounds, "gone"
        elif len(rows):
            place, bounds = map_.place_of(rows), map_.points.xyz[rows].astype(np.float64) + map_.origin
            looked_at = map_.presence.seen_at[rows].max() > -np.inf
            # Medians are no more certain than the points are dense.
            moved = track.home is not None and np.linalg.norm(place - track.home) > map_.points.edge
            state = "moved" if moved else "present" if looked_at else "unseen"
        else:
            continue
        # The median frame that brought its points: half of them were there by then.
        since = map_.stamp_of(int(np.median(map_.kept.born[rows]))) if len(rows) else np.inf
        objects.append(
            MapObject(
                id_, state, place, axis_aligned_box(bounds), len(rows), track.views, since, track.last_seen,
                track.descriptor,
            )
        )  # fmt: skip
    return objects


def remove_points(map_: GrowingMap, died: NDArray[np.int32], stamp: float) -> list[int]:
    """Remove points refuted by a frame of that stamp. Returns the ids of objects that left with them, as most of their
    points did."""
    owners = map_.votes.best(died, map_.tracks.root)
    map_.points.weight[died] = 0
    gone = []
    for k in np.unique(owners[owners >= 0]).tolist():
        track = map_.tracks.tracks[k]
        # Points that were measured again since are not lost: they had been removed by bad readings.
        lost = [row for row in track.lost if map_.points.weight[row] == 0]
        track.losing_since = track.losing_since if lost else stamp
        track.lost = lost + died[owners == k].tolist()
        if track.id >= 0 and len(track.lost) >= MIN_POINTS and _has_left(map_, k, stamp):
            gone.append(track.id)
    map_.forget(died)
    return sorted(gone)


def _has_left(map_: GrowingMap, k: int, stamp: float) -> bool:
    """Whether most of a track's visible points left; then the others leave too, at that stamp, except those measured
    since."""
    track, rows = map_.tracks.tracks[k], map_.rows_of(k)
    # Most of the points looked at since the first loss must be lost: points that no frame has looked at since are no
    # sign that the object is still there. And it must be a fair share of all points: a small part is not the whole.
    still = rows[(map_.presence.balance[rows] > 0) & (map_.presence.seen_at[rows] >= track.losing_since)]
    lost = len(track.lost)
    if lost <= max(MAJORITY * (lost + len(still)), MIN_LOST_SHARE * (lost + len(rows))):
        return False
    # Points that are still measured lie on the background that its masks had covered too: they stay, without votes, and
    # the look of the object is that of the others.
    leaving = np.setdiff1d(rows, still)
    gone = np.append(np.array(track.lost, np.int32), leaving)
    track.left, track.left_at, track.lost = _look(map_, k, gone), track.sequence, []
    track.left_anchor = int(np.bincount(map_.points.anchor[gone] + 1).argmax()) - 1
    map_.points.weight[leaving], seen_at = 0, map_.presence.seen_at
    seen_at[leaving] = np.maximum(seen_at[leaving], stamp)  # a late frame must not bring them back
    map_.forget(rows)
    return True


def assign_ids(
    map_: GrowingMap, new: list[int], again: list[int], gone: list[int]
) -> tuple[tuple[int, ...], tuple[Moved, ...]]:
    """Give ids to tracks that have become objects: the id of something that left, if they look like it, else the next
    one. Returns fresh ids, and what moved.

    An object may be seen at its new place, and get an id, before it is seen to be gone from the old one. So all objects
    are compared again when one leaves, and each one again whenever its number of views has doubled.
    """
    tracks, moved = map_.tracks.tracks, []
    doubled = (k for k in again if tracks[k].views & (tracks[k].views - 1) == 0)  # a power of two
    candidates = [*new, *(map_.tracks.by_id().values() if gone else doubled)]
    if candidates and any(track.left for track in tracks):
        scale = map_.tracks.likeness_scale()
        for k in candidates:
            if map_.tracks.root[k] == k and not tracks[k].left:  # by now it may be joined into another, or have left
                moved += _reidentified(map_, k, scale)
    ids = []
    for k in new:
        if map_.tracks.root[k] == k and tracks[k].id < 0:
            tracks[k].id, map_.tracks.next_id = map_.tracks.next_id, map_.tracks.next_id + 1
            ids.append(tracks[k].id)
    return tuple(ids), tuple(moved)


def _look(map_: GrowingMap, k: int, rows: NDArray[np.integer]) -> Look:
    """Appearance of a track, from some of its points."""
    descriptor = map_.tracks.tracks[k].descriptor
    descriptor = np.zeros((0, 1)) if descriptor is None else descriptor[None]
    xyz, rgb = map_.points.xyz[rows], map_.points.rgb[rows]
    spread = float(map_.tracks.spread()[k])
    return Look.of_points(descriptor.astype(np.float32), spread, map_.place_of(rows), xyz, map_.origin, rgb)


def _reidentified(map_: GrowingMap, k: int, scale: LikenessScale) -> list[Moved]:
    """Give a track the id of something that left, if that looks like it.

    Only its points that came after the other was last seen are compared. A track with hardly any such points stood here
    already. If masks had shown it before, most of its points must be such: otherwise it may only have been seen from
    another side since.
    """
    track, rows = map_.tracks.tracks[k], map_.rows_of(k)
    came, alike = {}, {}
    for old in map_.tracks.tracks:
        if old.left and old.id >= 0:
            came[old.id] = rows[map_.kept.born[rows] > old.left_at]
            share = MIN_LOST_SHARE if track.first > old.left_at else MAJORITY
            if len(came[old.id]) >= max(MIN_POINTS, share * len(rows)):
                alike[old.id] = scale.likeness(old.left, _look(map_, k, came[old.id]))
    best = max(alike, key=lambda old: (alike[old], -old), default=None)
    if best is None or alike[best] <= MIN_LIKENESS:
        return []
    gone = map_.tracks.tracks[map_.tracks.by_id()[best]]
    assert gone.left is not None
    moved = Moved(best, gone.left.place, map_.place_of(came[best]), best)
    # The id passes to this track; the old one, without points, is dropped at the next pruning.
    track.id, track.home, track.home_anchor = best, gone.home, gone.home_anchor
    if gone.home is None:
        track.home, track.home_anchor = gone.left.place, gone.left_anchor
    gone.id, gone.left = NO_TRACK, None
    return [moved]
