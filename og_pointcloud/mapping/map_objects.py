"""Objects of a growing map: tracks that get an id, leave with most of their points, and are known when they return."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.mapping.changes import FEWEST_POINTS, MOST, Moved
from og_pointcloud.mapping.growing_map import GrowingMap
from og_pointcloud.mapping.likeness import Look, recognized, typical_cosine
from og_pointcloud.mapping.tracks import Left, Track

__all__ = ["MapObject", "leave", "name", "objects_of"]


@dataclass(frozen=True)
class MapObject:
    """An object as it is known now. place: (3,) mean of its points, world coordinates; size: (3,) along the axes.
    state: "present"; "moved", present where it was not at first; "unseen", of an earlier map, where no frame has looked
    since; or "gone", then where it was last. last_seen: the stamp."""

    id: int
    state: str
    place: NDArray[np.float64]
    size: NDArray[np.float64]
    points: int
    views: int
    last_seen: float
    descriptor: NDArray[np.float64] | None = field(repr=False)


def objects_of(known: GrowingMap) -> list[MapObject]:
    """By id: objects that two frames or more have shown, and those that left."""
    found = []
    for id_, k in sorted(known.tracks.by_id().items()):
        track, rows = known.tracks.tracks[k], known.rows_of(k)
        if track.left:
            place, size, state = track.left.place, track.left.size, "gone"
        elif len(rows):
            size, place = np.ptp(known.points.xyz[rows].astype(np.float64), axis=0), known.place_of(rows)
            looked_at = known.presence.seen_at[rows].max() > -np.inf
            state = "moved" if track.moved else "present" if looked_at else "unseen"
        else:
            continue
        found.append(MapObject(id_, state, place, size, len(rows), track.views, track.last_seen, track.descriptor))
    return found


def leave(known: GrowingMap, died: NDArray[np.int32], stamp: float) -> list[int]:
    """Remove points that a frame of that stamp saw through; the ids of objects that left with most of theirs."""
    if len(died) == 0:
        return []
    owners = known.votes.best(died, known.tracks.root)
    known.points.weight[died] = 0
    gone = []
    for k in np.unique(owners[owners >= 0]).tolist():
        track = known.tracks.tracks[k]
        if not track.lost:
            track.losing_since = stamp
        track.lost.extend(died[owners == k].tolist())
        if track.id >= 0 and len(track.lost) >= FEWEST_POINTS and _has_left(known, k):
            gone.append(track.id)
    known.forget(died)
    return sorted(gone)


def _has_left(known: GrowingMap, k: int) -> bool:
    """Whether most of a track's visible points left; then the others leave too, but for what was measured since."""
    track = known.tracks.tracks[k]
    rows = known.rows_of(k)
    still = rows[known.presence.odds[rows] > 0]
    if len(track.lost) <= MOST * (len(track.lost) + len(still)):
        return False
    every = np.concatenate([np.array(track.lost, np.int32), rows])
    size = np.ptp(known.points.xyz[every].astype(np.float64), axis=0)
    track.left, track.lost = Left(_look(known, track, every), known.place_of(every), size, track.sequence), []
    known.points.weight[np.setdiff1d(rows, still[known.presence.seen_at[still] >= track.losing_since])] = 0
    known.forget(rows)
    return True


def name(known: GrowingMap, new: list[int], gone: list[int]) -> tuple[tuple[int, ...], tuple[Moved, ...]]:
    """Ids for tracks that are objects now: of something that left, if it looks so, else the next one. And what left
    just now may be an object already that was named since it was last seen where it stood."""
    if not new and not gone:
        return (), ()
    tracks, by_id = known.tracks.tracks, known.tracks.by_id()
    anything_left = any(track.left for track in tracks)
    since = min((tracks[by_id[old]].last_seen for old in gone if old in by_id), default=np.inf)
    ids, moved = [], []
    for k in (*new, *(k for k in by_id.values() if tracks[k].named_at >= since)):
        track = tracks[k]
        if known.tracks.root[k] != k or track.left or (k in new and track.id >= 0):
            continue
        rows = known.rows_of(k) if anything_left else np.zeros(0, np.int32)
        old = _recognized(known, track, rows) if len(rows) >= FEWEST_POINTS else None
        if old is not None:
            moved.append(_returned(known, old, track, rows))
        elif track.id < 0:
            track.id, track.named_at = known.tracks.next_id, known.stamp
            known.tracks.next_id += 1
            ids.append(track.id)
    return tuple(ids), tuple(moved)


def _look(known: GrowingMap, track: Track, rows: NDArray[np.integer]) -> Look:
    """How a track looks, by some of its points."""
    descriptor = np.zeros((0, 1)) if track.descriptor is None else track.descriptor[None]
    xyz, rgb = known.points.xyz[rows], known.points.rgb[rows]
    return Look.of_points(descriptor.astype(np.float32), track.spread, xyz, rgb)


def _recognized(known: GrowingMap, track: Track, rows: NDArray[np.integer]) -> int | None:
    """The id of what left and looks like a track of these points, if anything does. What stood here already when the
    other was still seen there is not it."""
    tracks = [t for t in known.tracks.tracks if t.id >= 0 and t.descriptor is not None]
    descriptors, spread = np.array([t.descriptor for t in tracks]), np.array([t.spread for t in tracks])
    typical = typical_cosine(descriptors, np.arange(len(tracks)), spread) if tracks else 0.0
    came = float(np.median(known.kept.born[rows]))
    left = {t.id: t.left.look for t in known.tracks.tracks if t.left and t.left.sequence < came}
    return recognized(_look(known, track, rows), left, typical)


def _returned(known: GrowingMap, old: int, track: Track, rows: NDArray[np.int32]) -> Moved:
    """Give a track the id of what left."""
    gone = known.tracks.tracks[known.tracks.by_id()[old]]
    assert gone.left is not None
    before = gone.left.place
    gone.id, gone.left, track.id, track.moved = -1, None, old, True
    return Moved(old, before, known.place_of(rows), old)
