"""Objects of a growing map: tracks that get an id, leave with most of their points, and keep it when they come back."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.ask.boxes import Box, axis_aligned_box
from og_pointcloud.mapping.changes import Moved
from og_pointcloud.mapping.growing_map import GrowingMap
from og_pointcloud.mapping.likeness import ALIKE, Look, Scale
from og_pointcloud.mapping.presence import FEWEST_POINTS, FLAT_SHARE, MOST
from og_pointcloud.mapping.tracks import NO_TRACK


@dataclass(frozen=True)
class MapObject:
    """An object as it is known now. place: (3,) median of its points, world coordinates; box: around them, along the
    world's axes. state: "present"; "moved": present, but not where it was at first; "unseen": part of an earlier map,
    where no frame has looked since; "gone": place and box are those it had last. since: the stamp from which on most of
    its points have been seen there, -inf for those of an earlier map, inf for what left; last_seen: the stamp of the
    last frame that showed it."""

    id: int
    state: str
    place: NDArray[np.float64]
    box: Box
    points: int
    views: int
    since: float
    last_seen: float
    descriptor: NDArray[np.float64] | None = field(repr=False)


def objects_of(known: GrowingMap) -> list[MapObject]:
    """In the order of ids: objects that two frames or more have shown, and those that left."""
    objects = []
    for id_, k in sorted(known.tracks.by_id().items()):
        track, rows = known.tracks.tracks[k], known.rows_of(k)
        if track.left:
            place, bounds, state = track.left.place, track.left.bounds, "gone"
        elif len(rows):
            place, bounds = known.place_of(rows), known.points.xyz[rows].astype(np.float64) + known.origin
            looked_at = known.presence.seen_at[rows].max() > -np.inf
            state = "moved" if track.moved else "present" if looked_at else "unseen"
        else:
            continue
        # Half of its points have come by the median of the frames that brought them.
        since = known.stamp_of(int(np.median(known.kept.born[rows]))) if len(rows) else np.inf
        objects.append(
            MapObject(
                id_, state, place, axis_aligned_box(bounds), len(rows), track.views, since, track.last_seen,
                track.descriptor,
            )
        )  # fmt: skip
    return objects


def leave(known: GrowingMap, died: NDArray[np.int32], stamp: float) -> list[int]:
    """Remove points that must leave after a frame of that stamp. Returns the ids of objects that left with them, as
    most of their points did."""
    owners = known.votes.best(died, known.tracks.root)
    known.points.weight[died] = 0
    gone = []
    for k in np.unique(owners[owners >= 0]).tolist():
        track = known.tracks.tracks[k]
        # Points that were measured again since then are not lost: readings that were off had removed them.
        lost = [row for row in track.lost if known.points.weight[row] == 0]
        track.losing_since = track.losing_since if lost else stamp
        track.lost = lost + died[owners == k].tolist()
        if track.id >= 0 and len(track.lost) >= FEWEST_POINTS and _has_left(known, k):
            gone.append(track.id)
    known.forget(died)
    return sorted(gone)


def _has_left(known: GrowingMap, k: int) -> bool:
    """Whether most of a track's visible points left; then its others leave too, but for those measured since."""
    track, rows = known.tracks.tracks[k], known.rows_of(k)
    # Lost must be most of what was looked at since the first point was lost: what no frame has looked at since is no
    # sign that the object is still there. And it must be a fair share of all its points: a small part is not the whole.
    still = rows[(known.presence.odds[rows] > 0) & (known.presence.seen_at[rows] >= track.losing_since)]
    lost = len(track.lost)
    if lost <= max(MOST * (lost + len(still)), FLAT_SHARE * (lost + len(rows))):
        return False
    # Points that are still measured lie on what it stood before and its masks had covered too: they stay, without
    # votes, and how the object looked is told by the others.
    leaving = np.setdiff1d(rows, still)
    gone = np.append(np.array(track.lost, np.int32), leaving)
    track.left, track.left_at, track.lost = _look(known, k, gone), track.sequence, []
    known.points.weight[leaving] = 0
    known.forget(rows)
    return True


def name(
    known: GrowingMap, new: list[int], again: list[int], gone: list[int]
) -> tuple[tuple[int, ...], tuple[Moved, ...]]:
    """Give ids to tracks that are objects now: the id of something that left, if it looks like that, else the next one.
    Returns fresh ids, and what moved.

    An object may be seen at its new place, and be named, before it is seen to be gone from the old one. So all objects
    are compared again when one leaves, and each one again whenever its number of views has doubled.
    """
    tracks, moved = known.tracks.tracks, []
    doubled = (k for k in again if tracks[k].views & (tracks[k].views - 1) == 0)  # a power of two
    asked = [*new, *(known.tracks.by_id().values() if gone else doubled)]
    if asked and any(track.left for track in tracks):
        scale = known.tracks.scale()
        for k in asked:
            if known.tracks.root[k] == k and not tracks[k].left:  # by now it may be joined into another, or have left
                moved += _returned(known, k, scale)
    ids = []
    for k in new:
        if known.tracks.root[k] == k and tracks[k].id < 0:
            tracks[k].id, known.tracks.next_id = known.tracks.next_id, known.tracks.next_id + 1
            ids.append(tracks[k].id)
    return tuple(ids), tuple(moved)


def _look(known: GrowingMap, k: int, rows: NDArray[np.integer]) -> Look:
    """How a track looks, by some of its points."""
    descriptor = known.tracks.tracks[k].descriptor
    descriptor = np.zeros((0, 1)) if descriptor is None else descriptor[None]
    xyz, rgb = known.points.xyz[rows], known.points.rgb[rows]
    spread = float(known.tracks.spread()[k])
    return Look.of_points(descriptor.astype(np.float32), spread, known.place_of(rows), xyz, known.origin, rgb)


def _returned(known: GrowingMap, k: int, scale: Scale) -> list[Moved]:
    """Give a track the id of what left, if anything that left looks like it.

    Only its points that came after the other was last seen are compared. A track with hardly any such points stood here
    already. If masks had shown it before, most of its points must be such: else it may only have been seen from another
    side since.
    """
    track, rows = known.tracks.tracks[k], known.rows_of(k)
    came, alike = {}, {}
    for old in known.tracks.tracks:
        if old.left and old.id >= 0:
            came[old.id] = rows[known.kept.born[rows] > old.left_at]
            share = FLAT_SHARE if track.first > old.left_at else MOST
            if len(came[old.id]) >= max(FEWEST_POINTS, share * len(rows)):
                alike[old.id] = scale.likeness(old.left, _look(known, k, came[old.id]))
    best = max(alike, key=lambda old: (alike[old], -old), default=None)
    if best is None or alike[best] <= ALIKE:
        return []
    gone = known.tracks.tracks[known.tracks.by_id()[best]]
    assert gone.left is not None
    moved = Moved(best, gone.left.place, known.place_of(came[best]), best)
    # The id goes over to this track; the old one, without points, is let go at the next pruning.
    gone.id, gone.left, track.id, track.moved = NO_TRACK, None, best, True
    return [moved]
